"""What fits of state-space models with latent signals cost, one thread.

    python benchmarks/state_space_speed.py

Printed are CPU microseconds a sample of one linearisation, without and with J'J, of models of several sizes; the CPU
seconds of descents of 1,000 samples from known starts, two tanks in a row and an ill-conditioned model of the same
size, of a Hammerstein fit with four inputs and four outputs, and of
a first fit in a fresh process without compiled code.
"""

import os
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from state_space import slow_input, tanks

import optid
from optid.bases import BSpline
from optid.data.channels import Transform
from optid.identify.prediction_error.descent import descend
from optid.identify.prediction_error.state_errors import StateErrors
from optid.statistics.expansion import expand
from optid.statistics.state_unknowns import Latent, StatePoint, StateUnknowns, beyond_affine

SIZES = ((2, 1, 1, 1), (4, 1, 1, 2), (6, 1, 1, 1), (8, 4, 4, 4))
"""States, inputs, outputs, latent signals."""

FIRST = """
import time
import numpy as np
import optid
rng = np.random.default_rng(0)
u, x, y = rng.uniform(-1, 1, 1000), 0.0, np.zeros(1000)
for k in range(1000):
    y[k] = x
    x = 0.8 * x - 0.1 * x**2 + 0.5 * u[k]
started = time.process_time()
optid.fit(optid.Data(u, y + 0.01 * rng.normal(size=1000)), "lfr.exact", nx=1, latent="states")
print(time.process_time() - started)
"""


def model(n: int, m: int, l: int, latent: int, samples: int) -> tuple[StateErrors, np.ndarray]:  # noqa: E741
    """Return the criterion of a random stable model with latent signals on its own noisy record, and a near point."""
    rng = np.random.default_rng(0)
    basis: Any = BSpline(4, interval=(-1.0, 1.0), outside="linear")
    u = rng.uniform(-1, 1, (samples, m))
    one = Latent(basis, beyond_affine(basis), direct=True)
    expansion = expand(optid.Data(u, rng.normal(size=(samples, l))), "linear")
    unknowns = StateUnknowns(n, expansion, 1, (True,) * m, latent=(one,) * latent)
    point = StatePoint(
        np.diag(np.linspace(0.3, 0.9, n)), rng.normal(size=(l, n)), np.zeros((n, l)), np.zeros(l), (np.ones(1),) * m,
        rng.normal(size=(n, m)) / n, rng.normal(size=(l, m)), (), np.zeros((n, 0)), np.zeros((1, n)),
        tuple(rng.normal(size=one.size) for _ in range(latent)), 0.02 * rng.normal(size=(n, latent)),
        0.02 * rng.normal(size=(l, latent)), 0.2 * rng.normal(size=(latent, n)), 0.1 * rng.normal(size=(latent, m)),
        np.zeros(latent))
    errors = StateErrors(optid.Data(u, rng.normal(size=(samples, l))), unknowns, np.eye(l), Transform.identity(m, l))
    x = errors.normalise(unknowns.pack(point))
    y = np.asarray(errors.at(unknowns.unpack(x)).simulate(errors.data, x0=np.zeros(n)))
    record = optid.Data(u, y + 0.01 * y.std() * rng.normal(size=y.shape))
    return replace(errors, data=record), x * (1 + 0.01 * rng.normal(size=x.size))


def linearisation(size: tuple[int, int, int, int], samples: int = 20_000) -> tuple[float, float]:
    """CPU microseconds a sample of the sensitivities, and of these with J'J; the best of five."""
    errors, x = model(*size, samples)
    blocks, spent = errors.rows(x), np.empty((6, 2))
    for row in spent:
        started = time.process_time()
        for _ in blocks(0):
            pass
        between = time.process_time()
        errors.linearise(x, "gram")
        row[:] = between - started, time.process_time() - between
    first, second = 1e6 * spent[1:].min(axis=0) / samples
    return float(first), float(second)


def two_tanks(samples: int = 1000) -> tuple[StateErrors, np.ndarray]:
    """The errors of a model with two latent signals on a record of two tanks, and a point 1 % off its optimum."""
    rng = np.random.default_rng(0)
    u = slow_input(rng, samples)
    y = tanks(rng)(u)
    record = optid.Data(u, y + 0.01 * y.std() * rng.normal(size=y.shape))
    compressed = optid.fit(record, "lfr.exact", nx=2, channels=2).problem.compressed
    return compressed.criterion, compressed.reference * (1 + 0.01 * rng.normal(size=compressed.reference.size))


def hammerstein(samples: int = 7000) -> tuple[float, str]:
    """CPU seconds and status of a Hammerstein fit with four inputs, outputs and states."""
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (samples, 4))
    f = u + 0.5 * u**2 - 0.3 * u**3
    a, b, c = np.diag([0.9, 0.8, 0.6, 0.3]), rng.normal(size=(4, 4)), rng.normal(size=(4, 4))
    x, y = np.zeros(4), np.zeros((samples, 4))
    for k in range(samples):
        y[k] = c @ x
        x = a @ x + b @ f[k]
    record = optid.Data(u, y + 0.05 * y.std(axis=0) * rng.normal(size=y.shape))
    started = time.process_time()
    fit = optid.fit(record, "hammerstein_ss.exact", nx=4)
    return time.process_time() - started, fit.solution.status.value


def first_fit() -> float:
    """CPU seconds of a fit in a fresh process that compiles."""
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.run([sys.executable, "-W", "ignore", "-c", FIRST], capture_output=True, text=True, check=True,
                             env={**os.environ, "NUMBA_CACHE_DIR": folder})
    return float(run.stdout)


def main() -> None:
    """Print the figures."""
    warnings.simplefilter("ignore")
    for size in SIZES:
        alone, whole = linearisation(size)
        print(f"linearisation, (n, m, l, latent) = {size}: {alone:.2f} us a sample, with J'J {whole:.2f}", flush=True)
    for name, (errors, x) in {"two tanks": two_tanks(), "ill-conditioned": model(2, 1, 1, 2, 1000)}.items():
        for _ in range(3):  # the first one loads compiled code
            started = time.process_time()
            end = descend(errors, x)
            spent = time.process_time() - started
        print(f"descent, 1000 samples, {name}: {spent:.3f} CPU s, {end.steps} steps {end.reason}", flush=True)
    spent, status = hammerstein()
    print(f"Hammerstein 4 x 4, 7000 samples: {spent:.2f} CPU s, {status}", flush=True)
    print(f"first fit in a fresh process: {first_fit():.1f} CPU s", flush=True)


if __name__ == "__main__":
    main()

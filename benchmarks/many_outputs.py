"""Many outputs and large orders: memory and time of whole fits, and of the shift step deflated and as one programme.

    python benchmarks/many_outputs.py [--outputs 28] [--orders 20 24 28] [--samples 3000]

First the step ``min ‖up A - down‖`` with stable poles, for observability matrices of so many outputs with some poles
outside the unit circle: the deflated step of `optid.identify.subspace.shift` against one programme in P and Q. Printed
are CPU seconds, peak memory (of a process for each), and the residual above the least-squares residual, relative to it.
Then fits with ``nx="auto"`` of simulated records with so many outputs: seven states and white noise, and with outputs
that drift and oscillate besides, which takes many states.
"""

import argparse
import multiprocessing
import resource
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import optid
import optid.identify.subspace.shift
from formulations.constraints.poles import stable
from formulations.hammerstein_ss import SUBSPACE
from optid.errors import DataWarning
from optid.solving.solve import run

STATES, INPUTS = 7, 3
FITS = {"seven states": ("hammerstein_ss.sid", "hammerstein_ss.asivid", "ss.exact", "order"),
        "drifting": ("hammerstein_ss.sid", "order")}


def rotations(n: int, sizes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return a block diagonal matrix with pairs of poles of these moduli and angles, the last one real for an odd n."""
    matrix = np.zeros((n, n))
    for i in range(n // 2):
        turn = np.array([[np.cos(angles[i]), np.sin(angles[i])], [-np.sin(angles[i]), np.cos(angles[i])]])
        matrix[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = sizes[i] * turn
    if n % 2:
        matrix[-1, -1] = sizes[-1]
    return matrix


def observability(n: int, outputs: int) -> np.ndarray:
    """Return a noisy observability matrix of five block rows more than n / outputs, a tenth of its poles unstable."""
    rng = np.random.default_rng(n)
    sizes = rng.uniform(0.4, 0.95, n // 2 + 1)
    sizes[: max(1, n // 20)] = 1.01
    matrix, blocks = rotations(n, sizes, rng.uniform(0.1, 3.0, n // 2 + 1)), [rng.normal(size=(outputs, n))]
    for _ in range(n // outputs + 5):
        blocks.append(blocks[-1] @ matrix)
    gamma = np.linalg.svd(np.vstack(blocks), full_matrices=False)[0]
    return gamma + 1e-3 * rng.normal(size=gamma.shape)


def step(n: int, outputs: int, whole: bool) -> str:
    """Solve one step; return its excess over the least-squares residual in words."""
    gamma = observability(n, outputs)
    if whole:
        optid.identify.subspace.shift.LARGEST = n
    programmes = SUBSPACE.shift, SUBSPACE.centre
    up, down = gamma[:-outputs], gamma[outputs:]
    shift = run(optid.identify.subspace.shift.constrained_shift(up, down, [stable(0.999)], programmes)).model
    return f"excess {shift.suboptimality / shift.bound:.3e}"


def record(kind: str, outputs: int, samples: int) -> optid.Data:
    """Simulate a record."""
    rng = np.random.default_rng(0)
    sizes, angles = rng.uniform(0.7, 0.97, STATES // 2 + 1), rng.uniform(0.2, 2.5, STATES // 2 + 1)
    a, b, c = rotations(STATES, sizes, angles), rng.normal(size=(STATES, INPUTS)), rng.normal(size=(outputs, STATES))
    u, x, y = rng.normal(size=(samples, INPUTS)), np.zeros(STATES), np.zeros((samples, outputs))
    for k in range(samples):
        y[k] = c @ x
        x = a @ x + b @ u[k]
    spread = y.std(axis=0)
    y += 0.05 * spread * rng.normal(size=y.shape)
    if kind == "drifting":
        y += spread * np.sin(np.arange(samples)[:, None] * rng.uniform(0.05, 3.0, outputs))
        y += 0.02 * spread * np.cumsum(rng.normal(size=y.shape), axis=0)
    return optid.Data(u, y)


def identified(name: str, kind: str, outputs: int, samples: int) -> str:
    """Fit with the order chosen; return the order and the fit in words."""
    data = record(kind, outputs, samples)
    if name == "order":
        return f"order {optid.order(data).nx}"
    fit = optid.fit(data, name, nx="auto")
    return f"order {fit.figures['order']}, worst simulation fit {fit.simulation_fit.min():.2f} %"


def measured(job: tuple[Callable[..., str], tuple[Any, ...]]) -> tuple[str, float, float]:
    """Return what a job says, its CPU seconds, and the peak memory of this process in GB."""
    function, arguments = job
    clock = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        said = function(*arguments)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)
    return said, time.process_time() - clock, peak


def alone(function: Callable[..., str], *arguments: Any) -> tuple[str, float, float]:
    """Measure a job in a process of its own, which inherits no memory."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measured, ((function, arguments),))


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--outputs", type=int, default=28)
    parser.add_argument("--orders", type=int, nargs="+", default=[20, 24, 28])
    parser.add_argument("--samples", type=int, default=3000)
    options = parser.parse_args(argv)
    figures: dict = {}
    print(f"{'':44}    CPU s   peak GB")
    for n in options.orders:
        for whole in (True, False):
            said, seconds, peak = alone(step, n, options.outputs, whole)
            figures[n, whole] = {"seconds": seconds, "peak": peak, "said": said}
            title = f"order {n}, {'one programme' if whole else 'deflated'}"
            print(f"{title:44}{seconds:9.2f}{peak:10.2f}   {said}", flush=True)
    for kind, names in FITS.items():
        for name in names:
            said, seconds, peak = alone(identified, name, kind, options.outputs, options.samples)
            figures[name, kind] = {"seconds": seconds, "peak": peak, "said": said}
            print(f"{f'{name}, {kind}':44}{seconds:9.2f}{peak:10.2f}   {said}", flush=True)
    ratios = [figures[n, True]["seconds"] / figures[n, False]["seconds"] for n in options.orders]
    print(f"one programme takes {min(ratios):.0f} to {max(ratios):.0f} times as long as the deflated step")
    return figures


if __name__ == "__main__":
    main()

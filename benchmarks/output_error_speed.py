"""Speed of Hammerstein output-error fits: against jax-sysid with a state function of the same structure, and growth.

    python benchmarks/output_error_speed.py [--peer PYTHON] [--samples 1000 100000] [--growth 1000000] [--epochs 500]
                                           [--budget 120]

The plant has two poles, delay one, and a dead zone; the model na 2, nb 2, nk 1 and ten cells. jax-sysid gets the state
function ``x+ = [-a1 1; -a2 0] x + b f(u)``, ``y = x1 + d`` with f interpolated between the same eleven nodes: the same
models, initial state included. It starts, as its examples do, from a guess (half-way poles, f the identity), takes 500
steps of Adam and then L-BFGS-B up to ``--epochs`` evaluations, in double precision. Both are measured in CPU time in a
process that has fitted before, ours as ``optid.fit`` as a whole (examination, starts, descents, the last programme and
its judgement), theirs as ``Model.fit``; it compiles its loss anew in every fit, and what a fit of one step each costs
is printed beside it. Where it is not done after ``--budget`` CPU seconds it is stopped, and the ratio is a lower bound.

``--peer`` names a Python interpreter in which jax-sysid is installed (default: this one); without it that part is
skipped, and says so. Goals: at least 20 times faster at an equal or better simulation fit, and linear growth.
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

import optid

CELLS = 10
TRUE = ([1.0, -1.5, 0.7], [0.8, 0.6])

PEER = """
import json, resource, sys, time
import numpy as np
import jax, jax.numpy as jnp
from jax_sysid.models import Model
jax.config.update("jax_enable_x64", True)
path, (cells, adam, epochs, budget) = sys.argv[1], map(int, sys.argv[2:])
record = np.load(path)
u, y = record["u"], record["y"]
nodes = jnp.linspace(u.min(), u.max(), cells + 1)

@jax.jit
def state(x, u, params):
    a, b, mu, d = params
    f = jnp.interp(u[0], nodes, mu)
    return jnp.array([-a[0] * x[0] + x[1] + b[0] * f, -a[1] * x[0] + b[1] * f])

@jax.jit
def output(x, u, params):
    return jnp.array([x[0] + params[3][0]])

def fitted(adam, epochs):
    model = Model(2, 1, 1, state_fcn=state, output_fcn=output)
    guess = [np.array([-0.5, 0.06]), np.array([0.5, 0.5]), np.asarray(nodes), np.zeros(1)]
    model.init(params=guess, x0=np.zeros(2))
    model.loss(rho_x0=0.0, rho_th=0.0)
    model.optimization(adam_epochs=adam, adam_eta=0.01, lbfgs_epochs=epochs, iprint=-1)
    started = time.process_time()
    model.fit(y, u)
    return model, time.process_time() - started

fitted(1, 1)
_, compiling = fitted(1, 1)
print(json.dumps({"compiling": compiling}), flush=True)
resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + 1 + budget, resource.RLIM_INFINITY))
model, whole = fitted(adam, epochs)
simulated, _ = model.predict(np.asarray(model.x0).reshape(-1), u)
error = y - np.asarray(simulated).reshape(y.shape)
fit = 100 * (1 - np.linalg.norm(error) / np.linalg.norm(y - y.mean()))
print(json.dumps({"seconds": whole, "compiling": compiling, "fit": float(fit)}))
"""


def record(n: int, seed: int = 0) -> optid.Data:
    """A dead-zone plant, 10 % white noise on its output."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, n)
    f = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0)
    x = lfilter([0.0, *TRUE[1]], TRUE[0], f)
    return optid.Data(u=u, y=x + 0.1 * np.std(x) * rng.standard_normal(n))


def ours(data: optid.Data, repeats: int) -> tuple[float, float]:
    """Median CPU time of whole fits, and the simulation fit in %."""
    times, fit = [], None
    for _ in range(repeats):
        started = time.process_time()
        fit = optid.fit(data, "hammerstein_oe.exact", na=2, nb=2, nk=1, basis=optid.Triangular(CELLS))
        times.append(time.process_time() - started)
    assert fit is not None
    return float(np.median(times)), float(fit.simulation_fit[0])


def theirs(data: optid.Data, peer: str, epochs: int, budget: int) -> dict | str:
    """What jax-sysid reaches in the interpreter ``peer``, or why it cannot be asked; no fit where it was stopped."""
    probe = subprocess.run([peer, "-c", "import jax_sysid"], capture_output=True, text=True)
    if probe.returncode:
        return f"jax-sysid is not importable in {peer}: {probe.stderr.strip().splitlines()[-1]}"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.npz"
        np.savez(path, u=data.u, y=data.y)
        done = subprocess.run([peer, "-c", PEER, str(path), str(CELLS), "500", str(epochs), str(budget)],
                              capture_output=True, text=True)
    if done.returncode == -signal.SIGXCPU and done.stdout:
        return {"seconds": budget, **figures_in(done.stdout)}
    if done.returncode:
        return f"jax-sysid failed: {done.stderr.strip().splitlines()[-1]}"
    return figures_in(done.stdout)


def figures_in(text: str) -> dict:
    """The figures of the lines that hold some; jax-sysid prints of its own."""
    found: dict = {}
    for line in text.splitlines():
        found |= json.loads(line) if line.startswith("{") else {}
    return found


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer", default=sys.executable, help="Python interpreter with jax-sysid")
    parser.add_argument("--samples", type=int, nargs="*", default=[1000, 100_000])
    parser.add_argument("--growth", type=int, default=1_000_000, help="largest record of the growth table")
    parser.add_argument("--epochs", type=int, default=500, help="function evaluations of L-BFGS-B at most")
    parser.add_argument("--budget", type=int, default=120, help="CPU seconds after which jax-sysid is stopped")
    options = parser.parse_args(argv)
    figures: dict = {}
    ours(record(500), 1)  # load and compile
    for n in options.samples:
        data = record(n)
        seconds, fit = ours(data, 5 if n <= 10_000 else 3)
        print(f"N = {n}: optid {seconds:.3f} s, simulation fit {fit:.4f} %")
        other = theirs(data, options.peer, options.epochs, options.budget)
        if isinstance(other, str):
            print(f"  skipped: {other}")
            continue
        ratio = other["seconds"] / seconds
        if "fit" not in other:
            print(f"  jax-sysid was stopped after {options.budget} CPU seconds ({other['compiling']:.2f} s for one "
                  f"step of each): more than {ratio:.0f} times as long   goal: at least 20")
            figures[n] = {"ratio at least": ratio, "fit": fit}
            continue
        print(f"  jax-sysid {other['seconds']:.2f} s ({other['compiling']:.2f} s for one step of each), simulation fit "
              f"{other['fit']:.4f} %: {ratio:.0f} times as long   goal: at least 20, fit at most ours")
        figures[n] = {"ratio": ratio, "fit": fit, "peer fit": other["fit"]}
    print("growth:")
    sizes = [n for n in (50_000, 100_000, 200_000, 500_000, 1_000_000) if n <= options.growth]
    for n in sizes:
        seconds, fit = ours(record(n), 2)
        figures[n, "seconds"] = seconds
        print(f"  N = {n:8d}: {seconds:6.2f} s, {1e6 * seconds / n:6.2f} microseconds a sample, fit {fit:.3f} %")
    return figures


if __name__ == "__main__":
    main()

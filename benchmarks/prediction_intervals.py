"""Do 95 % intervals of simulations and predictions contain the outputs of records that the fit has not seen?

    python benchmarks/prediction_intervals.py [--runs 200] [--workers 2] [--plants ARX process ...]

Ten plants are simulated again and again, each time with new noise and inputs; a model of the plant's structure is
fitted to a short record, so that its parameters are uncertain, and run over another record. Printed is the share of the
samples of all validation records inside the interval, of simulations from rest and with the initial state fitted, and
one and five samples ahead, with the standard error of the share by the scatter between the runs. The last columns are
the share of the variance of the simulation's interval that is due to the parameters, and how many fits were refused.
"""

import argparse
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from montecarlo import mapped
from scipy.signal import lfilter

import optid
from optid.errors import DataWarning, OptidError
from optid.identify.output_intervals import prediction_intervals, simulation_intervals
from optid.models import HammersteinSS, Nonlinearity
from optid.models.process import process_model

Array = np.ndarray
BEFORE, LEVEL = 300, 0.95  # samples for which the noise has been running before a record; probability
POLYNOMIAL = optid.Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate")
TRIANGULAR = optid.Triangular(6, interval=(-1.0, 1.0))
KINDS = ("from rest", "fitted x0", "1 ahead", "5 ahead")


def white(rng: Any, n: int) -> Array:
    """Uniform samples."""
    return rng.uniform(-1, 1, n)


def staircase(rng: Any, n: int) -> Array:
    """Levels held for 20 samples."""
    return np.repeat(rng.uniform(-1, 1, -(-n // 20)), 20)[:n]


def bent(u: Array) -> Array:
    """A function in the span of the polynomials."""
    return u + 0.4 * u**2 + 0.3 * u**3


def dead_zone(u: Array) -> Array:
    """Flat between -1/3 and 1/3, nodes of the triangular basis."""
    return 1.5 * np.sign(u) * np.maximum(np.abs(u) - 1 / 3, 0.0)


def coloured(rng: Any, n: int, c: Any, d: Any, size: float) -> Array:
    """Stationary noise C/D e."""
    return lfilter(c, d, size * rng.standard_normal(n + BEFORE))[BEFORE:]


def transfer(f: Callable[[Array], Array], b: Any, a: Any, c: Any, d: Any, size: float,
             excite: Callable[[Any, int], Array] = white) -> Callable[[Any, int], tuple[Array, Array]]:
    """Return the simulation of B/A f(u) + C/D e."""
    def simulate(rng: Any, n: int) -> tuple[Array, Array]:
        u = excite(rng, n)
        return u, lfilter(b, a, f(u)) + coloured(rng, n, c, d, size)
    return simulate


def integrator(rng: Any, n: int) -> tuple[Array, Array]:
    """A tank level that starts at rest with its noise."""
    u = staircase(rng, n)
    return u, lfilter([0, 0.3, 0.2], [1, -1.4, 0.4], u) + lfilter([1], [1, -1.4, 0.4], 0.05 * rng.standard_normal(n))


def two_by_two(rng: Any, n: int) -> tuple[Array, Array]:
    """ARX with two outputs, correlated noise and gaps in the outputs."""
    u = rng.uniform(-1, 1, (n + BEFORE, 2))
    u[:BEFORE] = 0
    past = np.array([[0.6, 0.2], [-0.1, 0.5]])
    right = np.zeros((n + BEFORE, 2))
    right[1:] = u[:-1] @ np.array([[1.0, 0.2], [0.5, -0.8]])
    right += rng.standard_normal(right.shape) @ np.array([[0.15, 0.1], [0.0, 0.1]])
    y = np.zeros_like(right)
    for k in range(1, len(y)):
        y[k] = past @ y[k - 1] + right[k]
    u, y = u[BEFORE:], y[BEFORE:]
    y[n // 2 : n // 2 + 5, 0] = np.nan
    return u, y


def states(model: HammersteinSS, root: Array, sensor: float) -> Callable[[Any, int], tuple[Array, Array]]:
    """Return the simulation of a state-space model with noise before and at the outputs."""
    def simulate(rng: Any, n: int) -> tuple[Array, Array]:
        u = rng.uniform(-1, 1, (n + BEFORE, model.m))
        u[:BEFORE] = 0.0
        drive, x, y = model.expand_inputs(u) @ model.B.T, np.zeros(model.nx), np.zeros((len(u), model.l))
        for k in range(len(u)):
            y[k] = model.C @ x
            back = np.array([g(y[k, o]) for g, o in zip(model.feedback, model.output_of)])
            x = model.A @ x + drive[k] + model.E @ back + root @ rng.standard_normal(model.nx)
        return u[BEFORE:], y[BEFORE:] + sensor * rng.standard_normal((n, model.l))
    return simulate


def heater(rng: Any, n: int) -> tuple[Array, Array]:
    """First order with dead time, in engineering units, white noise of the sensor."""
    u = 50 + 20 * staircase(rng, n)
    return u, np.asarray(HEATER.simulate(u)) + 0.5 * rng.standard_normal(n)


HEATER = process_model("P1D", K=0.8, tau=9.3, dead_time=3.4, level=20.0)
LINE = Nonlinearity(optid.Linear(), np.ones(1))
BACK = Nonlinearity(optid.Polynomial(3, interval=(-2.0, 2.0), outside="extrapolate"), np.array([0.0, 0.1, -0.3]))
COUPLED = HammersteinSS([[0.8, 0.2], [-0.3, 0.6]], [[1.0, 0.3], [0.2, 0.8]], [[1.0, 0.0], [0.2, 1.0]],
                        nonlinearities=(LINE, LINE))
FED_BACK = HammersteinSS([[0.7, 0.2], [-0.1, 0.5]], [[0.6], [0.3]], [[1.0, 0.0]], E=[[0.3], [0.1]], feedback=(BACK,))
SLOW = [1.0, -1.5, 0.7]
# simulation, samples of the fit, its formulation and arguments
PLANTS: dict[str, tuple[Callable[[Any, int], tuple[Array, Array]], int, str, dict[str, Any]]] = {
    "ARX, dead zone, monotone": (transfer(dead_zone, [0.8, 0.6], SLOW, [1.0], SLOW, 0.25), 150, "hammerstein_arx.exact",
                                 {"na": 2, "nb": 2, "nk": 0, "basis": TRIANGULAR,
                                  "constraints": ("monotone:increasing",)}),
    "ARX, 2x2, gaps": (two_by_two, 200, "arx", {"na": 1, "nb": 1, "nk": 1}),
    "ARX, integrator": (integrator, 300, "arx", {"na": 2, "nb": 2, "nk": 1}),
    "output error, white": (transfer(bent, [0, 0.5, 0.3], [1, -0.7], [1.0], [1.0], 0.3), 150, "hammerstein_oe.exact",
                            {"na": 1, "nb": 2, "nk": 1, "basis": POLYNOMIAL}),
    "output error, AR(0.9)": (transfer(bent, [0, 0.5, 0.3], [1, -0.7], [1.0], [1, -0.9], 0.1), 300,
                              "hammerstein_oe.exact", {"na": 1, "nb": 2, "nk": 1, "basis": POLYNOMIAL}),
    "ARMAX": (transfer(np.asarray, [0, 1.0, 0.5], SLOW, [1, 0.5], SLOW, 0.2), 200, "armax.exact",
              {"na": 2, "nb": 2, "nk": 1, "nc": 1}),
    "Box-Jenkins": (transfer(np.asarray, [0, 1.0, 0.5], SLOW, [1, 0.4], [1, -0.9], 0.2), 200, "bj.exact",
                    {"na": 2, "nb": 2, "nk": 1, "nc": 1, "nd": 1}),
    "state space, 2x2": (states(COUPLED, np.array([[0.1, 0.0], [0.09, 0.04]]), 0.03), 250, "hammerstein_ss.exact",
                         {"nx": 2, "basis": "linear", "criterion": "prediction", "feedthrough": False}),
    "state space, feedback": (states(FED_BACK, np.diag([0.02, 0.02]), 0.05), 300, "hammerstein_ss.exact",
                              {"nx": 2, "basis": "linear", "feedback_basis": BACK.basis, "criterion": "simulation",
                               "feedthrough": False}),
    "process, first order": (heater, 150, "process.exact", {"process": "P1D"}),
}


def run(job: tuple[str, int]) -> tuple[list[tuple[float, float]], float, str]:
    """Return (samples inside, samples) of every kind, the share of the parameters, and why a fit was refused."""
    name, seed = job
    simulate, n, formulation, arguments = PLANTS[name]
    rng = np.random.default_rng([seed, 36])
    record, other = (optid.Data(*simulate(rng, n)) for _ in range(2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        try:
            fit = optid.fit(record, formulation, prove=False, **arguments)
            u = other.experiments[0].u
            found = [simulation_intervals(fit, u, "zero", LEVEL), simulation_intervals(fit, other, "fit", LEVEL),
                     prediction_intervals(fit, other, 1, LEVEL), prediction_intervals(fit, other, 5, LEVEL)]
        except OptidError as error:
            return [(0.0, 0.0)] * len(KINDS), np.nan, f"{type(error).__name__}: {error}"
    counts = [tuple(map(np.sum, one.counts_inside(other.y))) for one in found]
    return counts, float(np.nanmean(found[0].parameters**2) / np.nanmean(found[0].error**2)), ""


def main(argv: Any = None) -> dict[str, Array]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--plants", nargs="+", default=[""], help="words of their names")
    options = parser.parse_args(argv)
    print(f"{'plant':>26}" + "".join(f"{kind:>18}" for kind in KINDS) + "   parameters  refused")
    figures = {}
    for name in PLANTS:
        if not any(word in name for word in options.plants):
            continue
        counts, shares, refused = zip(*mapped(run, [(name, seed) for seed in range(options.runs)], options.workers))
        table = np.array(counts)
        inside, total = table[..., 0], table[..., 1]
        share = inside.sum(axis=0) / total.sum(axis=0)
        error = np.sqrt(np.sum((inside - share * total) ** 2, axis=0)) / total.sum(axis=0)
        reasons = [reason for reason in refused if reason]
        print(f"{name:>26}" + "".join(f"{100 * s:>9.1f} ± {100 * e:.1f} %" for s, e in zip(share, error))
              + f"{100 * np.nanmean(shares):>10.0f} %{len(reasons):>9}", flush=True)
        for reason in sorted(set(reasons))[:2]:
            print(f"{'':>26}  {reason}")
        figures[name] = share
    return figures


if __name__ == "__main__":
    main()

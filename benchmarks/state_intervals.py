"""Do the 95 % intervals of state-space fits contain the truth in 95 % of repeated experiments?

    python benchmarks/state_intervals.py [--runs 300] [--workers 2] [--plants 2x2 ...]

Plants with known equations are simulated again and again with the same input and new noise, which enters before
and at the outputs, so that the errors of a free run are coloured. Printed for every group of quantities: the smallest
and the largest share of intervals that contain the truth, their mean, and the ratio of printed to true scatter. A share
over 300 runs has a standard error of 1.3 points.
"""

import argparse
from typing import Any

import numpy as np
from montecarlo import coverage, mapped

import optid
from optid.bases import Linear, Polynomial
from optid.identify.uncertainty import uncertainty
from optid.models import HammersteinSS, Nonlinearity

CUBIC = Nonlinearity(Polynomial(3, interval=(-1.0, 1.0), outside="extrapolate"), np.array([1.0, 0.3, 0.4]))
SINE = Nonlinearity(Polynomial(2, interval=(-1.0, 1.0), outside="extrapolate"), np.array([1.0, -0.5]))
LINE = Nonlinearity(Linear(), np.ones(1))
BACK = Nonlinearity(Polynomial(3, interval=(-2.0, 2.0), outside="extrapolate"), np.array([0.0, 0.1, -0.3]))

# the plant, deviation (n,) or root (n, n) of the covariance of what moves its states, arguments of the fit
PLANTS: dict[str, tuple[HammersteinSS, np.ndarray, dict[str, Any]]] = {
    "SISO Hammerstein, simulation": (
        HammersteinSS([[1.4, -0.5], [1.0, 0.0]], [[1.0], [0.0]], [[0.8, 0.3]], nonlinearities=(CUBIC,)),
        np.array([0.02, 0.0]), {"basis": "polynomial:3", "criterion": "simulation"}),
    "SISO Hammerstein, prediction": (
        HammersteinSS([[1.4, -0.5], [1.0, 0.0]], [[1.0], [0.0]], [[0.8, 0.3]], nonlinearities=(CUBIC,)),
        np.array([0.02, 0.0]), {"basis": "polynomial:3", "criterion": "prediction"}),
    "2x2 Hammerstein, simulation": (
        HammersteinSS([[0.8, 0.2], [-0.3, 0.6]], [[1.0, 0.3], [0.2, 0.8]], [[1.0, 0.0], [0.2, 1.0]],
                      nonlinearities=(CUBIC, SINE)),
        np.array([0.03, 0.02]), {"basis": ["polynomial:3", "polynomial:2"], "criterion": "simulation"}),
    **{f"2x2 linear, correlated noise, {criterion}": (
        HammersteinSS([[0.8, 0.2], [-0.3, 0.6]], [[1.0, 0.3], [0.2, 0.8]], [[1.0, 0.0], [0.2, 1.0]],
                      nonlinearities=(LINE, LINE)),
        np.array([[0.1, 0.0], [0.09, 0.04]]), {"basis": "linear", "criterion": criterion})
       for criterion in ("prediction", "simulation")},
    "output feedback, simulation": (
        HammersteinSS([[0.7, 0.2], [-0.1, 0.5]], [[0.6], [0.3]], [[1.0, 0.0]], E=[[0.3], [0.1]], feedback=(BACK,)),
        np.array([0.01, 0.01]), {"basis": "linear", "feedback_basis": "polynomial:3", "criterion": "simulation"}),
}
SAMPLES, SENSOR = 800, 0.03
FREQUENCIES, LEVELS = np.array([0.05, 0.3, 1.0, 2.5]), np.linspace(-0.8, 0.8, 5)


def quantities(model: Any) -> dict[str, np.ndarray]:
    """Groups of quantities that do not depend on the choice of the states."""
    response = model.frequency_response(FREQUENCIES) if not model.feedback else np.ones(0)
    levels = LEVELS * (0.3 if model.feedback else 1.0)  # where the record of the feedback has been
    gains = np.array([model.static_gain(np.full(model.m, u)) for u in levels])
    static = np.array([model.equilibrium(np.full(model.m, u))[1] for u in levels])
    scaled = model.regauge("gain") if model.l == 1 and not model.feedback else None
    poles = np.poly(_closed(model))[1:]
    found = {"characteristic polynomial": poles, "static gain": gains.ravel(),
             "static curve": np.delete(static - static[2], 2, axis=0).ravel()}
    if scaled is not None:
        step = np.cumsum(scaled.impulse_response(30)[:, 0, 0])[[2, 5, 10, 20]]
        curves = scaled.frequency_response(FREQUENCIES).ravel()
        f = scaled.nonlinearities[0](LEVELS[LEVELS != 0]) - scaled.nonlinearities[0](0.0)
        found |= {"f": f, "step response": step, "log magnitude": np.log(np.abs(curves))}
    elif response.size:
        found["log magnitude of G f'(0)"] = np.log(np.abs(
            response * np.array([f.slope(0.0) for f in model.nonlinearities]))).ravel()
    return found


def _closed(model: Any) -> np.ndarray:
    """The matrix of the free run near rest."""
    _, y = model.equilibrium(np.zeros(model.m))
    slopes = [h.slope(y[o]) for h, o in zip(model.feedback, model.output_of)]
    back = np.array([slope * model.C[o] for slope, o in zip(slopes, model.output_of)])
    return model.A + model.E @ back.reshape(-1, model.nx) + model.L @ model.C


def record(name: str, seed: int) -> optid.Data:
    """One experiment: the input of the plant, new noise."""
    model, process, _ = PLANTS[name]
    u = np.random.default_rng(0).uniform(-1, 1, (SAMPLES, model.m))
    rng = np.random.default_rng([seed, 11])
    x, y = np.zeros(model.nx), np.zeros((SAMPLES, model.l))
    f, root = model.expand_inputs(u), process if process.ndim == 2 else np.diag(process)
    for k in range(SAMPLES):
        y[k] = model.C @ x
        g = np.array([h(y[k, o]) for h, o in zip(model.feedback, model.output_of)])
        x = model.A @ x + model.B @ f[k] + model.E @ g + root @ rng.standard_normal(model.nx)
    sensor = root / np.linalg.norm(root) if process.ndim == 2 else np.eye(model.l)
    return optid.Data(u, y + SENSOR * rng.standard_normal(y.shape) @ sensor.T)


def run(job: tuple[str, int]) -> tuple[np.ndarray, ...]:
    """Return estimates, their standard errors, and which intervals contain the truth."""
    name, seed = job
    model, _, arguments = PLANTS[name]
    fit = optid.fit(record(name, seed), "hammerstein_ss.exact", nx=model.nx, feedthrough=False, **arguments)
    found = uncertainty(fit).of(lambda model: np.concatenate(list(quantities(model).values())))
    truth = np.concatenate(list(quantities(model).values()))
    return found.value, found.error, (found.lower <= truth) & (truth <= found.upper)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=300)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--plants", nargs="+", default=[""], help="words of their names")
    options = parser.parse_args()
    for name, (model, _, _) in PLANTS.items():
        if not any(word in name for word in options.plants):
            continue
        jobs = [(name, seed) for seed in range(options.runs)]
        values, errors, covered = map(np.array, zip(*mapped(run, jobs, options.workers)))
        print(f"\n{name}, {options.runs} records of {SAMPLES} samples")
        print(f"{'':>28}{'least':>10}{'mean':>8}{'most':>8}{'printed / true scatter':>26}")
        start = 0
        for group, truth in quantities(model).items():
            here = slice(start, start := start + truth.size)
            share, ratio = coverage(values[:, here], errors[:, here], covered[:, here])
            print(f"{group:>28}{share.min():>8.1f} %{share.mean():>6.1f} %{share.max():>6.1f} %"
                  f"{ratio.min():>17.2f} to {ratio.max():.2f}", flush=True)


if __name__ == "__main__":
    main()

"""Are the standard errors that `optid fit --example thruster` prints those of repeated experiments?

    python benchmarks/standard_errors.py [--runs 500] [--workers 2]

The thruster rig is simulated again and again with the same input and new noise, and every record is fitted as the
example suggests, without and with its constraint. Printed per parameter: its true value (of f the piecewise linear
function nearest to the truth at the samples of the input), the standard deviation of the estimates, the root mean
square of the standard errors printed with them, the same about the truth, and the share of the 95 % intervals that
contain the truth. A standard deviation over 500 runs has itself a standard error of 3.2 %, a share one of 1 point.
"""

import argparse

import numpy as np
from montecarlo import mapped
from scipy.signal import lfilter

import optid
from optid import examples
from optid.identify.uncertainty import uncertainty

POINTS = np.linspace(-1.5, 1.5, 11)
NAMES = ["a1", "a2", *(f"f({u:g})" for u in POINTS)]


def record(seed: int) -> tuple[optid.Data, np.ndarray]:
    """Simulate the rig with its own input and new noise; also the truth of `NAMES`."""
    rig = examples.thruster()
    a, b, sigma = rig.truth["a"], rig.truth["b"][0], rig.truth["sigma"]
    rng = np.random.default_rng([seed, 7])
    noise = lfilter([1.0], np.r_[1.0, a], sigma * rng.standard_normal(rig.data.n_samples))
    u = rig.data.u[:, 0]
    data = optid.Data(u, rig.truth["noise_free"][:, 0] + noise, rig.data.dt)
    hats = np.maximum(1 - np.abs(u[:, None] - POINTS) / (POINTS[1] - POINTS[0]), 0)
    nodes = np.linalg.lstsq(hats, b[0] * rig.truth["f"][0](u), rcond=None)[0]
    return data, np.concatenate([a, nodes])


def run(job: tuple[int, bool]) -> tuple[np.ndarray, ...]:
    """Return estimates, their standard errors, and which intervals contain the truth."""
    seed, constrained = job
    data, truth = record(seed)
    suggestion = dict(examples.thruster().suggestion)
    constraints = suggestion.pop("constraints")
    fit = optid.fit(data, prove=False, constraints=constraints if constrained else (), **suggestion)
    found = uncertainty(fit, seed=seed)
    intervals = [found.a, found.band(0, POINTS)]
    value, error, lower, upper = (np.concatenate([getattr(i, part) for i in intervals])
                                  for part in ("value", "error", "lower", "upper"))
    return value, error, (lower <= truth) & (truth <= upper)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    truth = record(0)[1]
    for constrained in (False, True):
        jobs = [(seed, constrained) for seed in range(options.runs)]
        values, errors, covered = map(np.array, zip(*mapped(run, jobs, options.workers)))
        print(f"\n{'increasing' if constrained else 'no constraint'}, {options.runs} records")
        print(f"{'':>8}{'truth':>10}{'scatter':>10}{'printed':>10}{'ratio':>8}{'about truth':>13}{'covered':>10}")
        for i, name in enumerate(NAMES):
            scatter, printed = np.std(values[:, i], ddof=1), np.sqrt(np.mean(errors[:, i] ** 2))
            about = np.sqrt(np.mean((values[:, i] - truth[i]) ** 2))
            print(f"{name:>8}{truth[i]:>10.4f}{scatter:>10.4f}{printed:>10.4f}{printed / scatter:>8.2f}{about:>13.4f}"
                  f"{100 * covered[:, i].mean():>8.1f} %", flush=True)


if __name__ == "__main__":
    main()

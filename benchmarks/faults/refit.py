"""Refit of what broke from few samples, and the table of fit against samples after the fault.

Actuator 2 of the standard plant gets a dead zone, loses 55 % of its gain and gains an offset. The record is 100 healthy
samples and N samples after the fault; the fit is that of a noise-free simulation of 1,500 unseen samples, all outputs
pooled. Compared are: what broke alone (QP: values at 7 nodes with a healthy prior, monotone, not steeper than before),
the same by least squares without rules, all parameters with a healthy prior and without one (Levenberg and Marquardt
from the healthy model), the ARX-Hammerstein model from scratch, the QP on the wrong actuator, and the schedule that
decides by hold-out. Beside them stand the healthy model, the plant without the actuator, and the best values at the
nodes there are. `--jump` takes a dead zone with a jump, which values at 7 nodes cannot follow; `--off` a healthy model
whose entries are off by so many percent, where all parameters catch up.

    python benchmarks/faults/refit.py [--runs 30] [--jump] [--off 2]
"""

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from plants import levels, standard_plant

import optid
from formulations.faults.refit import actuator, parameters
from optid import Data
from optid.bases import Triangular, UserFunctions
from optid.errors import OptidError
from optid.faults import Surroundings, trajectory
from optid.faults.repair.damage import Damage
from optid.faults.repair.refitting import RefitPrior, Refitting, refitting
from optid.faults.repair.schedule import RefitRules, refit
from optid.models import HammersteinSS, Nonlinearity
from optid.solving.solve import run

BEFORE, UNSEEN = 100, 1500
COUNTS = (5, 10, 20, 40, 80, 160, 320, 640)
GOALS = {20: 93.0, 40: 95.0, 80: 96.0}


def healthy_value(u: Any) -> Any:
    return np.tanh(1.5 * u) + 0.15 * u


def dead_zone(u: Any) -> Any:
    v = healthy_value(u)
    return 0.45 * np.sign(v) * np.maximum(np.abs(v) - 0.3, 0.0) + 0.1


def dead_zone_with_jump(u: Any) -> Any:
    return 0.45 * healthy_value(u) * (np.abs(u) > 0.7) + 0.1


def broken(plant: HammersteinSS, f: Callable[[Any], Any]) -> HammersteinSS:
    """Return the plant with another second nonlinearity."""
    basis = UserFunctions((f,), interval=(-1.2, 1.2), outside="extrapolate", names=("damaged",))
    return replace(plant, nonlinearities=(plant.nonlinearities[0], Nonlinearity(basis, np.ones(1))))


def record(plant: HammersteinSS, damaged: HammersteinSS, count: int, seed: int) -> Data:
    """Return healthy samples followed by `count` samples of the damaged plant."""
    u = levels(BEFORE + count, 1000 + seed)
    before = trajectory(plant, u[: BEFORE + 1], seed=seed)
    last = [model.expand_inputs(u[BEFORE - 1 : BEFORE])[0] for model in (plant, damaged)]
    x0 = before.x[-1] + plant.B @ (last[1] - last[0])
    after = trajectory(damaged, u[BEFORE:], seed=50_000 + seed, surroundings=Surroundings(x0))
    return Data(u, np.vstack([before.y[:BEFORE], after.y]))


def fit(truth: np.ndarray, simulated: np.ndarray) -> float:
    """Return 100 (1 - error / spread), all outputs pooled."""
    return float(100 * (1 - np.linalg.norm(truth - simulated) / np.linalg.norm(truth - truth.mean(axis=0))))


def scratch(data: Data, u: np.ndarray) -> Any:
    """Simulate a model that is fitted to the samples after the fault alone."""
    after = Data(data.u[BEFORE:], data.y[BEFORE:])
    found = optid.fit(after, "hammerstein_arx.exact", na=2, nb=2, nk=0, basis="triangular:6", prove=False)
    return found.model.simulate(u)


def off_by(plant: HammersteinSS, percent: float, seed: int) -> HammersteinSS:
    """Return the plant with entries that are off by so many percent of the largest of each matrix."""
    if not percent:
        return plant
    rng = np.random.default_rng(7000 + seed)
    moved = {
        name: getattr(plant, name) + percent / 100 * np.abs(getattr(plant, name)).max() * rng.standard_normal(
            getattr(plant, name).shape) * (getattr(plant, name) != 0)
        for name in "ABCD"
    }
    return replace(plant, **moved)


def levenberg_marquardt(problem: Refitting, steps: int = 60) -> np.ndarray:
    """Return the least squares of the innovations, with nothing believed beforehand."""
    theta, damping = problem.start, 1e-2
    r, s = problem.linearise(theta)
    for _ in range(steps):
        scale = np.sqrt(np.sum(s**2, axis=0)) + 1e-9
        rows = np.vstack([s, np.sqrt(damping) * np.diag(scale)])
        trial = theta + np.linalg.lstsq(rows, np.concatenate([-r, np.zeros(theta.size)]), rcond=None)[0]
        r_trial, s_trial = problem.linearise(trial)
        if np.sum(r_trial**2) < np.sum(r**2):
            settled = np.sum(r**2) - np.sum(r_trial**2) < 1e-8 * np.sum(r**2)
            theta, r, s, damping = trial, r_trial, s_trial, damping / 5
            if settled:
                break
        else:
            damping *= 4
    return theta


def one(plant: HammersteinSS, damaged: HammersteinSS, count: int, seed: int, off: float) -> dict[str, float]:
    data, u = record(plant, damaged, count, seed), levels(UNSEEN, 77)
    truth, known = damaged.simulate(u), off_by(plant, off, seed)

    def broken(which: int) -> Damage:
        return Damage(f"u{which + 1}", 1.0, BEFORE, True, (which,), (), (), (), {}, np.zeros((4, 4)), np.ones(2),
                      np.zeros(2), np.zeros(4), ())

    def narrow(which: int = 1, prior: RefitPrior | None = None, rules: Any = "default") -> Any:
        problem = refitting(known, data, broken(which), prior=prior)
        return run(actuator(problem, constraints=rules), prove=False).model.model

    def wide() -> Any:
        problem = refitting(known, data, broken(1), whole=True)
        return run(parameters(problem), prove=False).model.model

    def no_prior() -> Any:
        problem = refitting(known, data, broken(1), whole=True)
        return problem.model_at(levenberg_marquardt(problem))

    tries: dict[str, Callable[[], Any]] = {
        "what broke, QP": narrow,
        "what broke, LS": lambda: narrow(prior=RefitPrior(curvature=1e3), rules=[]),
        "all, prior": wide,
        "all, no prior": no_prior,
        "wrong actuator": lambda: narrow(0),
        "schedule": lambda: refit(known, data, broken(1), RefitRules())[0],
    }
    results = {}
    for word, how in tries.items():
        model = how()
        results[word] = fit(truth, model.simulate(u)) if model.is_stable else -np.inf
    try:
        results["from scratch"] = fit(truth, scratch(data, u)) if count >= 20 else np.nan
    except OptidError:
        results["from scratch"] = np.nan
    return results


def reference(plant: HammersteinSS, damaged: HammersteinSS, u: np.ndarray) -> dict[str, float]:
    """Return the fits of the healthy model, without the actuator, and of the best values at the nodes."""
    truth = damaged.simulate(u)
    basis = Triangular(6, (-1.2, 1.2))

    def with_values(mu: np.ndarray, constant: float) -> np.ndarray:
        f = (plant.nonlinearities[0], Nonlinearity(basis, mu))
        added = {"offset_x": plant.B[:, 1] * constant, "offset_y": plant.D[:, 1] * constant}
        return replace(plant, nonlinearities=f, **added).simulate(u)

    nothing = with_values(np.zeros(6), 0.0)
    columns = [with_values(np.eye(6)[j], 0.0) - nothing for j in range(6)] + [with_values(np.zeros(6), 1.0) - nothing]
    rows = np.stack([column.ravel() for column in columns], axis=1)
    best = np.linalg.lstsq(rows, (truth - nothing).ravel(), rcond=None)[0]
    return {"healthy model": fit(truth, plant.simulate(u)), "without the actuator": fit(truth, nothing),
            "best values at 7 nodes": fit(truth, nothing + (rows @ best).reshape(truth.shape))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=30, help="records per number of samples")
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS), help="samples after the fault")
    parser.add_argument("--jump", action="store_true", help="a dead zone with a jump")
    parser.add_argument("--off", type=float, default=0.0, help="error of the healthy model in percent")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    plant, _ = standard_plant()
    damaged = broken(plant, dead_zone_with_jump if options.jump else dead_zone)
    for word, value in reference(plant, damaged, levels(UNSEEN, 77)).items():
        print(f"{word:<24}{value:6.1f} %")
    print(f"\nmedian fit in % [10 % quantile] of {options.runs} records each"
          + f", healthy model off by {options.off:g} %" * bool(options.off))
    medians: dict[str, dict[int, float]] = {}
    for count in options.counts:
        found = [one(plant, damaged, count, seed, options.off) for seed in range(options.runs)]
        cells = []
        for word in found[0]:
            values = np.array([row[word] for row in found])
            medians.setdefault(word, {})[count] = float(np.nanmedian(values)) if not np.isnan(values).all() else np.nan
            low = np.nanquantile(values, 0.1) if not np.isnan(values).all() else np.nan
            cells.append(f"{word} {medians[word][count]:.1f} [{low:.1f}]")
        print(f"{count:>5}: " + ", ".join(cells), flush=True)
    print()
    for count, goal in GOALS.items():
        if count in options.counts:
            print(f"{count:>3} samples {medians['what broke, QP'][count]:.1f} %   (goal {goal:g} %)")
    needed = {word: next((n for n in options.counts if row[n] >= 95), None) for word, row in medians.items()}
    own = needed["what broke, QP"]
    for word, goal in (("all, prior", 1 / 2), ("all, no prior", 1 / 4), ("from scratch", 1 / 16)):
        other = needed[word]
        shown = f"{own} / {other or f'> {options.counts[-1]}'}"
        ratio = own / (other or options.counts[-1] * 2) if own else np.nan
        print(f"samples for 95 %, what broke alone over {word}: {shown} = "
              f"{'at most ' * (other is None)}{ratio:.3g}   (goal {goal:g})")
    gap = [max(medians["what broke, QP"][n], medians["all, prior"][n]) - medians["schedule"][n] for n in options.counts]
    print(f"schedule: at most {max(gap):.1f} points below the better of the two it chooses from")


if __name__ == "__main__":
    main()

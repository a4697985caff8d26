"""Van der Pol oscillator and reaction wheel pendulum against the reference tables of chapters 4 and 5.

Prints, for every entry of the tables, the median over the seeds of the error of the simulation with measured feedback
(P2, in % of the root mean square of the output, x0 fitted on the validation record), the reference, and the goal: at
most 1.1 times the reference and 0.1 point. No model of any order may be unstable. One setting for everything:
`hammerstein_ss.asivid` with past outputs among the instruments, the better weighting and the block rows of the
reference. The polynomials of the oscillator, whose damping is one, are continued beyond the range of the record, those
of the pendulum are held. Where ASIVID weighs the two outputs otherwise than the reference does (chirp, orders 4 and 8:
a smaller error of the wheel, a larger one of the pendulum), the line below takes its model as the start of 15 steps of
`hammerstein_ss.exact`.

The references are one record each, and some entries lie below what the best model of the class reaches on other
records: `--floor` prints that beside, the median error of `hammerstein_ss.exact`, which minimises the simulation error
on the estimation record itself, and for the oscillator that of the plant itself, with its own A and feedback and the
best polynomial in place of f, on all seeds. From a single sinusoid the library refuses to identify; its rows are not
run.

    python benchmarks/thesis_tables.py [--seeds 20] [--floor] [--workers 2]
"""

import argparse
import os
import warnings
from functools import partial

import numpy as np
from montecarlo import mapped

import optid
from optid import plants
from optid.models import Nonlinearity

ASIVID = {"noise": "white", "weighting": "best", "prove": False}
VAN_DER_POL = {(0.0, 3): 1.2, (0.0, 4): 1.2, (0.02, 3): 7.0, (0.02, 4): 7.0}
PENDULUM = {
    "chirp": {2: (99, 21), 3: (0.7, 2.5), 4: (0.5, 1.9), 6: (0.9, 1.9), 8: (0.5, 1.8)},
    "levels": {2: (120, 40), 3: (3.8, 3.4), 4: (3.9, 3.4), 6: (3.8, 3.7), 8: (3.5, 3.4)},
    "noise": {2: (100, 19), 3: (2.8, 3.2), 4: (2.7, 3.2), 6: (80, 16), 8: (2.8, 3.3)},
}
LINEAR = {"chirp": (6.8, 3.5), "levels": (8.6, 5.7), "noise": (5.6, 5.1)}
"""Errors of the linear subspace method of order 3, by which a reading of the excitation can be judged."""
REFINED = {"chirp": (4, 8)}
"""Orders whose models are also refined by the simulation error."""
CLIPS = 2.0, 2.5
"""Standard deviations at which the noise is clipped to 8, which the source does not say."""
ORDERS = range(1, 9)


def errors(model: optid.HammersteinSS, data: optid.Data) -> np.ndarray:
    """Error of the simulation with measured feedback, % of the root mean square, per output."""
    simulated = model.simulate_measured_feedback(data, x0="fit")
    return 100 * np.sqrt(np.sum((data.y - simulated) ** 2, axis=0) / np.sum(data.y**2, axis=0))


def identified(data: optid.Data, exact: bool | int, p: str, **settings: object) -> optid.HammersteinSS:
    """Return the model of ASIVID, or of the smallest simulation error (as a number: after so many steps)."""
    basis = {"basis": f"polynomial:{p}", "feedback_basis": f"polynomial:{p}"}
    if exact is not False:
        settings |= {} if exact is True else {"iterations": exact}
        settings |= {"criterion": "measured feedback", "prove": False}
        return optid.fit(data, "hammerstein_ss.exact", **basis, **settings).model
    return optid.fit(data, "hammerstein_ss.asivid", **ASIVID, **basis, **settings).model


def judged(make: object, test: optid.Data) -> tuple[np.ndarray, float]:
    """Return errors and largest pole modulus; infinite errors where there is no model."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = make()
            return errors(model, test), float(np.max(np.abs(model.poles)))
        except optid.errors.OptidError as error:
            print(f"    {error}")
            return np.full(test.l, np.inf), float("nan")


def oscillator(seed: int, exact: bool = False) -> dict[tuple[float, int], tuple[np.ndarray, float]]:
    """Entries of section 4.5.3 from one record: 6000 samples for the estimate, 1000 for validation."""
    u = np.random.default_rng([seed, 5]).uniform(-2, 2, 7000)
    found = {}
    for v, p in VAN_DER_POL:
        train, test = plants.van_der_pol(u, seed, process=v / 4, measurement=v).split(6000)
        settings = {"nx": 2, "block_rows": 6, "feedthrough": False}
        found[v, p] = judged(partial(identified, train, exact, f"{p}:outside=extrapolate", **settings), test)
    return found


def known_oscillator(seed: int) -> float:
    """Error of the noise-free plant itself but for f, for which the cubic stands that is best for its uniform input.

    The part of y^3 that is linear in y is in A, as in the coordinates of an identified model.
    """
    u = np.random.default_rng([seed, 5]).uniform(-2, 2, 7000)
    train, test = plants.van_der_pol(u, seed).split(6000)
    linear = np.sum(train.y**4) / np.sum(train.y**2)
    grid = np.linspace(-2, 2, 4001)
    cubic = np.polyfit(grid, grid + 0.5 * grid * np.abs(grid), 3)
    f = optid.UserFunctions((lambda v: np.polyval(cubic, v),), interval=(-2, 2), outside="extrapolate")
    g = optid.UserFunctions((lambda v: v**3 - linear * v,), interval=(-3, 3), outside="extrapolate")
    A = np.array([[1.1 - 0.1 * linear / 3, 0.1], [-0.1, 1.0]])
    B, C, E = np.array([[0.0], [0.1]]), np.array([[1.0, 0.0]]), np.array([[-0.1 / 3], [0.0]])
    functions = [(Nonlinearity(function, np.ones(1)),) for function in (f, g)]
    plant = optid.HammersteinSS(A, B, C, E=E, nonlinearities=functions[0], feedback=functions[1], output_of=(0,),
                                dt=train.dt)
    return float(errors(plant, test)[0])


def pendulum(job: tuple[str, int], exact: bool = False) -> dict[object, tuple[np.ndarray, float]]:
    """Entries of one row of the pendulum tables from one record: 4000 samples and 1000 for validation.

    Under 0 stands the linear subspace method, under (n, "refined") what the simulation error makes of order n.
    """
    kind, seed = job
    if kind.startswith("noise"):
        clip = float(kind.removeprefix("noise "))
        first = optid.signals.band_limited_noise(5000, -8.0, 8.0, cutoff=4.0, dt=0.02, clip=clip, seed=seed)
    else:
        first = plants.pendulum_input(kind, 4000 if kind == "chirp" else 5000, seed)
    u = np.concatenate([first, first[:1000]])[:5000]  # a chirp goes on with its next sweep
    train, test = plants.pendulum(u, seed).split(4000)
    orders = [3, 4] if exact else ORDERS
    found = {n: judged(partial(identified, train, exact, "4", nx=n, block_rows=10), test) for n in orders}
    if not exact:
        for n in REFINED.get(kind, ()):
            found[n, "refined"] = judged(partial(identified, train, 15, "4", nx=n, block_rows=10), test)
        words = {"basis": "linear", "nx": 3, "block_rows": 10, "prove": False}
        found[0] = judged(lambda: optid.fit(train, "hammerstein_ss.sid", **words).model, test)
    return found


def line(name: str, found: list[tuple[np.ndarray, float]], reference: tuple[float, ...], floor: list | None,
         held: bool = True) -> None:
    """Print medians, reference, goal and verdict of one entry, or medians and reference of one that has no goal."""
    medians = np.median([e for e, _ in found], axis=0)
    goals = 1.1 * np.array(reference) + 0.1
    words = ["/".join(f"{x:.3g}" for x in values) for values in (medians, reference, goals)]
    best = "" if not floor else "/".join(f"{x:.3g}" for x in np.median([e for e, _ in floor], axis=0))
    words[2] = words[2] if held else ""
    verdict = "" if not held or not len(reference) else "met" if (medians <= goals).all() else "missed"
    print(f"{name:<34}{words[0]:>14}{words[1]:>14}{words[2]:>14}{verdict:>9}{best:>14}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--floor", action="store_true", help="the best model of the class on the first 5 seeds beside")
    given = parser.parse_args()
    seeds, few = range(given.seeds), range(min(5, given.seeds))
    print(f"{given.seeds} seeds{'':<27}{'median':>14}{'reference':>14}{'goal':>14}{'':>9}"
          f"{'floor' if given.floor else '':>14}")
    runs = mapped(oscillator, seeds, given.workers)
    known = mapped(known_oscillator, seeds, given.workers) if given.floor else []
    floors = mapped(partial(oscillator, exact=True), few, given.workers) if given.floor else []
    largest = [radius for run in runs for _, radius in run.values()]
    for (v, p), reference in VAN_DER_POL.items():
        line(f"Van der Pol, v {v:g}, degree {p}", [run[v, p] for run in runs], (reference,), [f[v, p] for f in floors])
    if given.floor:
        below = np.mean(np.array(known) <= 1.1 * VAN_DER_POL[0.0, 3] + 0.1)
        print(f"the noise-free oscillator itself with the best cubic f: {np.median(known):.3g} "
              f"({min(known):.3g} to {max(known):.3g}); {100 * below:.0f} % of the records allow the goal")
    for kind in ("chirp", "levels", *(f"noise {clip:g}" for clip in CLIPS)):
        row = PENDULUM[kind.partition(" ")[0]]
        runs = mapped(pendulum, [(kind, seed) for seed in seeds], given.workers)
        floors = mapped(partial(pendulum, exact=True), [(kind, s) for s in few], given.workers) if given.floor else []
        largest += [radius for run in runs for _, radius in run.values()]
        line(f"pendulum, {kind}, linear", [run[0] for run in runs], LINEAR[kind.partition(" ")[0]], None, held=False)
        for n in ORDERS:
            line(f"pendulum, {kind}, order {n}", [run[n] for run in runs], row.get(n, ()),
                 [f[n] for f in floors if n in f])
            if n in REFINED.get(kind, ()):
                line(f"    order {n}, refined", [run[n, "refined"] for run in runs], row[n], None)
    print(f"\n{np.sum(np.array(largest) >= 1)} unstable of {len(largest)} models, "
          f"{np.sum(np.isnan(largest))} without an answer; largest pole modulus {np.nanmax(largest):.5f}")


if __name__ == "__main__":
    main()

"""Re-allocation after an actuator has failed: its cost beside the exact one, and beside that without a fault.

The standard plant, and one with a third actuator that can stand in for the second, follow steps of their outputs by
predictive control (horizon 40). At sample 60 an actuator sticks or dies; 8 samples later the controller is exchanged
for that of the damaged plant, whose filter has been run again from the onset. The cost is the weighted root mean square
of the tracking error (each output by half the range that it can be held in) over the 135 samples from 25 samples after
the fault on; process and measurement noise are those of the plant. Compared are: no fault, the old controller kept, a
controller that takes the nonlinearities as straight lines, the QP in v = f(u) with f^-1, and the NLP in u by IPOPT on
some of the records. Times are of CPU, taken in turn.

    python benchmarks/faults/allocation.py [--runs 20] [--nlp 4]
"""

import argparse
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from plants import standard_plant

from optid.bases import Triangular, UserFunctions
from optid.faults import allocate, inverse
from optid.models import HammersteinSS, Nonlinearity

BEFORE, LAG, SKIP, SCORED, HORIZON, HELD = 60, 8, 25, 135, 40, 60
SHARE = 0.3


def with_third(plant: HammersteinSS) -> HammersteinSS:
    """Add an actuator that acts much like the second and twice as strongly, with a nonlinearity of its own."""
    third = UserFunctions((lambda u: u - 0.1 * u**3,), interval=(-1.2, 1.2), outside="extrapolate", names=("f3",))
    column = 2.0 * plant.B[:, 1] + 0.1 * plant.B[:, 0]
    return replace(
        plant, B=np.column_stack([plant.B, column]), D=np.column_stack([plant.D, [0.0, 0.1]]), input_of=(0, 1, 2),
        nonlinearities=(*plant.nonlinearities, Nonlinearity(third, np.ones(1))), inputs=("u1", "u2", "u3"),
        input_units=("",) * 3,
    )


def failed(plant: HammersteinSS, actuator: int, at: float | None) -> HammersteinSS:
    """Return the plant with an actuator stuck at an input, or dead."""
    value = 0.0 if at is None else plant.nonlinearities[actuator](at)
    functions = list(plant.nonlinearities)
    functions[actuator] = Nonlinearity(Triangular(1, (-1.2, 1.2)), np.zeros(1))
    return replace(plant, nonlinearities=tuple(functions), offset_x=plant.B[:, actuator] * value,
                   offset_y=plant.D[:, actuator] * value)


def straight(plant: HammersteinSS) -> HammersteinSS:
    """Return the plant with the secants of its nonlinearities over the range of the inputs."""
    functions = []
    for f in plant.nonlinearities:
        functions.append(Nonlinearity(Triangular(1, (-1.2, 1.2)), np.array([f(1.2) - f(-1.2)])))
    middle = np.array([(f(1.2) + f(-1.2)) / 2 - float(np.asarray(g(0.0))) for f, g in zip(
        plant.nonlinearities, functions)])
    return replace(plant, nonlinearities=tuple(functions), offset_x=plant.offset_x + plant.B @ middle,
                   offset_y=plant.offset_y + plant.D @ middle)


def references(weights: np.ndarray, allocation: Any, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return outputs that the healthy plant can hold well inside its bounds, held 60 samples each."""
    problem = allocation.problem
    v = problem.middle + SHARE * problem.half * rng.uniform(-1, 1, (-(-count // HELD), problem.columns))
    return np.repeat([problem.members[0].rest_output(one) for one in v], HELD, axis=0)[:count]


def predict(model: HammersteinSS, x: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the predicted state of the next sample."""
    v = model.expanded(u[None, :])[0]
    surprise = y - (model.C @ x + model.D @ v + model.offset_y)
    return model.A @ x + model.B @ v + model.offset_x + model.K @ surprise


def closed_loop(plant: HammersteinSS, damaged: HammersteinSS, first: Any, second: Any, seed: int, weights: np.ndarray,
                believed: HammersteinSS, aims: np.ndarray, clock: list[float] | None = None
                ) -> tuple[float, float]:
    """Return the cost and the largest violation of a bound."""
    rng = np.random.default_rng(seed)
    count = BEFORE + SKIP + SCORED
    roots = np.linalg.cholesky(plant.noise.Q), np.linalg.cholesky(plant.noise.R)
    x, seen, kept = np.zeros(plant.nx), np.zeros(plant.nx), np.zeros(plant.nx)
    stored: list[tuple[np.ndarray, np.ndarray]] = []
    errors, outside, u = [], 0.0, np.zeros(plant.m)
    for k in range(count):
        own = damaged if k >= BEFORE else plant
        if k == BEFORE:
            kept = seen.copy()
        if k == BEFORE + LAG and second is not None:
            seen = kept
            for u_then, y_then in stored:
                seen = predict(believed, seen, u_then, y_then)
        after = k >= BEFORE + LAG and second is not None
        controller = second if after else first
        start = time.process_time()
        move = controller.step(seen, aims[k], u)
        if clock is not None and after:
            clock.append(time.process_time() - start)
        u = move.u
        outside = max(outside, float(np.max(np.abs(u))) - 1.2)
        v = own.expanded(u[None, :])[0]
        clean = own.C @ x + own.D @ v + own.offset_y
        y = clean + roots[1] @ rng.standard_normal(plant.l)
        x = own.A @ x + own.B @ v + own.offset_x + roots[0] @ rng.standard_normal(plant.nx)
        seen = predict(believed if after else plant, seen, u, y)
        if BEFORE <= k < BEFORE + LAG:
            stored.append((u, y))
        if k >= BEFORE + SKIP:
            errors.append(np.sum((weights * (clean - aims[k])) ** 2))
    return float(np.sqrt(np.mean(errors))), outside


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="records per fault")
    parser.add_argument("--nlp", type=int, default=4, help="of them also by the NLP")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    plant, _ = standard_plant()
    cases = [("2 actuators, u2 stuck at 1", plant, 1, 1.0), ("2 actuators, u1 stuck at 0.8", plant, 0, 0.8),
             ("2 actuators, u2 dead", plant, 1, None)]
    three = with_third(plant)
    cases += [("3 actuators, u2 stuck at 1", three, 1, 1.0), ("3 actuators, u2 dead", three, 1, None),
              ("3 actuators, u1 stuck at 0.8", three, 0, 0.8)]
    print(f"{'fault':<30}{'no fault':>9}{'kept':>8}{'straight':>9}{'QP':>8}{'on the same records: QP':>25}{'NLP':>8}"
          f"{'QP ms':>8}{'NLP ms':>8}{'ratio':>7}")
    worst_ratio, worst_violation, worst_speed, redundant = 0.0, -np.inf, np.inf, 0.0
    for word, own, actuator, at in cases:
        damaged = failed(own, actuator, at)
        healthy = allocate(own)
        reach = np.ptp(np.array([[healthy.problem.members[0].rest_output(v) for v in (
            healthy.problem.middle + healthy.problem.half * sign for sign in np.stack(np.meshgrid(
                *[[-1, 1]] * own.m), axis=-1).reshape(-1, own.m))]])[0], axis=0) / 2
        weights = 1 / reach
        rows: dict[str, list[float]] = {}
        quick, slow = [], []
        for run in range(options.runs):
            aims = references(weights, healthy, BEFORE + SKIP + SCORED, np.random.default_rng([run, 3]))
            def controller(model: HammersteinSS, route: str = "qp", weights: np.ndarray = weights) -> Any:
                return allocate(model, weights=weights, route=route).controller(HORIZON)
            ways = {
                "none": (own, controller(own), None, own), "kept": (damaged, controller(own), None, own),
                "straight": (damaged, controller(own), controller(straight(damaged)), damaged),
                "qp": (damaged, controller(own), controller(damaged), damaged),
            }
            if run < options.nlp:
                ways["nlp"] = (damaged, controller(own), controller(damaged, "nlp"), damaged)
            for name, (true, first, second, believed) in ways.items():
                clock = {"qp": quick, "nlp": slow}.get(name)
                cost, outside = closed_loop(own, true, first, second, run, weights, believed, aims, clock)
                rows.setdefault(name, []).append(cost)
                if name == "qp":
                    worst_violation = max(worst_violation, outside)
        mean = {name: float(np.mean(costs)) for name, costs in rows.items()}
        same = float(np.mean(rows["qp"][: options.nlp]))
        ratio = same / mean["nlp"] if options.nlp else np.nan
        times = [1e3 * float(np.median(clock)) for clock in (quick, slow)] if options.nlp else [np.nan] * 2
        print(f"{word:<30}{mean['none']:>9.4f}{mean['kept']:>8.4f}{mean['straight']:>9.4f}{mean['qp']:>8.4f}"
              f"{same:>25.4f}{mean.get('nlp', np.nan):>8.4f}{times[0]:>8.3f}{times[1]:>8.2f}{ratio:>7.3f}", flush=True)
        worst_ratio, worst_speed = max(worst_ratio, ratio), min(worst_speed, times[1] / times[0])
        if word.startswith("3") and "u2" in word:
            redundant = max(redundant, mean["qp"] / mean["none"])
    print(f"\ncost of the QP over that of the NLP {worst_ratio:.4f}   (goal 1.02)"
          f"\n           largest violation of a bound {max(worst_violation, 0):.1e}   (goal 0)"
          f"\n           NLP time over QP time {worst_speed:.0f}   (goal 10)"
          f"\ncost after a redundant fault over that without {redundant:.3f}   (goal 1.05)")
    static(plant)


def static(plant: HammersteinSS) -> None:
    """Print the error of a static allocation over the box of v by f^-1, tangent and secant."""
    rng, worst = np.random.default_rng(0), {"f^-1": 0.0, "tangent": 0.0, "secant": 0.0}
    for f in plant.nonlinearities:
        one = inverse(f, -1.2, 1.2)
        v = rng.uniform(one.v_low, one.v_high, 2000)
        tangent = (f(1e-4) - f(-1e-4)) / 2e-4
        for word, u in (("f^-1", one(v)), ("tangent", v / tangent), ("secant", v * 2.4 / (one.v_high - one.v_low))):
            error = np.sqrt(np.mean((f(np.clip(u, -1.2, 1.2)) - v) ** 2)) / np.sqrt(np.mean(v**2))
            worst[word] = max(worst[word], float(error))
    print("static allocation over the attainable box, worst relative error: "
          + ", ".join(f"{word} {value:.2g}" for word, value in worst.items()))


if __name__ == "__main__":
    main()

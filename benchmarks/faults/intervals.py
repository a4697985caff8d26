"""Do the intervals of size and onset hold what they promise, the onset being searched?

On the standard plant, in windows of 200 samples with one fault at an onset drawn from 60 to 140. Additive faults of
deflection 7, 10 and 20 take turns in five places; actuators lose 20, 30, 50 and 100 % of their effect, once seen for 60
to 140 samples and once for 25 to 40 only. `diagnose` knows neither fault nor onset nor initial state. Counted are
windows in which the right fault is the most probable answer, as a user sees them. Printed: coverage of the interval of
the size at nominal 95 % (goal 93 to 97 %), what least squares at the best onset would give (estimate +- 1.96 standard
errors), and coverage and mean length of the interval of the onset. The loss of everything lies on the border of what is
possible.

    python benchmarks/faults/intervals.py [--runs 400]
"""

import argparse
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from plants import BEFORE, PLANT, deflected, levels, rate, standard_plant

from optid import Data
from optid.faults import Dictionary, Fault, diagnose, dictionary, inject, thresholds, whiten
from optid.faults import scan as search

WINDOW = 200
ONSETS = 60, 140
LATE = 160, 175
GOAL = 0.93, 0.97
PLACES = "actuator:u1", "actuator:u2", "sensor:y1", "sensor:y2", "process:load"
LOSSES = 0.2, 0.3, 0.5, 1.0


class Count:
    """How often intervals hold the truth."""

    def __init__(self) -> None:
        self.runs, self.right, self.size, self.plain, self.onset, self.length = 0, 0, 0, 0, 0, 0

    def add(self, other: "Count") -> None:
        """Add the counts of another."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def line(self) -> str:
        """Say all rates."""
        n = max(self.right, 1)
        inside = "" if GOAL[0] <= self.size / n <= GOAL[1] else "   outside the goal"
        return (f"size {rate(self.size, n)}{inside}\n{'':26}least squares {self.plain / n:.3f}; onset "
                f"{self.onset / n:.3f}, {self.length / n:.1f} samples long; named rightly {self.right} of {self.runs}")


def counted(model: Any, found: Dictionary, limits: Any, fault: Fault, label: str, true: float, u: np.ndarray,
            seed: int, load: np.ndarray) -> Count:
    """Diagnose one window and compare."""
    result = Count()
    result.runs = 1
    y = inject(model, u, fault, seed=seed, process={"load": load})
    answer = diagnose(model, (u[BEFORE:], y[BEFORE:]), found, thresholds=limits)
    if answer.best is None or answer.best.labels != (label,):
        return result
    estimate, onset = answer.best.faults[0], fault.onset - BEFORE
    low, high = estimate.size_interval[0]
    first, last = estimate.onset_interval
    white = whiten(model, Data(u[BEFORE:], y[BEFORE:]))
    at = search(found, white, u[BEFORE:], onsets=[estimate.onset]).estimate(label, estimate.onset)
    result.right = 1
    result.size = int(low <= true <= high)
    result.plain = int(abs(at.nu[0] - true) <= 1.96 * np.sqrt(at.covariance[0, 0]))
    result.onset, result.length = int(first <= onset <= last), last - first + 1
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=400, help="windows per line")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    limits = thresholds(found, WINDOW, 0.01)
    print("additive faults, the five places in turn")
    total = Count()
    for d in (7, 10, 20):
        count, rng = Count(), np.random.default_rng([d, 29])
        for run in range(options.runs):
            label, onset = PLACES[run % len(PLACES)], int(rng.integers(*ONSETS))
            fault, size = deflected(found, label, WINDOW, onset, d, rng)
            count.add(counted(model, found, limits, fault, label, float(size[0]), levels(BEFORE + WINDOW, rng),
                              int(rng.integers(2**31)), load))
        print(f"  d = {d:<20g}{count.line()}", flush=True)
        total.add(count)
    print(f"  {'all':<24}{total.line()}")
    with_losses = dictionary(model, process={"load": load}, kinds=["bias", "loss"])
    print("losses of actuators")
    totals: dict[str, Count] = defaultdict(Count)
    for number, (word, onsets) in enumerate((("60 to 140 samples", ONSETS), ("25 to 40 samples", LATE))):
        for share in LOSSES:
            for actuator in ("u1", "u2"):
                count, rng = Count(), np.random.default_rng([number, int(100 * share), int(actuator[1]), 31])
                per_input = 50  # thresholds depend on the input: a new one for every so many windows
                for run in range(options.runs):
                    if run % per_input == 0:
                        u = levels(BEFORE + WINDOW, rng)
                        tuned = thresholds(with_losses, WINDOW, 0.01, u=u[BEFORE:], draws=5000)
                    onset = int(rng.integers(*onsets))
                    fault = Fault.loss(f"actuator:{actuator}", BEFORE + onset, share)
                    count.add(counted(model, with_losses, tuned, fault, f"actuator:{actuator} loss", share, u,
                                      int(rng.integers(2**31)), load))
                print(f"  {actuator} {100 * share:.0f} % for {word}\n{'':26}{count.line()}", flush=True)
                totals["all lost" if share == 1 else "some lost"].add(count)
    for word, count in totals.items():
        print(f"  {word:<24}{count.line()}")


if __name__ == "__main__":
    main()

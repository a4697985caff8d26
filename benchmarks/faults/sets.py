"""How often does the 95 % set of a diagnosis hold the fault, and how large is it? On the standard plant.

Windows of 200 samples hold one fault of deflection d at an onset drawn from 60 to 140; the six candidates (offsets of
both actuators and both sensors, a load, a jump of the state in a random direction) take turns. `diagnose` knows neither
the fault, nor the onset, nor the state at the start of the window. Printed for every d: how many are detected; of those
the coverage of the set and its mean size, the lowest coverage of any candidate, how often the most probable answer is
right, how often the answer is "unknown"; and how well the probabilities are calibrated: the mean probability of the
first answer beside how often it is right. At d = 0 the plant is healthy, and the alarms of `diagnose` are counted.
Below d = 4 there are four times as many windows, because few of the faults are detected.

    python benchmarks/faults/sets.py [--runs 600] [--levels 0 3 4 5 7 10 20]
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from plants import BEFORE, PLANT, deflected, levels, rate, standard_plant

from optid.faults import diagnose, dictionary, inject, thresholds

WINDOW = 200
ONSETS = 60, 140
SIZES = {7: 1.8, 10: 1.35, 20: 1.05}
COVERAGE = 0.95


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=600, help="windows per deflection")
    parser.add_argument("--levels", type=float, nargs="+", default=[0, 3, 4, 5, 7, 10, 20], help="deflections")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    limits = thresholds(found, WINDOW, 0.009)  # the rest of 1 % is for what no candidate describes
    for d in options.levels:
        rng, spent = np.random.default_rng([int(10 * d), 6]), 0.0
        detected, inside, first, unknown, sizes, claimed = 0, 0, 0, 0, [], []
        by_label = {label: [0, 0] for label in found.labels}
        runs = options.runs if d >= 4 else 4 * options.runs
        for run in range(runs):
            label, onset = found.labels[run % len(found.labels)], int(rng.integers(*ONSETS))
            fault: Any = deflected(found, label, WINDOW, onset, d, rng)[0] if d else ()
            u = levels(BEFORE + WINDOW, rng)
            y = inject(model, u, fault, seed=int(rng.integers(2**31)), process={"load": load})
            start = time.process_time()
            answer = diagnose(model, (u[BEFORE:], y[BEFORE:]), found, thresholds=limits)
            spent += time.process_time() - start
            if not answer.detected:
                continue
            detected += 1
            unknown += answer.verdict == "unknown"
            named = [candidate.label for candidate in answer.candidates]
            inside += label in named
            by_label[label][0] += label in named
            by_label[label][1] += 1
            sizes.append(len(named))
            if named:
                first += named[0] == label
                claimed.append(answer.candidates[0].posterior)
        if d == 0:
            print(f"healthy: alarms {rate(detected, runs)}   (nominal 0.01, goal 0.005 to 0.02)")
            continue
        seen = {name: held / times for name, (held, times) in by_label.items() if times}
        worst = min(seen, key=lambda name: seen[name])
        goal = f"(goal at most {SIZES[int(d)]})" if d in SIZES else ""
        print(f"d = {d:g}: detected {rate(detected, runs)}, {1e3 * spent / runs:.0f} ms each\n"
              f"  coverage of the set {rate(inside, detected)}   (goal at least {COVERAGE})\n"
              f"  mean size {np.mean(sizes):.3f}   {goal}\n"
              f"  lowest coverage: {worst} {rate(*by_label[worst])}\n"
              f"  first answer right {rate(first, detected)}, claimed {np.mean(claimed):.3f}; "
              f"unknown {unknown} of {detected}", flush=True)


if __name__ == "__main__":
    main()

"""One fault, which one, since when, how large? On the standard plant.

Windows of 200 samples hold one fault of deflection d at an onset drawn from 60 to 140; the six candidates take turns (a
jump of the state in a random direction). The search knows neither. Printed beside the goals: detected; named rightly
of those detected, by the largest gain and by the posterior with which `diagnose` ranks its answers; error of the onset
and relative error of the magnitude where the largest gain names it rightly (and the onset whatever the name); and which
rivals take the wrong answers. "Best possible" is the rate of the Bayes rule that is told the deflection and the range
of the onsets: no other rule can name more of these faults rightly (`bayes_limit.py` has it more precisely).

    python benchmarks/faults/isolation.py [--runs 1200] [--plant $OPTID_DATA/fault_plant.json]
"""

import argparse
import time
from collections import Counter
from pathlib import Path

import numpy as np
from plants import PLANT, deflected, rate, standard_plant, windows
from scipy.special import gammaln, ive, logsumexp

from optid.faults import dictionary, scan, thresholds
from optid.faults.diagnosis.posterior import single

WINDOW = 200
ONSETS = 60, 140
GOALS = {
    7: {"detected": 0.98, "right": 0.83}, 10: {"detected": 1.0, "right": 0.93, "median": 1, "mae": 2.0, "size": 0.20},
    20: {"right": 0.99, "mae": 0.5, "size": 0.10},
}


def told(statistic: np.ndarray, dimensions: np.ndarray, d: float) -> int:
    """Return the most probable candidate, given the deflection and the range of the onsets.

    The likelihood beside health is averaged over the directions of the magnitudes, a sphere in d dimensions, and over
    the onsets.
    """
    x = d * np.sqrt(statistic[:, slice(*ONSETS)])
    half = dimensions[:, None] / 2 - 1
    logs = gammaln(half + 1) - half * np.log(x / 2) + np.log(ive(half, x)) + x
    return int(np.argmax(np.asarray(logsumexp(logs, axis=1))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1200, help="windows per deflection")
    parser.add_argument("--levels", type=float, nargs="+", default=[3, 5, 7, 10, 20], help="deflections")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    limits = thresholds(found, WINDOW, draws=50_000)
    print(f"{limits}\n")
    for d in options.levels:
        rng, spent = np.random.default_rng([int(10 * d), 5]), 0.0
        truth = []
        for run in range(options.runs):
            label, onset = found.labels[run % len(found.labels)], int(rng.integers(*ONSETS))
            truth.append((label, onset, *deflected(found, label, WINDOW, onset, d, rng)))
        detected, right, ranked, possible, errors, any_errors, sizes, wrong = 0, 0, 0, 0, [], [], [], Counter()
        dimensions = np.array([c.dimension for c in found.candidates])
        for (label, onset, _, size), window in zip(truth, windows(model, [t[2] for t in truth], WINDOW, load=load,
                                                                  seed=int(10 * d))):
            start = time.process_time()
            result = scan(found, window.whitened)
            gains = result.gains(limits)
            spent += time.process_time() - start
            c, at = np.unravel_index(np.nanargmax(gains), gains.shape)
            if gains[c, at] <= 0:
                continue
            detected += 1
            possible += found.labels[told(result.statistic, dimensions, d)] == label
            explained = [single(result, candidate) for candidate in found.candidates]
            best = np.argmax([-np.inf if e is None else e.log_evidence for e in explained])
            ranked += found.labels[int(best)] == label
            any_errors.append(abs(at - onset))
            if found.labels[c] != label:
                wrong[f"{label} -> {found.labels[c]}"] += 1
                continue
            right += 1
            errors.append(abs(at - onset))
            estimate = result.estimate(label, int(at)).nu
            sizes.append(float(np.linalg.norm(estimate - size) / np.linalg.norm(size)))
        goal = GOALS.get(int(d), {})
        print(f"deflection {d:g}: {options.runs} windows, {1e3 * spent / options.runs:.2f} ms of CPU time each")
        rows = [("4 detected", rate(detected, options.runs), "detected"),
                ("5 named rightly of those detected", rate(right, detected) if detected else "-", "right"),
                ("5 by the posterior of diagnose", rate(ranked, detected) if detected else "-", "right"),
                ("  best possible", rate(possible, detected) if detected else "-", "")]
        if errors:
            rows += [("8 onset, median error", f"{np.median(errors):.1f}", "median"),
                     ("8 onset, mean error", f"{np.mean(errors):.2f} (any name {np.mean(any_errors):.2f}), "
                                             f"90 % within {np.quantile(errors, 0.9):.0f}", "mae"),
                     ("9 magnitude, relative RMSE", f"{np.sqrt(np.mean(np.square(sizes))):.3f}", "size")]
        for what, value, word in rows:
            sense = ">=" if word in ("detected", "right") else "<="
            bound = f"   (goal {sense} {goal[word]})" if word in goal else ""
            print(f"  {what:<36}{value}{bound}")
        top = ", ".join(f"{what} {count}" for what, count in wrong.most_common(3))
        print(f"  wrong names: {top or 'none'}\n", flush=True)


if __name__ == "__main__":
    main()

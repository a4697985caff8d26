"""Two faults at once: both named rightly, and the time of the exact search. On the standard plant.

Windows of 200 samples hold two faults of different candidates, each of deflection d, with onsets 20 to 70 samples
apart. The exact search goes through all pairs of candidates and onsets (186 onsets, 1,116 atoms); its time is that of
the whole search, products included. Beside it, the greedy one: the best fault, then the best one beside it.

    python benchmarks/faults/pairs.py [--runs 600] [--plant $OPTID_DATA/fault_plant.json]
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from plants import PLANT, deflected, rate, standard_plant, windows

from optid.faults import best_subsets, dictionary, scan, thresholds

WINDOW = 200
SEARCHED = 186
GOALS = {10: 0.75, 20: 0.95}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=600, help="windows per deflection")
    parser.add_argument("--levels", type=float, nargs="+", default=[7, 10, 20], help="deflections of both faults")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    limits = thresholds(found, WINDOW, draws=50_000)
    spent, atoms = [], 0
    for d in options.levels:
        rng, truth = np.random.default_rng([int(10 * d), 7]), []
        for _ in range(options.runs):
            labels = rng.choice(found.labels, 2, replace=False)
            first, apart = int(rng.integers(40, 100)), int(rng.integers(20, 71))
            onsets = first, first + apart
            faults = [deflected(found, str(label), WINDOW, k, d, rng) for label, k in zip(labels, onsets)]
            truth.append((labels, onsets, [f for f, _ in faults], [s for _, s in faults]))
        both = greedy = two = 0
        errors, sizes = [], []
        for (labels, onsets, _, true), window in zip(truth, windows(model, [t[2] for t in truth], WINDOW, load=load,
                                                                    seed=int(10 * d) + 1)):
            result = scan(found, window.whitened, onsets=slice(0, SEARCHED))
            atoms = int(np.sum(~np.isnan(result.statistic)))
            start = time.process_time()
            found_two = best_subsets(result, limits)
            spent.append(time.process_time() - start)
            best = found_two.best_of(2)
            assert best is not None
            two += best == found_two.best
            right = set(best.labels) == set(labels)
            both += right
            gains = result.gains(limits)
            c, at = np.unravel_index(np.nanargmax(gains), gains.shape)
            left = replace(window.whitened, r=window.whitened.r - result.signature(found.labels[c], int(at)) @
                           result.estimate(found.labels[c], int(at)).nu)
            rest = scan(found, left, onsets=slice(0, SEARCHED)).gains(limits)
            greedy += {found.labels[c], found.labels[np.nanargmax(np.nanmax(rest, axis=1))]} == set(labels)
            if right:
                order = [best.labels.index(label) for label in labels]
                errors += [abs(best.onsets[i] - k) for i, k in zip(order, onsets)]
                nu = found_two.estimate(best).nu
                middle = found[best.labels[0]].dimension
                parts = nu[:middle], nu[middle:]
                sizes += [np.linalg.norm(parts[i] - size) / np.linalg.norm(size) for i, size in zip(order, true)]
        print(f"deflection {d:g} each, {options.runs} windows")
        goal = f"   (goal >= {GOALS[int(d)]})" if int(d) in GOALS else ""
        print(f"  10 both named rightly    {rate(both, options.runs)}{goal}")
        print(f"     by the greedy search  {rate(greedy, options.runs)}")
        print(f"     two preferred to one  {rate(two, options.runs)}")
        print(f"     onset, mean error     {np.mean(errors):.2f}; magnitude, relative RMSE "
              f"{np.sqrt(np.mean(np.square(sizes))):.3f}\n", flush=True)
    low, middle, high = 1e3 * np.quantile(spent, [0.05, 0.5, 0.95])
    print(f"11 exact search of two faults, {atoms} atoms: {middle:.1f} ms of CPU time, 90 % within {low:.1f} - "
          f"{high:.1f}   (goal <= 100)")


if __name__ == "__main__":
    main()

"""How often is the order right? The examples of chapter 6: four states, two inputs, two outputs.

White inputs; (process, measurement) noise none, (0, 0.1), (0.05, 0.2) and (0.2, 0.5), and the last again with
first-order autoregressive measurement noise (pole 0.9), which no reference has. Goals: at least 95 % correct at
N >= 1000 in all noise cases, at least 85 % at N = 300, 100 % without noise; 200 runs each. Each share stands with its
95 % interval (Clopper and Pearson), and beside it the largest ratio and the two ways of being wrong.

    python benchmarks/order.py [--runs 200] [--samples 300 1000 4000] [--block-rows 8]
"""

import argparse
import time

import numpy as np
from montecarlo import share

from optid.bases import Linear
from optid.identify.order import RankTest, order_test
from optid.plants import NOISE_CASES, TWO_MODES
from optid.statistics.expansion import expand

CASES = {name: (*noise, 0.0) for name, noise in NOISE_CASES.items()}
CASES["strong, coloured"] = (*NOISE_CASES["strong"], 0.9)


def one(case: str, n: int, seed: int, alpha: int = 8) -> RankTest:
    """Simulate a record and test its ranks."""
    process, measurement, colour = CASES[case]
    u = np.random.default_rng(seed).normal(size=(n, 2))
    data = TWO_MODES.record(u, seed + 1000, process=process, measurement=measurement, colour=colour)
    records = data.records
    return order_test(records, expand(data, Linear()), alpha)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--samples", type=int, nargs="+", default=[300, 1000, 4000])
    parser.add_argument("--block-rows", type=int, default=8)
    options = parser.parse_args()
    print(f"{options.runs} runs each, {options.block_rows} block rows, true order {TWO_MODES.order}\n")
    print(f"{'case':<18}{'N':>6}  {'threshold correct':<24}{'goal %':>7}{'below':>7}{'above':>7}  "
          f"{'largest ratio correct':<24}{'ms':>5}")
    for case in CASES:
        for n in options.samples:
            start = time.process_time()
            tests = [one(case, n, seed, options.block_rows) for seed in range(options.runs)]
            spent = 1e3 * (time.process_time() - start) / options.runs
            found = np.array([test.order for test in tests])
            ratio = int(np.sum([test.ratio_order == TWO_MODES.order for test in tests]))
            right = int(np.sum(found == TWO_MODES.order))
            goal = 100 if case == "deterministic" else 95 if n >= 1000 else 85
            print(f"{case:<18}{n:>6}  {share(right, options.runs):<24}{goal:>7}{np.sum(found < TWO_MODES.order):>7}"
                  f"{np.sum(found > TWO_MODES.order):>7}  {share(ratio, options.runs):<24}{spent:>5.0f}", flush=True)


if __name__ == "__main__":
    main()

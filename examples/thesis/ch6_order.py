"""Section 6.4: order of a deterministic and of combined deterministic-stochastic systems; tables 6.1 to 6.3.

The numbers are lost; the pattern remains, on a system of order 4. Reference: shares of correct orders in 40 runs.
Figures 6.2 and 6.3 (expected threshold against N) are the right panel. python ch6_order.py [folder for the figure]
"""

from pathlib import Path

import numpy as np
from common import panels, run, save, with_style

from optid.bases import Linear
from optid.identify.order import RankTest, order_test
from optid.plants import NOISE_CASES, TWO_MODES
from optid.statistics.expansion import expand

ROWS, RUNS, LENGTHS, LONGER = 8, 20, (300, 1000), (300, 1000, 3000, 10_000)
REFERENCE = dict.fromkeys(NOISE_CASES, ("0.82-0.93", "0.97-1.00")) | {"deterministic": ("1.00", "1.00")}


def tested(case: str, n: int, seed: int) -> RankTest:
    u, (w, v) = np.random.default_rng(seed).normal(size=(n, 2)), NOISE_CASES[case]
    data = TWO_MODES.record(u, seed + 1000, process=w, measurement=v)
    return order_test([np.hstack([data.u, data.y])], expand(data, Linear()), ROWS)


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return the shares of correct orders; save singular values and thresholds."""
    found, shown = {}, {case: tested(case, 1000, 0) for case in ("deterministic", "combined")}
    print("Tables 6.1, 6.2: singular values and their ratios, N = 1000, i = 1 ... 7")
    for case, one in shown.items():
        raised = np.maximum(one.singular_values, one.floor)
        print(f"{case:<19}" + "".join(f"{value:10.2g}" for value in raised[:7]))
        print(f"{'':<19}" + "".join(f"{value:10.3g}" for value in one.ratios[:7]) + f"  -> {one.ratio_order}")
    print(f"Table 6.3, share of order 4 in {RUNS} runs: threshold (reference), largest ratio")
    for case in NOISE_CASES:
        for n, reference in zip(LENGTHS, REFERENCE[case]):
            tests = [tested(case, n, seed) for seed in range(RUNS)]
            found[f"{case}, N = {n}"] = share = float(np.mean([test.order == 4 for test in tests]))
            print(f"{case:<16}N = {n:<6}{share:6.2f} ({reference}){np.mean([t.ratio_order == 4 for t in tests]):8.2f}")
    thresholds = np.array([np.sqrt(tested("combined", n, 1).thresholds[4]) for n in LONGER])
    found["slope of the threshold"] = slope = float(np.polyfit(np.log(LONGER), np.log(thresholds), 1)[0])
    print(f"the threshold falls like N^{slope:.2f} (theory: N^-0.5)")
    figure, ((left, right),) = panels(1, 2)
    for case, one in shown.items():
        left.semilogy(range(1, 17), np.maximum(one.singular_values, one.floor), "o-", label=case)
    right.loglog(LONGER, thresholds, "o-", label="combined, order 4")
    right.loglog(LONGER, thresholds[0] * np.sqrt(300 / np.array(LONGER)), "k--", label=r"$\propto N^{-1/2}$")
    left.set(title="singular values", xlabel="i")
    right.set(title="expected threshold", xlabel="samples N")
    figure.legend(loc="outside lower center", ncols=4)
    save(figure, folder, "ch6_order.png")
    return found


if __name__ == "__main__":
    run(main)

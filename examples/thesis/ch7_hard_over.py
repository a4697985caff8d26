"""Chapter 7: hard-over failures of sensors and actuators by rank deficiency; tables 7.1 to 7.3.

The numbers are lost; two modes, apart or mixed, replace the system. The order drops only where the lost channel was the
only access to a mode; past outputs among the instruments hide an actuator. python ch7_hard_over.py [folder for figures]
"""

from pathlib import Path

import numpy as np
from common import panels, run, save, with_style

from optid import Data
from optid.faults import Fault, HardOver, hard_over_test, inject
from optid.plants import two_mode_plant

N, RUNS, FAULTS = 1500, 10, (None, "sensor:y1", "actuator:u1")
REFERENCE = {"decoupled": (4, 2, 2), "coupled": (4, 4, 4)}


def judged(plant: str, noise: float, fault: str | None, seed: int, at: int = 0, n: int = N, **settings) -> HardOver:
    model, u = two_mode_plant(plant == "coupled", noise), np.random.default_rng(seed).normal(size=(n + N, 2))
    y = inject(model, u, [Fault.loss(fault, N + at, 1.0)] if fault else [], seed=seed)
    return hard_over_test(Data(u[N:], y[N:]), Data(u[:N], y[:N]), window=N, **settings)


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return usual orders and range of the statistics; save those of a sliding window."""
    found = {}
    print(f"Tables 7.1 - 7.3: usual order of {RUNS} windows of {N}; statistic / threshold of rows and columns\n"
          f"plant      noise failure      order expected past outputs {'dead channel':>13} least of y2, u2")
    for (plant, orders), noise in [(one, w) for one in REFERENCE.items() for w in (0.0, 0.1)]:
        for fault, order in zip(FAULTS, orders):
            tests, past = ([judged(plant, noise, fault, seed, instruments=word).windows[0] for seed in range(RUNS)]
                           for word in ("inputs", "inputs+past"))
            usual, hidden = (int(np.median([test.order for test in t])) for t in (tests, past))
            own = [t.ratio for w in tests for t in (*w.rows, *w.columns) if t.name == fault] or [np.nan]
            others, key = min(t.ratio for w in tests for t in (w.rows[1], w.columns[1])), f"{plant}, {noise}, {fault}"
            found |= {key: usual, f"{key}, past": hidden, f"{key}, dead": max(own), f"{key}, others": others}
            print(f"{plant:<11}{noise:<6}{fault or 'none':<13}{usual:>5}{order:>9}{hidden:>13} "
                  f"{f'{min(own):.2f} - {max(own):.2f}':>13}{others:>12.0f}")
    figure, axes = panels(1, 2, sharey=True)
    for axis, fault in zip(axes[0], FAULTS[1:]):
        sliding = judged("coupled", 0.1, fault, 0, 2 * N, 5 * N, hop=N // 6)
        stops, tests = [w.stop for w in sliding.windows], [(*w.rows, *w.columns) for w in sliding.windows]
        for style, i in zip(("-", "--", "-", "--"), range(4)):
            axis.semilogy(stops, [t[i].ratio for t in tests], style, color=f"C{i // 2}", label=tests[0][i].name)
        axis.axhline(1, color="k", linewidth=0.8)
        axis.set(title=f"loss of {fault} at {2 * N}", xlabel="end of the window", ylabel="statistic / threshold")
        found[f"delay, {fault}"] = (sliding.alarm.stop if sliding.alarm else 10 * N) - 2 * N
        found[f"straddling, {fault}"] = next(w.order or 0 for w in sliding.windows if w.start == 2 * N - N // 2)
        print(f"loss of {fault} at {2 * N}: {sliding.explain()}")
    axes[0, 1].legend(fontsize="small")
    save(figure, folder, "ch7_hard_over.png")
    return found


if __name__ == "__main__":
    run(main)

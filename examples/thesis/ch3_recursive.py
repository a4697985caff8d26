"""Section 3.4: the estimates of a and b over time (Algorithm 3.2), gauge beta = 0.75.

Run: python ch3_recursive.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import BETA, bases, panels, recursion, run, save, table, with_style

from optid.examples import example


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return the last estimates of both bases and when they stay within 5 %; save the traces."""
    record, found = example("dead_zone", seed=0), {}
    data = record.data
    truth = np.concatenate([record.truth["a"], record.truth["b"][0]])
    figure, grid = panels(2, 2, sharex=True, sharey="row")
    for (name, basis), column in zip(bases(-1, 1).items(), grid.T):
        trace = recursion(data, basis).trace(data.u, data.y)
        _, b, ratio = trace.split(beta=BETA)
        estimates = np.hstack([trace.a, b])
        outside = (np.abs(estimates - truth) > 0.05 * np.abs(truth)).any(axis=1)
        settled = data.dt * (np.flatnonzero(outside)[-1] + 1)
        table(f"{name} basis, Algorithm 3.2 with P_0 = 1000 I", [
            ("a after 100 s", trace.a[-1], "(-1.50, 0.70)"),
            ("b after 100 s", b[-1], "(1.07, 0.79)"),
            ("a after 10 s", trace.a[99], ""),
            ("b after 10 s", b[99], ""),
            ("s_2 / s_1 after 100 s", ratio[-1], "0.02 to 0.04 (triangular)"),
            ("all four within 5 % of the truth from (s)", settled, ""),
        ])
        found |= {f"{name} {key}": value for key, value in zip(("a1", "a2", "b0", "b1"), estimates[-1])}
        found |= {f"{name} settled": settled, f"{name} ratio": ratio[-1]}
        time = data.dt * trace.samples
        for panel, values, aims, words in zip(
            column, (trace.a, b), (truth[:2], truth[2:]), (("a1", "a2"), ("b0", "b1"))
        ):
            for value, aim, word in zip(values.T, aims, words):
                line, = panel.plot(time, value, label=f"estimate of {word}")
                panel.axhline(aim, color=line.get_color(), linestyle="--", linewidth=0.8)
            panel.set(title=f"{name}: {'A' if words[0] == 'a1' else 'B'}", ylim=(aims.min() - 0.7, aims.max() + 0.7))
            panel.legend(loc="upper right", ncols=2)
        column[-1].set(xlabel="time (s)")
    save(figure, folder, "ch3_recursive.png")
    return found


if __name__ == "__main__":
    run(main)

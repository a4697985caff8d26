"""Figure of the quantitative isolability matrix."""

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from optid.faults.isolability import GRID, Isolability
from optid.show.panels import shorten, styled


@styled
def draw(found: Isolability) -> Figure:
    """Draw the deflections that isolate each fault from each other, and the probabilities by deflection."""
    needed = found.matrix * found.unit[:, None]
    count = len(found.labels)
    names = [shorten(label, 22) for label in found.labels]
    finite = needed[np.isfinite(needed) & (needed > 0)]
    figure = Figure(figsize=(10.0, 0.35 * count + 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    low, top = (float(finite.min()), float(finite.max())) if finite.size else (1.0, 10.0)
    shown = left.imshow(
        np.where(np.isfinite(needed), needed, np.nan), cmap="YlOrBr", norm=LogNorm(low, max(top, 2 * low))
    )
    for i in range(count):
        for j in range(count):
            word = f"{found.matrix[i, j]:.2g}" if np.isfinite(found.matrix[i, j]) else "never"
            dark = np.isfinite(needed[i, j]) and needed[i, j] > np.sqrt(low * top)
            left.text(j, i, word, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    left.set_xticks(range(count), names, rotation=40, ha="right")
    left.set_yticks(range(count), names)
    left.grid(False)
    left.set(title=f"size at which the row is isolated from the column, P = {found.prob:g}")
    figure.colorbar(shown, ax=left, label="required deflection", shrink=0.8)
    for number, (label, chance) in enumerate(zip(names, found.isolated)):
        right.semilogx(GRID[1:], chance[1:], ("-", "-.", ":")[number // 3 % 3], label=label)
    right.semilogx(GRID[1:], found.detected.mean(axis=0)[1:], "--", color="0.5", label="detection (mean)")
    right.axhline(found.prob, color="0.6", linewidth=0.8)
    right.set(title="probability of isolation", xlabel="deflection", ylim=(0, 1))
    right.set_xlim(1, min(2.5 * top, GRID[-1]))
    right.legend(fontsize=8)
    figure.suptitle(f"window of {found.window} samples, onset {found.onset}, false alarm {found.false_alarm:g}")
    return figure

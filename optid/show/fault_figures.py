"""Figures of faults: a study of isolability, a diagnosis, a reformulation."""

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from optid.faults.diagnosis.answers import Diagnosis
from optid.faults.isolability_study import Isolability
from optid.faults.repair.reformulation import Reformulation
from optid.phrases import short
from optid.show.diagnosis import diagnosis_charts
from optid.show.diagnosis_words import headline
from optid.show.isolability import isolation_chart
from optid.show.panels import draw_chart, draw_charts, plain, with_style
from optid.show.reformulation import explanation_names, reformulation_charts
from optid.show.sections import Chart


@with_style
def diagnosis(found: Diagnosis) -> Figure:
    """Draw innovations and energies below each other; `StructureError` for a diagnosis read from a file."""
    return _drawn(diagnosis_charts(found), 1, (9.6, 2.1), f"{found.verdict}: {headline(found)}")


@with_style
def reformulation(found: Reformulation) -> Figure:
    """Draw actuators and attainable outputs, before the fault and now, side by side."""
    title = f"{found.status}: {explanation_names(found.members) or 'healthy'}"
    return _drawn(reformulation_charts(found), 3, (3.6, 3.1), title)


def _drawn(charts: Sequence[Chart], most: int, size: tuple[float, float], title: str) -> Figure:
    """Draw charts in `most` columns, each of a size in inches."""
    columns = min(len(charts), most)
    rows = -(-len(charts) // columns)
    figure = Figure(figsize=(size[0] * columns + 0.6, size[1] * rows + 0.5), layout="constrained")
    draw_charts(figure, charts, most)
    figure.suptitle(plain(short(title, 90)), weight="bold")
    return figure


@with_style
def isolability(found: Isolability) -> Figure:
    """Draw the deflections that isolate each fault from each other, and the probabilities by deflection."""
    needed = found.matrix * found.unit[:, None]
    count = len(found.labels)
    names = [short(label, 22) for label in found.labels]
    finite = needed[np.isfinite(needed) & (needed > 0)]
    figure = Figure(figsize=(10.0, 0.35 * count + 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    low, top = (float(finite.min()), float(finite.max())) if finite.size else (1.0, 10.0)
    shown = left.imshow(
        np.where(np.isfinite(needed), needed, np.nan), cmap="YlOrBr", norm=LogNorm(low, max(top, 2 * low)))
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
    draw_chart(right, isolation_chart(found))
    right.axhline(found.prob, color="0.6", linewidth=0.8)
    figure.suptitle(f"window of {found.window} samples, onset {found.onset}, false alarm {found.false_alarm:g}")
    return figure

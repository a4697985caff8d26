"""Figure of a diagnosis."""

from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.diagnosis.answers import Diagnosis, Evidence
from optid.faults.diagnosis.words import headline
from optid.show.panels import BLUE, GREEN, GRID, INK, MUTED, ORANGE, plain, shorten, show_times, styled, thinned

WIDE = 26
"""Characters of a label beside a panel."""

ROWS = 12
"""Largest number of answers drawn."""


@styled
def draw(found: Diagnosis) -> Figure:
    """Draw the innovations with the signature of the best answer, the energies explained, and the probabilities.

    Raises:
        StructureError: a diagnosis read from a file: the record is not in it.
    """
    seen = found.evidence
    if seen is None:
        raise StructureError("The record is not in a saved diagnosis: draw it where it was diagnosed, or run it again.")
    outputs, count = seen.r.shape[1], max(len(seen.labels), 1)
    heights = [1.9] * outputs + [0.28 * count + 1.0]
    answers = found.candidates[:ROWS]
    if len(answers) > 1:
        heights.append(0.32 * len(answers) + 0.9)
    figure = Figure(figsize=(9.6, sum(heights) + 0.5), layout="constrained")
    axes = cast(list[Axes], np.atleast_1d(cast(Any, figure.subplots(len(heights), 1, height_ratios=heights))).tolist())
    names = found.outputs or tuple(f"y{o + 1}" for o in range(outputs))
    for o, ax in enumerate(axes[:outputs]):
        _innovations(ax, found, seen, o, names[o])
    _heat(figure, axes[outputs], found, seen)
    for ax in axes[outputs - 1 : outputs + 1]:
        show_times(ax, found.timeline)
    if len(answers) > 1:
        _probabilities(axes[outputs + 1], found, answers)
    figure.suptitle(plain(shorten(f"{found.verdict}: {headline(found)}", 90)), color=INK, fontsize=11, weight="bold")
    return figure


def _innovations(ax: Axes, found: Diagnosis, seen: Evidence, o: int, name: str) -> None:
    """Draw the whitened innovations of one output and the fit of the best answer."""
    k = np.arange(len(seen.r), dtype=float)
    there = seen.present[:, o]
    r = np.where(there, seen.r[:, o], np.nan)
    ax.plot(*thinned(k, r), color=MUTED, linewidth=0.8, label="innovation")
    if seen.fitted[:, o].any():
        ax.plot(*thinned(k, seen.fitted[:, o]), color=ORANGE, label="signature of the best answer")
    ax.axhspan(-2, 2, color=GRID, alpha=0.55, linewidth=0)
    _onsets(ax, found)
    title = "whitened innovations, mostly within 2 for a healthy plant" if o == 0 else ""
    ax.set(ylabel=plain(shorten(name)), xlim=(0, len(r) - 1), title=title)
    if o == 0 and seen.fitted.any():
        ax.legend(loc="upper left", ncols=3)


def _onsets(ax: Axes, found: Diagnosis) -> None:
    if found.best is None:
        return
    for fault, colour in zip(found.best.faults, (BLUE, GREEN) * len(found.best.faults)):
        low, high = fault.onset_interval
        ax.axvspan(low - 0.5, high + 0.5, color=colour, alpha=0.15, linewidth=0)
        ax.axvline(high if fault.onset_censored else fault.onset, color=colour, linewidth=1.0)


def _heat(figure: Figure, ax: Axes, found: Diagnosis, seen: Evidence) -> None:
    """Draw the energies explained beyond the thresholds, over onset and candidate."""
    gains: Array = seen.gains if seen.labels else np.full((1, len(seen.r)), np.nan)
    labels = [plain(shorten(label, WIDE)) for label in seen.labels] or ["no candidate is tested"]
    extent = (-0.5, gains.shape[1] - 0.5, len(labels) - 0.5, -0.5)
    how: dict[str, Any] = {"aspect": "auto", "extent": extent, "interpolation": "nearest"}
    ax.imshow(np.where(gains <= 0, np.maximum(gains, -20.0), np.nan), cmap="Greys", vmin=-20, vmax=40, **how)
    highest = float(np.nanmax(gains)) if np.isfinite(gains).any() else 0.0
    title = "energy that one candidate explains by its onset: below the threshold"
    if highest > 0:
        shown = ax.imshow(np.where(gains > 0, gains, np.nan), cmap="YlOrBr", vmin=0, vmax=highest, **how)
        figure.colorbar(shown, ax=ax, label="energy beyond\nthe threshold", pad=0.01)
        mark = "; encircled: the best answer" if found.best is not None else ""
        title = f"energy that one candidate explains by its onset{mark}"
    for fault in found.best.faults if found.best is not None else ():
        if fault.label in seen.labels:
            ax.plot(fault.onset, seen.labels.index(fault.label), "o", markerfacecolor="none", markeredgecolor=BLUE,
                    markersize=9, markeredgewidth=1.6)
    ax.set_yticks(range(len(labels)), labels)
    ax.grid(False)
    ax.set(xlabel="onset (sample)", title=title, xlim=extent[:2])


def _probabilities(ax: Axes, found: Diagnosis, answers: Any) -> None:
    values = [answer.posterior for answer in answers]
    where = np.arange(len(values))
    ax.barh(where, values, color=[ORANGE if answer is found.best else MUTED for answer in answers], height=0.6)
    for i, value in enumerate(values):
        ax.text(min(value + 0.01, 0.93), i, f"{value:.3f}", va="center", fontsize=8.5, color=INK)
    ax.set_yticks(where, [plain(shorten(answer.label, 2 * WIDE)) for answer in answers])
    ax.invert_yaxis()
    ax.grid(False, axis="y")
    ax.set(xlim=(0, 1), title=f"probability of each answer in the set of {100 * found.coverage:g} %")

"""Drawings on matplotlib axes: each function draws one panel, independent of its figure."""

from collections.abc import Callable, Sequence
from functools import wraps
from textwrap import wrap
from typing import Any, ParamSpec, TypeVar, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from optid.arrays import Array
from optid.show import sections
from optid.show.sections import Axis, Chart, extremes

INK, MUTED, GRID, PANEL = "#1d2530", "#5d6875", "#dfe4ea", "#ffffff"
BLUE, ORANGE, GREEN, RED = "#1063b5", "#a84e00", "#007a3e", "#b82e47"
"""Blue, orange and green of a colour-blind safe palette; red marks what lies outside a band."""

STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.labelsize": 9.0,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "axes.titlecolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.5,
    "lines.solid_capstyle": "round",
    "figure.facecolor": PANEL,
    "axes.facecolor": PANEL,
    "figure.constrained_layout.w_pad": 0.1,
    "figure.constrained_layout.h_pad": 0.08,
    "savefig.facecolor": PANEL,
    "axes.prop_cycle": f"cycler('color', ['{BLUE}', '{ORANGE}', '{GREEN}'])",
}

LINES = [(colour, dash) for dash in ("-", "--", ":") for colour in (BLUE, ORANGE, GREEN)]
COLOURS = {f"c{k}": LINES[k % len(LINES)] for k in range(10)} | {
    "ink": (INK, "-"), "muted": (MUTED, "-"), "red": (RED, "-")}
"""Colour and dash of the curves that a chart names by the variables of the style sheet."""

MARKERS = {"stems": "o", "diamonds": "D", "dots": "o", "poles": "x", "zeros": "o"}
"""Signs of the series of a chart that are no lines."""

CLOSEUP = 200
"""Samples of the close-up of a long record, in which single samples are visible."""

POINTS = 2000
"""Samples of a line; of a longer one the extremes and the gaps of a third as many stretches are drawn."""


P = ParamSpec("P")
R = TypeVar("R")


def with_style(draw: Callable[P, R]) -> Callable[P, R]:
    """Draw in this style; the user's settings stay as they are."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(cast(Any, STYLE)):
            return draw(*args, **kwargs)

    return inside


def attempt_panels(figure: Any, what: str, draw: Callable[[Any], None]) -> None:
    """Draw a part of a figure, or write the reason why it could not be computed in its place."""
    try:
        draw(figure)
    except sections.CAUGHT as error:
        figure.clear()
        write(figure, sections.failure(what, error))


def write(figure: Any, sentence: str) -> None:
    """Write a sentence in the middle of a figure."""
    figure.text(0.5, 0.5, plain("\n".join(wrap(sentence, 90))), ha="center", va="center")


def plain(text: str) -> str:
    """Write text for a figure: a dollar sign is a dollar sign, not mathematics."""
    return text.replace("$", r"\$")


def thin_line(t: Array, y: Array) -> tuple[Array, Array]:
    """Keep the extremes of every bin of a long line, so that no peak is lost; t, y (N,) become `POINTS` long."""
    if y.size <= POINTS:
        return t, y
    picked = extremes(y, POINTS // 3)
    return t[picked], y[picked]


def instants(values: Any, axis: Axis) -> Any:
    """Return places on an axis as matplotlib draws them: those on an axis of dates as dates."""
    values = np.asarray(values)
    return (values * 1e6).round().astype("M8[us]") if axis.dates else values


def show_dates(ax: Axes) -> None:
    """Set the ticks of an x axis of dates; what the ticks leave out stands at their end."""
    figure: Any = ax.get_figure()
    width = ax.get_position().width * figure.bbox.width / figure.dpi  # in inches, before the layout
    most = int(np.clip(width / 0.75, 2, 7))
    locator = AutoDateLocator(minticks=min(most - 1, 3), maxticks=most)
    ax.xaxis.label.set(x=0, horizontalalignment="left")
    ax.xaxis.set_major_locator(locator)
    ax.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def liveliest(y: Array) -> slice:
    """Return the stretch of `CLOSEUP` samples in which the signals (N, s) move most, each in units of its spread."""
    spread = np.nanstd(y, axis=0)
    scaled = y / np.where(spread > 0, spread, 1.0)
    starts = range(0, max(1, len(y) - CLOSEUP), CLOSEUP // 2)
    windows = [scaled[start : start + CLOSEUP] for start in starts]
    moved = [float(np.sum(np.nanstd(w[:, ~np.isnan(w).all(axis=0)], axis=0))) for w in windows]
    first = starts[int(np.argmax(moved))]
    return slice(first, first + CLOSEUP)


def draw_chart(ax: Axes, chart: Chart, legend: bool = True, title: str = "") -> None:
    """Draw a chart of a page on axes, under its own title or another; a legend where there are several names."""
    for one in chart.series:
        name, (colour, dash) = plain(one.name) or None, COLOURS[one.colour]
        xs, ys = instants(one.xs, chart.x), np.asarray(one.ys)
        if one.kind == "area":
            ax.fill_between(xs, one.lows, ys, color=colour, alpha=0.2, linewidth=0, label=name)
        elif one.kind == "bars":
            ax.bar(xs, 0.16 * ys, xs[1] - xs[0], align="edge", color=colour, alpha=0.3, linewidth=0, label=name,
                   transform=ax.get_xaxis_transform())
        elif one.kind in MARKERS:
            if one.kind in ("stems", "diamonds"):
                ax.vlines(xs, 0, ys, color=colour, linewidth=1.3)
            ax.plot(xs, ys, MARKERS[one.kind], color=colour, markersize=6 if one.kind in ("poles", "zeros") else 4,
                    label=name, fillstyle="none" if one.kind == "zeros" else "full")
        else:
            style: Any = (0, tuple(map(float, one.dash.split()))) if one.dash else dash
            ax.plot(*thin_line(xs, ys), color=colour, linestyle=style, linewidth=0.85 * one.width, label=name,
                    drawstyle="steps-post" if one.held else "default")
    ax.set(xlabel=plain(chart.x.title), ylabel=plain(chart.y.title), title=plain(title or chart.title))
    ax.set(**{f"{name}scale": "log" for name, axis in (("x", chart.x), ("y", chart.y)) if axis.log})
    ax.set(xlim=(chart.x.low, chart.x.high), ylim=(chart.y.low, chart.y.high))
    if any(one.kind == "bars" for one in chart.series):  # below the curves
        low, high = ax.get_ylim()
        ax.set_ylim(low - 0.25 * (high - low), high)
    if chart.x.dates:
        show_dates(ax)
    elif not chart.x.log and all(np.all(np.asarray(one.xs) % 1 == 0) for one in chart.series):
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    if chart.equal:
        ax.set_aspect("equal")
        ax.grid(False)
    if legend and sum(bool(one.name) for one in chart.series) > 1:
        ax.legend(loc="best", handlelength=1.6)


def draw_charts(figure: Any, charts: Sequence[Chart], most: int = 3) -> Any:
    """Draw charts in rows of at most so many, and return their axes."""
    columns = min(len(charts), most)
    axes = figure.subplots(-(-len(charts) // columns), columns, squeeze=False).ravel()
    for ax, chart in zip(axes, charts):
        draw_chart(ax, chart)
    for ax in axes[len(charts) :]:
        ax.remove()
    return axes


def draw_gap(ax: Axes, gap: float, threshold: float) -> None:
    """Draw the relative gap on a logarithmic scale, with the part of it that counts as a proof."""
    low, high, across = 1e-16, 1.0, ax.get_xaxis_transform()
    for word, start, end, colour, shade in (
        ("proved", low, threshold, GREEN, 0.14), ("not proved", threshold, high, ORANGE, 0.12)
    ):
        ax.axvspan(start, end, color=colour, alpha=shade, linewidth=0)
        ax.text(np.sqrt(start * end), 0.83, word, color=colour, ha="center", va="center", transform=across)
    if np.isfinite(gap):
        at = float(np.clip(gap, 2 * low, high))
        colour = GREEN if gap <= threshold else ORANGE
        ax.plot([at], [0.42], "D", color=colour, markersize=9, transform=across, clip_on=False)
        shift, side = (9, "left") if at < threshold else (-9, "right")
        ax.annotate(f"{gap:.1e}" if gap else "0", (at, 0.42), xycoords=across, xytext=(shift, 0),
                    textcoords="offset points", va="center", ha=side, fontweight="bold")
    ax.set_xscale("log")
    ax.set(xlim=(low, high), yticks=[], xlabel="relative gap between objective and certified bound")
    ax.spines["left"].set_visible(False)
    ax.grid(False)


def draw_ladder(ax: Axes, rungs: Sequence[str], reached: int, closed: bool) -> None:
    """Draw the steps of a proof as a row of boxes; those up to `reached` were taken, the last one in colour."""
    ax.set_axis_off()
    ax.set(xlim=(0, len(rungs)), ylim=(0, 1))
    for i, rung in enumerate(rungs):
        last, taken = i == reached, i <= reached
        colour = (GREEN if closed else ORANGE) if last else MUTED
        ax.add_patch(FancyBboxPatch(
            (i + 0.08, 0.2), 0.84, 0.6, boxstyle="round,pad=0,rounding_size=0.1", facecolor=colour if last else "none",
            edgecolor=colour, linewidth=1.1, alpha=1.0 if taken else 0.4, mutation_aspect=0.5))
        ax.text(i + 0.5, 0.5, rung, ha="center", va="center", color=PANEL if last else INK if taken else MUTED,
                fontsize=8.5, fontweight="bold" if last else "normal", alpha=1.0 if taken else 0.6)
        if i + 1 < len(rungs):
            ax.annotate("", (i + 1.08, 0.5), (i + 0.92, 0.5),
                        arrowprops={"arrowstyle": "-", "color": MUTED, "alpha": 0.6})

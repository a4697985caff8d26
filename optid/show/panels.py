"""Drawings on matplotlib axes: each function draws one panel, and knows nothing of the figure around it."""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from optid.arrays import Array
from optid.identify.validation.correlations import Correlation
from optid.show.sections import decibels, extremes

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
"""Colour and dash of the first, second, ... of several curves."""

CLOSEUP = 200
"""Samples of a long record that are drawn where single ones are to be told apart."""

POINTS = 2000
"""A line with more samples than this is drawn as the smallest and largest sample of each of half as many bins."""


P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Draw in this style; the user's settings stay as they are."""

    @wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(cast(Any, STYLE)):
            return draw(*args, **kwargs)

    return inside


def plain(text: str) -> str:
    """Write text for a figure: a dollar sign is a dollar sign, not mathematics."""
    return text.replace("$", r"\$")


def with_unit(name: str, unit: str) -> str:
    """Return "name (unit)", or the name alone, as `plain` text."""
    return plain(f"{name} ({unit})" if unit else name)


def shorten(name: str, most: int = 18) -> str:
    """Cut a long name, so that it fits above a small panel."""
    return name if len(name) <= most else name[: most - 1] + "\N{HORIZONTAL ELLIPSIS}"


def thinned(t: Array, y: Array) -> tuple[Array, Array]:
    """Keep the extremes of every bin of a long line, so that no peak is lost; t, y (N,) become `POINTS` long."""
    if y.size <= POINTS:
        return t, y
    picked = extremes(y, POINTS // 2)
    return t[picked], y[picked]


def liveliest(y: Array) -> slice:
    """Return the stretch of `CLOSEUP` samples in which the signals (N, s) move most, each in units of its spread."""
    spread = np.nanstd(y, axis=0)
    scaled = y / np.where(spread > 0, spread, 1.0)
    starts = range(0, max(1, len(y) - CLOSEUP), CLOSEUP // 2)
    windows = [scaled[start : start + CLOSEUP] for start in starts]
    moved = [float(np.sum(np.nanstd(w[:, ~np.isnan(w).all(axis=0)], axis=0))) for w in windows]
    first = starts[int(np.argmax(moved))]
    return slice(first, first + CLOSEUP)


def draw_record(ax: Axes, t: Array, lines: Sequence[tuple[str, Array, dict[str, Any]]]) -> None:
    """Draw several signals (N,) over the time t (N,): (label, signal, options of the line)."""
    for label, y, options in lines:
        ax.plot(*thinned(t, y), label=label, **options)
    ax.margins(x=0.01)


def draw_nonlinearity(
    ax: Axes, f: Any, u: Array, band: tuple[Array, Array, Array] | None, *, name: str, label: str
) -> None:
    """Draw f over the range of its input, its confidence band, and where the samples lie.

    Args:
        ax: axes.
        f: the `Nonlinearity`.
        u: (N,) samples of the input; may be empty.
        band: (grid, lower, upper), or None.
        name: name of the input, with its unit.
        label: name of the function.
    """
    low, high = f.basis.interval or ((float(np.nanmin(u)), float(np.nanmax(u))) if u.size else (-1.0, 1.0))
    grid = np.linspace(low, high, 401)
    values = f(grid)
    bottom, top = float(np.min(values)), float(np.max(values))
    if band is not None:
        points, lower, upper = band
        ax.fill_between(points, lower, upper, color=BLUE, alpha=0.22, linewidth=0, label="95 % band")
        bottom, top = min(bottom, float(np.min(lower))), max(top, float(np.max(upper)))
    ax.plot(grid, values, color=BLUE, linewidth=2.0, label=label)
    span = (top - bottom) or 1.0
    ax.set_ylim(bottom - 0.3 * span, top + 0.06 * span)
    here = u[(u >= low) & (u <= high)]
    if here.size:
        counts, edges = np.histogram(here, bins=40, range=(low, high))
        ax.bar(edges[:-1], 0.16 * counts / counts.max(), np.diff(edges), align="edge", color=MUTED, alpha=0.3,
               linewidth=0, transform=ax.get_xaxis_transform(), label="samples")
    ax.set_xlim(low - 0.02 * (high - low), high + 0.02 * (high - low))
    ax.set_xlabel(name)
    ax.legend(loc="best", handlelength=1.4)


def draw_correlation(ax: Axes, test: Correlation, title: str) -> None:
    """Draw the correlations of a residual test as stems, with their 99 % band; values outside it as red diamonds."""
    lags, values = test.lags, test.values
    tested = lags != 0 if test.input is None else np.full(lags.size, True)  # an autocorrelation is one at lag zero
    lags, values, band = lags[tested], values[tested], test.band[tested]
    ax.fill_between(lags, -band, band, color=MUTED, alpha=0.16, linewidth=0)
    ax.axhline(0, color=MUTED, linewidth=0.8)
    outside = np.abs(values) > band
    for mask, colour, marker in ((~outside, BLUE, "o"), (outside, RED, "D")):
        ax.vlines(lags[mask], 0, values[mask], color=colour, linewidth=1.3)
        ax.plot(lags[mask], values[mask], marker, color=colour, markersize=3.2)
    reach = 1.15 * float(np.nanmax(np.abs(values), initial=1.3 * float(np.nanmax(band, initial=1e-3))))
    ax.set_ylim(-reach, reach)
    ax.set_title(title)
    ax.set_xlabel("lag")
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))


def draw_poles(ax: Axes, poles: Array) -> None:
    """Draw complex poles in the unit circle."""
    ax.add_patch(Circle((0, 0), 1.0, facecolor="none", edgecolor=MUTED, linewidth=1.0))
    ax.axhline(0, color=GRID, linewidth=0.8)
    ax.axvline(0, color=GRID, linewidth=0.8)
    inside = np.abs(poles) < 1
    for mask, colour in ((inside, BLUE), (~inside, RED)):
        ax.plot(poles[mask].real, poles[mask].imag, "x", color=colour, markersize=7, markeredgewidth=1.8)
    reach = 1.12 * max(1.0, float(np.max(np.abs(poles), initial=0.0)))
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="real", ylabel="imaginary")
    ax.grid(False)
    ax.set_title("Poles")


def draw_steps(ax: Axes, dt: float, responses: Array, labels: Sequence[str]) -> None:
    """Draw step responses (n, K) over the time; K names, one alone is not shown."""
    t = dt * np.arange(len(responses))
    for k, (label, (colour, dash)) in enumerate(zip(labels, LINES * len(labels))):
        ax.step(t, responses[:, k], linestyle=dash, color=colour, label=label, where="post")
    ax.axhline(0, color=MUTED, linewidth=0.8)
    ax.margins(x=0.01)
    ax.set(xlabel="time")
    ax.set_title("Step response")


def draw_response(
    ax: Axes, w: Array, response: Array, bands: Sequence[tuple[Array, Array] | None], labels: Sequence[str]
) -> None:
    """Draw magnitudes in dB over the frequency.

    Args:
        ax: axes.
        w: (F,) frequencies, rad per unit of time.
        response: (F, K) complex responses.
        bands: K pairs of lower and upper magnitude (F,), or None.
        labels: K names; one alone is not shown.
    """
    for k, (label, band) in enumerate(zip(labels, bands)):
        colour, dash = LINES[k % len(LINES)]
        if band is not None:
            ax.fill_between(w, decibels(band[0]), decibels(band[1]), color=colour, alpha=0.2, linewidth=0)
        ax.plot(w, decibels(np.abs(response[:, k])), dash, color=colour, label=label)
    ax.set_xscale("log")
    ax.set_xlim(w[0], w[-1])
    ax.set(xlabel="frequency (rad per unit of time)", ylabel="magnitude (dB)")
    ax.set_title("Frequency response")
    if len(labels) > 1:
        ax.legend(loc="lower left", ncols=2, handlelength=1.6)


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


def draw_singular_values(ax: Axes, values: Array, name: str, rank: int = 1) -> None:
    """Draw singular values relative to the first; those up to `rank` in colour: they should stand out."""
    relative = values / max(float(values[0]), 1e-300)
    order = np.arange(1, values.size + 1)
    floor = max(1e-16, 0.3 * float(np.min(relative[relative > 0], initial=1.0)))
    ax.vlines(order, floor, np.maximum(relative, floor), color=GRID, linewidth=3)
    ax.plot(order[:rank], np.maximum(relative[:rank], floor), "o", color=BLUE, markersize=7)
    ax.plot(order[rank:], np.maximum(relative[rank:], floor), "o", color=MUTED, markersize=6)
    ax.set_yscale("log")
    ax.set(ylim=(floor, 2.0), xlabel="index", ylabel="relative to the first", xlim=(0.5, values.size + 0.5))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_title(name)

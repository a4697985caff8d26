"""A figure of a reformulation: effect of the actuators, attainable outputs, predicted errors of the outputs."""

from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optid.show.panels import BLUE, GREEN, INK, MUTED, ORANGE, plain, shorten, styled

if TYPE_CHECKING:
    from optid.faults.repair.reformulation import MemberModel, Reformulation

COLOURS = (ORANGE, GREEN, BLUE)


@styled
def draw(found: "Reformulation") -> Figure:
    """Draw the nonlinearities before and after, the attainable outputs, and the errors of the outputs."""
    inputs = found.healthy.m
    flat = found.healthy.l == 2
    lost = bool(found.observer.lost)
    panels = inputs + int(flat) + int(lost)
    columns = 2 if panels == 4 else min(panels, 3)
    rows = -(-panels // columns)
    figure = Figure(figsize=(3.6 * columns + 0.6, 3.1 * rows + 0.5), layout="constrained")
    axes = cast(list[Axes], np.atleast_1d(cast(Any, figure.subplots(rows, columns))).ravel().tolist())
    for c in range(inputs):
        _input(axes[c], found, c)
    if flat:
        _attainable(axes[inputs], found)
    if lost:
        _sensors(axes[panels - 1], found)
    for ax in axes[panels:]:
        ax.set_visible(False)
    label = " or ".join(member.label for member in found.members) or "healthy"
    figure.suptitle(plain(shorten(f"{found.status}: {label}", 90)), color=INK, fontsize=11, weight="bold")
    return figure


def _shown(found: "Reformulation") -> "list[tuple[MemberModel, str, str]]":
    """Explanations that are drawn, with their colours and labels."""
    one = len(found.members) == 1
    return [(member, colour, "now" if one else shorten(member.label, 20))
            for member, colour in zip(found.members, COLOURS)]


def _input(ax: Axes, found: "Reformulation", c: int) -> None:
    """One input: its nonlinearities before and now, with the standard errors of a refit."""
    columns, healthy = [i for i, of in enumerate(found.healthy.input_of) if of == c], found.healthy.nonlinearities
    low, high = healthy[columns[0]].basis.interval or (-1.0, 1.0)
    if found.allocation is not None:
        low, high = float(found.allocation.low[c]), float(found.allocation.high[c])
    u = np.linspace(low, high, 301)
    before = [np.asarray(healthy[i](u)) for i in columns]
    for i, values in zip(columns, before):
        ax.plot(u, values, color=MUTED, linestyle="--", label="before")
        for member, colour, name in _shown(found):
            if i not in member.damage.columns:
                continue
            curves = () if member.schedule is None else member.schedule.values
            one = next((curve for curve in curves if curve.column == i), None)
            if one is None:
                ax.plot(u, member.damage.gains[i] * values + member.damage.constants[i], color=colour, label=name)
                continue
            at, now, unseen = one.nodes, one.values, one.prior_only
            ax.plot(at, now, color=colour, label=name)
            ax.fill_between(at, now - 2 * one.std, now + 2 * one.std, color=colour, alpha=0.2, linewidth=0)
            ax.plot(at[~unseen], now[~unseen], "o", color=colour, markersize=4)
            ax.plot(at[unseen], now[unseen], "o", color=colour, markersize=4, markerfacecolor="white",
                    label="prior only" if unseen.any() else None)
    least, most = min(map(np.min, before)), max(map(np.max, before))
    margin = 0.35 * max(float(most - least), 1e-12)
    ax.set_ylim(float(least) - margin, float(most) + margin)
    ax.set(title=plain(f"actuator {shorten(found.healthy.inputs[c])}"), xlabel="input", ylabel="effect")
    ax.legend(fontsize=8)


def _attainable(ax: Axes, found: "Reformulation") -> None:
    """The attainable steady outputs, before and after."""
    from optid.errors import OptidError
    from optid.faults.repair.allocation import allocate

    sets = [(member.allocation, colour, word, "-") for member, colour, word in _shown(found)]
    if found.allocation is not None:
        with suppress(OptidError):
            before = allocate(found.healthy, low=found.allocation.low, high=found.allocation.high, route="qp")
            sets.insert(0, (before, MUTED, "before", "--"))
    for allocation, colour, word, dash in sets:
        if allocation is None or not allocation.problem.linear:
            continue
        corners = allocation.corners()
        if len(corners) > 2:
            ax.fill(*corners.T, color=colour, alpha=0.15, linewidth=0)
        around = np.vstack([corners, corners[:1]])
        ax.plot(*around.T, dash, color=colour, label=word, marker="o" if len(corners) == 1 else None)
    names = [plain(shorten(name)) for name in found.healthy.outputs]
    ax.set(title="attainable outputs", xlabel=names[0], ylabel=names[1])
    if ax.get_legend_handles_labels()[0]:
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.35 * (high - low))
        ax.legend(fontsize=8, loc="upper right")


def _sensors(ax: Axes, found: "Reformulation") -> None:
    """Predicted errors of the outputs: of the readings, and of the filter on the remaining sensors."""
    from optid.faults.repair.virtual_sensor import observer

    before = observer(found.healthy)
    bars = [("noise of the sensor", before.noise, MUTED), ("filter before", before.rmse, BLUE),
            ("filter now", found.observer.rmse, ORANGE)]
    names, width = found.healthy.outputs, 0.8 / len(bars)
    places = np.arange(len(names), dtype=float)
    for number, (label, values, colour) in enumerate(bars):
        ax.bar(places + (number - 1) * width, list(values.values()), width * 0.92, color=colour, label=label)
    ax.set_xticks(places, [plain(shorten(name, 14)) + "\n(not used)" * (name in found.observer.lost) for name in names])
    ax.grid(False, axis="x")
    ax.set(title="errors of the outputs, predicted", ylabel="root mean square")
    ax.set_ylim(0, 1.35 * max(max(values.values()) for _, values, _ in bars))
    ax.legend(fontsize=8, loc="upper right")

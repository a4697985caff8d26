"""A reformulation as a picture: what the actuators do now, where the plant can rest, what the sensors still say."""

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from optid.show.panels import BLUE, GREEN, INK, MUTED, ORANGE, plain, shorten, styled

if TYPE_CHECKING:
    from optid.faults.repair.allocation import Allocation
    from optid.faults.repair.reformulation import MemberModel, Reformulation
    from optid.models import HammersteinSS

COLOURS = (ORANGE, GREEN, BLUE)


@styled
def draw(found: "Reformulation") -> Figure:
    """Draw the nonlinearities before and now, the outputs that can be held, and what replaces a lost sensor.

    Args:
        found: the reformulation.
    """
    inputs = found.healthy.m
    flat = found.healthy.l == 2
    lost = bool(found.observer.lost)  # with all sensors left nothing has changed of what they say
    panels = inputs + int(flat) + int(lost)
    columns = 2 if panels == 4 else min(panels, 3)
    rows = -(-panels // columns)
    figure = Figure(figsize=(3.6 * columns + 0.6, 3.1 * rows + 0.5), layout="constrained")
    axes = cast(list[Axes], np.atleast_1d(cast(Any, figure.subplots(rows, columns))).ravel().tolist())
    shown = found.members[: len(COLOURS)]
    for c in range(inputs):
        _input(axes[c], found, shown, c)
    if flat:
        _attainable(axes[inputs], found, shown)
    if lost:
        _sensors(axes[panels - 1], found, shown)
    for ax in axes[panels:]:
        ax.set_visible(False)
    label = " or ".join(member.label for member in found.members) or "healthy"
    figure.suptitle(plain(shorten(f"{found.status}: {label}", 90)), color=INK, fontsize=11, weight="bold")
    return figure


def actuator_values(model: "HammersteinSS", healthy: "HammersteinSS", column: int, u: np.ndarray) -> np.ndarray:
    """Return f of one column with the constant that a refit has put into the constants of the model."""
    b = np.concatenate([healthy.B[:, column], healthy.D[:, column]])
    moved = np.concatenate([model.offset_x - healthy.offset_x, model.offset_y - healthy.offset_y])
    constant = float(b @ moved / (b @ b)) if b.any() and np.array_equal(model.B, healthy.B) else 0.0
    return np.asarray(model.nonlinearities[column](u)) + constant


def _input(ax: Axes, found: "Reformulation", shown: "tuple[MemberModel, ...]", c: int) -> None:
    """One input: its nonlinearities before and now, with the standard errors of a refit."""
    columns = [i for i, of in enumerate(found.healthy.input_of) if of == c]
    low, high = _range(found, columns[0], c)
    u = np.linspace(low, high, 301)
    for i in columns:
        ax.plot(u, np.asarray(found.healthy.nonlinearities[i](u)), color=MUTED, linestyle="--", label="before")
        for member, colour in zip(shown, COLOURS):
            if i not in member.damage.columns:
                continue
            name = "now" if len(shown) == 1 else shorten(member.label, 20)
            values = [] if member.schedule is None else [v for v in member.schedule.values if _of(v.name, found, c)]
            if values:
                one = values[columns.index(i)] if len(values) > columns.index(i) else values[0]
                ax.plot(one.nodes, one.values, color=colour, label=name)
                ax.fill_between(one.nodes, one.values - 2 * one.std, one.values + 2 * one.std, color=colour, alpha=0.2,
                                linewidth=0)
                ax.plot(one.nodes[~one.prior_only], one.values[~one.prior_only], "o", color=colour, markersize=4)
                ax.plot(one.nodes[one.prior_only], one.values[one.prior_only], "o", color=colour, markersize=4,
                        markerfacecolor="white", label="prior only" if one.prior_only.any() else None)
            else:
                ax.plot(u, actuator_values(member.model, found.healthy, i, u), color=colour, label=name)
    everything = np.concatenate([np.asarray(found.healthy.nonlinearities[i](u)) for i in columns])
    margin = 0.35 * max(float(np.ptp(everything)), 1e-12)
    ax.set_ylim(float(everything.min()) - margin, float(everything.max()) + margin)
    ax.set(title=plain(f"actuator {shorten(found.healthy.inputs[c])}"), xlabel="input", ylabel="effect")
    ax.legend(fontsize=8)


def _of(name: str, found: "Reformulation", c: int) -> bool:
    return name == found.healthy.inputs[c] or name.rpartition(" ")[0] == found.healthy.inputs[c]


def _range(found: "Reformulation", column: int, c: int) -> tuple[float, float]:
    if found.allocation is not None:
        return float(found.allocation.low[c]), float(found.allocation.high[c])
    interval = found.healthy.nonlinearities[column].basis.interval
    return interval if interval is not None else (-1.0, 1.0)


def _attainable(ax: Axes, found: "Reformulation", shown: "tuple[MemberModel, ...]") -> None:
    """The outputs that can be held at rest, before and now."""
    names = found.healthy.outputs
    before = _before(found)
    if before is not None:
        _outline(ax, before, MUTED, "before", "--")
    for member, colour in zip(shown, COLOURS):
        if member.allocation is not None and member.allocation.problem.linear:
            _outline(ax, member.allocation, colour, "now" if len(shown) == 1 else shorten(member.label, 20), "-")
    ax.set(title="outputs that can be held", xlabel=plain(shorten(names[0])), ylabel=plain(shorten(names[1])))
    if ax.get_legend_handles_labels()[0]:
        low, high = ax.get_ylim()
        ax.set_ylim(low, high + 0.35 * (high - low))
        ax.legend(fontsize=8, loc="upper right")


def _before(found: "Reformulation") -> "Allocation | None":
    from optid.errors import OptidError
    from optid.faults.repair.allocation import allocate

    if found.allocation is None:
        return None
    try:
        before = allocate(found.healthy, low=found.allocation.low, high=found.allocation.high, route="qp")
    except OptidError:
        return None
    return before


def _outline(ax: Axes, allocation: "Allocation", colour: str, label: str, dash: str) -> None:
    corners = allocation.corners()
    if len(corners) > 2:
        ax.fill(corners[:, 0], corners[:, 1], color=colour, alpha=0.15, linewidth=0)
    around = np.vstack([corners, corners[:1]])
    ax.plot(around[:, 0], around[:, 1], dash, color=colour, label=label, marker="o" if len(corners) == 1 else None)


def _sensors(ax: Axes, found: "Reformulation", shown: "tuple[MemberModel, ...]") -> None:
    """Predicted errors of the outputs: of the readings, and of the filter on what is left."""
    from optid.faults.repair.virtual_sensor import observer

    names = [shorten(name, 14) for name in found.healthy.outputs]
    places = np.arange(len(names), dtype=float)
    assert found.healthy.noise is not None
    bars: list[tuple[str, list[float], str]] = [
        ("noise of the sensor", np.sqrt(np.diag(found.healthy.noise.R)).tolist(), MUTED),
        ("filter before", list(observer(found.healthy).rmse.values()), BLUE),
    ]
    if found.members:
        bars.append(("filter now", list(found.observer.rmse.values()), ORANGE))
    width = 0.8 / len(bars)
    for number, (label, values, colour) in enumerate(bars):
        ax.bar(places + (number - (len(bars) - 1) / 2) * width, values, width * 0.92, color=colour, label=label)
    lost = set(found.observer.lost)
    words = [f"{name}\n(not used)" if full in lost else name for name, full in zip(names, found.healthy.outputs)]
    ax.set_xticks(places, [plain(word) for word in words])
    ax.grid(False, axis="x")
    ax.set(title="errors of the outputs, predicted", ylabel="root mean square")
    ax.set_ylim(0, 1.35 * max(max(values) for _, values, _ in bars))
    ax.legend(fontsize=8, loc="upper right")

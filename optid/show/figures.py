"""Figures of a record, of a comparison of models, and of a study of the order."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from optid.data.record import Data
from optid.identify.order.study import OrderStudy
from optid.show import panels
from optid.show.panels import CLOSEUP, INK, LINES, plain, styled, with_unit

if TYPE_CHECKING:
    from optid.identify.validation import Comparison


def channels(data: Data) -> Figure:
    """Draw one panel a channel, inputs first, and one curve an experiment."""
    units = dict(zip(data.inputs + data.outputs, data.input_units + data.output_units))
    figure = Figure(figsize=(8, 1 + 1.4 * len(units)), layout="constrained")
    axes = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    for c, (panel, (name, unit)) in enumerate(zip(axes, units.items())):
        for e, samples in zip(data.experiments, data.records):
            t = e.start + data.dt * np.arange(e.n_samples)
            panel.plot(*panels.thinned(t, samples[:, c]), lw=0.9, drawstyle="steps-post" if c < data.m else "default")
        panel.set_ylabel(plain(f"{name} [{unit}]" if unit else name))
    axes[-1].set_xlabel("time")
    if data.name:
        figure.suptitle(plain(data.name))
    return figure


@styled
def simulations(found: "Comparison") -> Figure:
    """Draw the measured outputs and every simulation; of a long record the stretch in which the outputs move most."""
    record, several = found.data, sum(bool(arrays) for arrays in found.simulated)
    figure = Figure(figsize=(9.0, 2.9 * record.l + 0.35 * several), layout="constrained")
    axes = figure.subplots(record.l, 1, squeeze=False, sharex=True)[:, 0]
    k = int(np.argmax([e.n_samples for e in record.experiments]))
    e = record.experiments[k]
    part = panels.liveliest(e.y) if len(e.y) > 2 * CLOSEUP else slice(len(e.y))
    t = (e.start + record.dt * np.arange(e.n_samples, dtype=float))[part]
    for o, (ax, name) in enumerate(zip(axes, record.outputs)):
        thin: dict[str, Any] = {"color": INK, "linewidth": 1.0}
        lines = [("measured", e.y[part, o], thin)]
        for label, arrays, (colour, dash) in zip(found.names, found.simulated, LINES * len(found.names)):
            if arrays:
                lines.append((plain(label), arrays[k][part, o], {"color": colour, "linestyle": dash}))
        panels.draw_record(ax, t, lines)
        ax.set_ylabel(with_unit(name, record.output_units[o]))
    axes[0].set_title("Simulations" + (f", experiment {k + 1}" if record.n_experiments > 1 else ""))
    axes[-1].set_xlabel("time")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=1)
    return figure


@styled
def order_study(study: OrderStudy) -> Figure:
    """Draw singular values with thresholds, criteria and hold-out by number of states, and the scan of lags."""
    ranks, states = study.ranks, study.states
    figure = Figure(figsize=(8.6, 6.0), layout="constrained")
    (values, tails), (criteria, lags) = figure.subplots(2, 2)
    n = np.arange(ranks.singular_values.size)
    floor = max(ranks.floor, 1e-300)
    values.semilogy(n + 1, np.maximum(ranks.singular_values, floor / 10), "o-", label="singular value")
    values.axvline(study.nx + 0.5, color="0.6", linewidth=1.0, linestyle="--")
    if ranks.exact:
        values.axhline(floor, color="0.4", linewidth=0.8, label="rounding")
    values.set(title=f"singular values: {ranks.order} are more than noise", xlabel="i")
    tails.semilogy(n, np.maximum(np.sqrt(ranks.statistics), floor / 10), "o", label="those after n together")
    tails.semilogy(n, np.maximum(np.sqrt(ranks.thresholds), floor / 10), "k_", markersize=11,
                   label=f"threshold, level {ranks.level:.2g}")
    tails.semilogy(n, np.maximum(np.sqrt(ranks.expected), floor / 10), ":", color="0.5", label="expected of noise")
    tails.set(title="order n is accepted below its threshold", xlabel="n")
    k = np.arange(states.bic.size)
    for name, word in (("aicc", "AICc"), ("bic", "BIC")):
        cost = getattr(states, name)
        criteria.plot(k, (cost - cost.min()) / states.windows, "o-", markersize=3, label=f"{word} per window")
    criteria.set(title="prediction errors, above the best", xlabel="n")
    criteria.set_yscale("symlog", linthresh=0.01)  # the first orders are far above, the others near the best
    criteria.set_ylim(bottom=0)
    if np.isfinite(states.fit).any():
        other = criteria.twinx()
        other.plot(k, states.fit, "s--", color="0.4", markersize=3)
        other.set_ylabel("hold-out fit, % (dashed)")
        other.grid(False)
    _draw_lags(study, lags)
    for axes, where in ((values, "upper right"), (tails, "upper right"), (criteria, "lower right")):
        axes.legend(loc=where)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    title = f"recommended: nx = {study.nx}"
    if study.lags is not None:
        title += f"; {study.lags.best('bic')}"
    figure.suptitle(title)
    return figure


def _draw_lags(study: OrderStudy, axes: Any) -> None:
    if study.lags is None:
        axes.text(0.5, 0.5, "no scan of lags", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    candidates, least = study.lags.candidates, study.lags.best("bic").bic
    for word, mark in (("na", "o-"), ("nb", "s-"), ("nk", "^-")):
        values = [int(np.ravel(getattr(c, word))[0]) for c in candidates]
        counts = sorted(set(values))
        found = [min(c.bic for c, value in zip(candidates, values) if value == count) for count in counts]
        axes.plot(counts, (np.array(found) - least) / study.lags.rows, mark, label=f"over {word}")
    axes.set(title="lags: least BIC per row, above the best", xlabel="na, nb, nk")
    axes.legend()

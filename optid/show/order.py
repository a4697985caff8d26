"""The picture of a study of the order."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from optid.identify.order.study import OrderStudy
from optid.show.panels import styled


@styled
def draw(study: OrderStudy) -> Figure:
    """Draw singular values with thresholds, criteria and hold-out by number of states, and the scan of lags.

    Args:
        study: what `optid.order` returned.
    """
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

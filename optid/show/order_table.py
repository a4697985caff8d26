"""The text of a study of the order."""

import textwrap

import numpy as np

from optid.identify.order.study import OrderStudy

LINES = 12
"""Orders listed, where the recommended one is not larger."""


def describe(study: OrderStudy) -> str:
    """Return tables, recommendation and reasons, at most 80 columns wide."""
    ranks, states = study.ranks, study.states
    lines = [f"Order of {study.data}" if study.data else "Order"]
    lines.append(f"  {ranks.windows} windows, {study.block_rows} block rows, level {ranks.level:.2g}")
    heads = f"{'s(n)':>11}{'s/s next':>10}{'tail':>11}{'threshold':>11}{'p':>9}{'BIC':>11}{'hold-out %':>12}"
    lines.append(f"  {'n':>3}{heads}")
    roots = np.sqrt(ranks.statistics), np.sqrt(ranks.thresholds)
    bic = states.bic - states.bic.min()
    for n in range(min(max(LINES, study.nx + 3), ranks.singular_values.size)):
        single = f"{ranks.singular_values[n - 1]:11.4g}" if n else f"{'':11}"
        ratio = f"{ranks.ratios[n - 1]:10.3g}" if 0 < n <= ranks.ratios.size else f"{'':10}"
        cost = f"{bic[n]:11.1f}" if n < bic.size else f"{'':11}"
        fit = f"{states.fit[n]:12.2f}" if n < bic.size and np.isfinite(states.fit[n]) else f"{'':12}"
        mark = " <" if n == study.nx else ""
        tail = f"{roots[0][n]:11.4g}{roots[1][n]:11.4g}{ranks.p_values[n]:9.2g}"
        lines.append(f"  {n:>3}{single}{ratio}{tail}{cost}{fit}{mark}"[:80])
    if study.lags is not None:
        lines.append(f"  {'lags by':<10}{'':<34}{'BIC':>12}{'hold-out %':>12}")
        for name in ("aicc", "bic", "fit"):
            if name != "fit" or any(np.isfinite(c.fit) for c in study.lags.candidates):
                one = study.lags.best(name)
                fit = f"{one.fit:12.2f}" if np.isfinite(one.fit) else ""
                word = {"fit": "hold-out", "aicc": "AICc", "bic": "BIC"}[name]
                lines.append(f"  {word:<10}{str(one):<34}{one.bic:12.1f}{fit}"[:80])
    said = f"nx = {study.nx}"
    if study.lags is not None:
        said += f"; {study.lags.best('bic')}"
    lines.append(f"Recommended: {said}")
    for reason in (*study.reasons, *(f"note: {note}" for note in study.notes)):
        lines += textwrap.wrap(reason, 80, initial_indent="  - ", subsequent_indent="    ")
    return "\n".join(lines)

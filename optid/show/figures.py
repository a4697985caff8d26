"""Figures of a record, of a comparison of models, and of a study of the order."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from optid.data.record import Data
from optid.identify.order.study import OrderStudy
from optid.identify.validation import Comparison
from optid.show import charts, panels
from optid.show.panels import CLOSEUP, plain, with_style


def channels(data: Data) -> Figure:
    """Draw one panel a channel, inputs first, and one curve an experiment."""
    units = dict(zip(data.inputs + data.outputs, data.input_units + data.output_units))
    figure = Figure(figsize=(8, 1 + 1.4 * len(units)), layout="constrained")
    axes = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    x = charts.time_axis(data)
    for c, (panel, (name, unit)) in enumerate(zip(axes, units.items())):
        for k, samples in enumerate(data.records):
            t = panels.instants(charts.places(data, k), x)
            panel.plot(*panels.thin_line(t, samples[:, c]), lw=0.9, drawstyle="steps-post" if c < data.m else "default")
        panel.set_ylabel(plain(f"{name} [{unit}]" if unit else name))
    axes[-1].set_xlabel(x.title)
    if x.dates:
        panels.show_dates(axes[-1])
    if data.name:
        figure.suptitle(plain(data.name))
    return figure


@with_style
def simulations(found: Comparison) -> Figure:
    """Draw the measured outputs and every simulation; of a long record the stretch in which the outputs move most."""
    record, several = found.data, sum(bool(arrays) for arrays in found.simulated)
    figure = Figure(figsize=(9.0, 2.9 * record.l + 0.35 * several), layout="constrained")
    axes = figure.subplots(record.l, 1, squeeze=False, sharex=True)[:, 0]
    k = int(np.argmax([e.n_samples for e in record.experiments]))
    y = record.experiments[k].y
    runs: list[Any] = [(label, arrays or None, {"colour": colour}) for label, arrays, colour in zip(
        found.names, found.simulated, charts.COLOURS * len(found.names))]
    shown = charts.time_charts(record, k, runs, part=panels.liveliest(y) if len(y) > 2 * CLOSEUP else slice(None))
    for ax, chart in zip(axes, shown[: record.l]):
        panels.draw_chart(ax, chart, legend=False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=1)
    return figure


@with_style
def order_study(study: OrderStudy) -> Figure:
    """Draw singular values with thresholds, criteria and hold-out by number of states, and the scan of lags."""
    shown = charts.order_charts(study)
    figure = Figure(figsize=(8.6, 3.0 * -(-len(shown) // 2)), layout="constrained")
    axes = panels.draw_charts(figure, shown, 2)
    axes[2].set_yscale("symlog", linthresh=0.01)  # the first orders are far above, the others near the best
    axes[2].set_ylim(bottom=0)
    scan = "" if study.lags is None else f"; {study.lags.best('bic')}"
    figure.suptitle(f"recommended: nx = {study.nx}{scan}")
    return figure

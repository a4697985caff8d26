"""Figures of several models on one record: their simulations, fits against the horizon, and poles."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from optid.show import panels
from optid.show.panels import CLOSEUP, INK, LINES, plain, styled, with_unit

if TYPE_CHECKING:
    from optid.identify.validation.comparison import Comparison


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
def horizons(found: "Comparison") -> Figure:
    """Draw the fit of every model against how far ahead it predicts, one panel per output."""
    outputs = found.data.outputs
    figure = Figure(figsize=(9.0, 3.0 + 0.25 * len(found.names)), layout="constrained")
    axes = figure.subplots(1, len(outputs), squeeze=False)[0]
    for o, (ax, name) in enumerate(zip(axes, outputs)):
        for label, curve, (colour, dash) in zip(found.names, found.curves, LINES * len(found.names)):
            text = plain(label)
            ax.plot(curve.horizons, curve.fits[:, o], dash, marker="o", markersize=3.5, color=colour, label=text)
            if np.isfinite(curve.simulation[o]):
                ax.axhline(curve.simulation[o], color=colour, linewidth=0.8, linestyle=(0, (1, 2)))
        ax.set_xscale("log")
        ax.set(xlabel="samples ahead", ylabel="fit (%)" if o == 0 else "")
        ax.set_title(with_unit(name, ""))
        ax.xaxis.set_major_formatter("{x:g}")
        low = min(float(np.nanmin(curve.fits[:, o])) for curve in found.curves)
        ax.set_ylim(bottom=max(low - 5, -100))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=1)
    return figure


@styled
def poles(found: "Comparison") -> Figure:
    """Draw the poles of every model in the unit circle."""
    figure = Figure(figsize=(6.4, 4.0 + 0.25 * len(found.names)), layout="constrained")
    ax = figure.subplots()
    panels.draw_poles(ax, np.zeros(0))
    marks = "x+o^sd"
    for i, (label, model, (colour, _)) in enumerate(zip(found.names, found.models, LINES * len(found.names))):
        text = plain(label)
        values: Any = np.asarray(model.poles)
        hollow: dict[str, Any] = {"markerfacecolor": "none", "linestyle": ""}
        ax.plot(values.real, values.imag, marks[i % len(marks)], color=colour, label=text, **hollow)
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower left", ncols=1)
    return figure

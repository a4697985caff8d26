"""The figure of several models on one record: measured and simulated outputs."""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from optid.show import panels
from optid.show.panels import CLOSEUP, INK, LINES, plain, styled, with_unit

if TYPE_CHECKING:
    from optid.identify.validation import Comparison


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

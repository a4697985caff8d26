"""Figure of a record: every channel over time."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from optid.data.record import Data

MOST_POINTS = 4000
"""Points of a curve: of a longer record the lowest and the highest sample of each stretch are drawn."""


def draw(data: Data) -> Figure:
    """Return a figure with one panel a channel, inputs first, and one curve an experiment."""
    units = dict(zip(data.inputs + data.outputs, data.input_units + data.output_units))
    figure = Figure(figsize=(8, 1 + 1.4 * len(units)), layout="constrained")
    panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    for c, (panel, (name, unit)) in enumerate(zip(panels, units.items())):
        for e, samples in zip(data.experiments, data.records):
            k, x = _thinned(samples[:, c])
            panel.plot(e.start + data.dt * k, x, lw=0.9, drawstyle="steps-post" if c < data.m else "default")
        panel.set_ylabel((f"{name} [{unit}]" if unit else name).replace("$", r"\$"))
    panels[-1].set_xlabel("time")
    if data.name:
        figure.suptitle(data.name.replace("$", r"\$"))
    return figure


def _thinned(x: np.ndarray) -> tuple[Any, np.ndarray]:
    """Return the samples to draw of x (N,) and their positions."""
    stretch = -(-2 * x.size // MOST_POINTS)
    if stretch <= 2:
        return np.arange(x.size), x
    whole = x.size // stretch * stretch
    rows = x[:whole].reshape(-1, stretch)
    first = np.arange(0, whole, stretch)
    here = ~np.isnan(rows)
    low = np.argmin(np.where(here, rows, np.inf), axis=1)
    high = np.argmax(np.where(here, rows, -np.inf), axis=1)
    k = np.unique(np.concatenate([first + low, first + high, np.arange(whole, x.size)]))
    return k, x[k]

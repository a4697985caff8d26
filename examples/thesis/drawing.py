"""The numbered figures of chapters 4 and 5: each function draws and saves one kind.

What the figures of the dissertation show is known in part (README.md): SID is dashed and ASIVID dotted there.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import feedback_error, panels, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.signal import welch

import optid
from optid.plants import ReactionWheelPendulum
from optid.show.panels import BLUE, GREEN, INK, MUTED, ORANGE, plain, with_style
from optid.show.wording import with_unit

Cases = Sequence[tuple[str, optid.Data, dict[str, Any]]]

LOOKS = (ORANGE, "--"), (BLUE, ":")
"""Colour and dash of the first and the second model."""


def save_numbered(figure: Figure, folder: Path, number: str, name: str, title: str) -> None:
    """Save figure "4.2" of the dissertation as fig_4_2_name.png under its title."""
    figure.suptitle(f"Figure {number}: {title}", fontsize=11, fontweight="bold")
    save(figure, folder, f"fig_{number.replace('.', '_')}_{name}.png")


def onto(truth: np.ndarray, *parts: np.ndarray) -> np.ndarray:
    """Return the combination of the parts and a constant that is closest to the truth: the gauge leaves it open."""
    table = np.column_stack([np.ones_like(truth), *parts])
    return table @ np.linalg.lstsq(table, truth, rcond=None)[0]


@with_style
def draw_record(folder: Path, number: str, name: str, title: str, data: optid.Data, time: str = "time (s)") -> None:
    """Save the inputs of a record above its outputs."""
    channels = zip(data.inputs + data.outputs, data.input_units + data.output_units, np.hstack([data.u, data.y]).T)
    figure, axes = panels(data.m + data.l, 1, (8.4, 1.8), sharex=True)
    for axis, (channel, unit, values), colour in zip(axes[:, 0], channels, [BLUE] * data.m + [INK] * data.l):
        axis.plot(data.time, values, color=colour, linewidth=1.0)
        axis.set(ylabel=plain(with_unit(channel, unit)))
    axes[-1, 0].set(xlabel=time)
    save_numbered(figure, folder, number, name, title)


@with_style
def draw_responses(folder: Path, number: str, name: str, title: str, cases: Cases, samples: int,
                   time: str = "time (s)", more: Sequence[Callable[[Axes], None]] = ()) -> None:
    """Save the measured outputs and their simulations with measured feedback, with the errors beside.

    Args:
        folder: where the figure goes.
        number: that of the dissertation.
        name: of the file.
        title: of the figure.
        cases: label, validation record and models by the name of their method: the first dashed, the second dotted.
        samples: how many are drawn; the errors in the titles are those of the whole record.
        time: label of the abscissa.
        more: draw the panels of a further row.
    """
    rows = [(case, o) for case in cases for o in range(case[1].l)]
    figure, axes = panels(len(rows) + bool(more), 2, (5.6, 2.3))
    for ((label, data, models), o), (left, right) in zip(rows, axes):
        t, y, heads = data.time[:samples], data.y[:samples, o], []
        left.plot(t, y, color=MUTED, alpha=0.5, linewidth=2.5, label="measured")
        for (method, model), (colour, dash) in zip(models.items(), LOOKS):
            simulated = model.simulate_measured_feedback(data, x0="fit")[:samples, o]
            left.plot(t, simulated, dash, color=colour, label=method)
            right.plot(t, y - simulated, dash, color=colour)
            heads.append(f"{method} {feedback_error(model, data)[o]:.2g} %")
        channel = plain(with_unit(data.outputs[o], data.output_units[o]))
        left.set(title=f"{label}{data.outputs[o]}", ylabel=channel, xlabel=time)
        right.set(title="error: " + ", ".join(heads), ylabel=channel, xlabel=time)
    for axis, draw in zip(axes[len(rows):].ravel(), more):
        draw(axis)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save_numbered(figure, folder, number, name, title)


@with_style
def draw_functions(folder: Path, number: str, name: str, title: str, models: dict[str, Any],
                   f: Callable[[np.ndarray], np.ndarray], g: Callable[[np.ndarray], np.ndarray]) -> None:
    """Save f and g of models with one input and output beside the truth; their gauge is that of the truth."""
    figure, ((left, right),) = panels(1, 2, (4.6, 3.0))
    u, y = np.linspace(-2, 2, 201), np.linspace(-2.5, 2.5, 201)
    draw_function(left, "u", "f(u)", u, f(u), {
        label: onto(f(u), model.nonlinearities[0](u)) for label, model in models.items()})
    draw_function(right, "y", "g(y)", y, g(y), {
        label: onto(g(y), y, model.feedback[0](y)) for label, model in models.items()})
    save_numbered(figure, folder, number, name, title)


def draw_function(axis: Axes, x_label: str, y_label: str, x: np.ndarray, truth: np.ndarray,
                  found: dict[str, np.ndarray]) -> None:
    """Draw a true function (grey) and what was identified, the first dashed, the second dotted."""
    axis.plot(x, truth, color=MUTED, alpha=0.5, linewidth=2.5, label="truth")
    for (name, values), (colour, dash) in zip(found.items(), LOOKS):
        axis.plot(x, values, dash, color=colour, label=name)
    axis.margins(y=0.4)  # room for the legend
    axis.set(xlabel=x_label, ylabel=y_label)
    axis.legend(loc="upper center", ncols=3)


@with_style
def draw_times(folder: Path, number: str, name: str, title: str, lengths: Sequence[int], times: np.ndarray) -> None:
    """Save the times (2, lengths) in ms of SIVID and ASIVID against the lengths of the records."""
    figure, ((axis,),) = panels(1, 1, (5.6, 3.6))
    for label, values, (colour, _) in zip(("SIVID, explicit projectors", "ASIVID, triangular form"), times, LOOKS):
        axis.loglog(lengths, values, "o-", color=colour, label=label)
    axis.set(xlabel="samples N", ylabel="processor time (ms)", xticks=lengths, xticklabels=lengths, ylim=(1, None))
    axis.minorticks_off()
    axis.legend()
    save_numbered(figure, folder, number, name, title)


@with_style
def draw_orders(folder: Path, number: str, name: str, title: str, cases: dict[str, dict[str, optid.Fit]]) -> None:
    """Save the singular values of the projections of SID and ASIVID, one line per case."""
    figure, axes = panels(1, 2)
    for axis, method in zip(axes[0], ("SID", "ASIVID")):
        draw_singular_values(axis, method, {case: fits[method] for case, fits in cases.items()})
    save_numbered(figure, folder, number, name, title)


def draw_singular_values(axis: Axes, title: str, fits: dict[str, optid.Fit],
                         colours: Sequence[str] = (BLUE, ORANGE, GREEN)) -> None:
    """Draw the singular values of the projected outputs, from which the order is read."""
    for (name, fit), marker, colour in zip(fits.items(), "os^", colours):
        values = fit.figures["singular values"][:10]
        axis.semilogy(range(1, values.size + 1), np.maximum(values / values[0], 1e-16), marker + "-", color=colour,
                      label=name)
    axis.set(title=title, xlabel="index", ylabel="relative to the first", xticks=range(1, 11))
    axis.legend()


@with_style
def draw_excitations(folder: Path, number: str, experiment: int, records: dict[str, optid.Data]) -> None:
    """Save the commands of an experiment, their spectra and the outputs, divided by their root mean squares."""
    records = {name[2:]: data for name, data in records.items() if name.startswith(str(experiment))}
    figure, axes = panels(len(records), 3, (4.6, 2.3))
    for (name, data), (time, spectrum, outputs) in zip(records.items(), axes):
        shown = slice(0, 1000 if "chirp" in name else 400)
        time.plot(data.time[shown], data.u[shown, 0], linewidth=1.0)
        time.set(title=name, xlabel="time (s)", ylabel="command")
        frequency, power = welch(data.u[:, 0], 1 / data.dt, nperseg=512)
        spectrum.plot(frequency, 10 * np.log10(power))
        spectrum.set(title="spectrum of the command", xlabel="frequency (Hz)", ylabel="power (dB/Hz)", xlim=(0, 10),
                     ylim=(-60, 10))
        relative = data.y / np.sqrt(np.mean(data.y**2, axis=0))
        outputs.plot(data.time[shown], relative[shown], linewidth=1.0, label=[f"output: {one}" for one in data.outputs])
        outputs.set(title="outputs", xlabel="time (s)", ylabel="relative to r.m.s.")
    figure.legend(*axes[0, 2].get_legend_handles_labels(), loc="outside lower right", ncols=2)
    save_numbered(figure, folder, number, f"experiment_{experiment}_inputs", f"experiment {experiment}: inputs")


@with_style
def draw_frequency_response(folder: Path, number: str, title: str, data: optid.Data) -> None:
    """Save the measured frequency response of every output to the first input up to 5 Hz, and its coherence."""
    found = optid.frequency_response(data)
    shown = found.frequency <= 5
    figure, ((left, right),) = panels(1, 2, (4.6, 3.0))
    for o, (output, unit) in enumerate(zip(data.outputs, data.output_units)):
        gain = np.abs(found.response[shown, o, 0])
        left.plot(found.frequency[shown], 20 * np.log10(gain / np.nanmax(gain)),
                  label=f"{output}, largest {np.nanmax(gain):.2g} {unit} per unit of {data.inputs[0]}")
        right.plot(found.frequency[shown], found.coherence[shown, o], label=output)
    left.set(xlabel="frequency (Hz)", ylabel="gain relative to the largest (dB)", ylim=(None, 12))
    right.set(xlabel="frequency (Hz)", ylabel="coherence", ylim=(0, 1.05))
    left.legend()
    right.legend()
    save_numbered(figure, folder, number, "frequency_response", title)


def draw_experiment(folder: Path, number: str, name: str, test: optid.Data, fits: dict[str, optid.Fit]) -> None:
    """Save responses to an experiment such as "3 noise", the curves of the motor less a line, and singular values."""
    kind, u = name[2:].partition(",")[0], np.linspace(-8, 8, 201)
    torque = 1e3 * ReactionWheelPendulum().torque(u)
    line = onto(torque, u)
    curves = {method: onto(torque, fit.model.nonlinearities[0](u)) - line for method, fit in fits.items()}
    draw_responses(
        folder, number, f"experiment_{name[0]}_{kind}", f"experiment {name[0]}, {name[2:]}, order 3",
        [("", test, {method: fit.model for method, fit in fits.items()})], 1000 if kind == "chirp" else 300,
        more=(lambda axis: draw_function(axis, "command", "torque - line (mN m)", u, torque - line, curves),
              lambda axis: draw_singular_values(axis, "singular values", fits, [colour for colour, _ in LOOKS])))

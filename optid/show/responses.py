"""Characteristics and step responses in the units of the outputs, as charts and tables, for every document."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.identify.dynamics import dynamics, input_levels, integration
from optid.identify.responses import LONGEST, Response, responses, step_samples
from optid.models.functions import static_functions
from optid.show.charts import COLOURS, channel_axis, density
from optid.show.estimates import interval_row
from optid.show.sections import Axis, Chart, Series
from optid.show.wording import Table, number, time_title

ROWS, TIMES, LEVELS = 11, 6, 5
"""Rows of a table of a characteristic and of a step response, and columns of those that compare models."""

MOST_TABLES = 6
"""Tables of characteristics and step responses in a document; the charts show all."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A chart and the curve that it shows, of the first model where there are several."""

    chart: Chart
    curve: Response


def longest(record: Data | None) -> int:
    """Return the samples of the longest experiment."""
    return LONGEST if record is None else max(e.n_samples for e in record.experiments)


def fit_responses(fit: Any, known: Any) -> tuple[list[Response], list[str]]:
    """Return the curves of a fit, and why some are missing."""
    record = fit.data.raw() if isinstance(fit.data, Data) else None
    return responses(fit.model, input_levels(fit.model, record), known, longest(record))


def curve_charts(curves: Mapping[str, Sequence[Response]], models: Sequence[Any], record: Data | None) -> list[Drawn]:
    """Draw the curves of models by their labels, one chart for each input, output and kind, with bands if known."""
    groups: dict[tuple[int, int, str], list[tuple[str, Response, str]]] = {}
    for k, (label, found) in enumerate(curves.items()):
        for one in found:
            key = one.input, one.output, one.kind.replace("static", "rest")  # before the step response
            groups.setdefault(key, []).append((label, one, COLOURS[k % len(COLOURS)]))
    return [Drawn(_chart(groups[key], models[0], record), groups[key][0][1]) for key in sorted(groups)]


def _chart(part: list[tuple[str, Response, str]], model: Any, record: Data | None) -> Chart:
    first, series = part[0][1], []
    for label, one, colour in part:
        if one.has_band:
            name = "95 % band" if len(part) == 1 else ""
            series.append(Series(name, one.at, one.upper, "area", colour, lows=one.lower))
        series.append(Series(label, one.at, one.value, colour=colour, width=2.2))
    name, unit, channel = model.outputs[first.output], model.output_units[first.output], model.inputs[first.input]
    low, high = first.levels
    if first.kind == "step":
        title = f"Step response of {name} to {channel} from {low:.3g} to {high:.3g}"
        caption = f"Change of {name} as {channel} goes from one level to the other."
        time = Axis(time_title(model.time_unit, model.dt == 1))
        return Chart(title, caption, time, channel_axis(name, unit), series, height=300)
    if record is not None:
        samples = np.concatenate([e.u[:, first.input] for e in record.experiments])
        samples = samples[np.isfinite(samples) & (samples >= low) & (samples <= high)]
        series += [density(samples, low, high)] if samples.size else []
    if first.kind == "rate":
        title, y = f"Rate of {name} against {channel}", Axis(f"rate of {name} ({rate_unit(model, first.output)})")
        caption = f"How fast {name} moves with {channel} held, above its rate at {low:.3g}."
    else:
        title, y = f"Static characteristic of {name} against {channel}", channel_axis(name, unit)
        caption = f"{name} at rest{'; the functions of the other inputs are at zero' if model.m > 1 else ''}."
    return Chart(title, caption, channel_axis(channel, model.input_units[first.input]), y, series, height=300)


def rate_unit(model: Any, o: int) -> str:
    """Return the unit of the rate of an output."""
    return f"{model.output_units[o] or 1}/{model.time_unit or ('sample' if model.dt == 1 else 'unit of time')}"


def curve_tables(curves: Sequence[Response], model: Any) -> list[Table]:
    """List nonlinear characteristics at a few points; of an integrator, and of what has none, the step responses."""
    bent = {function.channel for function in static_functions(model) if not function.is_linear}
    bent = set(range(model.m)) if len(static_functions(model)) > model.m or not model.nonlinearities else bent
    found = []
    for one in curves:
        rest = [other.kind for other in curves if (other.input, other.output) == (one.input, one.output)]
        if (one.kind == "step" and "static" not in rest) or (one.kind != "step" and one.input in bent):
            found.append(_curve_table(one, model))
    return found[:MOST_TABLES]


def _curve_table(one: Response, model: Any) -> Table:
    name, channel, (low, high) = model.outputs[one.output], model.inputs[one.input], one.levels
    unit = rate_unit(model, one.output) if one.kind == "rate" else model.output_units[one.output]
    if one.kind == "step":
        title = f"Response of {name} to a step of {channel} from {low:.4g} to {high:.4g}"
        against, places = channel_axis("time", model.time_unit).title, np.linspace(0, one.at.size - 1, TIMES)
    else:
        title = f"Static characteristic: {name} at rest against {channel}" if one.kind == "static" else (
            f"Rate of {name} against {channel}, above that at {low:.4g}")
        against, places = channel_axis(channel, model.input_units[one.input]).title, _listed(one, model)
    rows, head = np.unique(np.round(places).astype(int)), (against, channel_axis(name, unit).title)
    if not one.has_band:
        return Table(title, head, [(number(float(one.at[k]), 4), number(float(one.value[k]))) for k in rows])
    size, bands = float(np.nanmax(np.abs(one.value))), np.column_stack([one.value, one.error, one.lower, one.upper])
    return Table(title, (*head, "std. error", "95 % low", "95 % high"), [
        interval_row(number(float(one.at[k]), 4), *map(float, bands[k]), size=size) for k in rows])


def _listed(one: Response, model: Any) -> Any:
    """Return the places of the nodes of f where they are few, or else of evenly spaced inputs."""
    places = getattr(model, "input_of", range(model.m))
    nodes = [np.asarray(f.basis.nodes) for f, place in zip(model.nonlinearities, places)
             if place == one.input and hasattr(f.basis, "nodes")]
    wanted = nodes[0] if nodes and nodes[0].size <= 2 * ROWS else np.linspace(*one.levels, ROWS)
    return np.unique([int(np.argmin(np.abs(one.at - u))) for u in wanted])


def comparison_curves(found: Any) -> tuple[dict[str, list[Response]], list[str]]:
    """Return the curves of every model of a comparison between the levels of its record, and why some are missing."""
    record = found.data.raw()
    levels, curves, reasons = record_levels(record), {}, []
    count = max(step_samples(model, bool(integration(model)), longest(record)) for model in found.models)
    for name, model in zip(found.names, found.models):
        curves[name], missing = responses(model, levels, count=count)
        reasons += [f"{name}: {reason}" for reason in missing]
    return curves, reasons


def record_levels(record: Data) -> list[tuple[float, float]]:
    """Return the range of every input of a record; 0 to 1 around a constant."""
    found = []
    for c in range(record.m):
        u = np.concatenate([e.u[:, c] for e in record.experiments])
        low, high = float(np.nanmin(u)), float(np.nanmax(u))
        found.append((low, high) if high > low else (low - 0.5, low + 0.5))
    return found


def comparison_dynamics(found: Any) -> Table:
    """Return the dynamics of every model of a comparison, gains between the same levels."""
    levels = record_levels(found.data.raw())
    parts = [(name, dynamics(model, levels)) for name, model in zip(found.names, found.models)]
    rows = [(f"{name}: {row.name}", number(row.estimate, 4), row.unit) for name, part in parts for row in part]
    return Table("Dynamics", ("model: quantity", "estimate", "unit"), rows,
                 " ".join(dict.fromkeys(note for _, part in parts for note in part.notes)))


def comparison_tables(curves: Mapping[str, Sequence[Response]], model: Any) -> list[Table]:
    """Set the characteristics and the step responses of models side by side, a row for each model."""
    tables = []
    keys = dict.fromkeys((one.input, one.output, one.kind) for found in curves.values() for one in found)
    for c, o, kind in list(keys)[:MOST_TABLES]:
        shown = {label: one for label, found in curves.items() for one in found
                 if (one.input, one.output, one.kind) == (c, o, kind)}
        end = max(one.at[-1] for one in shown.values())
        low, high = next(iter(shown.values())).levels
        at = np.linspace(0.0, end, LEVELS + 1)[1:] if kind == "step" else np.linspace(low, high, LEVELS)
        unit = rate_unit(model, o) if kind == "rate" else model.output_units[o]
        what = {"static": f"{model.outputs[o]} at rest", "rate": f"Rate of {model.outputs[o]}",
                "step": f"Change of {model.outputs[o]} after a step of {model.inputs[c]} from {low:.3g} to {high:.3g}"}
        against = f", against time{f' in {model.time_unit}' if model.time_unit else ''}" if kind == "step" else (
            f", against {model.inputs[c]}{f' in {model.input_units[c]}' if model.input_units[c] else ''}")
        rows = [(label, *(number(float(value), 4) for value in np.interp(at, one.at, one.value)))
                for label, one in shown.items()]
        tables.append(Table(f"{what[kind]}{f' in {unit}' if unit else ''}{against}",
                            ("model", *(number(float(x), 3) for x in at)), rows))
    return tables

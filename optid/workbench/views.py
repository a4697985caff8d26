"""Figures and charts of a fit: those that follow a drag, and, computed later, the verdict and the residual tests."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.uncertainty import uncertainty
from optid.identify.verdict import GOOD, GOOD_BLOCK, GOOD_FIT
from optid.models.functions import step_length
from optid.show import charts, summary
from optid.show.page import coded
from optid.show.sections import TONES, Axis, Chart, Series

BINS = 700
"""Intervals of the time axis; the extremes of each are drawn."""

POINTS, STEPS, DRAWS = 41, 60, 1000
"""Points of a characteristic; most samples of a step response; draws for a band under constraints."""


def quick(fit: Any, run: list[Array] | None, output: str | None = None) -> dict[str, Any]:
    """Return figures, prices and charts of a fit, as JSON types; curves of one output, the first by default."""
    model, record = fit.model, fit.data.raw()
    tone, word, sentence = summary.verdict(fit)
    size = 0.0 if run is None else float(np.nanmean(fit.simulation_fit))
    prices = [{"name": p.name, "active": p.active, "rows": p.rows, "binding": bool(p.binding),
               "price": _finite(p.points_per_step), "words": p.words} for p in fit.prices]
    return {
        "cards": [["one step ahead", summary.percent(np.mean(fit.one_step_fit))],
                  ["simulation", "-" if run is None else summary.percent(size)],
                  ["largest pole", summary.number(float(np.max(np.abs(model.poles), initial=0.0)), 3)],
                  ["relative gap", summary.gap_text(fit.solution.gap)]],
        "tone": tone, "word": word, "sentence": sentence, "prices": prices, "findings": list(fit.findings),
        "objective": _finite(fit.solution.objective), "equation": model.equation(),
        "charts": [*characteristics(fit, record, output),
                   coded(charts.pole_chart({"": model.poles})) | {"tool": "poles"}],
    }


def time_chart(record: Data, run: list[Array] | None, experiment: int = 0,
               view: Sequence[float] | None = None) -> list[dict[str, Any]]:
    """Return outputs, measured and simulated, and inputs of an experiment (from 0) between two samples (all)."""
    e, found = record.select(experiments=experiment).experiments[0], []
    several = f", experiment {experiment + 1} of {record.n_experiments}" if record.n_experiments > 1 else ""
    first, last = (0, e.n_samples) if view is None else (max(int(view[0]), 0), min(int(view[1]), e.n_samples))
    t = e.start + record.dt * np.arange(first, last, dtype=float)
    for o, name in enumerate(record.outputs):
        series = [("measured", e.y[first:last, o], "ink", 1.1)]
        if run is not None:
            series.append(("simulated", run[experiment][first:last, o], "c0", 1.8))
        found.append((f"Output {name}", name, record.output_units[o], series, 250))
    for c, name in enumerate(record.inputs):
        found.append((f"Input {name}", name, record.input_units[c], [(name, e.u[first:last, c], "muted", 1.1)], 150))
    return [coded(Chart(title + several, "", Axis("time"), Axis(f"{name} ({unit})" if unit else name, unit=unit),
                        [Series(label, *reduced(t, values), colour=colour, width=width)
                         for label, values, colour, width in series], "time", height=height)) | {"tool": "time"}
            for title, name, unit, series, height in found]


def reduced(t: Array, values: Array, bins: int = BINS) -> tuple[Array, Array]:
    """Return the smallest and the largest value of every interval, in order of time."""
    width = len(values) // bins
    if width <= 2:
        return t, values
    whole = values[: bins * width].reshape(bins, width)
    low = np.argmin(np.where(np.isfinite(whole), whole, np.inf), axis=1)
    high = np.argmax(np.where(np.isfinite(whole), whole, -np.inf), axis=1)
    kept = np.unique(np.concatenate([np.arange(bins) * width + low, np.arange(bins) * width + high,
                                     [len(values) - 1]]))
    return t[kept], values[kept]


def characteristics(fit: Any, record: Data, output: str | None = None) -> list[dict[str, Any]]:
    """Return the static characteristic and the step response of an output to every input, with bands if known."""
    model, found, several = fit.model, [], len(record.outputs) > 1
    o = 0 if output is None else record.outputs.index(output)
    name, unit = record.outputs[o], record.output_units[o]
    known = None
    with suppress(OptidError):  # some fits have no intervals
        known = uncertainty(fit, draws=DRAWS)
    count = min(step_length(model), STEPS)
    for c, channel in enumerate(record.inputs):
        basis = model.nonlinearities[c].basis
        samples = np.concatenate([e.u[:, c] for e in record.experiments])
        low, high = basis.interval or (float(np.nanmin(samples)), float(np.nanmax(samples)))
        points = np.unique(np.append(np.linspace(low, high, POINTS), getattr(basis, "nodes", [])))
        span = np.array([low, high])

        def shown(model: Any, c: int = c, points: Array = points, span: Array = span) -> Array:
            f = model.nonlinearities[c]
            step = model.step_response(count).reshape(count, model.l, -1)[:, o, c] * np.diff(f(span))
            return np.concatenate([static(model, c, points, o), step])

        value = shown(model)
        band = None if known is None else known.of(shown)
        density, edges = np.histogram(samples[np.isfinite(samples)], bins=40, range=(low, high))
        bars = Series("density of the samples", edges[:-1], density / max(density.max(), 1), "bars", "muted",
                      aside=True)
        for what, at, x, extra in (
                ("static", points, Axis(_named(channel, record.input_units[c])), [bars]),
                ("step", model.dt * np.arange(count), Axis("time"), [])):
            part = slice(0, points.size) if what == "static" else slice(points.size, None)
            series = [] if band is None else [Series("95 % band", at, band.upper[part], "area", lows=band.lower[part])]
            title = f"Static characteristic of {f'{name} against ' if several else ''}{channel}"
            if what == "step":
                title = f"Step response {f'of {name} ' if several else ''}to {channel} from {low:.3g} to {high:.3g}"
            y = Axis(_named(name, unit))
            chart = Chart(title, "", x, y, [*series, Series("fit", at, value[part], width=2.2), *extra], height=300)
            found.append(coded(chart) | {"tool": what, "channel": channel if model.m > 1 else None,
                                         "output": name if several else None, "dt": model.dt, "interval": [low, high]})
    return found


def static(model: Any, c: int, points: Array, o: int = 0) -> Array:
    """Return an output at rest with an input held at points (k,), the functions of the others at zero."""
    if model.structure == "ss":
        rest = np.eye(model.nx) - model.A
        gain = model.C[o] @ np.linalg.solve(rest, model.B[:, c]) + model.D[o, c]
        level = model.C[o] @ np.linalg.solve(rest, model.offset_x) + model.offset_y[o]
        return level + gain * model.nonlinearities[c](points)
    rest = np.eye(model.l) + model.matrices.sum(axis=0)
    gain = np.linalg.solve(rest, np.atleast_1d(np.sum(model.b[c], axis=0)))[o]
    return np.linalg.solve(rest, np.atleast_1d(model.offset))[o] + gain * model.nonlinearities[c](points)


def judged(fit: Any) -> dict[str, Any]:
    """Return the verdict on a fit and its residual tests."""
    found = fit.verdict
    says = "; ".join(f"{part.name}: {part.value}" for part in found.failed) or "Every test passes."
    if not found.failed and found.word != GOOD:
        says = (f"No test fails; a good model simulates {GOOD_FIT:g} % of the record, and {GOOD_BLOCK:g} % of every "
                "block.")
    return {"word": found.word, "tone": TONES[found.word], "sentence": says, "parts": [
        [part.name, part.value, "PASS" if part.passed else "FAIL"] for part in found.parts],
        "charts": [coded(one) for one in charts.correlation_charts(charts.validated(fit.model, fit.data.raw()))]}


def _named(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

"""Figures and charts of a fit: those that follow a drag, and, computed later, the verdict and the residual tests."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.uncertainty import uncertainty
from optid.models.functions import step_length
from optid.show import charts, summary
from optid.show.page import coded
from optid.show.sections import TONES, Chart, Series

SHOWN = 1400
"""Samples of a curve that are drawn; of a longer one the extremes of half as many stretches."""

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
    record.select(experiments=experiment)  # an unknown one is refused
    part = slice(None) if view is None else slice(max(int(view[0]), 0), int(view[1]))
    shown = charts.time_charts(record, experiment, [("simulated", run, {"width": 1.9})], "time", part=part,
                               heights=(250, 150))
    return [coded(chart, SHOWN) | {"tool": "time"} for chart in shown]


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
            rest = np.full(points.size, np.nan)
            with suppress(OptidError):  # a plant that integrates, or one without an equilibrium at some input
                rest = model.static_curve(c, points)[:, o]
            return np.concatenate([rest, step])

        value = shown(model)
        band = None if known is None else known.of(shown)
        bars = charts.density(samples[np.isfinite(samples)], low, high)
        for what, at, x, extra in (
                ("static", points, charts.channel_axis(channel, record.input_units[c]), [bars]),
                ("step", model.dt * np.arange(count), charts.response_axis(model), [])):
            part = slice(0, points.size) if what == "static" else slice(points.size, None)
            if np.isnan(value[part]).all():
                continue
            series = [] if band is None else [Series("95 % band", at, band.upper[part], "area", lows=band.lower[part])]
            title = f"Static characteristic of {f'{name} against ' if several else ''}{channel}"
            if what == "step":
                title = f"Step response {f'of {name} ' if several else ''}to {channel} from {low:.3g} to {high:.3g}"
            y = charts.channel_axis(name, unit)
            chart = Chart(title, "", x, y, [*series, Series("fit", at, value[part], width=2.2), *extra], height=300)
            found.append(coded(chart) | {"tool": what, "channel": channel if model.m > 1 else None,
                                         "output": name if several else None, "dt": model.dt, "interval": [low, high]})
    return found


def judged(fit: Any) -> dict[str, Any]:
    """Return the verdict on a fit and its residual tests."""
    found = fit.verdict
    return {"word": found.word, "tone": TONES[found.word], "sentence": summary.judgement(found),
            "parts": [list(row) for row in summary.verdict_table(found).rows],
            "charts": [coded(one) for one in charts.correlation_charts(charts.validated(fit.model, fit.data.raw()))]}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

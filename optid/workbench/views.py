"""Figures and charts of a fit: those that follow a drag, and, computed later, the verdict and the residual tests."""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, OptidError
from optid.identify import responses
from optid.identify.dynamics import input_levels
from optid.identify.informativity import informativity
from optid.identify.uncertainty import uncertainty
from optid.show import charts, summary
from optid.show.page import encode_chart
from optid.show.responses import curve_charts, longest
from optid.show.sections import TONES

SHOWN = 1400
"""Samples of a curve that are drawn; of a longer one the extremes of half as many stretches."""

DRAWS = 1000
"""Draws for a band under constraints."""


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
                   encode_chart(charts.pole_chart({"": model.poles})) | {"tool": "poles"}],
    }


def time_chart(record: Data, run: list[Array] | None, experiment: int = 0,
               view: Sequence[float] | None = None) -> list[dict[str, Any]]:
    """Return outputs, measured and simulated, and inputs of an experiment (from 0) between two samples (all)."""
    record.select(experiments=experiment)  # an unknown one is refused
    part = slice(None) if view is None else slice(max(int(view[0]), 0), int(view[1]))
    shown = charts.time_charts(record, experiment, [("simulated", run, {"width": 1.9})], "time", part=part,
                               heights=(250, 150))
    return [encode_chart(chart, SHOWN) | {"tool": "time"} for chart in shown]


def characteristics(fit: Any, record: Data, output: str | None = None) -> list[dict[str, Any]]:
    """Return the static characteristic and the step response of an output to every input, with bands if known."""
    model, several = fit.model, len(record.outputs) > 1
    o = 0 if output is None else record.outputs.index(output)
    known = None
    with suppress(OptidError):  # some fits have no intervals
        known = uncertainty(fit, draws=DRAWS)
    curves, _ = responses.responses(model, input_levels(model, record), known, longest(record))
    found = []
    for one in curve_charts({"fit": [curve for curve in curves if curve.output == o]}, [model], record):
        curve, channel = one.curve, record.inputs[one.curve.input]
        found.append(encode_chart(one.chart) | {
            "tool": "" if curve.kind == "rate" else curve.kind, "channel": channel if model.m > 1 else None,
            "output": record.outputs[o] if several else None, "dt": model.dt, "interval": list(curve.levels)})
    return found


def delay_view(record: Data) -> dict[str, Any]:
    """Return the lag of the first coefficient of every input, `nk`, and what the record shows, in sentences.

    Raises:
        DataError: the record shows no delay, with the reason.
    """
    told = informativity(record)
    if told.reason or not told.processes:
        raise DataError(f"No delay can be estimated from this record: {told.reason or told.untested}")
    lags = [f"{name!r} acts from lag {lag} on" for name, lag in zip(told.inputs, told.lags)]
    return {"nk": list(told.lags), "sentences": [*lags, *told.findings]}


def verdict_view(fit: Any) -> dict[str, Any]:
    """Return the verdict on a fit and its residual tests."""
    found, checked = fit.verdict, charts.validate_quietly(fit.model, fit.data.raw())
    return {"word": found.word, "tone": TONES[found.word], "sentence": summary.judgement(found),
            "parts": [[part.name, part.value, part.outcome] for part in found.parts],
            "charts": [encode_chart(charts.correlation_chart(test)) for test in checked.tests]}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None

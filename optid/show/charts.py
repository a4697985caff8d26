"""Charts of pages: records, nonlinearities, responses, poles, residual tests, as data for the plot inside the page."""

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, DataWarning
from optid.identify.validation import validate
from optid.identify.validation.correlations import Correlation
from optid.identify.validation.predictions import one_step, simulated
from optid.models.functions import StaticFunction, has_feedback, response_pairs, static_functions, step_length
from optid.show.estimates import uncertainty
from optid.show.sections import Axis, Chart, Series, decibels

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.order.study import OrderStudy
    from optid.identify.search import Identification
    from optid.identify.validation import Comparison, Validation

MOST_EXPERIMENTS = 4
COLOURS = tuple(f"c{k}" for k in range(10))


def _unit(name: str, unit: str) -> Axis:
    return Axis(f"{name} ({unit})" if unit else name, unit=unit)


def validated(model: Any, record: Data) -> "Validation":
    """Validate a model without the warnings, which stand in the notes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return validate(model, record)


def visited(function: StaticFunction, record: Data | None) -> Array:
    """Samples of the argument of a function; none if the simulation of a latent signal diverges."""
    try:
        return np.zeros(0) if record is None else function.samples(record)
    except DataError:
        return np.zeros(0)


def free_run(model: Any, record: Data) -> list[Array] | None:
    """Simulated outputs, or None where an input is missing or the model runs away."""
    if not (model.is_stable or has_feedback(model)):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        try:
            return simulated(model, record)
        except DataError:
            return None


def record_charts(models: dict[str, Any], data: Data, *, ahead: bool = True, group: str = "time") -> list[Chart]:
    """Measured outputs, simulations of models, and one-step predictions of a single one; inputs below, linked."""
    record, charts = data.raw(), []
    runs = {name: free_run(model, record) for name, model in models.items()}
    predicted = one_step(next(iter(models.values())), record) if ahead else None
    for k, e in enumerate(record.experiments[:MOST_EXPERIMENTS]):
        t = e.start + record.dt * np.arange(e.n_samples, dtype=float)
        several = f", experiment {k + 1} of {record.n_experiments}" if record.n_experiments > 1 else ""
        for o, name in enumerate(record.outputs):
            series = [Series("measured", t, e.y[:, o], colour="ink", width=1.2)]
            series += [Series(label if len(models) > 1 else "simulated", t, run[k][:, o], colour=colour, width=1.9)
                       for (label, run), colour in zip(runs.items(), COLOURS * len(runs)) if run is not None]
            if predicted is not None:
                series.append(Series("one step ahead", t, predicted[k][:, o], colour="c1", dash="4 2", width=1.3))
            charts.append(Chart(f"Output {name}{several}", "Every simulation starts from the best-fitting initial "
                                "state and uses no measured output.", Axis("time"), _unit(name, record.output_units[o]),
                                series, f"{group}{k}", height=300))
        for c, name in enumerate(record.inputs):
            charts.append(Chart(f"Input {name}{several}", "", Axis("time"), _unit(name, record.input_units[c]),
                                [Series(name, t, e.u[:, c], colour="muted", width=1.2)], f"{group}{k}", height=190))
    return charts


def nonlinearity_charts(fit: "Fit") -> list[Chart]:
    """Every static function over its interval, its 95 % band, and the density of the samples below."""
    known, _ = uncertainty(fit)
    record = fit.data.raw() if isinstance(fit.data, Data) else None
    charts = []
    for function in static_functions(fit.model):
        if function.is_linear:
            continue
        f = function.nonlinearity
        samples = visited(function, record)
        samples = samples[np.isfinite(samples)]
        ends = f.basis.interval or ((samples.min(), samples.max()) if samples.size else (-1.0, 1.0))
        low, high = map(float, ends)
        grid, series = np.linspace(low, high, 401), []
        if known is not None:
            band = known.band(function.index, family=function.family)
            series.append(Series("95 % band", band.at, band.upper, "area", lows=band.lower))
        series.append(Series(function.word, grid, f(grid), width=2.2))
        here = samples[(samples >= low) & (samples <= high)]
        if here.size:
            counts, edges = np.histogram(here, bins=40, range=(low, high))
            series.append(Series("density of the samples", edges[:-1], counts / counts.max(), "bars", "muted",
                                 aside=True))
        charts.append(Chart(f"{function.what} {function.word} of {function.name}", "The bars show where the samples "
                            "lie: the function is uncertain where there are few.", _unit(function.name, function.unit),
                            Axis(f"{function.word}({function.name})"), series))
    return charts


def dynamics_charts(models: dict[str, Any], fit: "Fit | None" = None) -> list[Chart]:
    """Bode magnitude and phase (with the bands of a fit), step response, and poles."""
    first = next(iter(models.values()))
    w = np.geomspace(np.pi / first.dt * 1e-3, np.pi / first.dt, 300)
    pairs = response_pairs(first)
    known = uncertainty(fit)[0] if fit is not None else None
    size, turn = (None, None) if known is None else known.frequency_response(w)
    magnitude, phase, steps = [], [], []
    for m, (label, model) in enumerate(models.items()):
        curves = model.frequency_response(w).reshape(w.size, -1)
        response = model.step_response(step_length(model)).reshape(step_length(model), -1)
        t = model.dt * np.arange(len(response))
        for k, (u, y) in enumerate(pairs):
            colour = COLOURS[(m * len(pairs) + k) % len(COLOURS)]
            name = " ".join(part for part in (label, f"{u} to {y}" if len(pairs) > 1 else "") if part) or "response"
            if size is not None and turn is not None:
                lower, upper = (edge.reshape(w.size, -1)[:, k] for edge in (size.lower, size.upper))
                magnitude.append(Series("95 % band" if len(pairs) == 1 else "", w, decibels(upper), "area", colour,
                                        decibels(lower)))
                lower, upper = (np.degrees(edge.reshape(w.size, -1)[:, k]) for edge in (turn.lower, turn.upper))
                phase.append(Series("95 % band" if len(pairs) == 1 else "", w, upper, "area", colour, lower))
            magnitude.append(Series(name, w, decibels(np.abs(curves[:, k])), colour=colour, width=2.0))
            phase.append(Series(name, w, np.degrees(np.unwrap(np.angle(curves[:, k]))), colour=colour, width=2.0))
            steps.append(Series(name, t, response[:, k], colour=colour, width=2.0))
    frequency = Axis("frequency (rad per unit of time)", log=True, low=float(w[0]), high=float(w[-1]))
    caption = "The linear part, up to the Nyquist frequency" + ("; shaded: 95 % bands." if known is not None else ".")
    return [Chart("Bode diagram: magnitude", caption, frequency, Axis("magnitude (dB)", unit="dB"), magnitude, "bode"),
            Chart("Bode diagram: phase", caption, frequency, Axis("phase (degrees)", unit="degrees"), phase, "bode"),
            Chart("Step response", "Response of the linear part to a unit step of the function of the input.",
                  Axis("time"), Axis("response"), steps),
            pole_chart({label: model.poles for label, model in models.items()})]


def pole_chart(poles: dict[str, Array]) -> Chart:
    """Poles of models in the unit circle."""
    angle = np.linspace(0, 2 * np.pi, 181)
    series = [Series("", np.cos(angle), np.sin(angle), "line-only", "muted", width=1.2)]
    for k, (label, values) in enumerate(poles.items()):
        inside = np.abs(values) < 1
        series.append(Series(label or "poles", values[inside].real, values[inside].imag, "poles", COLOURS[k % 10]))
        if not inside.all():
            outside = values[~inside]
            series.append(Series(f"{label} unstable".strip(), outside.real, outside.imag, "poles", "red"))
    return Chart("Poles", "A stable model has all its poles inside the unit circle.", Axis("real part"),
                 Axis("imaginary part"), series, equal=True)


def correlation_charts(checked: "Validation") -> list[Chart]:
    """Every residual test with its 99 % band, its name and its outcome."""
    return [_correlation(test) for test in checked.tests]


def _correlation(test: Correlation) -> Chart:
    own = test.input is None
    tested = test.lags != 0 if own else np.full(test.lags.size, True)  # an autocorrelation is one at lag zero
    lags, values, band = test.lags[tested].astype(float), test.values[tested], test.band[tested]
    outside = np.abs(values) > band
    what = f"Whiteness of the residuals of {test.output}" if own else (
        f"Independence of the residuals of {test.output} from {test.input}")
    outcome = "not tested" if np.isnan(test.p_value) else (
        f"{'PASS' if test.passed else 'FAIL'} (p = {test.p_value:.2g})")
    reach = 1.15 * float(np.nanmax(np.abs(np.append(values, 1.3 * band)), initial=1e-3))
    series = [Series("99 % band", lags, band, "area", "muted", -band),
              Series("inside", lags[~outside], values[~outside], "stems")]
    if outside.any():
        series.append(Series("outside", lags[outside], values[outside], "diamonds", "red"))
    return Chart(f"{what}: {outcome}", "", Axis("lag (samples)"), Axis("correlation", low=-reach, high=reach), series,
                 height=230)


def horizon_charts(found: "Comparison") -> list[Chart]:
    """Fit of every model against how far ahead it predicts, by output."""
    charts = []
    for o, name in enumerate(found.data.outputs):
        series = [Series(label, np.array(curve.horizons, dtype=float), curve.fits[:, o], colour=colour, width=2.0)
                  for label, curve, colour in zip(found.names, found.curves, COLOURS * len(found.names))]
        charts.append(Chart(f"Fit of {name} against the horizon", "The further ahead, the closer to the simulation.",
                            Axis("samples ahead", log=True), Axis("fit (%)", unit="%"), series))
    return charts


def block_chart(found: "Identification") -> Chart:
    """Cross-validated fit by block of the best structure of every class."""
    series = [Series(f"{kind}{' (chosen)' if trial is found.chosen else ''}",
                     np.arange(1.0, len(trial.by_block) + 1), trial.by_block, colour=colour,
                     width=2.4 if trial is found.chosen else 1.4)
              for (kind, trial), colour in zip(found.best.items(), COLOURS)]
    return Chart("Fit by block left out", "Every block of the record is simulated by a model not fitted to it.",
                 Axis("block"), Axis("fit (%)", unit="%"), series)


def spectrum_chart(name: str, values: Array, rank: int) -> Chart:
    """Singular values relative to the first; those up to the rank in colour: they should stand out."""
    relative = np.maximum(values / max(float(values[0]), 1e-300), 1e-16)
    order = np.arange(1.0, values.size + 1)
    series = [Series("kept", order[:rank], relative[:rank], "dots", "c0"),
              Series("left out", order[rank:], relative[rank:], "dots", "muted")]
    return Chart(name, "Singular values well above the others support this order.", Axis("index"),
                 Axis("relative to the first", log=True), [s for s in series if len(s.xs)])


def noise_chart(model: Any) -> Chart:
    """Spectral density of the noise at every output, in dB of its squared unit."""
    from optid.identify.noise import noise_spectrum

    w = np.geomspace(np.pi / model.dt * 1e-3, np.pi / model.dt, 300)
    power = np.abs(np.einsum("foo->fo", noise_spectrum(model, w)))
    series = [Series(name, w, 10 * np.log10(np.maximum(power[:, o], 1e-24)), colour=COLOURS[o % 10], width=2.0)
              for o, name in enumerate(model.outputs)]
    return Chart("Spectrum of the noise", "Process and measurement noise at the outputs; white noise is a flat line.",
                 Axis("frequency (rad per unit of time)", log=True),
                 Axis("power per unit of bandwidth (dB)", unit="dB"), series)


def order_charts(study: "OrderStudy") -> list[Chart]:
    """Singular values with their threshold and the prediction errors by number of states."""
    ranks, states = study.ranks, study.states
    n = np.arange(ranks.singular_values.size, dtype=float)
    floor = max(ranks.floor, 1e-300)
    tails = [Series("values after n together", n, np.maximum(np.sqrt(ranks.statistics), floor / 10), "dots"),
             Series("threshold", n, np.maximum(np.sqrt(ranks.thresholds), floor / 10), colour="c1", dash="4 3")]
    k = np.arange(states.bic.size, dtype=float)
    best = [Series(word, k, (cost - cost.min()) / states.windows, colour=colour, width=2.0)
            for word, cost, colour in (("AICc", states.aicc, "c0"), ("BIC", states.bic, "c1"))]
    return [Chart("Singular values", "An order is accepted where its value falls below the threshold.",
                  Axis("number of states"), Axis("size", log=True), tails),
            Chart("Prediction errors", "Criteria per window above the best; the smallest is preferred.",
                  Axis("number of states"), Axis("above the best"), best)]

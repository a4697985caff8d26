"""Charts of pages: records, nonlinearities, responses, poles, residual tests, as data for the plot inside the page."""

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array, as_list
from optid.data.record import Data
from optid.errors import DataError, DataWarning, OptidError
from optid.identify.dynamics import Levels, mean_slopes
from optid.identify.uncertainty import Interval
from optid.identify.validation import validate
from optid.identify.validation.correlations import Correlation
from optid.identify.validation.predictions import one_step_or_nan, simulate_outputs
from optid.models.functions import StaticFunction, response_pairs, runs_free, static_functions
from optid.phrases import p_equals, unit_ratio
from optid.show import summary
from optid.show.estimates import uncertainty
from optid.show.sections import Axis, Chart, Series, decibels
from optid.show.wording import frequency_title, time_title, with_unit

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.order.lags import LagScan
    from optid.identify.order.study import OrderStudy
    from optid.identify.search import Identification
    from optid.identify.validation import Comparison, Validation

MOST_EXPERIMENTS = 4
COLOURS = tuple(f"c{k}" for k in range(10))
CIRCLE = np.cos(np.linspace(0, 2 * np.pi, 181)), np.sin(np.linspace(0, 2 * np.pi, 181))
INTERVAL = "95 % interval"
FAMILIES = ("nonlinearities", "feedback", "latent")
Lines = tuple[str, Sequence[Any] | None, dict[str, Any]]
"""Name, outputs (N, l) or their `OutputInterval` of every experiment or None for none, and options of the series."""


def channel_axis(name: str, unit: str) -> Axis:
    """Return the axis of a channel, with its unit where it has one."""
    return Axis(with_unit(name, unit), unit=unit)


def time_axis(record: Data, k: int = 0) -> Axis:
    """Return the axis of time of experiment k, which counts samples too where these are evenly spaced."""
    e, title = record.experiments[k], "time" if record.dated else time_title(record.time_unit)
    return Axis(title, unit=record.time_unit, dates=record.dated, start=e.start,
                step=record.dt if e.stamps is None else None)


def places(record: Data, k: int = 0) -> Array:
    """Return where on the axis of time the samples (N,) of experiment k lie."""
    e = record.experiments[k]
    return e.start + record.timelines[k].times_after_start(np.arange(e.n_samples))


def is_held(u: Array) -> bool:
    """Return whether an input (N,) keeps its value at most of its samples, as one that is held between its moves."""
    known = u[np.isfinite(u)]
    return bool(2 * np.count_nonzero(np.diff(known)) < known.size)


def validate_quietly(model: Any, record: Data) -> "Validation":
    """Validate a model without the warnings, which the notes repeat."""
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        return validate(model, record)


def argument_samples(function: StaticFunction, record: Data | None) -> Array:
    """Samples of the argument of a function; none if the simulation of a latent signal diverges."""
    try:
        return np.zeros(0) if record is None else function.samples(record)
    except DataError:
        return np.zeros(0)


def free_run(model: Any, record: Data) -> list[Array] | None:
    """Simulated outputs, or None where an input is missing or the model runs away."""
    if not runs_free(model):
        return None
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        try:
            return simulate_outputs(model, record)
        except DataError:
            return None


def record_charts(models: dict[str, Any], data: Data, *, ahead: bool = True, group: str = "time",
                  bands: Sequence[Lines] = (), remark: str = "") -> list[Chart]:
    """Measured outputs, simulations of models, and one-step predictions of a single one; inputs below, linked.

    The bands, such as `interval_band`, lie behind them; the remark ends the captions.
    """
    record = data.raw()
    runs, caption = [*bands, *runs_of(models, record, ahead)], (
        "Every simulation starts from the best-fitting initial state and uses no measured output."
        + f" {remark}" * bool(remark))
    return [chart for k in range(min(record.n_experiments, MOST_EXPERIMENTS))
            for chart in time_charts(record, k, runs, f"{group}{k}", caption)]


def runs_of(models: dict[str, Any], record: Data, ahead: bool = True) -> list[Lines]:
    """Return the simulations of models, and the one-step predictions of a single one, as `time_charts` takes them."""
    runs: list[Lines] = [
        (label if len(models) > 1 else "simulated", free_run(model, record), {"colour": colour, "width": 1.9})
        for (label, model), colour in zip(models.items(), COLOURS * len(models))]
    if ahead:
        predicted = one_step_or_nan(next(iter(models.values())), record)
        runs.append(("one step ahead", predicted, {"colour": "c1", "dash": "4 2", "width": 1.3}))
    return runs


def interval_band(fit: "Fit", record: Data) -> tuple[list[Lines], str, tuple[str, ...]]:
    """Return the 95 % interval of the simulation of a record as a band, if any, what it contains, and remarks."""
    if not runs_free(fit.model):
        return [], "", ()
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        try:
            found: list[Any] = as_list(fit.simulate(record, interval=0.95))
        except OptidError as error:
            return [], "", (f"No interval of the simulation: {str(error).rstrip('.')}.",)
    inside = np.sum([one.counts_inside(e.y) for one, e in zip(found, record.raw().experiments)], axis=0)
    shares = [f"{100 * count / total:.1f} % of the samples of {name}" for name, count, total in zip(
        record.outputs, *inside) if total]
    contains = f"The 95 % interval of the simulation, of parameters and noise, contains {' and '.join(shares)}."
    return [(INTERVAL, found, {})], contains if shares else "", found[0].notes


def time_charts(record: Data, k: int, runs: Sequence[Lines], group: str = "", caption: str = "",
                part: slice = slice(None), heights: tuple[int, int] = (300, 190)) -> list[Chart]:
    """Return charts of every output, measured and of some runs, and of every input over some samples of experiment k.

    A run that is an interval is drawn as a band, an input that `is_held` as steps.
    """
    e = record.experiments[k]
    t, x = places(record, k)[part], time_axis(record, k)
    several = f", experiment {k + 1} of {record.n_experiments}" if record.n_experiments > 1 else ""
    charts = []
    for o, name in enumerate(record.outputs):
        series = [Series("measured", t, e.y[part, o], colour="ink", width=1.2)]
        series += [Series(label, t, run[k].upper[part, o], "area", lows=run[k].lower[part, o], **how)
                   if isinstance(run[k], Interval) else Series(label, t, run[k][part, o], **how)
                   for label, run, how in runs if run is not None]
        y = channel_axis(name, record.output_units[o])
        charts.append(Chart(f"Output {name}{several}", caption, x, y, series, group, height=heights[0]))
    for c, name in enumerate(record.inputs):
        curve = Series(name, t, e.u[part, c], colour="muted", width=1.2, held=is_held(e.u[:, c]))
        charts.append(Chart(f"Input {name}{several}", "", x, channel_axis(name, record.input_units[c]), [curve], group,
                            height=heights[1]))
    return charts


def nonlinearity_charts(fit: "Fit", linear: bool = False, families: Sequence[str] = FAMILIES) -> list[Chart]:
    """Every static function, or every nonlinear one, over its interval, its 95 % band, and the density of samples.

    Functions of inputs are in the gauge of the model; the families are attributes of the model.
    """
    known, _ = uncertainty(fit)
    record = fit.data.raw() if isinstance(fit.data, Data) else None
    charts = []
    for function in static_functions(fit.model):
        if function.family not in families or function.is_linear and not linear:
            continue
        f = function.nonlinearity
        samples = argument_samples(function, record)
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
            series.append(density(here, low, high))
        charts.append(Chart(f"{function.what} {function.word} of {function.name}", "The bars show where the samples "
                            "lie: the function is uncertain where there are few.",
                            channel_axis(function.name, function.unit), Axis(f"{function.word}({function.name})"),
                            series))
    return charts


def density(samples: Array, low: float, high: float) -> Series:
    """Return a histogram of samples (N,) between two values as bars, the highest of height one."""
    counts, edges = np.histogram(samples, bins=40, range=(low, high))
    return Series("density of the samples", edges[:-1], counts / max(counts.max(), 1), "bars", "muted", aside=True)


def frequencies(model: Any, count: int = 300) -> Array:
    """Return frequencies in radians per unit of time: up to the Nyquist frequency, or around continuous poles."""
    if hasattr(model, "dt"):
        return np.geomspace(np.pi / model.dt * 1e-3, np.pi / model.dt, count)
    sizes = np.concatenate([np.abs(model.poles), [1 / delay for delay in model.dead_time if delay]])
    sizes = sizes[sizes > 1e-12 * sizes.max(initial=0.0)]
    low, high = (sizes.min(), sizes.max()) if sizes.size else (1.0, 1.0)
    return np.geomspace(low / 100, 10 * high, count)


def ratio_unit(model: Any) -> str:
    """Return the unit of the responses, where all have the same and it is known; otherwise ""."""
    units = {unit_ratio(y, u) for y in model.output_units for u in model.input_units}
    return units.pop() if len(units) == 1 else ""


def dynamics_charts(models: dict[str, Any], levels: Levels, known: Any = None) -> list[Chart]:
    """Return `bode_charts` and the poles."""
    return [*bode_charts(models, levels, known), pole_chart({label: model.poles for label, model in models.items()})]


def bode_charts(models: dict[str, Any], levels: Levels, known: Any = None, hertz: bool = False) -> list[Chart]:
    """Bode magnitude and phase from input to output, with bands where the uncertainty is known.

    A nonlinear f counts with its range over that of its input, between two levels of every input, so that the scale
    between f and B has no effect.
    """
    first = next(iter(models.values()))
    w = frequencies(first)
    at = w / (2 * np.pi) if hertz else w
    pairs = response_pairs(first)
    size, turn = (None, None) if known is None else known.frequency_response(
        w, lambda model: mean_slopes(model, levels))
    magnitude, phase = [], []
    for m, (label, model) in enumerate(models.items()):
        curves = (model.frequency_response(w) * mean_slopes(model, levels)).reshape(w.size, -1)
        for k, (u, y) in enumerate(pairs):
            if not curves[:, k].any():
                continue
            colour = COLOURS[(m * len(pairs) + k) % len(COLOURS)]
            name = " ".join(part for part in (label, f"{u} to {y}" if len(pairs) > 1 else "") if part) or "response"
            if size is not None and turn is not None:
                lower, upper = (edge.reshape(w.size, -1)[:, k] for edge in (size.lower, size.upper))
                magnitude.append(Series("95 % band" if len(pairs) == 1 else "", at, decibels(upper), "area", colour,
                                        decibels(lower)))
                lower, upper = (np.degrees(edge.reshape(w.size, -1)[:, k]) for edge in (turn.lower, turn.upper))
                phase.append(Series("95 % band" if len(pairs) == 1 else "", at, upper, "area", colour, lower))
            magnitude.append(Series(name, at, decibels(np.abs(curves[:, k])), colour=colour, width=2.0))
            phase.append(Series(name, at, np.degrees(np.unwrap(np.angle(curves[:, k]))), colour=colour, width=2.0))
    frequency = Axis(frequency_title(first, hertz), log=True, low=float(at[0]), high=float(at[-1]))
    bent = any(not function.is_linear for model in models.values() for function in static_functions(model))
    reach = ", up to the Nyquist frequency" * hasattr(first, "dt")
    caption = (f"From input to output{reach}" + ", with the mean slope of f" * bent
               + ("; shaded: 95 % bands." if known is not None else "."))
    unit = ratio_unit(first)
    size_axis = Axis(with_unit("magnitude", f"dB of {unit}" if unit else "dB"), unit="dB")
    return [Chart("Bode diagram: magnitude", caption, frequency, size_axis, magnitude, "bode"),
            Chart("Bode diagram: phase", caption, frequency, Axis("phase (degrees)", unit="degrees"), phase, "bode")]


def pole_chart(poles: dict[str, Array]) -> Chart:
    """Poles of models in the unit circle."""
    series = [Series("", *CIRCLE, "line-only", "muted", width=1.2)]
    for k, (label, values) in enumerate(poles.items()):
        inside = np.abs(values) < 1
        series.append(Series(label or "poles", values[inside].real, values[inside].imag, "poles", COLOURS[k % 10]))
        if not inside.all():
            outside = values[~inside]
            series.append(Series(f"{label} unstable".strip(), outside.real, outside.imag, "poles", "red"))
    return Chart("Poles", "A stable model has all its poles inside the unit circle.", Axis("real part"),
                 Axis("imaginary part"), series, equal=True)


def correlation_chart(test: Correlation) -> Chart:
    """Correlations of a residual test as stems, with their 99 % band; those outside it as red diamonds."""
    own = test.input is None
    tested = test.lags != 0 if own else np.full(test.lags.size, True)  # an autocorrelation is one at lag zero
    lags, values, band = test.lags[tested].astype(float), test.values[tested], test.band[tested]
    outside = np.abs(values) > band
    what = f"Whiteness of the residuals of {test.output}" if own else (
        f"Independence of the residuals of {test.output} from {test.input}")
    outcome = "not tested" if np.isnan(test.p_value) else (
        f"{'PASS' if test.passed else 'FAIL'} ({p_equals(test.p_value)})")
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


def theta_charts(fit: "Fit") -> list[Chart]:
    """Singular values of Theta of every input, before the rank is forced to one."""
    return [_spectrum(f"Singular values of Theta, {name}", values, 1)
            for name, values in summary.theta_singular_values(fit).items()]


def spectrum_charts(fit: "Fit") -> list[Chart]:
    """Singular values that a procedure of several steps measured, from which it read the order."""
    order = int(fit.model.orders.get("nx", 0)) or 1
    return [_spectrum(name[:1].upper() + name[1:], values, order) for name, values in summary.spectra(fit).items()]


def _spectrum(name: str, values: Array, rank: int) -> Chart:
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
                 Axis(frequency_title(model), log=True),
                 Axis("power per unit of bandwidth (dB)", unit="dB"), series)


def order_charts(study: "OrderStudy") -> list[Chart]:
    """Singular values, their tails with the threshold, criteria and hold-out by states, and the scan of lags."""
    ranks, states = study.ranks, study.states
    n, k = np.arange(float(ranks.singular_values.size)), np.arange(float(states.bic.size))
    floor, sizes = max(ranks.floor, 1e-300), Axis("size", log=True)

    def tail(name: str, squares: Array, **how: Any) -> Series:
        return Series(name, n, np.maximum(np.sqrt(squares), floor / 10), **how)

    tails = [tail("values after n together", ranks.statistics, kind="dots"),
             tail("threshold", ranks.thresholds, colour="c1", dash="4 3"),
             tail("expected of noise", ranks.expected, colour="muted", dash="1 3")]
    if ranks.exact:
        tails.append(tail("rounding", np.full(n.size, floor**2), colour="ink"))
    best = [Series(word, k, (cost - cost.min()) / states.windows, colour=colour, width=2.0)
            for word, cost, colour in (("AICc", states.aicc, "c0"), ("BIC", states.bic, "c1"))]
    charts = [_spectrum("Singular values", ranks.singular_values, study.nx),
              Chart("Singular values after n together", "An order is accepted where its value falls below the "
                    "threshold.", Axis("number of states"), sizes, tails),
              Chart("Prediction errors", "Criteria per window above the best; the smallest is preferred.",
                    Axis("number of states"), Axis("above the best"), best)]
    if np.isfinite(states.fit).any():
        charts.append(Chart("Prediction of the part held out", "", Axis("number of states"), Axis("fit (%)", unit="%"),
                            [Series("hold-out fit", k, states.fit, width=2.0)]))
    if study.lags is not None:
        charts.append(Chart("Lags", "Smallest BIC per row above the best.", Axis("na, nb, nk"), Axis("above the best"),
                            [_over(study.lags, word, colour) for word, colour in zip(("na", "nb", "nk"), COLOURS)]))
    return charts


def _over(scan: "LagScan", word: str, colour: str) -> Series:
    """The smallest BIC of a scan of lags for every value of one of its orders."""
    values = np.array([int(np.ravel(getattr(one, word))[0]) for one in scan.candidates])
    costs, counts = np.array([one.bic for one in scan.candidates]), np.unique(values)
    found = [float(costs[values == count].min()) for count in counts]
    return Series(f"over {word}", counts, (np.array(found) - scan.best("bic").bic) / scan.rows, colour=colour)

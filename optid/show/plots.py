"""Figures of a fit. Every function returns a matplotlib `Figure` and leaves the user's settings as they are.

Long records are thinned to the extremes of every bin, so that figures stay small and no peak is lost.
"""

from textwrap import wrap
from typing import TYPE_CHECKING, Any, cast

from matplotlib.figure import Figure

from optid.core.least_squares import RankOneForm
from optid.data.record import Data
from optid.errors import DataError
from optid.identify.dynamics import input_levels
from optid.identify.validation import Validation
from optid.lazy import public_names
from optid.models.functions import static_functions
from optid.phrases import short
from optid.show import charts, frequency, panels, responses
from optid.show.estimates import uncertainty
from optid.show.panels import CLOSEUP, MUTED, attempt_panels, liveliest, plain, with_style
from optid.show.sections import Chart

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.search import Identification

MOST_EXPERIMENTS = 3
TEST = "test record"
"""Experiments drawn side by side; the title says how many there are."""

RUNGS = {"instant": "instant proof", "ascent": "dual ascent", "sdp": "SDP", "product cuts": "product cuts"}
"""The ladder of proofs of a rank-one programme, cheapest first."""

NARROW = 18
"""Characters of a name above a small panel."""

THRESHOLD = 1e-8
"""Relative gap that counts as a proof."""


@with_style
def overview(fit: "Fit", test: Data | None = None) -> Figure:
    """Draw the result on one page: fit over time, characteristics, residual tests, poles, frequency response.

    Args:
        fit: the fit.
        test: record to show the fit on; the estimation record when not given.

    Raises:
        DataError: the fit was made from a stream and no test record is given.
    """
    record, model, functions = _record(fit, test), fit.model, static_functions(fit.model)
    long = _needs_closeup(record, 5)
    rows_of_f = [2.9 * -(-len(functions) // 3)] if len(functions) > 1 else []
    heights = [(4.2 if long else 2.9) * record.l, *rows_of_f, 3.0, 2.5]
    figure = Figure(figsize=(10.0, sum(heights)), layout="constrained")
    rows = cast(Any, figure.subfigures(len(heights), 1, height_ratios=heights))
    which = TEST if test is not None else "estimation record"
    attempt_panels(rows[0], "The fit over time", lambda part: _time_panels(part, fit, record, which, closeup=long))
    left, right = rows[1:3] if rows_of_f else rows[1].subfigures(1, 2, width_ratios=[1, 1.45]) if functions else (
        None, rows[1])
    if left is not None:
        attempt_panels(left, "Characteristics", lambda part: panels.draw_charts(part, _functions(fit)))
    attempt_panels(right, "The dynamics", lambda part: _dynamics_panels(part, fit))
    attempt_panels(rows[-1], "The residual tests", lambda part: _residual_panels(
        part, _validated(model, record), record, outputs=1, inputs=min(model.m, 2)))
    return figure


@with_style
def fit_over_time(fit: "Fit", data: Data | None = None) -> Figure:
    """Draw measured, simulated and one-step predicted outputs; long records with a close-up.

    Args:
        fit: the fit.
        data: the record, drawn with the 95 % interval of its simulation; the estimation record when not given.

    Raises:
        DataError: the fit was made from a stream and no record is given.
    """
    record = _record(fit, data)
    long = _needs_closeup(record, 2)
    figure = Figure(figsize=(9.0, (4.6 if long else 3.0) * record.l), layout="constrained")
    _time_panels(figure, fit, record, TEST if data is not None else "estimation record", closeup=long)
    return figure


@with_style
def nonlinearity(fit: "Fit") -> Figure:
    """Draw every static nonlinearity in the gauge of the model, with its 95 % band and where samples lie.

    Raises:
        DataError: the model has no static functions.
    """
    count = len(static_functions(fit.model))
    if not count:
        raise DataError(f"a model of {fit.formulation!r} has no static functions to draw")
    figure = Figure(figsize=(9.0 if count > 1 else 6.4, 3.4 * -(-count // 3)), layout="constrained")
    panels.draw_charts(figure, charts.nonlinearity_charts(fit, linear=True))
    return figure


@with_style
def residual_tests(fit: "Fit", data: Data | None = None) -> Figure:
    """Draw autocorrelations of the residuals and their cross-correlations with the inputs, with 99 % bands.

    Args:
        fit: the fit.
        data: the record; the estimation record when not given.

    Raises:
        DataError: the fit was made from a stream and no record is given.
    """
    record = _record(fit, data)
    figure = Figure(figsize=(9.0, 2.5 * record.l), layout="constrained")
    _residual_panels(figure, _validated(fit.model, record), record, outputs=record.l, inputs=record.m)
    return figure


@with_style
def poles_and_response(fit: "Fit") -> Figure:
    """Draw poles, and frequency response and step responses from input to output, with 95 % bands."""
    figure = Figure(figsize=(10.0, 3.3 * -(-(2 + fit.model.m * fit.model.l) // 3)), layout="constrained")
    steps = [one.chart for one in _drawn(fit) if one.curve.kind == "step"]
    panels.draw_charts(figure, [*_dynamics(fit), *steps])
    return figure


@with_style
def bode(result: Any, hertz: bool = False) -> Figure:
    """Draw magnitude and phase from every input to every output, of a fit with 95 % bands.

    Args:
        result: a fit, or a model, sampled or continuous.
        hertz: frequencies in Hz (cycles per unit of time) instead of radians per unit of time.
    """
    model, levels, known = _linear_part(result)
    figure = Figure(figsize=(7.2, 5.6), layout="constrained")
    for ax, chart in zip(figure.subplots(2, 1, sharex=True), charts.bode_charts({"": model}, levels, known, hertz)):
        panels.draw_chart(ax, chart)
        ax.label_outer()
    return figure


@with_style
def nyquist(result: Any) -> Figure:
    """Draw the frequency response of a fit or model in the complex plane, of a fit with 95 % ellipses."""
    return _plane(frequency.nyquist_chart(*_linear_part(result)))


@with_style
def poles_and_zeros(result: Any) -> Figure:
    """Draw poles (crosses) and zeros (circles) of a fit or model, of a fit with 95 % ellipses, and bars of real ones.

    Those of a sampled model lie beside the unit circle, those of a continuous one in the plane of s.
    """
    model, _, known = _linear_part(result)
    return _plane(frequency.pole_zero_chart(model, known))


def _plane(chart: Chart) -> Figure:
    """Draw a chart of the complex plane with its axes."""
    figure = Figure(figsize=(5.6, 5.2), layout="constrained")
    ax = figure.subplots()
    ax.axhline(0, color=MUTED, linewidth=0.6, zorder=0)
    ax.axvline(0, color=MUTED, linewidth=0.6, zorder=0)
    panels.draw_chart(ax, chart)
    return figure


def _linear_part(result: Any) -> tuple[Any, Any, Any]:
    """Return the model of a fit or a model, the range of every input, and the uncertainty where it is known."""
    if not hasattr(result, "model"):
        return result, input_levels(result), None
    record = result.data.raw() if isinstance(result.data, Data) else None
    return result.model, input_levels(result.model, record), uncertainty(result)[0]


@with_style
def noise(fit: "Fit") -> Figure:
    """Draw the spectral density of the noise at every output, in dB of its squared unit.

    Raises:
        StructureError: the model has no noise covariances.
    """
    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    panels.draw_charts(figure, [charts.noise_chart(fit.model)])
    return figure


@with_style
def certificate(fit: "Fit") -> Figure:
    """Draw the steps of the proof of global optimality and the remaining gap."""
    bound = fit.solution.bound
    ladder = RankOneForm.of(fit.problem) is not None and bound is not None and bound.method in RUNGS
    figure = Figure(figsize=(9.0, 2.7 if ladder else 1.9), layout="constrained")
    axes = figure.subplots(2 if ladder else 1, 1, height_ratios=[1, 1.35] if ladder else None, squeeze=False)[:, 0]
    if ladder and bound is not None:
        methods = list(RUNGS)
        rungs = ["local solution", *(RUNGS[m] for m in methods if m != "product cuts" or bound.method == m)]
        reached = rungs.index(RUNGS[bound.method])
        panels.draw_ladder(axes[0], rungs, reached, fit.solution.proof)
    gap = fit.solution.gap
    threshold = max(THRESHOLD, 1.01 * gap) if fit.solution.proof else THRESHOLD
    panels.draw_gap(axes[-1], gap, threshold)
    reason = bound.reason if bound is not None and bound.reason else "no bound"
    axes[0].set_title(plain("\n".join(wrap(reason[0].upper() + reason[1:], 95))))
    return figure


@with_style
def singular_values(fit: "Fit") -> Figure:
    """Draw the singular values of Theta of every input, before the rank is forced to one.

    One dominant singular value supports the Hammerstein structure.

    Raises:
        DataError: the formulation has no matrix Theta.
    """
    return _row(charts.theta_charts(fit), 3.4, f"formulation {fit.formulation!r} has no matrix Theta with more than "
                "one row and column")


@with_style
def spectra(fit: "Fit") -> Figure:
    """Draw the singular values that a procedure of several steps measured, from which it read the order.

    Raises:
        DataError: the formulation has none.
    """
    return _row(charts.spectrum_charts(fit), 4.4, f"formulation {fit.formulation!r} reports no singular values")


def _row(shown: list[Chart], width: float, none: str) -> Figure:
    """Draw charts of a width in inches in a row; `DataError` with a reason where there are none."""
    if not shown:
        raise DataError(none)
    figure = Figure(figsize=(min(9.0, width * len(shown) + 1.0), 2.9), layout="constrained")
    panels.draw_charts(figure, shown)
    return figure


def search_overview(found: "Identification", test: Data | None = None) -> Figure:
    """Draw the fit that a search ended with, as `overview` does."""
    return overview(found.fit, test)


def _record(fit: "Fit", data: Data | None) -> Data:
    record = fit.data if data is None else data
    if not isinstance(record, Data):
        raise DataError("the fit was made from a stream; give the record to draw, e.g. optid.plots.overview(fit, test)")
    return record.raw()


def _needs_closeup(record: Data, factor: int) -> bool:
    """Whether a record is one experiment too long to show single samples."""
    return record.n_experiments == 1 and record.n_samples > factor * CLOSEUP


def _time_panels(figure: Any, fit: "Fit", record: Data, title: str, closeup: bool = False) -> None:
    """Fill a figure with one row per output (two with close-ups), one column per experiment."""
    shown = record.experiments[:MOST_EXPERIMENTS]
    heights = [1.25, 1.0] * record.l if closeup else [1.0] * record.l
    longest = max(e.n_samples for e in record.experiments)
    axes = figure.subplots(len(heights), len(shown), squeeze=False, sharey="row", height_ratios=heights,
                           width_ratios=[max(e.n_samples, 0.25 * longest) for e in shown])
    bands = charts.interval_band(fit, record)[0] if title == TEST else []
    runs = [*bands, *charts.runs_of({"": fit.model}, record)]
    for k, e in enumerate(shown):
        for o, chart in enumerate(charts.time_charts(record, k, runs)[: record.l]):
            ax = axes[o * (2 if closeup else 1), k]
            panels.draw_chart(ax, chart, legend=False)
            if closeup:
                _closeup(ax, axes[2 * o + 1, k], charts.time_charts(record, k, runs, part=liveliest(e.y[:, [o]]))[o])
    for ax in axes.flat:
        ax.set_title("")
        if not closeup:
            ax.label_outer()
        elif not ax.get_subplotspec().is_last_row():
            ax.set_xlabel("")
    several = f", experiments 1-{len(shown)} of {record.n_experiments}" if record.n_experiments > 1 else ""
    axes[0, 0].set_title(f"Fit over time: {title}{several}")
    # outside the layout, where it would widen its column
    place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 4, "borderaxespad": 0.2}
    axes[0, -1].legend(**place, handlelength=1.6).set_in_layout(False)


def _closeup(ax: Any, below: Any, chart: Chart) -> None:
    """Draw the stretch in which the output moves most, and mark it in the panel above."""
    panels.draw_chart(below, chart, legend=False)
    t = panels.instants(chart.series[0].xs, chart.x)
    ax.axvspan(t[0], t[-1], color=MUTED, alpha=0.15, linewidth=0)
    below.set_ylabel("close-up")


def _validated(model: Any, record: Data) -> Validation | str:
    """Return the validation, or the reason why there is none."""
    try:
        return charts.validate_quietly(model, record)
    except DataError as error:
        return f"No residual tests: {error}"


def _residual_panels(figure: Any, checked: Validation | str, record: Data, outputs: int, inputs: int) -> None:
    """One row per output: autocorrelation, then the cross-correlation with every input; or a reason for none."""
    if isinstance(checked, str):
        panels.write(figure, checked)
        return
    axes = iter(figure.subplots(outputs, 1 + inputs, squeeze=False).ravel())
    for name in record.outputs[:outputs]:
        tests = [checked.autocorrelations[name]]
        tests += [checked.cross_correlations[name, channel] for channel in record.inputs[:inputs]]
        for k, test in enumerate(tests):
            ax = next(axes)
            title = "Autocorrelation" if test.input is None else f"With past {short(test.input, NARROW)}"
            panels.draw_chart(ax, charts.correlation_chart(test), legend=False, title=title)
            ax.set_ylabel("" if k else plain(f"residual of {short(name, NARROW)}"))


def _dynamics(fit: "Fit") -> list[Chart]:
    """Poles, and the magnitude of every input-output pair."""
    record = fit.data.raw() if isinstance(fit.data, Data) else None
    magnitude, _, poles = charts.dynamics_charts({"": fit.model}, input_levels(fit.model, record), uncertainty(fit)[0])
    return [poles, magnitude]


def _drawn(fit: "Fit") -> list[responses.Drawn]:
    """Characteristics and step responses in output units."""
    record = fit.data.raw() if isinstance(fit.data, Data) else None
    found, _ = responses.fit_responses(fit, uncertainty(fit)[0])
    return responses.curve_charts({"fit": found}, [fit.model], record)


def _functions(fit: "Fit") -> list[Chart]:
    """Static characteristics, or rates, in output units, and functions of outputs fed back and of latent signals."""
    shown = [one.chart for one in _drawn(fit) if one.curve.kind != "step"]
    return shown + charts.nonlinearity_charts(fit, linear=True, families=charts.FAMILIES[1:])


def _dynamics_panels(figure: Any, fit: "Fit") -> None:
    shown = _dynamics(fit)
    for ax, chart in zip(figure.subplots(1, len(shown), width_ratios=[1.0, 1.7]), shown):
        panels.draw_chart(ax, chart)


__dir__ = public_names(__name__)

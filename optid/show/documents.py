"""Documents of every result, most important facts first, which terminal, notebook and page render."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from optid import phrases
from optid.data.description import RECORD
from optid.data.record import Data
from optid.errors import DataError
from optid.identify.dynamics import input_levels
from optid.identify.informativity import informativity
from optid.identify.responses import Response
from optid.identify.validation import Validation
from optid.identify.validation.predictions import SIMULATION, prediction_fit
from optid.identify.verdict import POOR_FIT, USELESS_FIT
from optid.phrases import plural
from optid.show import charts, checks, estimates, responses, summary, wording
from optid.show.record import informativity_table
from optid.show.sections import (
    TONES,
    Banner,
    Charts,
    Code,
    Document,
    FactColumns,
    Findings,
    Fold,
    Heading,
    Notes,
    Pair,
    Section,
    attempt,
)
from optid.show.terminal import findings_lines, set_table, wrap_sentence

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.order.study import OrderStudy
    from optid.identify.search import Identification
    from optid.identify.validation import Comparison
    from optid.identify.verdict import Verdict

Curves = Callable[[], tuple[list[Response], list[str]]]

ORDERS = 12
"""Orders listed of a study, where the recommended one is not larger."""

ADVISED = ("poor", "useless")
"""Verdicts for which a page gives advice; finding it requires fits of neighbouring structures."""


def fit_document(fit: "Fit", test: Data | None = None, *, judged: "Verdict | None" = None, command: str = "",
                 advise: bool = True) -> Document:
    """Return the document of a fit.

    Args:
        fit: the fit, with a model.
        test: record that the fit has not seen; adds its validation.
        judged: the verdict on the model; that of the fit when not given.
        command: the command line behind the fit.
        advise: whether to say what would help a poor model, which takes time.

    Raises:
        DataError: the fit ended without a model.
    """
    if fit.model is None:
        raise DataError(f"there is no model to report: the fit ended with status '{fit.solution.status}'")
    lead = " · ".join(part for part in (fit.formulation, fit.data.name, _length(fit.data)) if part)
    curves = cache(lambda: responses.fit_responses(fit, estimates.uncertainty(fit)[0]))
    sections = [
        *record_findings(fit.record_findings),
        Section("trust", "", lambda: _trust(fit, fit.verdict if judged is None else judged, test, advise)),
        Section("dynamics", "Dynamics", lambda: _dynamics(fit, curves)),
        Section("optimum", "", lambda: _optimum(fit)),
        Section("model", "Model", lambda: _model(fit)),
        Section("constraints", "Constraints and their prices", lambda: [summary.constraint_table(fit)]),
        Section("figures", "Figures", lambda: _fit_charts(fit, curves), page_only=True),
        Section("validation", "Validation", lambda: _validations(fit, test), page_only=True),
        Section("certificate", "Certificate", lambda: [summary.certificate_facts(fit)], page_only=True),
        Section("data", "Data", lambda: [
            summary.record_facts(fit), *([summary.channel_table(fit.data)] if isinstance(fit.data, Data) else [])],
            page_only=True),
        Section("solver", "Solver and times", lambda: [summary.solver_facts(fit)], page_only=True),
        Section("reproduce", "Reproduce", lambda: reproduce(
            "\n".join(part for part in (command, summary.call(fit)) if part), str(fit)), page_only=True)]
    judgeable = isinstance(fit.data, Data)
    left_out = {"trust": not judgeable and judged is None, "constraints": not fit.prices,
                "validation": not judgeable and test is None}
    return Document(summary.title(fit), lead, [one for one in sections if not left_out.get(one.id)])


def _dynamics(fit: "Fit", curves: Curves) -> list[Any]:
    """Return what the model does in the units of the record: dynamics, then characteristics at a few points."""
    return [*attempt("The table of the dynamics", lambda: [estimates.parameters_table(fit.dynamics)]),
            *attempt("The static characteristics", lambda: [
                *responses.curve_tables(curves()[0], fit.model), *([Notes(curves()[1])] if curves()[1] else [])])]


def _model(fit: "Fit") -> list[Any]:
    """Return equation, facts, tables and intermediate results; each fails without the others.

    f itself, whose scale and sign are a matter of the gauge, is for those who ask: the page opens it on a click.
    """
    tables = [*attempt("The table of the parameters", lambda: estimates.parameter_tables(fit)),
              *attempt("The table of the nonlinearities", lambda: estimates.nonlinearity_tables(fit, inputs=False)),
              *attempt("The fit on the estimation record", lambda: [summary.fit_table(fit)]),
              *attempt("The table of the noise", lambda: filter(None, [summary.noise_table(fit)]))]
    evidence = attempt("The intermediate results", lambda: filter(None, [summary.evidence_facts(fit)]))
    gauged = [*attempt("The table of f", lambda: estimates.nonlinearity_tables(fit, inputs=True)),
              *attempt("The coefficients of the basis", lambda: filter(None, [estimates.coefficient_table(fit)]))]
    drawn = attempt("The figure of f", lambda: charts.nonlinearity_charts(fit, families=("nonlinearities",)))
    return [
        *attempt("The equation", lambda: [Code(fit.model.equation(), equation=True)]),
        *attempt("The facts about the model", lambda: [summary.model_facts(fit)]),
        Pair(tables),
        *([Heading("Intermediate results"), *evidence] if evidence else []),
        *([Fold("f in its gauge", [*([Charts(drawn)] if drawn else []), *gauged])] if gauged else [])]


def record_findings(findings: Sequence[str]) -> list[Section]:
    """Return the section of what reading the record derived, assumed or repaired; none where there is nothing."""
    return [Section("record", RECORD, [Findings(findings)])] if findings else []


def record_document(data: Data, *, command: str = "") -> Document:
    """Return the document of a record: what reading it found, its channels, and their course."""
    raw = data.raw()

    def draw() -> list[Any]:
        return [Charts([chart for k in range(min(raw.n_experiments, charts.MOST_EXPERIMENTS))
                        for chart in charts.time_charts(raw, k, [], f"time{k}")], wide=True)]

    channels = f"{', '.join(data.inputs)} to {', '.join(data.outputs)}"
    lead = " · ".join([_length(data), f"every {data.interval}", channels])
    return Document(data.name or "Record", lead, [
        *record_findings((*data.findings, *informativity(data).findings)),
        Section("channels", "Channels", lambda: [summary.channel_table(data)]),
        Section("tests", "What the record tells", lambda: [informativity_table(informativity(data))]),
        Section("figures", "Figures", draw, page_only=True),
        *([Section("reproduce", "Reproduce", [Code(command)], page_only=True)] if command else [])])


def _length(data: Any) -> str:
    return plural(data.n_samples, "sample", "") if data.n_samples else ""


def _trust(fit: "Fit", judged: "Verdict | None", test: Data | None, advise: bool) -> list[Any]:
    which = ", lowest output" if fit.model.l > 1 else ""

    def cards() -> Iterator[tuple[str, str]]:
        fits = [("one-step fit", fit.one_step_fit), ("simulation fit", summary.simulation_fit(fit))]
        if test is not None:
            fits.append(("simulation fit, test record", prediction_fit(fit.model, test, SIMULATION)))
        return ((label + which, wording.percent(np.min(values))) for label, values in fits)

    found = attempt("The fit at first glance", cards)
    if judged is None:
        return [Banner("plain", "The model on this record: not judged", "The tests of a verdict need a record in "
                       "memory.", tuple(one for one in found if isinstance(one, tuple)))]
    if judged.failed and any(price.binding for price in fit.prices):
        found = [*found, Notes(["An active constraint may be the reason for tests that fail: the record alone would "
                                "not have it so. See the prices."])]
    advice = attempt("The advice", lambda: [Notes([str(one) for one in fit.advice])] if fit.advice else []) if (
        advise and judged.word in ADVISED) else []
    return [Banner(TONES[judged.word], f"The model on this record: {judged.word}", summary.judgement(judged),
                   tuple(one for one in found if isinstance(one, tuple))),
            *(one for one in found if isinstance(one, Notes)), summary.verdict_table(judged), *advice]


def _optimum(fit: "Fit") -> list[Any]:
    tone, word, sentence = summary.verdict(fit)
    solution = fit.solution
    cards = [("relative gap to the bound", "none" if solution.bound is None else wording.gap_text(solution.gap))]
    if fit.prices:
        cards.append(("constraints active", f"{sum(p.binding for p in fit.prices)} of {len(fit.prices)}"))
    cards.append(("time", phrases.seconds(fit.total_seconds)))
    right = [(name, value) for name, value in summary.certificate_facts(fit)
             if name in ("Objective", "Bound", "Relative gap")]
    right += [(name, value) for name, value in summary.solver_facts(fit) if name in ("Solver", "Iterations", "Total")]
    return [Banner(tone, f"Solution: {word}", sentence, tuple(cards)), FactColumns(summary.record_facts(fit), right),
            *filter(None, [summary.steps_table(fit)]), *([Notes(fit.findings)] if fit.findings else [])]


def _fit_charts(fit: "Fit", curves: Curves) -> list[Any]:
    parts: list[Any] = []
    data, models = fit.data, {"": fit.model}
    record = data.raw() if isinstance(data, Data) else None
    if isinstance(data, Data):
        parts += attempt("The figure of the record", lambda: [Charts(charts.record_charts(models, data), wide=True)])
    several = [
        *attempt("The figure of the responses", lambda: [
            one.chart for one in responses.curve_charts({"fit": curves()[0]}, [fit.model], record)]),
        *attempt("The figure of the nonlinearities", lambda: charts.nonlinearity_charts(
            fit, families=charts.FAMILIES[1:])),
        *attempt("The figure of the dynamics", lambda: charts.dynamics_charts(
            models, input_levels(fit.model, record), estimates.uncertainty(fit)[0])),
        *attempt("The figure of Theta", lambda: charts.theta_charts(fit)),
        *attempt("The figure of the singular values", lambda: charts.spectrum_charts(fit)),
        *attempt("The figure of the noise", lambda: [charts.noise_chart(fit.model)] if summary.has_noise(fit.model)
                 else [])]
    return [*parts, Charts(several)]


def _validations(fit: "Fit", test: Data | None) -> list[Any]:
    parts: list[Any] = []
    for title, record in (("Estimation record", fit.data), ("Test record, not used by the fit", test)):
        if isinstance(record, Data):
            parts += [Heading(title), *attempt("The validation", partial(_validation, fit.model, record))]
            if record is test:
                parts += attempt("The figure of the test record", partial(_test_charts, fit, record))
    return parts


def _validation(model: Any, record: Data) -> list[Any]:
    try:
        return validation_parts(charts.validate_quietly(model, record))
    except DataError as error:
        return [Notes([f"No validation: {error}"])]


def _test_charts(fit: "Fit", record: Data) -> list[Any]:
    bands, contains, notes = charts.interval_band(fit, record)
    drawn = charts.record_charts({"": fit.model}, record, group="test", bands=bands, remark=contains)
    return [*([Notes(notes)] if notes else []), Charts(drawn, wide=True)]


def validation_parts(checked: Validation) -> list[Any]:
    """Return errors, tests, notes and the correlations of a validation."""
    notes, drawn = [Notes(checked.notes)] if checked.notes else [], map(charts.correlation_chart, checked.tests)
    return [*checks.validation_tables(checked), *notes, Charts([*drawn])]


def reproduce(call: str, text: str) -> list[Any]:
    """Return the parts that say how to make a result again, what made it, and its text."""
    from optid.show.page import versions

    return [Code(call), versions(), Fold("Result as plain text", [Code(text)])]


def search_document(found: "Identification", test: Data | None = None, *, command: str = "") -> Document:
    """Return the document of a search: verdict, structures on trial, score by block, then the fit it ended with."""
    document = fit_document(found.fit, test, judged=found.verdict, command=command)
    section = Section("search", "Search for the structure", lambda: _search(found))
    first = next(k for k, one in enumerate(document.sections) if one.id == "model")
    return Document(document.title, document.lead, [*document.sections[:first], section, *document.sections[first:]])


def _search(found: "Identification") -> list[Any]:
    chosen = found.chosen.candidate
    notes = [f"{found.ended[0].upper()}{found.ended[1:]}."] if found.stopped else []
    trials = [t for t in found.trials if np.isfinite(t.score)]
    table = wording.Table(f"Every structure that was tried on all blocks ({len(trials)})",
                          ("structure", "fit %", "worst block", "parameters", "time"),
                          [(f"{t.candidate.kind}: {t.candidate.formulation} {t.candidate.words}", f"{t.score:.1f}",
                            checks.worst_block(t), str(t.parameters), phrases.seconds(t.seconds))
                           for t in sorted(trials, key=lambda t: -t.score)])
    drawn = [Charts([charts.block_chart(found)])] if found.chosen.by_block.size else []
    return [checks.search_table(found), Notes([*found.reasons, *notes]),
            Code(f"--formulation {chosen.formulation} {chosen.words}"), *drawn, Fold(table.title, [table])]


def validation_document(checked: Validation) -> Document:
    """Return the document of a validation."""
    tests = [t for t in checked.tests if not np.isnan(t.p_value)]
    failed = sum(not t.passed for t in tests)
    sentence = f"{len(tests) - failed} of {len(tests)} residual tests pass" + (
        "" if checked.structure is None else f"; structure test: {'PASS' if checked.structure.passed else 'FAIL'}")
    fits = tuple((f"{name}, {word}", f"{q.fit:.2f} %") for word, table in checked.predictors.items()
                 for name, q in table.items())[:4]
    worst = min((q.fit for table in checked.predictors.values() for q in table.values()), default=np.nan)
    tone = "bad" if not worst >= USELESS_FIT else "fair" if worst < POOR_FIT or not checked.passed else "good"
    banner = Banner(tone, f"Residual tests: {'PASS' if checked.passed else 'FAIL'}", sentence + ".", fits)
    return Document(f"Validation on {checked.data}" if checked.data else "Validation", "", [
        *record_findings(checked.findings),
        Section("trust", "", [banner]), Section("tests", "Errors and tests", lambda: validation_parts(checked))])


def comparison_document(found: "Comparison", *, command: str = "") -> Document:
    """Return the document of several models on one record."""
    models = dict(zip(found.names, found.models))
    several, alike = len(models) > 1, len({(m.l, m.m) for m in found.models}) == 1
    curves = cache(lambda: responses.comparison_curves(found))
    title = f"{len(models)} models on one record" if several else f"Validation of a {found.models[0].title}"
    lead = " · ".join(part for part in (found.data.name, _length(found.data)) if part)

    def figures() -> list[Any]:
        record = found.data.raw()
        linear = attempt("The figure of the dynamics", lambda: charts.dynamics_charts(
            models, responses.record_levels(record)) if alike else [
            charts.pole_chart({name: model.poles for name, model in models.items()})])
        shown = attempt("The figure of the responses", lambda: [
            one.chart for one in responses.curve_charts(curves()[0], found.models, record)])
        return [*attempt("The figure of the record", lambda: [
                    Charts(charts.record_charts(models, found.data, ahead=False), wide=True)]),
                Charts([*charts.horizon_charts(found), *shown, *linear])]

    def each() -> list[Any]:
        return [part for name, model, checked in zip(found.names, found.models, found.validations)
                for part in (Heading(name), Code(model.equation(), equation=True), *validation_parts(checked))]

    call = command or f"optid.compare_models(models, data, horizon={found.horizon})"
    return Document(title, lead, [
        *record_findings(found.data.findings),
        Section("fits", "Fits", lambda: [checks.comparison_table(found), checks.facts_table(found)]),
        Section("dynamics", "Dynamics", lambda: comparison_dynamics(found, curves())),
        Section("figures", "Figures", figures, page_only=True),
        Section("validation", "Each model by itself", each, page_only=True),
        Section("reproduce", "Reproduce", lambda: reproduce(call, str(found)), page_only=True)])


def comparison_dynamics(found: "Comparison", curves: tuple[Any, list[str]]) -> list[Any]:
    """Return time constants, dead times and gains of models side by side, and what they do in output units."""
    return [*attempt("The table of the dynamics", lambda: [responses.comparison_dynamics(found)]),
            *attempt("The responses", lambda: responses.comparison_tables(curves[0], found.models[0])),
            *([Notes(curves[1])] if curves[1] else [])]


def order_document(study: "OrderStudy") -> Document:
    """Return the document of a study of the order."""
    notes = [Notes([*study.reasons, *study.notes])]
    return Document(f"Order of {study.data}" if study.data else "Order", f"recommended: nx = {study.nx}", [
        *record_findings(study.findings),
        Section("order", "Recommendation", [Banner("plain", f"nx = {study.nx}"), *notes,
                                            Charts(charts.order_charts(study)),
                                            Fold("Tables", [Code(order_text(study))])])])


def order_text(study: "OrderStudy") -> str:
    """Return tables, recommendation and reasons, at most 80 columns wide."""
    ranks, states, scan = study.ranks, study.states, study.lags
    columns = [(ranks.singular_values, 1, ".4g"), (ranks.ratios, 1, ".3g"), (np.sqrt(ranks.statistics), 0, ".4g"),
               (np.sqrt(ranks.thresholds), 0, ".4g"), (ranks.p_values, 0, ".2g"),
               (states.bic - states.bic.min(), 0, ".1f"), (states.fit, 0, ".2f")]

    def cell(values: Any, k: int, digits: str) -> str:
        return f"{values[k]:{digits}}" if 0 <= k < values.size and np.isfinite(values[k]) else ""

    rows = [(f"{n}{' <' * (n == study.nx)}", *(cell(values, n - first, digits) for values, first, digits in columns))
            for n in range(min(max(ORDERS, study.nx + 3), ranks.singular_values.size))]
    tables = [wording.Table(f"{ranks.windows} windows, {study.block_rows} block rows, level {ranks.level:.2g}",
                            ("n", "s(n)", "s/s next", "tail", "threshold", "p", "BIC", "hold-out %"), rows)]
    if scan is not None:
        held = any(np.isfinite(one.fit) for one in scan.candidates)
        best = {word: scan.best(name) for word, name in (("AICc", "aicc"), ("BIC", "bic"), ("hold-out", "fit"))
                if name != "fit" or held}
        tables.append(wording.Table("", ("lags by", "orders", "BIC", "hold-out %"), [
            (word, str(one), f"{one.bic:.1f}", f"{one.fit:.2f}" if np.isfinite(one.fit) else "")
            for word, one in best.items()]))
    lines = [*findings_lines(study.findings), f"Order of {study.data}" if study.data else "Order",
             *(line for one in tables for line in set_table(one))]
    lines.append(f"Recommended: nx = {study.nx}{'' if scan is None else '; ' + str(scan.best('bic'))}")
    for reason in (*study.reasons, *(f"note: {note}" for note in study.notes)):
        lines += wrap_sentence(f"- {reason}")
    return "\n".join(lines)

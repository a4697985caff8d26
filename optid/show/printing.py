"""The printed results: text of at most 80 columns."""

from dataclasses import replace
from typing import TYPE_CHECKING

from optid.data.record import Data
from optid.show import charts, checks, documents, estimates, responses, summary
from optid.show.sections import Notes, attempt
from optid.show.terminal import WIDTH, facts_lines, findings_lines, part_lines, set_table, text, wrap_sentence

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.parameters import Parameters
    from optid.identify.search import Identification
    from optid.identify.validation import Comparison, HorizonCurve, Validation
    from optid.identify.verdict import Verdict


def describe(fit: "Fit", judged: "Verdict | None" = None, *, findings: bool = True) -> str:
    """Return the result of a fit as text.

    Args:
        fit: the fit; one without a model (``raises=False``) gives the facts about the solve.
        judged: the verdict on the model; that of the fit when not given.
        findings: whether to begin with the findings of reading the record.
    """
    if fit.model is not None:
        document = documents.fit_document(fit, judged=judged, advise=False)
        shown = [one for one in document.sections if findings or one.id != "record"]
        return text(replace(document, sections=shown))
    tone, word, sentence = summary.verdict(fit)
    rule = "=" * WIDTH
    return "\n".join([*findings_lines(fit.record_findings), rule, f"No model: {word}", rule, *wrap_sentence(sentence),
                      "",
                      *facts_lines(summary.certificate_facts(fit)), rule])


def describe_advice(fit: "Fit") -> str:
    """Return what would improve a model whose verdict is poor, a line each; "" for any other model."""
    if fit.model is None:
        return ""
    found = attempt("The advice", lambda: [f"Advice: {one}" for one in fit.advice] if (
        fit.verdict is not None and fit.verdict.word in documents.ADVISED) else [])
    return "".join(f"\n{one.sentences[0] if isinstance(one, Notes) else one}" for one in found)


def describe_interval(fit: "Fit", record: Data) -> str:
    """Return how much of a record the 95 % interval of its simulation contains, as text at most 80 columns wide."""
    lines = []
    for part in attempt("The interval of the simulation", lambda: [charts.interval_band(fit, record)]):
        said = part.sentences if isinstance(part, Notes) else [part[1], *(f"Note: {note}" for note in part[2])]
        lines += [line for one in said if one for line in wrap_sentence(one)]
    return "\n".join(lines)


def describe_checks(checked: "Validation") -> str:
    """Return what a validation found as text, at most 80 columns wide."""
    lines = [*findings_lines(checked.findings), f"Validation on {checked.data}" if checked.data else "Validation"]
    for part in attempt("Errors and tests", lambda: checks.validation_tables(checked)):
        lines += [*part_lines(part), ""]
    return "\n".join([*lines[:-1], *(line for note in checked.notes for line in wrap_sentence(f"Note: {note}"))])


def describe_horizons(curve: "HorizonCurve") -> str:
    """Return the fit against the prediction horizon as text, at most 80 columns wide."""
    return "\n".join(set_table(checks.horizon_table(curve)))


def describe_comparison(found: "Comparison") -> str:
    """Return the comparison of several models as text, at most 80 columns wide."""
    parts = attempt("The dynamics", lambda: documents.comparison_dynamics(found, responses.comparison_curves(found)))
    return "\n".join([*findings_lines(found.data.findings), *set_table(checks.comparison_table(found)),
                      *(line for part in parts for line in ("", *part_lines(part)))])


def describe_parameters(found: "Parameters") -> str:
    """Return estimates with their intervals as text, at most 80 columns wide."""
    return "\n".join(set_table(estimates.parameters_table(found)))


def describe_search(found: "Identification") -> str:
    """Return the search and the fit it ended with as text, at most 80 columns wide."""
    lines = [*findings_lines(found.fit.record_findings), *set_table(checks.search_table(found))]
    lines += [line for reason in found.reasons for line in wrap_sentence(f"- {reason}")]
    chosen = found.chosen.candidate
    lines += ["", *wrap_sentence(f"Chosen: --formulation {chosen.formulation} {chosen.words}", "    ")]
    if found.stopped:
        lines += wrap_sentence(f"Note: {found.ended}")
    return "\n".join([*lines, "", describe(found.fit, found.verdict, findings=False)])

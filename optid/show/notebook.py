"""What a notebook shows of a result: the verdict, the model and one table, at most one screen."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from optid.data.description import RECORD, first_findings
from optid.phrases import plural
from optid.show import documents, estimates, summary
from optid.show.checks import comparison_table, search_table, validation_tables
from optid.show.printing import describe
from optid.show.sections import TONES, Banner, Notes, attempt
from optid.show.wording import Table, percent

if TYPE_CHECKING:
    from optid.data.record import Data
    from optid.identify.fitting import Fit
    from optid.identify.parameters import Parameters
    from optid.identify.search import Identification
    from optid.identify.validation import Comparison, Validation
    from optid.identify.verdict import Verdict

MOST_ROWS = 12
"""Rows of a table; the printed text has the rest."""

COLOURS = {"good": "#00843f", "plain": "#1f72c9", "fair": "#b85600", "bad": "#c83350"}


def fit_html(fit: "Fit", judged: "Verdict | None" = None, *, findings: bool = True) -> str:
    """Show the verdict, the status of the solution, the equation and the parameters of a fit, below its findings."""
    if fit.model is None:
        return f"<pre>{escape(describe(fit))}</pre>"
    return _html(summary.title(fit), [
        *(_record(fit.record_findings) if findings else []),
        *attempt("The verdict on the model", lambda: _verdict(fit.verdict if judged is None else judged)),
        *attempt("The verdict on the solution", lambda: [_solution(fit)]),
        *attempt("The fit", lambda: [", ".join(f"{name} {percent(values)}" for name, values in (
            ("one step", fit.one_step_fit), ("simulation", summary.simulation_fit(fit))))]),
        *attempt("The equation", lambda: [("pre", fit.model.equation())]),
        *attempt("The table of the dynamics", lambda: [estimates.parameters_table(fit.dynamics)]),
        *attempt("The table of the parameters", lambda: [estimates.parameters_table(fit.params)])])


def data_html(data: "Data") -> str:
    """Show the name, length and sampling of a record, its findings and its channels."""
    runs = f", {data.n_experiments} experiments" * (data.n_experiments > 1)
    title = f"{data.name or 'Record'}: {plural(data.n_samples, 'sample', '')} every {data.interval}{runs}"
    return _html(title, [*_record(data.findings), summary.channel_table(data)])


def verdict_html(judged: "Verdict") -> str:
    """Show the verdict on a model and every test behind it."""
    return _html("", [*_verdict(judged), summary.verdict_table(judged)])


def _verdict(judged: "Verdict | None") -> list[Banner]:
    if judged is None:
        return []
    failed = "; ".join(f"{part.name} {part.value}: FAIL" for part in judged.failed)
    return [Banner(TONES[judged.word], f"The model on this record: {judged.word}",
                   failed or f"all tests pass, fit {judged.score:.1f} %")]


def _solution(fit: "Fit") -> Banner:
    tone, word, sentence = summary.verdict(fit)
    return Banner(tone, f"Solution: {word}", sentence)


def search_html(found: "Identification") -> str:
    """Show the best structures by class above the fit."""
    fit = found.fit
    above = _html("", [*_record(fit.record_findings), search_table(found)])
    return above + fit_html(fit, found.verdict, findings=False)


def parameters_html(found: "Parameters") -> str:
    """Show estimates with their intervals."""
    return _html("", [estimates.parameters_table(found)])


def validation_html(checked: "Validation") -> str:
    """Show the outcome, the errors and the tests of a validation."""
    document = documents.validation_document(checked)
    (trust,) = (section for section in document.sections if section.id == "trust")
    return _html(document.title, [*_record(checked.findings), *trust.content(),
                                  *attempt("Errors and tests", lambda: validation_tables(checked))])


def comparison_html(found: "Comparison") -> str:
    """Show the fits of several models."""
    return _html("", [*_record(found.data.findings), comparison_table(found)])


def _record(findings: Sequence[str]) -> list[Any]:
    """What reading the record derived, assumed or repaired."""
    return [Markup("<b>{}</b><ul>{}</ul>").format(RECORD, Markup("").join(
        Markup("<li>{}</li>").format(finding) for finding in first_findings(findings)))] if findings else []


def _html(title: str, parts: list[Any]) -> str:
    shown = [Markup("<b>{}</b>").format(title)] if title else []
    for part in parts:
        if isinstance(part, Banner):
            shown.append(Markup('<div style="border-left:4px solid {0};padding-left:8px;margin:4px 0"><b>{1}</b><br>{2}'
                                "</div>").format(COLOURS[part.tone], part.word, part.sentence))
        elif isinstance(part, Table):
            shown.append(_table(part))
        elif isinstance(part, Notes):
            shown += [Markup("<div>{}</div>").format(sentence) for sentence in part.sentences]
        elif isinstance(part, tuple):
            shown.append(Markup('<pre style="white-space:pre-wrap;margin:4px 0">{}</pre>').format(part[1]))
        else:
            shown.append(Markup("<div>{}</div>").format(part))
    return '<div class="optid">' + "".join(shown) + "</div>"


def _table(table: Table) -> Markup:
    head = Markup("").join(Markup("<th>{}</th>").format(cell) for cell in table.head)
    rows = Markup("").join(Markup("<tr>{}</tr>").format(Markup("").join(
        Markup("<td>{}</td>").format(cell) for cell in row)) for row in table.rows[:MOST_ROWS])
    more = f"... and {len(table.rows) - MOST_ROWS} more: print the result" if len(table.rows) > MOST_ROWS else ""
    return Markup("<div>{}</div><table><thead><tr>{}</tr></thead><tbody>{}</tbody></table><div>{}</div>").format(
        table.title, head, rows, more)

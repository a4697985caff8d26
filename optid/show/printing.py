"""The printed result of a fit: 80 columns of plain text that can be pasted into a paper."""

from itertools import zip_longest
from textwrap import wrap
from typing import TYPE_CHECKING

from optid.show import checks, estimates, summary
from optid.show.summary import Facts
from optid.show.wording import Table

if TYPE_CHECKING:
    from optid.identify.fitting import Fit
    from optid.identify.parameters import Parameters
    from optid.identify.validation import Comparison, HorizonCurve, Validation
    from optid.identify.verdict import Verdict

WIDTH, LEFT = 80, 36

MOST_NAME = 44
"""First cells of a table wider than this stand on lines of their own."""


def describe(fit: "Fit", judged: "Verdict | None" = None) -> str:
    """Return the result of a fit as text, at most 80 columns wide.

    Args:
        fit: the fit; one without a model (``raises=False``) gives the facts about the solve.
        judged: the verdict on the model; that of the fit when not given.
    """
    tone, word, sentence = summary.verdict(fit)
    if fit.model is None:
        return "\n".join(
            [
                _rule("="),
                f"No model: {word}",
                _rule("="),
                *wrapped(sentence),
                "",
                *_facts(summary.certificate_facts(fit)),
                _rule("="),
            ]
        )
    left = summary.record_facts(fit)
    right = [
        ("Status", word),
        *[(name, value) for name, value in summary.certificate_facts(fit) if name in _SHORT],
        *[(name, value) for name, value in summary.solver_facts(fit) if name in ("Solver", "Iterations", "In all")],
    ]
    judged = fit.verdict if judged is None else judged
    lines = [
        _rule("="),
        summary.title(fit).center(WIDTH).rstrip(),
        fit.formulation.center(WIDTH).rstrip(),
        _rule("="),
        *_columns(left, right),
        _rule("-"),
        *([*set_table(summary.verdict_table(judged)), _rule("-")] if judged is not None else []),
        *_equation(fit.model.equation()),
        *_facts(summary.model_facts(fit)),
    ]
    if evidence := summary.evidence_facts(fit):
        lines += [_rule("-"), *_facts(evidence)]
    for table in (*estimates.parameter_tables(fit), *estimates.nonlinearity_tables(fit), summary.fit_table(fit)):
        lines += [_rule("-"), *set_table(table)]
    if noise := summary.noise_table(fit):
        lines += [_rule("-"), *set_table(noise)]
    if fit.prices:
        lines += [_rule("-"), *set_table(summary.constraint_table(fit))]
    lines += [_rule("-"), *wrapped(sentence)]
    lines += wrapped(
        "Solver: " + "; ".join(f"{name.lower()} {value}" for name, value in summary.solver_facts(fit)[1:])
    )
    lines += [line for finding in fit.findings for line in wrapped(f"Note: {finding}")]
    return "\n".join([*lines, _rule("=")])


def describe_checks(checked: "Validation") -> str:
    """Return what a validation found as text, at most 80 columns wide."""
    lines = [f"Validation on {checked.data}" if checked.data else "Validation"]
    for table in checks.validation_tables(checked):
        lines += [*set_table(table), ""]
    return "\n".join([*lines[:-1], *(line for note in checked.notes for line in wrapped(f"Note: {note}"))])


def describe_horizons(curve: "HorizonCurve") -> str:
    """Return the fit against the prediction horizon as text, at most 80 columns wide."""
    return "\n".join(set_table(checks.horizon_table(curve)))


def describe_comparison(found: "Comparison") -> str:
    """Return the comparison of several models as text, at most 80 columns wide."""
    return "\n".join(set_table(checks.comparison_table(found)))


def describe_parameters(found: "Parameters") -> str:
    """Return estimates with their intervals as text, at most 80 columns wide."""
    return "\n".join(set_table(estimates.parameters_table(found)))


_SHORT = ("Objective", "Bound", "Relative gap")


def _rule(sign: str) -> str:
    return sign * WIDTH


def wrapped(text: str, indent: str = "  ") -> list[str]:
    """Break a sentence into lines of the page, those after the first indented."""
    return wrap(text, WIDTH, subsequent_indent=indent, break_on_hyphens=False) or [""]


def _equation(text: str) -> list[str]:
    """Break long equations before a sign, aligned behind the equals sign."""
    lines = []
    for equation in text.splitlines():
        head, _, terms = equation.partition(" = ")
        indent = " " * (len(head) + 3)
        line = f"{head} = "
        for k, term in enumerate(terms.replace(" + ", "\n+ ").replace(" - ", "\n- ").split("\n")):
            if k and len(line) + 1 + len(term) > WIDTH:
                lines.append(line.rstrip())
                line = indent
            line += term + " "
        lines.append(line.rstrip())
    return lines


def _facts(facts: Facts) -> list[str]:
    lines = []
    for name, value in facts:
        lines += wrapped(f"{name}: {value}")
    return lines


def _columns(left: Facts, right: Facts) -> list[str]:
    """Set two lists of facts side by side; what is too wide for its half gets a line of its own below."""
    widths = (LEFT, WIDTH - 2 - LEFT)
    fits: list[list[str]] = []
    wide: Facts = []
    for facts, width in zip((left, right), widths):
        lines = [(f"{name:<12} {value}", (name, value)) for name, value in facts]
        fits.append([line for line, _ in lines if len(line) <= width])
        wide += [fact for line, fact in lines if len(line) > width]
    return [f"{a:<{LEFT}}  {b}".rstrip() for a, b in zip_longest(*fits, fillvalue="")] + _facts(wide)


def set_table(table: Table) -> list[str]:
    """Set a table in 80 columns: first column left, numbers right, a long first cell on a line of its own."""
    widths = [max(len(row[c]) for row in [table.head, *table.rows]) for c in range(1, len(table.head))]
    room = WIDTH - sum(widths) - len(widths)
    names = min(max(len(row[0]) for row in [table.head, *table.rows]), MOST_NAME, max(room, 0))
    gap = 2 if names + sum(widths) + 2 * len(widths) <= WIDTH else 1
    lines = wrapped(table.title)
    for row in (*[table.head] * any(table.head), *table.rows):
        cells = "".join(" " * gap + f"{cell:>{width}}" for cell, width in zip(row[1:], widths))
        if len(row[0]) > names:
            lines += [row[0], " " * names + cells]
        else:
            lines.append(f"{row[0]:<{names}}{cells}".rstrip())
    return lines + (wrapped(table.note) if table.note else [])

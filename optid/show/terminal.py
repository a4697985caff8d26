"""Documents as text of 80 columns, which can be pasted into a paper."""

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from textwrap import wrap

from optid.data.description import listed_findings
from optid.show.sections import Banner, Code, Document, FactColumns, Facts, Findings, Notes, Pair
from optid.show.wording import Table

WIDTH, LEFT = 80, 36

MOST_NAME = 44
"""First cells of a table wider than this are set on a separate line."""


def text(document: Document) -> str:
    """Return a document without what only a page shows."""
    lines = [_rule("="), document.title.center(WIDTH).rstrip(), document.lead.center(WIDTH).rstrip(), _rule("=")]
    for section in document.sections:
        for part in () if section.page_only else section.content():
            if shown := part_lines(part):
                lines += [*shown, _rule("-")]
    return "\n".join([*lines[:-1], _rule("=")])


def part_lines(part: object) -> list[str]:
    """Return the lines of a part; none for charts and folds."""
    if isinstance(part, Banner):
        return [*wrap_sentence(part.word), *(wrap_sentence(part.sentence) if part.sentence else [])]
    if isinstance(part, FactColumns):
        return _columns(part.left, part.right)
    if isinstance(part, list):
        return facts_lines(part)
    if isinstance(part, Table):
        return set_table(part)
    if isinstance(part, Pair):
        blocks = [part_lines(table) for table in part.tables]
        return [line for k, block in enumerate(blocks) for line in ([_rule("-")] * bool(k) + block)]
    if isinstance(part, Notes):
        return [line for sentence in part.sentences for line in wrap_sentence(f"Note: {sentence}")]
    if isinstance(part, Findings):
        return findings_lines(part.sentences)
    if isinstance(part, Code):
        return _equation(part.text) if part.equation else part.text.splitlines()
    return []


def _rule(sign: str) -> str:
    return sign * WIDTH


def wrap_sentence(text: str, indent: str = "  ") -> list[str]:
    """Break a sentence into lines of the page, those after the first indented."""
    return wrap(text, WIDTH, subsequent_indent=indent, break_on_hyphens=False) or [""]


def wrap_lines(lines: Iterable[str]) -> str:
    """Break the lines that are too wide; they keep their indent."""
    return "\n".join(part for line in lines for part in wrap_sentence(line, " " * (len(line) - len(line.lstrip()) + 2)))


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


def findings_lines(findings: Sequence[str]) -> list[str]:
    """Set the findings of a record under their heading; none without findings."""
    return [line for sentence in listed_findings(findings) for line in wrap_sentence(sentence)]


def facts_lines(facts: Facts) -> list[str]:
    """Set facts one below the other."""
    lines = []
    for name, value in facts:
        lines += wrap_sentence(f"{name}: {value}")
    return lines


def _columns(left: Facts, right: Facts) -> list[str]:
    """Set two lists of facts side by side; what is too wide for its half is set on a line below."""
    widths = (LEFT, WIDTH - 2 - LEFT)
    fits: list[list[str]] = []
    wide: Facts = []
    for facts, width in zip((left, right), widths):
        lines = [(f"{name:<12} {value}", (name, value)) for name, value in facts]
        fits.append([line for line, _ in lines if len(line) <= width])
        wide += [fact for line, fact in lines if len(line) > width]
    return [f"{a:<{LEFT}}  {b}".rstrip() for a, b in zip_longest(*fits, fillvalue="")] + facts_lines(wide)


def set_table(table: Table) -> list[str]:
    """Set a table in 80 columns: first column left, numbers right, a long first cell on a separate line."""
    widths = [max(len(row[c]) for row in [table.head, *table.rows]) for c in range(1, len(table.head))]
    room = WIDTH - sum(widths) - len(widths)
    names = min(max(len(row[0]) for row in [table.head, *table.rows]), MOST_NAME, max(room, 0))
    gap = 2 if names + sum(widths) + 2 * len(widths) <= WIDTH else 1
    lines = wrap_sentence(table.title) if table.title else []
    for row in (*[table.head] * any(table.head), *table.rows):
        cells = "".join(" " * gap + f"{cell:>{width}}" for cell, width in zip(row[1:], widths))
        if len(row[0]) > names:
            lines += [row[0], " " * names + cells]
        else:
            lines.append(f"{row[0]:<{names}}{cells}".rstrip())
    return lines + (wrap_sentence(table.note) if table.note else [])

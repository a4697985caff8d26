"""Layout of the pages of a diagnosis and of a reformulation."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optid import __version__
from optid.data.description import RECORD
from optid.show.page import figure, template, versions
from optid.show.wording import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_page(
    path: str | Path, title: str, lead: Sequence[str], *, headings: tuple[str, str, str], draw: "Callable[[], Figure]",
    caption: str, cards: Sequence[tuple[str, str]], tables: Sequence[Table], texts: Sequence[tuple[str, str]] = (),
    facts: Sequence[tuple[str, str]] = (), findings: Sequence[str] = (), **content: Any,
) -> Path:
    """Write a self-contained HTML page; `content` has tone, word, sentences, notes, call and text of the template.

    The findings of reading the record come first. Headings are those of the tables, of the figure, and of texts (title,
    text) and facts (name, value).

    Raises:
        OSError: the file cannot be written.
    """
    shown = ("tables", headings[0], tables), ("figures", headings[1], True), ("evidence", headings[2], texts or facts)
    sections = [("verdict", "Result"), *((name, word) for name, word, there in shown if there)]
    page = template("faults.html.j2").render(
        version=__version__, title=title, lead=" · ".join(part for part in lead if part), headings=headings,
        cards=[{"label": label, "value": value} for label, value in cards], tables=tables, texts=texts, facts=facts,
        findings=findings, record=RECORD,
        figures=[figure(title.partition(":")[0].lower(), draw, caption)], versions=versions(),
        sections=[*([("record", RECORD)] if findings else []), *sections, ("reproduce", "Reproduce")], **content)
    Path(path).write_text(page, encoding="utf-8")
    return Path(path)

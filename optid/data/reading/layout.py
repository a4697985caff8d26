"""The layout of a text table: encoding, delimiter, header, rows of units, and what a reader must be told about it.

What the file says (a byte order mark, ``sep=;``, the header of LabVIEW) and what all of its first rows agree in (the
delimiter, a row of units) is used. What could be meant otherwise (a decimal comma, the order of day and month, words
of missing samples) is only proposed: a refusal lists all words to type.
"""

import csv
import io
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from optid.data.reading import dates
from optid.data.reading.clock import clock_hints
from optid.data.reading.columns import check_unique, position_names
from optid.data.reading.format import Format, call, is_number
from optid.data.reading.textfile import open_text
from optid.errors import DataError

BLANKS = " "
"""The delimiter of a table whose cells any number of blanks separates."""

SAMPLE = 200  # rows from which the layout is derived
LONGEST_LINE = 10_000  # characters beyond fifty times the first lines of a line that is left to the reader of rows
MOST_TEXT_ROWS = 3  # rows of units and descriptions after the header
LONGEST_UNIT = 10  # characters; a longer text describes the channel
LONGEST_MARK = 20  # characters of a word that may mark a missing sample

_NUMERIC = re.compile(r"[+-]?[\d.,' \u00a0]*\d[\d.,' \u00a0]*(?:[eEdD][+-]?\d+)?")
_POINT = re.compile(r"[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?")
_GROUPED = re.compile(r"[+-]?\d{1,3}(?:[ '\u00a0]\d{3})+(?:[.,]\d*)?")
_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_TRIPLES = re.compile(r"[+-]?\d{1,3}(?:\.\d{3})*")  # numbers with a decimal point, or points between thousands


@dataclass(frozen=True)
class TextLayout:
    """Where the samples of a text table are, and how its cells are written."""

    names: list[str]  # one name a column, "" for one without a name
    how: Format  # the format given, completed by what the file says
    offset: int  # bytes of the text as UTF-8, after a byte order mark, before the first row of samples
    units: dict[str, str]  # units by column, where a row holds them
    text_rows: int = 0  # rows of units and descriptions after the header
    dates: tuple[str, ...] = ()  # columns of dates or times of day
    advice: str = ""  # what a refusal proposes to type; empty where the file needs no words
    hints: Mapping[str, str] = field(default_factory=dict)  # why other columns may be the clock
    findings: tuple[str, ...] = ()  # what was derived and is worth saying

    @property
    def delimiter(self) -> str:
        """Character between cells after the clean-up of `optid.data.reading.textfile`."""
        return "\t" if self.how.delimiter == BLANKS else self.how.delimiter or ","


class _Row(NamedTuple):
    cells: list[str]
    line: int  # of the file, from 1
    end: int  # characters before the next row


def find_layout(path: Path, how: Format) -> TextLayout:
    """Find the layout of a text table; errors name the line, and what to type.

    Raises:
        DataError: no rows, not text, preamble or comments before the header, names that do not fit the rows, or two
            columns of one name.
    """
    with open_text(path, how.encoding) as file:
        text, encoding = file.head()
        how = how if how.encoding else replace(how, encoding=encoding)
        needed = {} if file.trusted else {"encoding": encoding}
        where = path.name
        if file.longest_line():
            raise DataError(f"{where}: its first line has more than {len(text)} characters; it is not a table.")
    lines = list(io.StringIO(text, newline=""))
    how, skipped = _declared(lines, how)
    first = skipped + how.skip_rows
    if first >= len(lines):
        raise DataError(f"{where} has {len(lines)} lines; skip_rows={how.skip_rows} leaves none.")
    start = sum(map(len, lines[:first]))
    usual = 50 * max(map(len, lines[first : first + 3])) + LONGEST_LINE
    lines = lines[: next((k for k, line in enumerate(lines) if k > first and len(line) > usual), len(lines))]
    body = [line for line in lines[first:] if not how.is_comment(line)][:SAMPLE]
    if not any(line.strip() for line in body):
        raise DataError(f"{where} is empty: it must have a header row and at least one row of numbers.")
    delimiter, width = (how.delimiter, 0) if how.delimiter else _delimiter(body, where)
    if not how.delimiter and delimiter not in (",", BLANKS, "\t"):
        needed["delimiter"] = delimiter
    how = replace(how, delimiter=delimiter)
    rows = _rows(lines[first:], first, start, how, where)
    if not rows:
        raise DataError(f"{where} is empty: it must have a header row and at least one row of numbers.")
    width = width or Counter(len(row.cells) for row in rows).most_common(1)[0][0]
    found = _headed(rows, width, how, needed, where, lines)
    if not file.trusted:
        raise DataError(f"{where} is not UTF-8 text. Pass {_advice(found, needed)}.")
    return replace(found, offset=len(text[: found.offset].encode()), advice=_advice(found, needed))


def _declared(lines: list[str], how: Format) -> tuple[Format, int]:
    """Return the format completed by what the file declares of itself, and the lines of that declaration."""
    if lines and (mark := re.fullmatch(r'"?sep=(.)"?\s*', lines[0])):  # Excel
        return replace(how, delimiter=how.delimiter or mark[1]), 1
    if not lines or not lines[0].startswith("LabVIEW Measurement"):
        return how, 0
    words = dict(line.rstrip().split("\t", 1) for line in lines[:40] if "\t" in line.rstrip() and line[0].isalpha())
    words |= dict(line.rstrip().split(",", 1) for line in lines[:40] if "," in line.rstrip() and "\t" not in line)
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")][:2]  # of file and channels
    marks = {"Tab": "\t", "Comma": ","}
    known = {"delimiter": how.delimiter or marks.get(words.get("Separator", ""), "\t"),
             "decimal": words.get("Decimal_Separator", how.decimal).strip()[:1] or how.decimal}
    return replace(how, **known), ends[-1] + 1 if ends and not how.skip_rows else 0


def _delimiter(lines: Sequence[str], where: str) -> tuple[str, int]:
    """Return the delimiter that cuts most lines into equally many cells, and how many."""
    lines = [line for line in lines if line.strip()]
    found: dict[str, tuple[int, bool, bool, int]] = {}
    for mark in (",", "\t", ";", "|"):
        try:
            widths = [len(row) for row in csv.reader(lines, delimiter=mark) if row]
        except csv.Error:  # a line that this mark does not cut
            continue
        width, count = Counter(widths).most_common(1)[0]
        if width > 1 and count > len(widths) / 2:
            found[mark] = (count, widths[0] == width, widths[0] > 1, width)
    if found:
        best = max(one[:3] for one in found.values())
        likely = [mark for mark, one in found.items() if one[:3] == best]
        if len(likely) > 1:
            several = " or ".join(f"delimiter={mark!r} ({found[mark][3]} columns)" for mark in likely)
            raise DataError(f"{where}: more than one character may separate the cells. Pass {several}.")
        return likely[0], found[likely[0]][3]
    widths = [len(line.split()) for line in lines]
    width, count = Counter(widths).most_common(1)[0]
    if width > 1 and count > len(widths) / 2 and all(map(_is_value, lines[-1].split())):
        return BLANKS, width
    return ",", 0


def _rows(lines: Sequence[str], first: int, start: int, how: Format, where: str) -> list[_Row]:
    """Return the first rows of a table, without comments and blank lines."""
    rows: list[_Row] = []
    taken = [first, start]  # number of the last line, characters before the next

    def read_named() -> Any:
        for line in lines:
            taken[0], taken[1] = taken[0] + 1, taken[1] + len(line)
            if not how.is_comment(line):
                yield line

    blanks = how.delimiter == BLANKS
    named = read_named()
    try:
        for cells in map(str.split, named) if blanks else csv.reader(named, delimiter=how.delimiter or ","):
            if any(cells) or len(rows) > MOST_TEXT_ROWS or any(any(map(_is_value, row.cells)) for row in rows):
                rows.append(_Row(cells, *taken))
            elif rows:  # a blank line after the header
                rows[-1] = rows[-1]._replace(end=taken[1])
            if len(rows) >= SAMPLE:
                break
    except csv.Error as error:
        raise DataError(f"{where} is not a text table ({error}).") from error
    return [row for k, row in enumerate(rows) if row.cells or k + 1 < len(rows)]


def _headed(rows: list[_Row], width: int, how: Format, needed: dict[str, Any], where: str, lines: Sequence[str]
            ) -> TextLayout:
    """Return the layout of rows, of which the first may be a header and the next ones units and descriptions."""
    head, findings = rows[0], []
    cells = [cell.strip() for cell in head.cells]
    if cells[0][:1] in ("#", "%") and how.columns is None:
        bare = cells[0].lstrip("#% ")
        fits = len(rows) > 1 and any(map(_is_value, rows[1].cells))
        marked = [bare, *cells[1:]] if bare else cells[1:]
        if fits and len(marked) == len(rows[1].cells):  # as numpy.savetxt writes a header
            cells = marked
        elif how.comment is None:
            mark = cells[0][0]
            raise DataError(f"{where}: line {head.line} begins with {mark!r}. If it is a comment pass "
                            f"{call({'comment': mark} | needed)}.")
    if how.columns is not None:
        names = [name.strip() for name in position_names(how.columns, len(cells), where)]
        if len(rows) > 1 and not any(map(_is_value, cells)) and not any(map(how.is_missing, cells)):
            raise DataError(f"{where} has a header ({', '.join(cells)[:60]}). Leave columns= out, or pass "
                            f"{call({'skip_rows': head.line} | needed)}.")
        rows = [_Row([], head.line, head.end - len(lines[head.line - 1])), *rows]
    elif len(cells) > 1 and cells == [str(place) for place in range(len(cells))] and len(rows) > 1:
        raise DataError(f"{where}: the first row ({', '.join(cells)[:40]}) may be a header of numbers, or samples. To "
                        f"leave it out pass {call({'skip_rows': head.line} | needed)}; if it holds samples name the "
                        "columns, columns=[...].")
    elif all(_is_value(cell) or how.is_missing(cell) for cell in cells) and any(map(_is_value, cells)):
        names = [str(c) for c in range(len(cells))]
        findings.append(f"no header: the columns are numbered {names[0]} to {names[-1]}")
        rows = [_Row([], head.line, head.end - len(lines[head.line - 1])), *rows]
    else:
        if odd := [cell for cell in cells if _is_value(cell) and not cell.isdigit()]:
            raise DataError(f"{where}: line {head.line} would be the header, but holds {odd[0]!r}. If the file has no "
                            "header name its columns, columns=[...]; if it begins later pass skip_rows=.")
        if len(cells) != width:
            _refuse_preamble(rows, width, where, needed)
        names = _fitted(cells, rows[1:])
    check_unique(filter(None, names), where)
    texts, units = _text_rows(rows[1:], names, how)
    if how.units_row and how.units_row < len(rows) and any(map(_is_value, rows[how.units_row].cells)):
        raise DataError(f"{where}: units_row={how.units_row}, but row {how.units_row} after the header holds numbers.")
    if how.units_row and how.units_row > len(texts):
        units = dict(zip(names, rows[how.units_row].cells)) if how.units_row < len(rows) else {}
        texts = rows[1 : how.units_row + 1]
    if texts and how.units_row is None:
        shown = ", ".join(f"{name} {unit}" for name, unit in units.items() if unit)
        skipped = f"{len(texts) - bool(shown)} row{'s' if len(texts) - bool(shown) > 1 else ''} of descriptions skipped"
        findings.append("after the header: " + "; ".join(
            part for part in (f"units {shown}" if shown else "", skipped if len(texts) > bool(shown) else "") if part))
    samples = [row.cells for row in rows[1 + len(texts) :] if len(row.cells) == len(names)]
    columns = dict(zip(names, zip(*samples)))
    dated = tuple(name for name, column in columns.items() if (one := _first(column, how)) and dates.is_date(one))
    _propose(columns, dated, how, needed)
    return TextLayout(names, how, rows[len(texts)].end, {name: unit.strip() for name, unit in units.items()},
                      len(texts), dated, hints=clock_hints(columns), findings=tuple(findings))


def _refuse_preamble(rows: list[_Row], width: int, where: str, needed: dict[str, Any]) -> None:
    """Refuse lines before the header, where a later row looks like one."""
    for row in rows[1:-1]:
        if len(row.cells) == width:
            if not any(map(_is_value, row.cells)) and any(row.cells):
                raise DataError(
                    f"{where}: line {rows[0].line} ({', '.join(rows[0].cells)[:40]!r}) has {len(rows[0].cells)} cells, "
                    f"the rows below have {width}: the header seems to be line {row.line}. Pass "
                    f"{call({'skip_rows': row.line - 1} | needed)}.")
            return


def _fitted(names: list[str], rows: Sequence[_Row]) -> list[str]:
    """Return the names for rows with one cell more or less than the header, if that cell is empty throughout."""
    widths = {len(row.cells) for row in rows if row.cells}
    if widths == {len(names) + 1} and not any(row.cells[-1].strip() for row in rows if row.cells):
        return [*names, ""]  # a delimiter at the end of the rows
    if widths == {len(names) - 1} and names[-1].lower() in ("", "comment"):
        return names[:-1]  # a delimiter at the end of the header, or the column of comments of LabVIEW
    return names


def _text_rows(rows: Sequence[_Row], names: Sequence[str], how: Format) -> tuple[Sequence[_Row], dict[str, str]]:
    """Return the rows after the header that hold no samples, and the units among them by column."""
    count = 0
    while count < min(MOST_TEXT_ROWS, len(rows) - 1) and _is_text(rows[count].cells, names, how):
        count += 1
    texts = rows[:count] if any(map(_is_value, rows[count].cells if count < len(rows) else ())) else []
    for row in texts if how.units_row is None else texts[how.units_row - 1 : how.units_row] if how.units_row else []:
        cells = [cell.strip().strip("[]()") for cell in row.cells]
        if how.units_row or (max(map(len, cells)) <= LONGEST_UNIT and cells != list(names)):
            return texts, dict(zip(names, cells))
    return texts, {}


def _is_text(cells: Sequence[str], names: Sequence[str], how: Format) -> bool:
    """Whether a row holds units or descriptions: texts, but neither values nor words of missing samples alone."""
    full = [cell.strip() for cell in cells if cell.strip()]
    return len(cells) == len(names) and bool(full) and not any(map(_is_value, full)) and not any(
        map(how.is_missing, full)) and any(any(map(str.isalpha, cell)) or cell in ("%", "°", "1/s") for cell in full)


def _is_value(cell: str) -> bool:
    """Whether a cell is a number in some notation, or a date."""
    text = cell.strip()
    return bool(_NUMERIC.fullmatch(text)) or is_number(text) or dates.is_date(text)


def _first(column: Sequence[str], how: Format) -> str:
    return next((cell.strip() for cell in column if not how.is_missing(cell)), "")


def _propose(columns: dict[str, tuple[str, ...]], dated: Sequence[str], how: Format, needed: dict[str, Any]) -> None:
    """Add the words to type: decimal mark, thousands, words of missing samples, format of dates."""
    words: list[str] = []
    points = any(_POINT.fullmatch(cell.strip()) and not _TRIPLES.fullmatch(cell.strip())
                 for name, column in columns.items() if name not in dated for cell in column)
    for name, column in columns.items():
        cells = [cell.strip() for cell in column if not how.is_missing(cell)]
        if name in dated:
            forms = dates.agreed_format(cells)
            if how.date_format is None and forms and not dates.is_unambiguous(forms[0]):
                needed.setdefault("date_format", forms)
            continue
        odd = [cell for cell in cells if not _NUMERIC.fullmatch(cell) and not is_number(cell)]
        if len(odd) * 2 > len(cells):
            continue
        words += [cell for cell in dict.fromkeys(odd) if len(cell) <= LONGEST_MARK and cell not in words
                  and cell.isprintable() and not {"\ufffd", '"'} & set(cell) and not any(map(str.isdigit, cell))]
        if how.is_plain:
            values = [cell for cell in cells if cell not in odd]
            if any(re.fullmatch(r"[+-]?\d{1,3}(,\d{3})+\.\d*", cell) for cell in values):
                needed["thousands"] = ","
            elif any(re.fullmatch(r"[+-]?\d{1,3}(\.\d{3})+,\d*", cell) for cell in values):
                needed |= {"decimal": ",", "thousands": "."}
            elif (commas := list(filter(_COMMA.fullmatch, values))) and not any(map(_POINT.fullmatch, values)):
                triples = all(re.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+", cell) for cell in commas)
                if triples and (points or how.delimiter == ","):
                    needed["thousands"] = ","
                else:
                    needed["decimal"] = ","
            elif grouped := list(filter(_GROUPED.fullmatch, values)):
                needed["thousands"] = re.sub(r"[\d+-]", "", grouped[0])[0]
    if words and len(words) <= 8:
        needed["missing"] = ",".join(words)


def _advice(found: TextLayout, needed: dict[str, Any]) -> str:
    """Return the words to type as text; a format of dates that may be another one with it."""
    forms = needed.get("date_format")
    others = call({word: value for word, value in needed.items() if word != "date_format"})
    return ", ".join(part for part in (others, dates.choices(forms) if forms else "") if part)

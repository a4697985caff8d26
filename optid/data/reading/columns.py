"""The columns of inputs, outputs and quality, and the one conversion of cells to numbers."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from optid.data.channels import numbered_names
from optid.data.reading.format import Format, call, is_number
from optid.errors import DataError, nearest

Wanted = str | int | Sequence[str | int] | Mapping[str, str | int] | None
"""Columns by name or position; a mapping {channel name: column} renames."""

MOST_LISTED = 40  # columns that a message lists

MARKS = {sign * value for sign in (1, -1) for value in (
    99.0, 999.0, 9999.0, 99999.0, 999999.0, 999.25, 999.99, 32767.0, 32768.0, 65535.0, 1e10, 1e20, 1e30, 1e35, 1e36,
    9.96921e36, 1e37, 9.9e37, 9.91e37, 3.4028234663852886e38)}
"""Numbers that loggers write where they have no sample."""

_SWITCH = frozenset("on off true false yes no open closed ein aus ja nein auf zu start stop running stopped".split())

FAR = 5.0  # times their range beyond which such a number is far from the others

_QUALITY = re.compile(
    r"[ ._:/-]*\(?(q|qual|qua|quality|status|state|sts|stat|qc|good|valid|flag|ok|bad|conf|confidence)\)?",
    re.IGNORECASE)
"""What the name of a column of quality adds to that of its channel."""

_ALL = re.compile(r"(opc)?(quality|status|confidence|validity)", re.IGNORECASE)
"""Names of a column of quality of the whole row."""


def choose(known: Sequence[str], wanted: Wanted, letter: str, label: str) -> dict[str, str]:
    """Return {channel name: column} for the inputs (letter u) or the outputs (letter y).

    None takes the column `letter`, or `letter`1, `letter`2, ... of the known columns of the source called `label`.

    Raises:
        DataError: no such column (the nearest is named), or none of the default names is present.
    """
    what = "inputs" if letter == "u" else "outputs"
    if wanted is None:
        numbered = sorted((c for c in known if re.fullmatch(rf"{letter}[0-9]+", c)), key=lambda c: int(c[1:]))
        found = [letter] if letter in known else numbered
        if not found:
            bare = " It has no header: name its columns, columns=[...], or give their positions." * (
                list(known) == [str(place) for place in range(len(known))])
            raise DataError(f"{label} has no column {letter!r} or '{letter}1': name the {what}.{bare} {listing(known)}")
        return {c: c for c in found}
    if isinstance(wanted, Mapping):
        pairs = {str(name): column_name(known, column, label) for name, column in wanted.items()}
    else:
        if not isinstance(wanted, str | int | np.integer | list | tuple) and np.ndim(
                wanted if isinstance(wanted, np.ndarray) else 0) != 1:
            raise DataError(f"{what}={wanted!r}: must be the name or position of a column, a list of these, or a "
                            "mapping {channel name: column}.")
        several = [wanted] if isinstance(wanted, str | int | np.integer) else list(wanted)
        columns = [column_name(known, column, label) for column in several]
        pairs = {c: c for c in columns}
        if len(pairs) < len(columns):
            raise DataError(f"{label}: a column is listed twice in {what} {several}.")
        pairs = _unnamed(pairs, known, letter)
    if not pairs:
        raise DataError(f"{label}: {what} is empty; name at least one column. {listing(known)}")
    return pairs


def column_name(known: Sequence[str], wanted: str | int, label: str) -> str:
    """Return the name of a column given by name or by position; a `DataError` names the nearest one."""
    if isinstance(wanted, int | np.integer) and not isinstance(wanted, bool):
        if not 0 <= wanted < len(known):
            raise DataError(f"{label} has {len(known)} columns, counted from 0; there is no column {wanted}.")
        return known[wanted]
    if not isinstance(wanted, str) or wanted not in known:
        single = " Is the delimiter right? Pass delimiter=';' or '\\t'." if len(known) == 1 else ""
        raise DataError(f"{label} has no column {wanted!r}. {nearest(str(wanted), known)}{single}")
    return wanted


def position_names(columns: Sequence[str] | None, width: int, label: str) -> list[str]:
    """Return the names of the columns of a plain array: those given (or a `DataError`), else their positions."""
    if columns is not None and len(columns) != width:
        raise DataError(f"{label} has {width} columns, columns= names {len(columns)}.")
    return [str(c) for c in (range(width) if columns is None else columns)]


def check_unique(names: Iterable[str], label: str) -> None:
    """Refuse two columns of one name (`DataError`)."""
    if several := [name for name, count in Counter(names).items() if count > 1]:
        raise DataError(f"{label} has two columns named {several[0]!r}: rename one.")


def listing(known: Sequence[str]) -> str:
    """Return a sentence that lists the columns."""
    more = f", and {len(known) - MOST_LISTED} more" if len(known) > MOST_LISTED else ""
    return "Columns: " + ", ".join(known[:MOST_LISTED]) + more + "."


# -- columns of quality


def quality_columns(known: Sequence[str], signals: Iterable[str]) -> dict[str, str]:
    """Return {column of quality: column of samples, "" for all} by the names of the columns."""
    found, signals = {}, list(signals)
    for name in known:
        guarded = [signal for signal in signals if name.startswith(signal) and _QUALITY.fullmatch(name[len(signal) :])
                   or name.endswith(signal) and _QUALITY.fullmatch(name[: len(name) - len(signal)].strip(" ._:/-"))]
        if name not in signals and (guarded or _ALL.fullmatch(name)):
            found[name] = max(guarded, key=len) if guarded else ""
    return found


def check_quality_columns(quality: Mapping[str, str], known: Sequence[str], signals: Sequence[str],
                          label: str) -> dict[str, str]:
    """Return {column of quality: column of samples, "" for all} for those that the user names (`DataError`)."""
    found, named = {}, quality_columns(known, signals)
    for column in quality:
        name = column_name(known, column, label)
        likely = [signal for signal in signals if name.startswith(signal)]
        found[name] = named[name] if name in named else max(likely, key=len, default="")
    return found


def unused_quality(names: Sequence[str], loaded: Mapping[str, Any]) -> str:
    """Return the finding about columns of quality that the user did not name."""
    words, bad = [], 0
    for name in names:
        cells = np.ravel(loaded[name]).astype(str)
        values, counts = np.unique(cells, return_counts=True)
        usual = [str(value).removesuffix(".0") for value in values[np.argsort(-counts)]]
        opc = [value for value in usual if is_number(value) and 192 <= float(value) <= 255]  # good, as OPC has it
        good = opc if opc else usual[:1]
        words.append(f"{name}:{'|'.join(good)}")
        bad += cells.size - int(sum(count for value, count in zip(values, counts)
                                    if str(value).removesuffix(".0") in good))
    return (f"columns of quality are not used: {', '.join(names)} ({bad} cells differ from the usual ones). Pass "
            f"quality={','.join(words)!r} to count such samples as missing")


def is_good(values: Any, good: str, where: str) -> np.ndarray:
    """Return which samples (N,) a column of quality marks as good: those equal to a value, as a number or as text."""
    array, found = np.asarray(values), None
    for one in good.split("|"):
        if array.dtype.kind in "iufb":
            if not is_number(one):
                raise DataError(f"{where} holds numbers, and {one!r} is none.")
            same = array == float(one)
        else:
            text = np.char.strip(array.astype(str))
            same = np.char.lower(text) == one.lower()
            if is_number(one):
                same = np.array([is_number(cell) and float(cell) == float(one) for cell in text.tolist()], dtype=bool)
        found = same if found is None else found | same
    assert found is not None
    return found


# -- cells


def to_numbers(cells: Sequence[str], how: Format) -> tuple[np.ndarray, int | None]:
    """Return the numbers of some cells (N,), NaN where missing, and the row of the first cell that is no number."""
    if how.is_plain and "_" not in "".join(cells):  # float() reads 1_000 as a number, a table does not
        try:
            return np.array(list(map(float, cells)), dtype=np.float64), None
        except ValueError:
            pass
    values = np.empty(len(cells))
    for row, cell in enumerate(cells):
        try:
            values[row] = how.number(cell)
        except ValueError:
            return values, row
    return values, None


def without_marks(samples: np.ndarray, how: Format) -> np.ndarray:
    """Return samples with NaN in place of the numbers that mark missing ones."""
    marks = [mark for mark in how.numbers if not np.isnan(mark)]
    if not marks:
        return samples
    lost = np.isin(samples, marks)
    return np.where(lost, np.nan, samples) if lost.any() else samples


def likely_marks(channels: Mapping[str, np.ndarray]) -> list[str]:
    """Return findings about channels whose lowest or highest value is a usual mark of missing samples, far away."""
    found = []
    for name, samples in channels.items():
        for value in (float(np.fmin.reduce(samples)), float(np.fmax.reduce(samples))):
            if value not in MARKS:
                continue
            marked = samples == value
            others = samples[~marked & np.isfinite(samples)]
            if others.size and abs(value - np.median(others)) > FAR * max(float(np.ptp(others)), 1e-3 * abs(value)):
                found.append(f"channel {name!r}: {int(marked.sum())} samples are {value:g}, far from all others. If "
                             f"that marks missing samples pass missing='{value:g}'")
    return found


def cell_error(where: str, cell: str, how: Format, around: Sequence[Sequence[str]] = (), advice: str = "",
               row: Sequence[str] = ()) -> DataError:
    """Return the error about a cell that is no number, with what to type.

    `around` are columns of cells of the same rows, which may hold further words of missing samples; `row` are the cells
    of its row, that of the clock among them; `advice` is what the layout of the file proposes.
    """
    text, words = cell.strip(), dict[str, Any]()
    if text.lower() in _SWITCH:
        return DataError(f"{where} holds {cell!r}, not a number. Write 0 and 1 in place of words for off and on.")
    if re.fullmatch(r"[+-]?[\d.,]+ *[A-Za-z%°µΩ/]+", text) and not re.fullmatch(r"[+-]?[\d.,]+ *[eEdD][+-]?\d*", text):
        return DataError(f"{where} holds {cell!r}, a number with its unit. Remove the unit from the cells.")
    if re.fullmatch(r"[+-]?\d*\.?\d+[dD][+-]?\d+", text):
        return DataError(f"{where} holds {cell!r}, an exponent of Fortran. Write E in place of D.")
    if row and all(one.strip() and not any(sign.isdigit() for sign in one) for one in row) and len(row) > 2:
        return DataError(f"{where} holds {cell!r}, not a number. The whole row is text ({', '.join(row)[:60]}): a row "
                         "of units or another header inside the table; remove it.")
    if "#" in text or not any(sign.isdigit() for sign in text):
        marks = dict.fromkeys(one.strip() for column in around for one in column
                              if ("#" in one or not any(sign.isdigit() for sign in one))
                              and not how.is_missing(one))
        marks = [text] if not marks or len(marks) > 8 else list(marks)
        words["missing"] = ",".join([*how.missing, *marks])
        hint = "Leave the cell blank where a sample is missing, or name the words of missing samples"
    elif how.decimal == "," and "." in text:
        hint = "With a decimal comma a point is no decimal mark; it may separate thousands"
        words["thousands"] = "."
    elif how.thousands is None and re.fullmatch(r"[+-]?\d{1,3}([,.' \u00a0\u2019\u202f]\d{3})+([.,]\d*)?", text):
        words["thousands"] = re.sub(r"[\d+-]", "", text)[0]
        hint = "It seems to have a separator of thousands"
        if words["thousands"] == how.decimal:
            words = {"decimal": ",", "thousands": "."}
        if "decimal=" in advice or "thousands=" in advice:
            words = {}
    elif how.decimal == "." and re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", text):
        hint, words["decimal"] = "It seems to be a number with a decimal comma", ","
    else:
        hint = "Leave the cell blank where a sample is missing"
    given = {word: value for word, value in words.items() if value != getattr(how, word) and f"{word}=" not in advice}
    if "missing" in words and "missing=" in advice:
        given.pop("missing", None)
    typed = ", ".join(part for part in (call(given), advice) if part)
    return DataError(f"{where} holds {cell!r}, not a number. {hint}{f': pass {typed}.' if typed else '.'}")


def _unnamed(pairs: dict[str, str], known: Sequence[str], letter: str) -> dict[str, str]:
    """Name channels after their letter if the columns have only positions."""
    positions = {str(place) for place, name in enumerate(known) if name == str(place)}
    if not positions.issuperset(pairs.values()):
        return pairs
    return dict(zip(numbered_names(letter, len(pairs)), pairs.values()))

"""The rows of a study as one array per column, whatever they come as."""

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.studies.storage.rows import BY_NAME

LABELS, LONGEST_LABEL = ("data", "formulation", "solver"), 80
REQUIRED = ("data", "formulation", "solver", "outcome", "status_verified", "objective", "solve_s")


def columns(rows: Any) -> dict[str, np.ndarray]:
    """Return rows as one array per column of the schema; what is not given is empty.

    Args:
        rows: a mapping of columns, a frame (pandas, polars), or dict rows.

    Returns:
        {column: array}: numbers as floats (``nan`` where empty), flags as bools, texts as str ("" where empty); labels
        longer than `LONGEST_LABEL` shortened.

    Raises:
        DataError: a column that a verdict needs is missing, columns of unequal length, or a text in place of a number.
    """
    given = _by_column(rows)
    lengths = {name: len(values) for name, values in given.items()}
    n = max(lengths.values(), default=0)
    short = [name for name, length in lengths.items() if length != n]
    if short:
        raise DataError(f"column {short[0]!r} has {lengths[short[0]]} values, others have {n}")
    missing = [name for name in REQUIRED if name not in given] if n else []
    if missing:
        raise DataError(f"the rows have no column {', '.join(missing)}: this is not a table of study rows")
    table = {name: _filled(name, column.kind, given.get(name), n) for name, column in BY_NAME.items()}
    for name in LABELS:
        table[name] = np.array([_label(text) for text in table[name]], dtype=object)
    return table


def _label(text: str) -> str:
    """Shorten a label that no sentence could hold, so that it stays different from others."""
    if len(text) <= LONGEST_LABEL:
        return text or "(no name)"
    return f"{text[: LONGEST_LABEL - 8]}…{hashlib.sha256(text.encode(errors='replace')).hexdigest()[:6]}"


def _by_column(rows: Any) -> dict[str, Any]:
    if isinstance(rows, Mapping):
        return {name: rows[name] for name in rows if name in BY_NAME}
    if hasattr(rows, "columns"):
        return {name: rows[name].to_numpy() for name in rows.columns if name in BY_NAME}
    if isinstance(rows, str | bytes) or not isinstance(rows, Iterable):
        raise DataError(f"rows are a mapping of columns, a frame or dicts, not {type(rows).__name__}")
    listed = list(rows)
    if not all(isinstance(row, Mapping) for row in listed):
        raise DataError("rows are a mapping of columns, a frame or dicts; one of them is not a dict")
    names = {name for row in listed for name in row if name in BY_NAME}
    return {name: [row.get(name) for row in listed] for name in names}


def _filled(name: str, kind: str, values: Any, n: int) -> np.ndarray:
    if kind in ("number", "integer"):
        return np.full(n, np.nan) if values is None else _numbers(name, values)
    if kind == "flag":
        return np.array([not _empty(v) and bool(v) for v in ([False] * n if values is None else values)], dtype=bool)
    texts = np.empty(n, dtype=object)
    texts[:] = ["" if _empty(v) else str(v) for v in ([""] * n if values is None else values)]
    return texts


def _numbers(name: str, values: Any) -> np.ndarray:
    if isinstance(values, np.ndarray) and values.dtype.kind in "fiu" and not np.ma.isMaskedArray(values):
        return values.astype(float)
    try:
        return np.array([np.nan if _empty(v) else float(v) for v in values])
    except (TypeError, ValueError) as error:
        raise DataError(f"column {name!r} holds something that is not a number: {error}") from error


def _empty(value: Any) -> bool:
    """Whether a value is None, NaN or the missing value of a frame."""
    nan = isinstance(value, float) and value != value
    return value is None or nan or type(value).__name__ in ("NAType", "NaTType")

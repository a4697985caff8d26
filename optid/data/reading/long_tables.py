"""Long tables, one row for each tag and instant: recognised where a channel is asked for, and what to do."""

from typing import Any

import numpy as np

from optid.data.reading.clock import is_time_name
from optid.data.reading.format import is_number
from optid.data.reading.sources import RawTable
from optid.errors import DataError

MOST_TAGS = 1000


def explain_missing_column(error: DataError, table: RawTable, inputs: Any, outputs: Any) -> DataError:
    """Return the error about a missing column, or the one that the table is long where its cells name the channels."""
    texts = [name for name in table.names if name and name not in table.dates and not is_time_name(name)]
    if not texts:
        return error
    try:
        loaded = table.load(texts, dict.fromkeys(texts, "text"))
    except DataError:
        return error
    asked = [one for wanted in (inputs, outputs) for one in (
        wanted.values() if isinstance(wanted, dict) else wanted if isinstance(wanted, list | tuple) else [wanted])
        if one is not None]
    for name in texts:
        cells = np.asarray(loaded[name])
        if cells.dtype.kind not in "UO" or cells.ndim != 1:
            continue
        tags = list(dict.fromkeys(str(cell) for cell in cells[:10_000]))
        counts = [str(cell) for cell in cells[:10_000]]
        named = [one for one in asked if counts.count(str(one)) > 1]
        repeated = len(tags) <= MOST_TAGS and len(cells) >= 4 * len(tags) > 4 and not asked
        numbers = any(is_number(tag.replace(",", ".")) for tag in tags)  # with decimal commas, too
        if named or (repeated and not numbers):
            clock = next((one for one in table.names if one in table.dates or is_time_name(one)), "TIME")
            numeric = [one for one in table.names if one != name and one in loaded and _is_numeric(loaded[one])]
            value = next((one for one in numeric if "val" in one.lower()), numeric[0] if numeric else "VALUE")
            return DataError(
                f"{table.label} is a long table: column {name!r} holds the tags ({', '.join(tags[:4])}), one row for "
                f"each tag and instant. Make a column of each tag first, in pandas: "
                f"frame.set_index([{clock!r}, {name!r}])[{value!r}].unstack(), and read the result.")
    return error


def _is_numeric(values: Any) -> bool:
    array = np.asarray(values)
    if array.dtype.kind in "iuf":
        return True
    try:
        array[:100].astype(float)
    except (ValueError, TypeError):
        return False
    return True

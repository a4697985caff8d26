"""Checks of arguments and records that the formulations share."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from optid.arrays import check_integer
from optid.data.record import Data
from optid.errors import DataError, RankError, StructureError

ROWS_PER_UNKNOWN = 1.1  # errors that a fit needs for each of its unknowns
Offset = bool | Literal["each"]  # of an equation: one constant, none, or one for each experiment


def per_channel(name: str, value: int | Sequence[int], inputs: Sequence[str], low: int) -> tuple[int, ...]:
    """Expand a scalar to one integer per input and check it."""
    values = list(value) if isinstance(value, list | tuple | np.ndarray) else [value] * len(inputs)
    if len(values) != len(inputs):
        raise StructureError(f"{name} has {len(values)} entries for {len(inputs)} inputs ({', '.join(inputs)})")
    return tuple(check_integer(entry, f"{name} of input {channel!r}", low) for channel, entry in zip(inputs, values))


def check_offset(offset: Any, data: Any) -> Offset:
    """Return whether there is one constant, none, or one for each of several experiments; refuse other words.

    With a single experiment "each" is one constant. A stream does not keep its experiments apart (`StructureError`).
    """
    if not isinstance(offset, bool | np.bool_) and not (isinstance(offset, str) and offset == "each"):
        raise StructureError(f"offset must be True (one constant), False (none) or 'each' (one for each experiment); "
                             f"got {offset!r}")
    if offset != "each":
        return bool(offset)
    if not isinstance(data, Data):
        raise StructureError("offset='each' requires a record in memory: read it with optid.read instead of a stream")
    return "each" if data.n_experiments > 1 else True


def in_memory(data: Any, errors: str) -> Data:
    """Refuse a stream (`StructureError`); the message names the errors that the fit minimises."""
    if not isinstance(data, Data):
        raise StructureError(f"{errors} require a record in memory: read it with optid.read instead of a stream")
    return data


def one_output(data: Any, errors: str) -> Data:
    """Refuse streams, several outputs (`StructureError`), and an output without a single sample (`DataError`)."""
    data = in_memory(data, errors)
    if data.l > 1:
        raise StructureError(
            f"a transfer-function model has one output; there are {data.l} ({', '.join(data.outputs)}). Fit each by "
            "itself (data.select(outputs=...)), or all of them with 'hammerstein_ss.exact'")
    return outputs_in_memory(data, errors)


def outputs_in_memory(data: Any, errors: str) -> Data:
    """Refuse streams (`StructureError`), and outputs without a single sample (`DataError`)."""
    data = in_memory(data, errors)
    for o, name in enumerate(data.outputs):
        if not any(np.isfinite(e.y[:, o]).any() for e in data.experiments):
            raise DataError(f"output {name!r} has no sample that is present")
    return data


def enough_rows(rows: int, what: str, unknowns: int, remedy: str) -> None:
    """Refuse a record with fewer than 1.1 rows, called `what`, per unknown, initial states included (`RankError`)."""
    least = ROWS_PER_UNKNOWN * unknowns
    if rows < least:
        raise RankError(f"{rows} {what} for {unknowns} unknowns (initial states included), fewer than "
                        f"{int(np.ceil(least))}: use a longer record, fewer {remedy} or fewer basis functions")


def outputs_present(data: Data) -> int:
    """Return the number of output samples that are not missing."""
    return sum(int(np.count_nonzero(~np.isnan(e.y))) for e in data.experiments)


def violations(model: Any, rules: Sequence[Any]) -> list[str]:
    """Return the violations of rules by a model, one sentence each; builders without `verify` are skipped."""
    checks = [rule.verify for rule in rules if getattr(rule, "verify", None) is not None]
    return [sentence for check in checks if (sentence := check(model))]

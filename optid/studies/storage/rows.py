"""The row of a study: names, types, units and meaning of its columns, from which tables and documentation are made."""

import hashlib
import json
import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.program.solution import Status

SCHEMA_VERSION = 3

DONE, TIME_LIMIT, MEMORY_LIMIT, CRASHED = "done", "time limit", "memory limit", "crashed"
KILLED, ERROR, REFUSED, NON_FINITE = "killed", "error", "refused", "non-finite"

OUTCOMES = {
    DONE: "the fit was completed and judged; the result is in `status_verified`",
    TIME_LIMIT: "the worker was killed because the cell took longer than its time limit",
    MEMORY_LIMIT: "the worker exceeded its memory limit, or the machine had no more memory",
    CRASHED: "the worker died: segmentation fault, abort, or it exited by itself",
    KILLED: "the worker was killed from outside; the next run of the study runs the cell again",
    ERROR: "the cell could not be run: unreadable record, wrong argument, an exception outside the solver",
    REFUSED: "the solver cannot take this formulation, or is not installed; nothing was run",
    NON_FINITE: "the fit was completed, but the point, the objective or the model has numbers that are not finite",
}
"""Every value of the column ``outcome`` and what it means."""

STATUSES = tuple(str(status) for status in Status)  # every value of the column ``status_verified``
SUCCESS = (str(Status.OPTIMAL), str(Status.LOCAL))  # those with which the requested accuracy was reached


KINDS: Mapping[str, tuple[str, type, str]] = {
    "text": ("TEXT", str, ""), "json": ("TEXT", str, " (JSON)"), "number": ("REAL", float, ""),
    "integer": ("INTEGER", int, ""), "flag": ("INTEGER", bool, " (flag)"), "time": ("TEXT", str, " (time)")}
"""Kinds of columns: type in the database, type in a row, and a note on it. A time is UTC, as ISO 8601."""


@dataclass(frozen=True)
class Column:
    """One column."""

    name: str
    kind: str  # of `KINDS`
    meaning: str  # one sentence for people
    unit: str = ""  # of its numbers
    always: bool = False  # whether every row has a value

    @property
    def sql(self) -> str:
        """Its type in the database."""
        return KINDS[self.kind][0]


COLUMNS: tuple[Column, ...] = (
    # which cell
    Column("key", "text", "SHA-256 of everything that determines the result, the machine excepted", always=True),
    Column("repetition", "integer", "counted from 0; (study, key, repetition) identifies a row", always=True),
    Column("study", "text", "title of the study", always=True),
    Column("data", "text", "label of the data entry", always=True),
    Column("formulation", "text", "label of the formulation entry", always=True),
    Column("solver", "text", "label of the solver entry", always=True),
    # what was run
    Column("system", "text", "simulated system; empty for a file"),
    Column("file", "text", "data file, or several with a comma between them; empty for a simulated system"),
    Column("data_hash", "text", "SHA-256 of the data file, of the SHA-256 of several, or of the record in memory; "
                                "empty for a simulated system"),
    Column("samples", "integer", "requested length of a simulated record"),
    Column("noise", "number", "standard deviation of the noise relative to that of the noise-free output"),
    Column("seed", "integer", "seed of the simulation"),
    Column("formulation_name", "text", "registered name of the formulation", always=True),
    Column("options", "json", "arguments of the formulation", always=True),
    Column("constraints", "json", "named constraints, a list of texts", always=True),
    Column("solver_name", "text", "requested back end, or auto", always=True),
    Column("solver_options", "json", "native options of the solver", always=True),
    Column("accuracy", "number", "requested relative accuracy", always=True),
    Column("warm", "flag", "whether a second solve from its own solution was requested", always=True),
    Column("holdout", "number", "share of the record that the fit did not see", always=True),
    Column("time_limit", "number", "longest time a cell may take", "s", always=True),
    Column("memory_limit", "number", "largest memory a cell may take", "MB", always=True),
    # the record
    Column("n_samples", "integer", "samples of the record, all experiments together"),
    Column("n_estimation", "integer", "samples that the fit saw"),
    Column("n_inputs", "integer", "inputs of the record"),
    Column("n_outputs", "integer", "outputs of the record"),
    # how it ended
    Column("outcome", "text", "how the cell ended; see the table of outcomes", always=True),
    Column("status_claimed", "text", "status as reported by the solver"),
    Column("status_verified", "text", "status after our own residuals have judged the claim; empty where nothing was "
                                      "judged"),
    Column("reason", "text", "one sentence where outcome or status needs one"),
    Column("reached", "flag", "whether the verified accuracy was reached: optimal or locally optimal", always=True),
    Column("proved", "flag", "whether global optimality is proved", always=True),
    Column("false_claim", "flag", "whether the solver claimed a success or an infeasibility that the verified "
                                  "residuals contradict", always=True),
    Column("solver_used", "text", "back end that ran, where auto chose it"),
    Column("program_class", "text", "class of the last programme: LP, QP, SOCP, SDP, conic or NLP"),
    Column("unknowns", "integer", "scalar variables of the last programme"),
    Column("n_programs", "integer", "programmes solved: 1, or those of all steps of a procedure"),
    Column("steps", "json", "one entry per step and solver: step, solver, programs, reached, iterations, seconds; the "
                            "view `steps` has a row for each"),
    # the answer
    Column("objective", "number", "objective at the point, recomputed", "data"),
    Column("scale", "number", "objective of the zero model, the yardstick of objectives", "data"),
    Column("bound", "number", "certified lower bound; empty where there is none", "data"),
    Column("gap", "number", "relative gap between objective and bound; empty without a bound"),
    Column("violation", "number", "largest constraint violation, relative to its terms"),
    Column("stationarity", "number", "largest component of the gradient of the Lagrangian, relative to its terms"),
    Column("complementarity", "number", "products of multipliers and slacks, relative to the objective"),
    Column("iterations", "integer", "iterations as counted by the solver, all programmes together"),
    # times and memory
    Column("load_s", "number", "reading or simulating the record; near 0 if kept from an earlier cell", "s"),
    Column("build_s", "number", "building the problem: checks, statistics, programme", "s"),
    Column("compile_s", "number", "translation of the programme for the solver, part of a cold solve; empty where the "
                                  "back end does not report it", "s"),
    Column("solve_s", "number", "cold solve without the reported compilation, all programmes together", "s"),
    Column("judge_s", "number", "measuring residuals at the point", "s"),
    Column("prove_s", "number", "the attempt to prove global optimality", "s"),
    Column("fit_s", "number", "the whole fit: build, compile, solve, judge, prove, prices", "s"),
    Column("warm_s", "number", "the second solve, from the first one's solution, with nothing built or compiled again",
           "s"),
    Column("warm_iterations", "integer", "iterations of the second solve"),
    Column("warm_status", "text", "verified status of the second solve"),
    Column("total_s", "number", "the whole cell in the worker, or until it was killed", "s"),
    Column("peak_mb", "number", "largest resident memory of the worker during the cell", "MB"),
    Column("base_mb", "number", "resident memory of the worker before the cell", "MB"),
    # the model
    Column("one_step_fit", "number", "one-step fit on the hold-out samples, mean over the outputs", "%"),
    Column("one_step_fits", "json", "the same for every output, a list", "%"),
    Column("simulation_fit", "number", "simulation fit on the hold-out samples, initial state fitted, mean over the "
                                       "outputs", "%"),
    Column("simulation_fits", "json", "the same for every output, a list", "%"),
    Column("parameter_error", "number", "relative error of the linear part against the truth, in a common gauge"),
    Column("nonlinearity_error", "number", "relative error of the nonlinearity against the truth, in a common gauge"),
    Column("poles", "json", "poles of the linear part, a list of [real, imaginary]"),
    Column("parameters", "json", "coefficients of the linear part by name, mu[input] of nonlinearities as lists"),
    Column("stable", "flag", "whether every pole lies inside the unit circle; empty without a model"),
    # when and where
    Column("started", "time", "when the cell started, UTC", always=True),
    Column("machine", "text", "name, processor, system and Python of the machine that ran it", always=True),
    Column("versions", "json", "versions of optid and of the packages that determine the result", always=True),
)

NAMES: tuple[str, ...] = tuple(column.name for column in COLUMNS)
BY_NAME: Mapping[str, Column] = {column.name: column for column in COLUMNS}

LARGEST = 2**63  # what a whole number in the database is below
LONGEST_LABEL = 80  # characters of the labels of data, formulations and solvers in a table
REQUIRED = ("data", "formulation", "solver", "outcome", "status_verified", "objective", "solve_s")
"""Columns that rows must have."""


def complete(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return a complete row in the order of the columns; missing values are None, or False for a flag in every row.

    Numbers that are not finite become empty; numpy scalars become Python numbers.

    Raises:
        ValueError: unknown column, value of another type, integer beyond 64 bits, unknown outcome or status, or a
            missing value where every row has one.
    """
    unknown = sorted(set(values) - set(NAMES))
    if unknown:
        raise ValueError(f"no column is called {', '.join(unknown)}")
    row = {column.name: _cell_value(column, values.get(column.name)) for column in COLUMNS}
    if row["outcome"] not in OUTCOMES:
        raise ValueError(f"outcome {row['outcome']!r} is none of {', '.join(OUTCOMES)}")
    if row["status_verified"] not in (None, *STATUSES):
        raise ValueError(f"status_verified {row['status_verified']!r} is none of {', '.join(STATUSES)}")
    return row


def _cell_value(column: Column, value: Any) -> Any:
    value, wanted = value.item() if hasattr(value, "item") else value, KINDS[column.kind][1]
    if wanted is float and type(value) is int:
        value = float(value) if abs(value) <= sys.float_info.max else None
    if wanted in (float, int) and isinstance(value, float) and not math.isfinite(value):
        value = None
    if wanted is int and isinstance(value, float) and value.is_integer():
        value = int(value)
    if value is None and column.always:
        if wanted is bool:
            return False
        raise ValueError(f"column {column.name!r} must have a value in every row")
    if value is not None and (not isinstance(value, wanted) or isinstance(value, bool) != (wanted is bool)):
        raise ValueError(f"column {column.name!r} holds a {column.kind}, not {value!r}")
    if wanted is int and value is not None and not -LARGEST <= value < LARGEST:
        raise ValueError(f"column {column.name!r} holds integers of 64 bits; this one is larger")
    if isinstance(value, str):  # messages of solvers may be no valid text
        return value.encode(errors="replace").decode().replace("\0", "")
    return value


def as_json(value: Any) -> str:
    """Write a value as JSON; numbers that are not finite become null, objects unknown to JSON their text."""
    return json.dumps(_finite(value), sort_keys=True, default=str, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return _finite(value.tolist())
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def columns(rows: Any) -> dict[str, np.ndarray]:
    """Return rows as one array per column of the schema; missing values are empty.

    Args:
        rows: a mapping of columns, a frame (pandas, polars), or dict rows.

    Returns:
        {column: (rows,) array}: numbers and integers as floats (``nan`` if empty), flags as bools (False), texts, JSON
        and times as str (""); labels longer than `LONGEST_LABEL` are shortened.

    Raises:
        DataError: a required column is missing, columns differ in length, or a text in place of a number.
    """
    given = _by_column(rows)
    n = max(map(len, given.values()), default=0)
    for name, values in given.items():
        if len(values) != n:
            raise DataError(f"column {name!r} has {len(values)} values, others have {n}")
    missing = [name for name in REQUIRED if name not in given] if n else []
    if missing:
        raise DataError(f"the rows have no column {', '.join(missing)}: this is not a table of study rows")
    table = {column.name: _array(column, given.get(column.name, [None] * n)) for column in COLUMNS}
    for name in ("data", "formulation", "solver"):
        table[name] = np.array([_label(text) for text in table[name]], dtype=object)
    return table


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
    return {name: [row.get(name) for row in listed] for name in NAMES if any(name in row for row in listed)}


def _array(column: Column, values: Any) -> np.ndarray:
    missing = [v is None or isinstance(v, float) and v != v or type(v).__name__ in ("NAType", "NaTType")  # of pandas
               for v in values]
    if column.kind in ("number", "integer"):
        try:
            return np.array([np.nan if empty else float(v) for empty, v in zip(missing, values)])
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(f"column {column.name!r} holds something that is not a number: {error}") from error
    if column.kind == "flag":
        return np.array([not empty and bool(v) for empty, v in zip(missing, values)], dtype=bool)
    return np.array(["" if empty else str(v) for empty, v in zip(missing, values)], dtype=object)


def _label(text: str) -> str:
    """Shorten a long label such that it stays distinct."""
    if len(text) <= LONGEST_LABEL:
        return text or "(no name)"
    return f"{text[: LONGEST_LABEL - 8]}…{hashlib.sha256(text.encode(errors='replace')).hexdigest()[:6]}"


def markdown() -> str:
    """Return the documentation of the schema as two Markdown tables: columns and outcomes."""
    lines = [f"""# The rows of a study

Schema version {SCHEMA_VERSION}. One row per cell and repetition, in the table `rows` of the SQLite file and in what \
`optid study export` writes. A column without a value is NULL; there is no NaN and no infinity; flags are 0 and 1, \
times are texts (ISO 8601, UTC). A row of a cell that the study no longer has (entries taken out, changed data, \
versions or options), or that was run again, is in the table `superseded`, from where a run takes back what the study \
has again; the text of the study file is in `studies`, runs under way are in `runs`, the schema version is in `meta`.

Other programs read the file as it is, also while a run goes on:

```python
import sqlite3, pandas
pandas.read_sql("SELECT * FROM rows", sqlite3.connect("study.sqlite"))
```

```sql
-- DuckDB
INSTALL sqlite; LOAD sqlite;
SELECT solver, median(solve_s) FROM sqlite_scan('study.sqlite', 'rows') GROUP BY solver;
```

In exported CSV files a text that a spreadsheet would run as a formula begins with an apostrophe.

| column | type | unit | meaning |
|---|---|---|---|"""]
    lines += [f"| `{c.name}` | {c.sql}{KINDS[c.kind][2]}{' NOT NULL' if c.always else ''} "
              f"| {c.unit} | {c.meaning} |" for c in COLUMNS]
    lines += ["", "| outcome | meaning |", "|---|---|", *(f"| {word} | {text} |" for word, text in OUTCOMES.items())]
    return "\n".join(lines) + "\n"

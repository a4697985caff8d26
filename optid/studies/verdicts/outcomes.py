"""Which runs count: a table of problems and solvers, every entry with a time or with the reason why it has none."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.solution import GRADIENT, tolerance
from optid.studies.storage.rows import BY_NAME, DONE, NON_FINITE, REFUSED, SUCCESS

SOLVED, NOT_RUN = "solved", "not run"
FALSE_CLAIM, CONTRADICTED, INFEASIBLE = "false claim", "contradicted", "infeasible"
LESS_ACCURATE, WORSE_MINIMUM = "less accurate", "worse minimum"
VALUE = 1e-6  # relative difference of objectives up to which two runs found the same minimum
LABELS, LONGEST_LABEL = ("data", "formulation", "solver"), 80
REQUIRED = ("data", "formulation", "solver", "outcome", "status_verified", "objective", "solve_s")
TIMES = {"solve": ("compile_s", "solve_s"), "fit": ("fit_s",), "warm": ("warm_s",)}
"""Measures of time and the columns they are the sum of."""

MEANINGS = {
    SOLVED: "the verified accuracy was reached, at the best objective that any solver verified",
    FALSE_CLAIM: "success or infeasibility was claimed, and our residuals took it back",
    CONTRADICTED: "infeasible or unbounded, it said; another solver has a verified point",
    LESS_ACCURATE: "verified to a looser accuracy of its own, not to the one compared at",
    WORSE_MINIMUM: "a verified minimum above the best one that another solver verified; of a procedure the minimum of "
                   "its last programme, which depends on the steps before it",
    NOT_RUN: "no run in the database",
}
"""What the words of the failure table mean beyond the outcomes and statuses of a row."""


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


@dataclass(frozen=True)
class Results:
    """Problems (rows) against solvers (columns).

    A problem is what every solver was given alike: study, record (data, samples, noise, seed) and formulation.

    Attributes:
        study, data, formulation: labels per problem, (P,).
        samples, noise, seed: what the record was simulated with, (P,); ``nan`` for files.
        n: length of the record, (P,); ``nan`` where no run got that far.
        solvers: labels, S of them, in alphabetical order.
        state: `SOLVED` or the word for why not, (P, S).
        reason: sentence of the first run that did not solve it, (P, S).
        false: whether a claim was false, of any repetition, or contradicted, (P, S).
        time: median over the repetitions in seconds, (P, S); ``nan`` unless solved.
        objective: (P, S), of the runs whose verified accuracy was reached, local minima included; ``nan`` otherwise.
        size: yardstick of differences of objectives, (P,).
        residual: worst verified residual as `worst_residual` counts it, (P, S), wherever there is a point.
        limit: time limit in seconds, (P,).
        row: number of the row that speaks for the entry, (P, S); -1 where there is none.
        tolerance: residual up to which a run counts.
    """

    study: np.ndarray
    data: np.ndarray
    formulation: np.ndarray
    samples: np.ndarray
    noise: np.ndarray
    seed: np.ndarray
    n: np.ndarray
    solvers: tuple[str, ...]
    state: np.ndarray
    reason: np.ndarray
    false: np.ndarray
    time: np.ndarray
    objective: np.ndarray
    size: np.ndarray
    residual: np.ndarray
    limit: np.ndarray
    row: np.ndarray
    tolerance: float

    @property
    def solved(self) -> np.ndarray:
        """Which entries are solved, (P, S)."""
        return self.state == SOLVED

    def where(self, problems: np.ndarray, solvers: np.ndarray | None = None) -> "Results":
        """Return some of the problems (mask over P) and solvers (mask over S; all unless given)."""
        kept = np.ones(len(self.solvers), dtype=bool) if solvers is None else solvers
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                values[name] = value[problems][:, kept] if value.ndim == 2 else value[problems]
        values["solvers"] = tuple(s for s, keep in zip(self.solvers, kept) if keep)
        return Results(**values)

    @property
    def case(self) -> np.ndarray:
        """Number of the record per problem, (P,): the same for all formulations of one record."""
        keys = list(zip(self.study, self.data, *(_words(v) for v in (self.samples, self.noise, self.seed))))
        numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        return np.array([numbers[key] for key in keys], dtype=int)


def usual_accuracy(table: Mapping[str, np.ndarray]) -> float:
    """Return the accuracy that most runs asked for, of equally frequent ones the strictest."""
    known = table["accuracy"][np.isfinite(table["accuracy"]) & (table["accuracy"] > 0)]
    if not known.size:
        return 1e-8
    values, counts = np.unique(known, return_counts=True)
    return float(values[np.argmax(counts)])


def tabulate(table: Mapping[str, np.ndarray], accuracy: float | None = None, time: str = "solve") -> Results:
    """Sort rows into problems and solvers, and decide which entries are solved.

    Args:
        table: what `columns` returned.
        accuracy: relative accuracy to compare at; unless given, the one most runs asked for.
        time: "solve" (compile and solve, cold), "fit" (the whole fit) or "warm" (the second solve).

    Returns:
        The table. An entry is solved where every repetition ran to its end, was verified, has residuals within the
        tolerance of the common accuracy and an objective within `VALUE` of the best verified one.

    Raises:
        DataError: unknown measure of time.
    """
    if time not in TIMES:
        raise DataError(f"time is one of {', '.join(TIMES)}, not {time!r}")
    limit = tolerance(usual_accuracy(table) if accuracy is None else accuracy)
    residual = worst_residual(table)
    states = _row_states(table, residual, limit)
    seconds = seconds_of(table, time)
    if time == "warm":  # the second solve counts by its own verified status
        seconds = np.where(np.isin(table["warm_status"], SUCCESS), seconds, np.nan)
    labels = (table[c] for c in ("study", "data", "formulation"))
    keys = list(zip(*labels, *(_words(table[c]) for c in ("samples", "noise", "seed"))))
    problems = {key: p for p, key in enumerate(dict.fromkeys(keys))}
    solvers = {name: s for s, name in enumerate(sorted(set(table["solver"])))}
    entries: dict[tuple[int, int], list[int]] = {}
    members: list[list[int]] = [[] for _ in problems]
    for i, (key, name) in enumerate(zip(keys, table["solver"])):
        entries.setdefault((problems[key], solvers[name]), []).append(i)
        members[problems[key]].append(i)
    first = np.array([m[0] for m in members], dtype=int)
    shape = (len(problems), len(solvers))
    state, reason = np.full(shape, NOT_RUN, dtype=object), np.full(shape, "", dtype=object)
    false = np.zeros(shape, dtype=bool)
    row, numbers = np.full(shape, -1), {name: np.full(shape, np.nan) for name in ("time", "objective", "residual")}
    for (p, s), runs in entries.items():
        runs.sort(key=lambda i: (table["repetition"][i], table["key"][i]))
        bad = next((i for i in runs if states[i] != SOLVED), None)
        speaks = runs[0] if bad is None else bad
        row[p, s], state[p, s] = speaks, states[speaks]
        reason[p, s] = "" if bad is None else table["reason"][speaks]
        false[p, s] = table["false_claim"][runs].any()
        numbers["residual"][p, s] = np.max(residual[runs])
        if bad is None:
            numbers["time"][p, s] = np.median(seconds[runs])
            numbers["objective"][p, s] = np.max(table["objective"][runs])
    found = Results(
        *(table[name][first] for name in ("study", "data", "formulation", "samples", "noise", "seed")),
        n=np.array([_largest(table["n_samples"][m], table["samples"][m]) for m in members]),
        size=np.array([_largest(table["scale"][m]) for m in members]),
        limit=np.array([_largest(table["time_limit"][m]) for m in members]),
        solvers=tuple(solvers), state=state, reason=reason, false=false, row=row, tolerance=limit, **numbers,
    )  # fmt: skip
    return _against_the_best(found, limit)


def _words(values: np.ndarray) -> list[str]:
    """Numbers as words, so that an empty one equals an empty one."""
    return [f"{v:.12g}" for v in values]


def _largest(*choices: np.ndarray) -> float:
    """Largest finite number of the first choice that has one."""
    return next((float(np.max(c[np.isfinite(c)])) for c in choices if np.isfinite(c).any()), float("nan"))


def worst_residual(table: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return what is held against the tolerance, (rows,); ``nan`` without a point.

    It is the largest of violation, complementarity and stationarity, the last one divided by `GRADIENT`: solving allows
    gradients that much more.
    """
    return np.fmax(np.fmax(table["violation"], table["complementarity"]), table["stationarity"] / GRADIENT)


def seconds_of(table: Mapping[str, np.ndarray], time: str) -> np.ndarray:
    """Return the time that is compared, (rows,); ``nan`` where it is not known."""
    parts = TIMES[time]  # only the last one must be there
    total = table[parts[-1]] + sum(np.nan_to_num(table[part]) for part in parts[:-1])
    return np.where(total > 0, total, np.where(total == 0, 1e-6, np.nan))  # a clock that stood still: a microsecond


def _row_states(table: Mapping[str, np.ndarray], residual: np.ndarray, limit: float) -> np.ndarray:
    """`SOLVED` or why not, for every row by itself."""
    verified = np.isin(table["status_verified"], SUCCESS)
    unknown = np.where(table["status_verified"] == "", "failed", table["status_verified"])
    choices = [
        (table["outcome"] != DONE, np.where(table["outcome"] == "", "error", table["outcome"])),
        (table["false_claim"], FALSE_CLAIM),
        (~verified, unknown),
        (~np.isfinite(table["objective"]), NON_FINITE),
        (residual > limit, LESS_ACCURATE),
    ]
    states = np.full(len(residual), SOLVED, dtype=object)
    for condition, word in reversed(choices):
        states = np.where(condition, word, states)
    return states.astype(object)


def _against_the_best(found: Results, limit: float) -> Results:
    """Take out minima above the best one, and claims of infeasibility that a verified point contradicts."""
    solved = found.solved
    best = np.min(np.where(solved, found.objective, np.inf), axis=1, initial=np.inf)
    best = np.where(np.isfinite(best), best, 0.0)
    size = np.maximum(np.maximum(np.abs(best), 1e-2 * np.nan_to_num(found.size)), np.finfo(float).tiny)
    with np.errstate(invalid="ignore", over="ignore"):
        worse = solved & ((found.objective - best[:, None]) / size[:, None] > max(VALUE, limit))
    denied = np.isin(found.state, (INFEASIBLE, "unbounded")) & np.any(solved, axis=1, keepdims=True)
    state = np.where(worse, WORSE_MINIMUM, np.where(denied, CONTRADICTED, found.state)).astype(object)
    values = {f.name: getattr(found, f.name) for f in fields(found)}
    values |= {"state": state, "false": found.false | denied, "time": np.where(worse, np.nan, found.time), "size": size}
    return Results(**values)


def states_of_rows(table: Mapping[str, np.ndarray], found: Results) -> np.ndarray:
    """Return `SOLVED` or the word for why not for every row, (rows,).

    Args:
        table: the rows.
        found: what `tabulate` made of them.
    """
    states = _row_states(table, worst_residual(table), found.tolerance)
    for word in (WORSE_MINIMUM, CONTRADICTED):
        states[found.row[found.state == word]] = word
    return states


def agreed_infeasible(found: Results) -> np.ndarray:
    """Return the problems that nobody solved and some solver was verified to call infeasible, (P,)."""
    return ~found.solved.any(axis=1) & (found.state == INFEASIBLE).any(axis=1)


def applicable(found: Results) -> np.ndarray:
    """Return the entries where the solver was run at all: neither refused nor left out, (P, S)."""
    return (found.state != REFUSED) & (found.state != NOT_RUN)

"""A table of problems and solvers: every entry has a time, or the reason why it has none."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from scipy.stats import mode

from optid.errors import DataError
from optid.program.solution import GRADIENT, Status, tolerance
from optid.studies.storage.rows import (
    CRASHED,
    DONE,
    ERROR,
    KILLED,
    MEMORY_LIMIT,
    NON_FINITE,
    REFUSED,
    SUCCESS,
    TIME_LIMIT,
)
from optid.studies.verdicts.statement import group

SOLVED, NOT_RUN = "solved", "not run"
FALSE_CLAIM, CONTRADICTED, INFEASIBLE = "false claim", "contradicted", str(Status.INFEASIBLE)
LESS_ACCURATE, WORSE_MINIMUM, OTHER_ACCURACY = "less accurate", "worse minimum", "other accuracy"
WARM_FAILED, UNTIMED = "warm solve failed", "no time"
VALUE = 1e-6  # relative difference of objectives up to which two runs found the same minimum
TIMES = {"solve": ("compile_s", "solve_s"), "fit": ("fit_s",), "warm": ("warm_s",)}  # measures: sums of columns
VERIFIED = (SOLVED, WARM_FAILED, UNTIMED)  # the accuracy was reached, with or without a time
UNANSWERED = (TIME_LIMIT, MEMORY_LIMIT, CRASHED, KILLED, ERROR, str(Status.LIMIT))  # no answer of the solver
MEANINGS = {
    SOLVED: "the verified accuracy was reached, at the best objective that any solver verified",
    FALSE_CLAIM: "the solver claimed success or infeasibility, which the verified residuals contradict",
    CONTRADICTED: "the solver claimed infeasible or unbounded; another solver has a verified point",
    LESS_ACCURATE: "verified at its own looser accuracy, not at the compared one",
    WORSE_MINIMUM: "a verified minimum above the best one that another solver verified; of a procedure the minimum of "
                   "its last programme, which depends on the steps before it",
    OTHER_ACCURACY: "asked for another accuracy than the compared one, at which the same solver has runs",
    WARM_FAILED: "the cold solve was verified, the warm solve, whose time is compared, was not",
    UNTIMED: "solved, but without the compared time: not solved warm; a procedure never is",
    NOT_RUN: "no run in the database",
    INFEASIBLE: "the solver claims that no point satisfies the constraints; the claim has no point to verify",
    str(Status.UNBOUNDED): "the solver claims that the objective has no lower bound",
    str(Status.LIMIT): "the solver stopped at its own limit of iterations or time",
    str(Status.INACCURATE): "the point misses the tolerance of its accuracy, but by too little for a false claim",
    str(Status.FAILED): "no point to judge, or a point far from the claim",
}
"""The meaning of the states in the failure table, beyond the outcomes of a row."""

Table = Mapping[str, np.ndarray]
_RECORD = ("study", "data", "samples", "noise", "seed")


@dataclass(frozen=True)
class Results:
    """Problems (P rows) against solvers (S columns).

    A problem is what every solver was given alike: study, record (data, samples, noise, seed) and formulation.
    """

    study: np.ndarray  # labels per problem, (P,), as those of data and formulation
    data: np.ndarray
    formulation: np.ndarray
    case: np.ndarray  # number of the record, (P,): the same for all formulations of one record
    solvers: tuple[str, ...]  # labels, in alphabetical order
    state: np.ndarray  # `SOLVED` or the reason, (P, S)
    reason: np.ndarray  # sentence of the first run that did not solve it, (P, S)
    false: np.ndarray  # whether a claim was false, of any repetition at any accuracy, or contradicted, (P, S)
    time: np.ndarray  # median over the repetitions in seconds, (P, S); nan unless solved
    proved: np.ndarray  # whether every repetition was proved globally optimal, (P, S)
    objective: np.ndarray  # (P, S), where the verified accuracy was reached, local minima included; nan otherwise
    size: np.ndarray  # yardstick of differences of objectives, (P,)
    residual: np.ndarray  # worst verified residual as `worst_residual` counts it, (P, S), wherever there is a point
    row: np.ndarray  # number of the row that represents the entry, (P, S); -1 without one
    accuracy: float  # requested relative accuracy that is compared at
    measure: str  # of time: "solve", "fit" or "warm"

    @property
    def tolerance(self) -> float:
        """Residual up to which a run counts."""
        return tolerance(self.accuracy)

    @property
    def solved(self) -> np.ndarray:
        """Which entries are solved, (P, S)."""
        return self.state == SOLVED

    @property
    def verified(self) -> np.ndarray:
        """Which entries are solved, apart from the compared time, (P, S)."""
        return np.isin(self.state, VERIFIED)

    @property
    def ran(self) -> np.ndarray:
        """Where the solver was run: not refused, not left out, not without a time, (P, S)."""
        return ~np.isin(self.state, (REFUSED, NOT_RUN, UNTIMED))

    @property
    def data_set(self) -> np.ndarray:
        """Study and data as one label per problem, (P,)."""
        return np.array([f"{study}\0{data}" for study, data in zip(self.study, self.data)], dtype=object)

    def where(self, problems: np.ndarray | slice = slice(None), solvers: np.ndarray | slice = slice(None)) -> "Results":
        """Return some of the problems (mask over P) and solvers (mask over S)."""
        values: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        kept = {name: value[problems][:, solvers] if value.ndim == 2 else value[problems]
                for name, value in values.items() if isinstance(value, np.ndarray)}
        return replace(self, **kept, solvers=tuple(np.array(self.solvers, dtype=object)[solvers]))


def tabulate(table: Table, accuracy: float | None = None, time: str = "solve") -> Results:
    """Sort rows, as of `rows.columns`, into problems and solvers; arguments and errors are those of `conclude`.

    An entry is solved where every repetition was completed and verified, has residuals within the tolerance of the
    common accuracy, the compared time, and an objective within `VALUE` of the best verified one. Of runs at several
    requested accuracies those closest to the common one count.
    """
    if time not in TIMES:
        raise DataError(f"time is one of {', '.join(TIMES)}, not {time!r}")
    if accuracy is None:
        asked = table["accuracy"][np.isfinite(table["accuracy"]) & (table["accuracy"] > 0)]
        accuracy = float(mode(asked).mode) if asked.size else 1e-8  # of equally frequent values the smallest
    residual, seconds = worst_residual(table), seconds_of(table, time)
    states = _row_states(table, accuracy, time)
    verified = np.isin(states, VERIFIED)
    problem, solver, solvers = _places(table)
    first = np.unique(problem, return_index=True)[1]  # row of every problem
    scale = np.zeros(len(first))
    np.maximum.at(scale, problem, np.nan_to_num(table["scale"], nan=0.0, posinf=0.0))
    entries = group(((problem[i], solver[i]), i) for i in np.flatnonzero(states != OTHER_ACCURACY))
    shape = (len(first), len(solvers))
    state, reason = np.full(shape, NOT_RUN, dtype=object), np.full(shape, "", dtype=object)
    false = np.zeros(shape, dtype=bool)
    np.logical_or.at(false, (problem, solver), table["false_claim"])
    row, proved = np.full(shape, -1), np.zeros(shape, dtype=bool)
    numbers = {name: np.full(shape, np.nan) for name in ("time", "objective", "residual")}
    for at, runs in entries.items():
        runs.sort(key=lambda i: (table["repetition"][i], table["key"][i]))
        bad = next((i for i in runs if not verified[i]), next((i for i in runs if states[i] != SOLVED), None))
        row[at] = runs[0] if bad is None else bad
        state[at], reason[at] = states[row[at]], "" if bad is None else table["reason"][bad]
        numbers["residual"][at] = np.max(residual[runs])
        if bad is None:
            numbers["time"][at] = np.median(seconds[runs])
            proved[at] = table["proved"][runs].all()
        if verified[runs].all():
            numbers["objective"][at] = np.max(table["objective"][runs])
    of_problem = {name: values[first] for name, values in table.items()}
    return _against_the_best(Results(
        *(of_problem[name] for name in ("study", "data", "formulation")), case=_numbered(of_problem, *_RECORD),
        size=scale, solvers=solvers, state=state, reason=reason, false=false, row=row, proved=proved,
        accuracy=accuracy, measure=time, **numbers))


def _places(table: Table) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return the numbers of the problem and the solver of every row, and the solvers in alphabetical order."""
    solvers, solver = np.unique(table["solver"], return_inverse=True)
    return _numbered(table, *_RECORD, "formulation"), solver, tuple(solvers)


def _numbered(table: Table, *names: str) -> np.ndarray:
    """Number the rows by their values in some columns, in order of first appearance; empty numbers equal each other."""
    words = ([f"{v:.12g}" for v in table[name]] if table[name].dtype.kind == "f" else table[name] for name in names)
    keys = list(zip(*words))
    numbers = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], dtype=int)


def _other_accuracy(table: Table, accuracy: float) -> np.ndarray:
    """Return which runs asked for a less suitable accuracy than another run of the same solver and problem, (rows,).

    The most suitable is the loosest that is not looser than the common one, else the strictest.
    """
    asked = table["accuracy"]
    steps = np.log(np.where(np.isfinite(asked) & (asked > 0), asked, accuracy) / accuracy)
    distance = np.where(steps <= 0, -steps, steps + 1e6)
    problem, solver, solvers = _places(table)
    nearest = np.full((len(problem), len(solvers)), np.inf)
    np.minimum.at(nearest, (problem, solver), distance)
    return distance > nearest[problem, solver]


def worst_residual(table: Table) -> np.ndarray:
    """Return the residual that is compared with the tolerance, (rows,); ``nan`` without a point.

    It is the largest of violation, complementarity, and stationarity / `GRADIENT`, the factor that solving allows.
    """
    return np.fmax(np.fmax(table["violation"], table["complementarity"]), table["stationarity"] / GRADIENT)


def seconds_of(table: Table, time: str) -> np.ndarray:
    """Return the time that is compared, (rows,); ``nan`` where it is not known."""
    *parts, last = TIMES[time]  # only the last one must be there
    total = table[last] + sum(np.nan_to_num(table[part]) for part in parts)
    return np.where(total > 0, total, np.where(total == 0, 1e-6, np.nan))  # a clock that stood still: a microsecond


def _row_states(table: Table, accuracy: float, time: str) -> np.ndarray:
    warm_failed = (time == "warm") & (table["warm_status"] != "") & ~np.isin(table["warm_status"], SUCCESS)
    status, outcome = table["status_verified"], table["outcome"]
    choices = [
        (_other_accuracy(table, accuracy), OTHER_ACCURACY),
        (outcome != DONE, np.where(outcome == "", ERROR, outcome)),
        (table["false_claim"], FALSE_CLAIM),
        (~np.isin(status, SUCCESS), np.where(status == "", str(Status.FAILED), status)),
        (~np.isfinite(table["objective"]), NON_FINITE),
        (worst_residual(table) > tolerance(accuracy), LESS_ACCURATE),
        (warm_failed, WARM_FAILED),
        (~np.isfinite(seconds_of(table, time)), UNTIMED),
    ]
    conditions, words = zip(*choices)
    return np.select(conditions, words, SOLVED).astype(object)


def _against_the_best(found: Results) -> Results:
    """Mark minima above the best one, and claims of infeasibility that a verified point contradicts."""
    verified = np.isfinite(found.objective)
    best = np.min(np.where(verified, found.objective, np.inf), axis=1, initial=np.inf)
    best = np.where(np.isfinite(best), best, 0.0)
    size = np.maximum(np.maximum(np.abs(best), 1e-2 * found.size), np.finfo(float).tiny)
    with np.errstate(invalid="ignore", over="ignore"):
        far = (found.objective - best[:, None]) / size[:, None] > max(VALUE, found.tolerance)
    worse = found.solved & far
    denied = np.isin(found.state, (INFEASIBLE, str(Status.UNBOUNDED))) & np.any(verified, axis=1, keepdims=True)
    state = np.where(worse, WORSE_MINIMUM, np.where(denied, CONTRADICTED, found.state)).astype(object)
    return replace(found, state=state, false=found.false | denied, proved=found.proved & ~worse, size=size,
                   time=np.where(worse, np.nan, found.time))


def states_of_rows(table: Table, found: Results) -> np.ndarray:
    """Return `SOLVED` or the reason for every row of the table of some results, (rows,)."""
    states = _row_states(table, found.accuracy, found.measure)
    for word in (WORSE_MINIMUM, CONTRADICTED):
        states[found.row[found.state == word]] = word
    return states


def agreed_infeasible(found: Results) -> np.ndarray:
    """Return the problems that are infeasible by agreement, (P,): all solvers with an answer, and at least two, say so.

    One claim is not enough: it comes without a point, so it cannot be verified.
    """
    says = found.state == INFEASIBLE
    answered = found.ran & ~np.isin(found.state, UNANSWERED)
    return (says.sum(axis=1) >= 2) & (says | ~answered).all(axis=1)

"""Conformance of a back end: it is run over the zoo and judged by our residuals; third parties can run it too.

    from optid.conformance import check_back_end
    check_back_end(my_back_end)

A conformant back end never makes a claim that the known answer or our residuals contradict. It may fail honestly on
cases marked hard, and need not recognise infeasible or unbounded programmes as such.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optid.backends import BackEnd
from optid.errors import OptidError
from optid.program import Program
from optid.solution import Solution, Status
from optid.solving import solve
from optid.zoo import SOLVED, Case, cases

SUCCESS = (Status.OPTIMAL, Status.LOCAL)
VALUE = 1e-6  # relative accuracy of the objective behind every "optimal"
POINT = 1e-3  # points are determined less sharply than values: to about the square root of their accuracy
DUAL = 1e-4


class ConformanceError(OptidError, AssertionError):
    """A back end does not do what it claims; the message lists every complaint."""


@dataclass(frozen=True)
class Row:
    """One back end on one case.

    Attributes:
        case: what was solved.
        solver: name of the back end.
        solution: the judged outcome.
        seconds: wall time, building included.
        complaints: what contradicts the back end's claim; empty for a conformant run.
    """

    case: Case
    solver: str
    solution: Solution
    seconds: float
    complaints: tuple[str, ...]


def accepted_cases(back_end: BackEnd, zoo: Sequence[Case] | None = None) -> list[Case]:
    """Return the cases whose class the back end says it solves."""
    return [case for case in (cases() if zoo is None else zoo) if not back_end.refuses(case.build())]


def run_case(back_end: BackEnd, case: Case, **settings) -> Row:
    """Solve one case and compare the outcome with what is known.

    Args:
        back_end: the solver.
        case: an entry of the zoo.
        settings: as in `optid.solving.solve`.
    """
    clock = time.perf_counter()
    program = case.build()
    solution = solve(program, back_end, **settings)
    seconds = time.perf_counter() - clock
    return Row(case, back_end.name, solution, seconds, tuple(_complaints(back_end, case, program, solution)))


def check_back_end(back_end: BackEnd, zoo: Sequence[Case] | None = None) -> list[Row]:
    """Run a back end over every case of its classes.

    Args:
        back_end: the solver.
        zoo: cases to use instead of the shipped ones.

    Returns:
        One row per case.

    Raises:
        ConformanceError: lists all complaints.
    """
    rows = [run_case(back_end, case) for case in accepted_cases(back_end, zoo)]
    complaints = [f"{row.case.name}: {text}" for row in rows for text in row.complaints]
    if complaints:
        raise ConformanceError(f"{back_end.name} is not conformant:\n  " + "\n  ".join(complaints))
    return rows


def value_error(case: Case, solution: Solution) -> float:
    """Return the error of the objective relative to its size (a vanishing one: to a millionth of its scale)."""
    return abs(solution.objective - case.value) / max(abs(case.value), 1e-6 * solution.scale)


def _complaints(back_end: BackEnd, case: Case, program: Program, solution: Solution):
    claims = solution.status in SUCCESS
    if case.outcome != SOLVED:
        if claims:
            yield f"claims {solution.status} for a programme that is {case.outcome}"
        wrong = {"infeasible": Status.UNBOUNDED, "unbounded": Status.INFEASIBLE}[case.outcome]
        if solution.status is wrong:
            yield f"says {solution.status} of a programme that is {case.outcome}"
        return
    if solution.status in (Status.INFEASIBLE, Status.UNBOUNDED):
        yield f"says {solution.status} of a programme that has a solution"
    if not claims:
        if not case.hard:
            yield f"{solution.status}: {solution.reason} (its own word: {solution.claimed})"
        return
    if value_error(case, solution) > VALUE:
        yield f"objective {solution.objective:.9g}, known {case.value:.9g}"
    for name, known in case.point.items():
        yield from _differs(f"variable {name!r}", solution.values[name], np.asarray(known, dtype=float), POINT)
    if not back_end.duals:
        return
    if missing := set(program.constraints) - set(solution.duals):
        yield f"no multipliers for {', '.join(sorted(missing))}"
        return
    for name, known in case.duals.items():
        yield from _differs(f"multiplier of {name!r}", solution.duals[name], np.asarray(known, dtype=float), DUAL)


def _differs(what: str, found: np.ndarray, known: np.ndarray, tolerance: float):
    known = np.ravel(known, order="F")
    error = float(np.max(np.abs(np.ravel(found, order="F") - known), initial=0.0))
    if not error <= tolerance * (1.0 + float(np.max(np.abs(known), initial=0.0))):
        yield f"{what} is off by {error:.1e}"

"""What a back end is: one function ``run(problem, settings) -> Answer`` with its capabilities as data.

What it answers is a claim: `optid.solving` measures the point and decides the status.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import is_number, short_repr
from optid.core.form import Form
from optid.errors import StructureError
from optid.program.solution import Status

if TYPE_CHECKING:  # problems import CVXPY, which the list of solvers does not need
    from optid.core.problem import Problem


@dataclass(frozen=True)
class Settings:
    """Requests to a solver, in words that do not depend on the solver."""

    accuracy: float = 1e-8  # requested relative accuracy; every back end translates it into its own tolerances
    time_limit: float | None = None  # seconds, or None
    warm: bool = True  # start from the programme's ``start`` (or the previous solution) where the solver can
    verbose: bool = False  # let the solver print
    options: Mapping[str, Any] = field(default_factory=dict)  # native options, passed through

    def __post_init__(self) -> None:
        if not is_number(self.accuracy) or not 0 < self.accuracy < 1:
            raise StructureError(f"accuracy={short_repr(self.accuracy)}: it must be a number between 0 and 1")
        if self.time_limit is not None and (not is_number(self.time_limit) or not self.time_limit > 0):
            raise StructureError(f"time_limit={short_repr(self.time_limit)}: it must be a positive number of seconds")


@dataclass(frozen=True)
class Answer:
    """A solver's claim."""

    status: Status  # its own status in our words; a claim of success is ``Status.LOCAL`` or ``Status.OPTIMAL``
    word: str  # its own word
    values: Mapping[str, np.ndarray] = field(default_factory=dict)  # {variable: array}, empty without a point
    duals: Mapping[str, np.ndarray] = field(default_factory=dict)  # {constraint: flat multipliers}; may be incomplete
    iterations: int = -1  # -1 where unknown
    # seconds of the call that translated the programme for the solver; nan where they are not measured separately
    compile: float = float("nan")


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a method that closes a duality gap stopped."""

    point: Any  # of the primal problem
    dual: np.ndarray  # of the dual problem, feasible
    value: float  # objective at the point
    bound: float  # value of the dual problem at its point
    iterations: int  # number of them

    @property
    def gap(self) -> float:
        """Duality gap relative to the value."""
        return max(self.value - self.bound, 0.0) / max(self.value, np.finfo(float).tiny)

    def answer(self, allowed: float, values: Mapping[str, np.ndarray], duals: Mapping[str, np.ndarray]) -> Answer:
        """Return the claim that this is the minimum, where the gap is at most the allowed one."""
        status, word = (Status.LOCAL, "duality gap closed") if self.gap <= allowed else (
            Status.LIMIT, f"iteration limit at a relative gap of {self.gap:.1e}")
        return Answer(status, word, values, duals, self.iterations)


@dataclass(frozen=True)
class BackEnd:
    """One solver under one word."""

    name: str  # the word, in lower case
    classes: frozenset[str]  # programme classes it accepts: "LP", "QP", "SOCP", "SDP", "conic", "NLP"
    run: Callable[["Problem", Settings], Answer] = field(repr=False)  # (problem, settings) -> Answer
    installed: bool = True  # whether it can run here
    pip: str = ""  # what to install where it cannot
    form: str = ""  # word of the form of problems that it exploits, whatever their class
    takes: Callable[[Any], Form | None] | None = field(default=None, repr=False)  # problem -> that form, or None
    duals: bool = True  # whether it returns multipliers
    warm: bool = False  # whether it can start from a given point
    # options with which it searches further for a better local optimum, for where the proof fails
    thorough: Mapping[str, Any] = field(default_factory=dict)
    about: str = ""  # one line for the table of solvers
    broken: str = ""  # why its entry point cannot be loaded, "" where it can

    @property
    def accepted(self) -> tuple[str, ...]:
        """Classes and form it accepts, as words."""
        return (*sorted(self.classes), *([self.form] if self.form else []))

    def form_of(self, problem: "Problem") -> Form | None:
        """Return the form of the problem that it exploits, None where it has another."""
        return None if self.takes is None else self.takes(problem)

    def exploits(self, problem: "Problem") -> bool:
        """Whether it accepts the form of the problem, with the user's constraints."""
        form = self.form_of(problem)
        return form is not None and (form.constrained or not problem.constraint_names)

    def refuses(self, problem: "Problem") -> str:
        """Return why this back end cannot take the programme, or an empty string."""
        if self.exploits(problem):
            return ""
        from optid.core.statement import class_of, statement_of

        if self.form_of(problem) is not None:
            names = ", ".join(map(repr, problem.constraint_names))
            return (f"{self.name} takes no further constraints ({names}); use a back end of class {class_of(problem)} "
                    "(clarabel, scs)")
        kind = class_of(problem)
        if kind in self.classes:
            return ""
        if kind == "NLP":
            parts = ", ".join(statement_of(problem).nonconvex_parts())
            return (f"{self.name} solves {', '.join(self.accepted)}; {problem.name!r} is not convex in {parts}. "
                    "Use an NLP back end (gauss_newton, ipopt, uno) or a relaxed formulation")
        return f"{self.name} solves {', '.join(self.accepted)}; {problem.name!r} is of class {kind}"

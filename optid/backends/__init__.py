"""Back ends: the only place that knows a solver.

A back end is one function ``run(program, settings) -> Answer`` with its capabilities as data. It registers in the
entry-point group ``optid.backends``; the target is a `BackEnd` or a function that returns several. What it answers is
a claim: `optid.solve` measures the point and decides the status.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.errors import LookupFailed, SolverMissing, StructureError, nearest
from optid.program.solution import Status

if TYPE_CHECKING:
    from optid.program.program import Program

GROUP = "optid.backends"


@dataclass(frozen=True)
class Settings:
    """What is asked of a solver, in words that do not depend on the solver.

    Attributes:
        accuracy: requested relative accuracy; every back end translates it into its own tolerances.
        time_limit: seconds, or None.
        warm: start from the programme's ``start`` (or the previous solution) where the solver can.
        verbose: let the solver print.
        options: native options, passed through.
    """

    accuracy: float = 1e-8
    time_limit: float | None = None
    warm: bool = True
    verbose: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """A solver's claim.

    Attributes:
        status: its own status in our words; a claim of success is ``Status.LOCAL`` or ``Status.OPTIMAL``.
        word: its own word.
        values: {variable: array}, empty without a point.
        duals: {constraint: flat multipliers}; may be incomplete.
        iterations: -1 where unknown.
        compile: seconds of the call that translated the programme for the solver; nan where they are not told apart.
    """

    status: Status
    word: str
    values: Mapping[str, np.ndarray] = field(default_factory=dict)
    duals: Mapping[str, np.ndarray] = field(default_factory=dict)
    iterations: int = -1
    compile: float = float("nan")


@dataclass(frozen=True)
class BackEnd:
    """One solver under one word.

    Attributes:
        name: the word, in lower case.
        classes: programme classes it accepts: "LP", "QP", "SOCP", "SDP", "conic", "NLP", "rank-one", "nuclear",
            "group-sparse".
        run: (program, settings) -> Answer.
        installed: whether it can run here.
        pip: what to install where it cannot.
        duals: whether it returns multipliers.
        warm: whether it can start from a given point.
        thorough: options with which it searches further for a better local optimum, for where the proof fails.
        about: one line for the table of solvers.
        broken: why its entry point cannot be loaded, "" where it can.
    """

    name: str
    classes: frozenset[str]
    run: Callable[["Program", Settings], Answer] = field(repr=False)
    installed: bool = True
    pip: str = ""
    duals: bool = True
    warm: bool = False
    thorough: Mapping[str, Any] = field(default_factory=dict)
    about: str = ""
    broken: str = ""

    def refuses(self, program: "Program") -> str:
        """Return why this back end cannot take the programme, or an empty string."""
        if program.rank_one is not None and "rank-one" in self.classes:
            return ""
        if program.nuclear is not None and "nuclear" in self.classes:
            names = ", ".join(map(repr, program.user_constraints))
            return "" if not names else (f"{self.name} takes no further constraints ({names}); use an SDP back end "
                                         "(clarabel, scs)")
        if program.group is not None and "group-sparse" in self.classes:
            names = ", ".join(map(repr, program.user_constraints))
            return "" if not names else (f"{self.name} takes no further constraints ({names}); use a conic back end "
                                         "(clarabel, scs)")
        kind = program.kind
        if kind in self.classes:
            return ""
        if kind == "NLP":
            parts = ", ".join(program.nonconvex_parts())
            return (f"{self.name} solves {_listed(self.classes)}; {program.name!r} is not convex in {parts}. "
                    "Use an NLP back end (gauss_newton, ipopt, uno) or a relaxed formulation")
        return f"{self.name} solves {_listed(self.classes)}; {program.name!r} is of class {kind}"


@cache
def back_ends() -> dict[str, BackEnd]:
    """Return every registered back end by name, installed or not."""
    found: dict[str, BackEnd] = {}
    for point in entry_points(group=GROUP):
        try:
            target = point.load()
            several: Iterable[BackEnd] = (target,) if isinstance(target, BackEnd) else tuple(target())
        except Exception as error:  # one broken plug-in must not take the other solvers away
            several = (_broken(point.name, f"{point.value} fails: {type(error).__name__}: {error}"),)
        for back_end in several:
            found[back_end.name] = back_end
    return found


def _broken(name: str, reason: str) -> BackEnd:
    def run(program: "Program", settings: Settings) -> Answer:
        return Answer(Status.FAILED, reason)

    return BackEnd(name, frozenset(), run, installed=False, about="cannot be loaded", broken=reason)


def find(name: str) -> BackEnd:
    """Look a back end up by its word, in any case.

    Raises:
        LookupFailed: unknown word; names the nearest.
        SolverMissing: known but not installed; the message has the pip line.
    """
    known = back_ends()
    back_end = known.get(name.lower())
    if back_end is None:
        raise LookupFailed(f"no solver is called {name!r}. {nearest(name.lower(), known)}")
    if back_end.broken:
        raise SolverMissing(f"solver {back_end.name!r} cannot be loaded: {back_end.broken}")
    if not back_end.installed:
        how = f"pip install {back_end.pip}" if back_end.pip else "it needs its vendor's package and licence"
        raise SolverMissing(f"solver {back_end.name!r} is not installed: {how}")
    return back_end


AUTO: dict[str, tuple[str, ...]] = {
    "rank one": ("gauss_newton",), "nuclear norm": ("admm",), "groups": ("block_descent",),
    "small NLP": ("uno", "ipopt"), "NLP": ("ipopt", "uno"), "convex": ("clarabel", "scs"),
}
"""What `choose` chooses from: of a kind of programme the first that is installed."""


def choose(program: "Program") -> tuple[BackEnd, str]:
    """Choose a back end by class and size of the programme, and say why.

    Raises:
        StructureError: when no installed back end accepts the programme.
    """
    if program.rank_one is not None:
        return find(*AUTO["rank one"]), (
            f"gauss_newton: rank-one least squares with {program.rank_one.problem.root.shape[0]} lifted unknowns"
        )
    if program.nuclear is not None and not program.user_constraints:
        shape = program.nuclear.problem.shape
        return find(*AUTO["nuclear norm"]), f"admm: nuclear norm of a Hankel matrix, {shape} entries"
    if program.group is not None and not program.user_constraints:
        return find(*AUTO["groups"]), f"block_descent: {program.group.problem.weights.size} groups"
    kind = program.kind
    for name in AUTO["convex" if kind != "NLP" else "small NLP" if program.size <= 200 else "NLP"]:
        back_end = back_ends().get(name)
        if back_end is not None and back_end.installed and kind in back_end.classes:
            return back_end, f"{name}: class {kind}, {program.size} unknowns"
    raise StructureError(f"no installed back end accepts a programme of class {kind}; see `optid solvers`")


FALLBACKS = ("daqp", "qoco", "highs", "cvxopt", "ipopt")
"""Convex back ends that take over from one chosen automatically, in this order; IPOPT comes with optid."""


def fallbacks(program: "Program", failed: str) -> Iterator[BackEnd]:
    """Yield the installed back ends that can solve a convex programme in place of one that gave no usable answer."""
    for name in FALLBACKS if program.kind != "NLP" and failed in AUTO["convex"] else ():
        back_end = back_ends().get(name)
        if back_end is not None and back_end.installed and not back_end.refuses(program):
            yield back_end


def _listed(classes: frozenset[str]) -> str:
    return ", ".join(sorted(classes))

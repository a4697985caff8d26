"""The steps of a formulation by name, declared before any work, and which solver takes each.

A formulation says with `steps` what its programmes will be; ``solver=`` is one word for all steps that take it, or
{step: word}. What no step takes is refused here, before the record is looked at.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any

from optid.annotations import check_words
from optid.backends.back_end import BackEnd
from optid.backends.choice import back_ends, find
from optid.core.problem import Problem
from optid.errors import LookupFailed, SolverRefused, nearest
from optid.registry import annotations

Solver = str | BackEnd | Callable[..., Any]
Declaration = Callable[[Mapping[str, Any]], Mapping[str, str]]


def steps(declare: Declaration) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Declare the steps of a formulation as a function of its arguments: {name of its programmes: what they are}.

    What they are is a class of programme and, where special methods use it, the word of their structure, as `optid
    solvers` lists them: "QP linear", "NLP rank-one", "SDP". The step whose objective is that of the fit comes first.
    Words that the annotations of the function do not list are refused before it is called (`StructureError`).
    """
    def mark(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def call(data: Any, **arguments: Any) -> Any:
            check_words(arguments, annotations(function))
            return function(data, **arguments)

        call.steps = declare  # type: ignore[attr-defined]
        return call
    return mark


@dataclass(frozen=True)
class Solvers:
    """Which solver is asked for which step.

    Attributes:
        word: for the steps that take it: a word, "auto", or a solver of the user.
        named: {step: solver}, which every programme of the step must take.
        main: name of the step whose objective is that of the fit, "" where it is not declared.
        skips_main: whether the main step does not take the word.
    """

    word: Solver = "auto"
    named: Mapping[str, Solver] = field(default_factory=dict)
    main: str = ""
    skips_main: bool = False

    def of(self, problem: Problem) -> Solver:
        """Return the solver of a programme: "auto" in a declared step that does not take the word.

        The main step takes it where that was declared; what a constraint makes of it, the solver may still refuse.
        """
        if self.named:
            return self.named.get(problem.name, "auto")
        if not self.main or problem.name == self.main and not self.skips_main or callable(self.word):
            return self.word
        one = find(self.word) if isinstance(self.word, str) and self.word != "auto" else self.word
        return "auto" if isinstance(one, BackEnd) and one.refuses(problem) else self.word


def choose_solvers(name: str, formulation: Callable[..., Any], arguments: Mapping[str, Any], solver: Any) -> Solvers:
    """Read ``solver=``, and refuse what the steps of a formulation do not take.

    Raises:
        LookupFailed: no such solver, or no such step.
        SolverMissing: not installed.
        SolverRefused: no step, or not the named step, takes a solver; names those that do.
    """
    declare = getattr(formulation, "steps", None)
    declared = dict(declare(arguments)) if declare else {}
    main = next(iter(declared), "")
    if isinstance(solver, Mapping):
        if not declared:
            raise SolverRefused(f"{name!r} declares no steps: solver= must be one word for it")
        for step, word in solver.items():
            if step not in declared:
                raise LookupFailed(f"{name!r} has no step {step!r}. {nearest(str(step), declared)}")
            _check(name, word, {step: declared[step]})
        return Solvers("auto", dict(solver), main)
    _check(name, solver, declared)
    skips = bool(main) and isinstance(solver, str) and solver != "auto" and not takes(find(solver), declared[main])
    return Solvers(solver, {}, main, skips)


def takes(solver: BackEnd, step: str) -> bool:
    """Whether a solver can be used for the programmes of a step."""
    return not set(solver.accepted).isdisjoint(step.split())


def takers(step: str) -> tuple[str, ...]:
    """Return the installed solvers that take a step."""
    return tuple(name for name, one in sorted(back_ends().items()) if one.installed and takes(one, step))


def _check(name: str, solver: Any, declared: Mapping[str, str]) -> None:
    """Refuse a word that none of the steps takes."""
    if not isinstance(solver, str) or solver == "auto":
        return
    one = find(solver)
    if declared and not any(takes(one, step) for step in declared.values()):
        who = "; ".join(f"{step!r}{' is not convex and' * ('NLP' in words)} is taken by {', '.join(takers(words))}"
                        for step, words in declared.items())
        what = f"the step {next(iter(declared))!r}" if len(declared) == 1 else "any step"
        raise SolverRefused(f"solver {one.name!r} does not take {what} of {name!r}: {who}")

"""A named constraint that is built when the variables of a formulation exist, and checks of its arguments."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import wraps
from importlib import import_module
from typing import Any, ParamSpec

import numpy as np

from optid.errors import StructureError
from optid.program.limits import name_limits
from optid.program.view import View

P = ParamSpec("P")


@dataclass(frozen=True)
class Rule:
    """What the functions of `formulations.constraints.shape` return, and what ``constraints=[...]`` takes.

    Attributes:
        name: name under which it is reported.
        build: view -> CVXPY constraint, or `optid.program.limits.Limit` where its bound needs words, or a list of them.
        verify: model -> what is wrong with it, "" where it obeys; for statements that the constraint itself only
            approximates.
        about: what it restricts, "poles" or "coefficients": a procedure of several steps hands it to the steps that
            choose these.
        stand_in: {argument: value} of a formulation -> by what it replaces a condition that is not convex, such as "its
            tangent": a proof would be one for that; "" where it is the condition itself.
        depth: complex numbers -> by how much poles there obey it, negative where they do not; None for other rules.
        matrix: whether it is a matrix inequality in a state-space model.
        call: module, name and arguments of the function that returned it, from which a pickled rule is built again.
    """

    name: str
    build: Callable[[View], Any]
    verify: Callable[[Any], str] | None = None
    about: frozenset[str] = frozenset({"coefficients"})
    stand_in: Callable[[Mapping[str, Any]], str] | None = None
    depth: Callable[[np.ndarray], float] | None = None
    matrix: bool = False
    call: tuple[str, str, tuple[Any, ...], Mapping[str, Any]] | None = field(default=None, repr=False, compare=False)

    def __reduce__(self) -> Any:
        return super().__reduce__() if self.call is None else (_built_again, (*self.call, self.name))

    def __call__(self, view: View) -> dict[str, Any]:
        """Build the constraint in the variables of a formulation."""
        return {self.name: self.build(view)}

    def members(self, view: View) -> list[Any]:
        """Return its CVXPY constraints alone."""
        return [limit.member for limits in name_limits(self(view), "").values() for limit in limits]

    def with_name(self, name: str) -> "Rule":
        """Return the same constraint under another name, for two of a kind."""
        return replace(self, name=name)


def record_arguments(function: Callable[P, Rule]) -> Callable[P, Rule]:
    """Let the rules of a function remember its arguments, so that they can be pickled."""

    @wraps(function)
    def build(*args: P.args, **kwargs: P.kwargs) -> Rule:
        return replace(function(*args, **kwargs), call=(function.__module__, function.__name__, args, kwargs))

    return build


def _built_again(module: str, function: str, args: tuple[Any, ...], kwargs: Mapping[str, Any], name: str) -> Rule:
    return getattr(import_module(module), function)(*args, **kwargs).with_name(name)


def label(word: str, *names: str | None) -> str:
    """Return the name of a rule about the named channel and output."""
    given = [name for name in names if name is not None]
    return f"{word}[{','.join(given)}]" if given else word


def sign_of(argument: str, word: str, positive: str, negative: str) -> float:
    """Return 1 or -1 for two words; refuse others (`StructureError`)."""
    if word not in (positive, negative):
        raise StructureError(f"the {argument} must be {positive!r} or {negative!r}; got {word!r}")
    return 1.0 if word == positive else -1.0


def check_bounds(word: str, low: Any, high: Any, *, apart: bool = False) -> None:
    """Refuse missing, infinite or crossing bounds, and equal ones where they must lie apart (`StructureError`)."""
    if low is None and high is None:
        raise StructureError(f"{word} needs low= and/or high=")
    for bound in (low, high):
        try:
            finite = bound is None or np.isfinite(np.asarray(bound, dtype=float)).all()
        except (TypeError, ValueError):
            finite = False
        if not finite:
            raise StructureError(f"{word} needs finite numbers; got {bound!r}. Leave out a bound that does not hold")
    if low is not None and high is not None and (np.any(low > high) or apart and not low < high):
        raise StructureError(f"{word} needs low {'<' if apart else '<='} high; got {low!r}, {high!r}")

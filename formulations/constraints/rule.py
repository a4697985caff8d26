"""A named constraint that is built when the variables of a formulation exist, and checks of its arguments."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.errors import StructureError
from optid.program.view import View


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
    """

    name: str
    build: Callable[[View], Any]
    verify: Callable[[Any], str] | None = None
    about: frozenset[str] = frozenset({"coefficients"})

    def __call__(self, view: View) -> dict[str, Any]:
        """Build the constraint in the variables of a formulation."""
        return {self.name: self.build(view)}

    def named(self, name: str) -> "Rule":
        """Return the same constraint under another name, for two of a kind."""
        return replace(self, name=name)


def label(word: str, *names: str | None) -> str:
    """Return the name of a rule about the named channel and output."""
    given = [name for name in names if name is not None]
    return f"{word}[{','.join(given)}]" if given else word


def sign_of(argument: str, word: str, positive: str, negative: str) -> float:
    """Return 1 or -1 for two words; refuse others (`StructureError`)."""
    if word not in (positive, negative):
        raise StructureError(f"the {argument} is {positive!r} or {negative!r}; got {word!r}")
    return 1.0 if word == positive else -1.0


def check_bounds(word: str, low: Any, high: Any, *, apart: bool = False) -> None:
    """Refuse missing or crossing bounds, and equal ones where they must lie apart (`StructureError`)."""
    if low is None and high is None:
        raise StructureError(f"{word} needs low= and/or high=")
    if low is not None and high is not None and (np.any(low > high) or apart and not low < high):
        raise StructureError(f"{word} needs low {'<' if apart else '<='} high; got {low!r}, {high!r}")

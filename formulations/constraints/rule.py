"""A named constraint that is built when the variables of a formulation exist."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

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

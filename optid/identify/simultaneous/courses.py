"""A model by the courses of its runs: the states that follow one another, and what else they determine at a sample.

With the courses as unknowns a fit is one sparse programme whatever the model (multiple shooting with one sample between
the nodes, Bock 1981); the model gives its step function here, in CVXPY expressions of named unknowns.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.errors import StructureError
from optid.identify.prediction_error.criterion import Criterion

Expressions = Mapping[str, Any]  # of unknowns, courses, and what constraints may also use
Formula = Callable[[Expressions], Any]


class Reading(NamedTuple):
    """Measured outputs: their errors are ``‖weights course - measured‖²``, the course column by column."""

    course: str
    weights: Any  # sparse
    measured: Array


@dataclass(frozen=True, eq=False)
class Courses(ABC):
    """The courses of all experiments; names of those of a record of several end in their labels."""

    criterion: Criterion  # the errors of a run, whose unknowns are those of the model
    determined: ClassVar[bool] = True  # whether unknowns of the model determine all courses

    @abstractmethod
    def readings(self, i: int) -> Iterator[Reading]:
        """Yield what is measured of the courses of an experiment."""

    @abstractmethod
    def following(self, i: int, v: Expressions) -> dict[str, list[Any]]:
        """Return the constraints that make states of an experiment follow one another, by name."""

    @abstractmethod
    def formulas(self, i: int) -> dict[str, Formula]:
        """Return what other courses of an experiment are equal to, in an order in which they can be computed."""

    def further(self, v: Expressions, x: Values) -> dict[str, Any]:
        """Return what constraints may use besides unknowns and courses."""
        return {}

    def confining(self, v: Expressions) -> dict[str, Any]:
        """Return restrictions of the unknowns that are no equations of a run."""
        return {}

    def limits(self, start: Values) -> dict[str, tuple[Array, Array]]:
        """Return the least and largest values of courses."""
        return {}

    def complete(self, start: Values) -> dict[str, Array]:
        """Return the values of unknowns and states with those of all other courses."""
        found = dict(start)
        v: dict[str, Any] = {name: cp.Constant(value) for name, value in start.items()}
        v |= self.further(v, start)
        for i in range(len(self.criterion.labels)):
            for name, formula in self.formulas(i).items():
                found[name] = np.asarray(formula(v).value)
                v[name] = cp.Constant(found[name])
        return found

    @property
    def compressed(self) -> Any:
        """The compressed record for intervals, None where there are none."""
        return None


# (name, courses, start, constraints) -> the problem
Pose = Callable[[str, Courses, Values, Sequence[Any]], Problem]


def check_size(count: int, most: int, remedy: str, what: str = "samples") -> None:
    """Refuse a record whose programme would take minutes (`StructureError`)."""
    if count > most:
        raise StructureError(f"{count} {what}: with the courses of a run as unknowns this formulation takes up to "
                             f"{most}. Use {remedy}")

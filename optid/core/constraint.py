"""Constraints of the user, read once into rows on the leaves of a problem.

A builder gets the leaves as CVXPY variables, in the units of the record, and returns CVXPY constraints. Affine ones
become ``g = rows y - right`` with g = 0, g <= 0 or, square, -g positive semidefinite; y are all leaves one after
another. What is not affine in the leaves stays a CVXPY constraint and is measured there. A builder that looked at
values of an iterate is *moving*: it is read again at every iterate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from cvxpy.constraints.constraint import Constraint as Member
from cvxpy.constraints.psd import PSD

from optid.arrays import Array
from optid.core.leaves import LeafSpace
from optid.core.terms import Values
from optid.errors import StructureError
from optid.program.expressions import affine_parts, flat_value, jacobians, side_by_side
from optid.program.limits import EQUALITIES, Limit, rows_of
from optid.program.program import named
from optid.program.view import View

NEGLIGIBLE = 64 * float(np.finfo(float).eps)  # share of its constant beneath which a row has no size of its own


@dataclass(frozen=True, eq=False)
class Constraint:
    """One CVXPY constraint of a named group.

    Attributes:
        name: of the group.
        limit: the constraint as the user wrote it, its bound, and what its rows were divided by.
        cone: "zero", "below", "psd", or "other" where CVXPY alone measures it.
        rows: (m, leaves), but for a matrix divided by their sizes; zeros where the cone is "other".
        right: (m,).
        moving: whether its builder looked at values of an iterate.
        builder: position of its builder.
        position: of it in its group.
        first: its first row among those of its group.
    """

    name: str
    limit: Limit
    cone: str
    rows: Array
    right: Array
    moving: bool
    builder: int
    position: int = 0
    first: int = 0

    def __len__(self) -> int:
        return len(self.right)

    @property
    def span(self) -> slice:
        """Its place in the flat multipliers of its group."""
        return slice(self.first, self.first + len(self))

    @property
    def sizes(self) -> Array:
        """What the rows were divided by (m,)."""
        return np.broadcast_to(self.limit.sizes, (len(self),))

    def refuse_nonconvex(self, problem: str) -> None:
        """Raise a `StructureError` where it is not convex in the leaves, as that of a convex problem must be."""
        if self.cone == "other" and not self.limit.member.is_dcp():
            raise StructureError(
                f"constraint {self.name!r} is not convex, and {problem!r} is a convex formulation: "
                f"{self.limit.member}. State it in the named variables of the relaxation or use an exact formulation.")

    def leaves(self, space: LeafSpace) -> frozenset[str]:
        """Return the names of the leaves that it speaks about."""
        if self.cone != "other":
            return frozenset(name for name, place in space.places.items() if self.rows[:, place].any())
        names: dict[int, str] = {variable.id: name for name, variable in space.variables.items()}
        return frozenset(names.get(variable.id, "an auxiliary variable") for variable in self.limit.member.variables())

    def residual(self, space: LeafSpace, y: Values) -> Array:
        """Return g (m,) at values of the leaves: vec(-M) of a matrix M that must be definite."""
        if self.cone != "other":
            return self.rows @ space.vector(y) - self.right
        space.assign(y)
        expression = rows_of(self.limit.member)
        return np.atleast_1d(self.limit.member.violation()).ravel() if expression is None else flat_value(expression)

    def slope(self, space: LeafSpace, y: Values) -> Array:
        """Return the derivative (m, leaves) of g at values of the leaves; NaN where CVXPY knows none."""
        if self.cone != "other":
            return self.rows
        space.assign(y)
        expression = rows_of(self.limit.member)
        parts = None if expression is None else jacobians(expression)
        if parts is None:
            return np.full((len(self), space.size), np.nan)
        return np.asarray(side_by_side(parts, space.variables.values(), len(self)))

    def violation(self, space: LeafSpace, y: Values) -> float:
        """Return the sum of the violations of its rows, or the largest one of a matrix."""
        g = self.residual(space, y)
        if self.cone == "zero":
            return float(np.sum(np.abs(g)))
        if self.cone == "psd":
            return largest_eigenvalue(g)
        return float(np.sum(np.maximum(g, 0.0)))


def join_by_name(constraints: Sequence[Constraint], parts: Sequence[Array]) -> dict[str, Array]:
    """Join the multipliers of the members of every group, in the order in which these were stated."""
    found: dict[str, list[tuple[int, Array]]] = {}
    for one, part in zip(constraints, parts):
        found.setdefault(one.name, []).append((one.position, part))
    return {name: np.concatenate([part for _, part in sorted(several, key=lambda pair: pair[0])])
            for name, several in found.items()}


def largest_eigenvalue(vector: Array) -> float:
    """Return that of the symmetric part of a square matrix that is flat, not below zero; NaN where an entry is NaN."""
    return max(0.0, float(np.linalg.eigvalsh(symmetric_part(vector))[-1])) if np.all(np.isfinite(vector)) else np.nan


def symmetric_part(vector: Array) -> Array:
    """Return the symmetric part of a square matrix that is flat."""
    n = round(vector.size**0.5)
    matrix = vector.reshape(n, n, order="F")
    return (matrix + matrix.T) / 2


class Reference(dict[str, Array]):
    """The point about which a constraint is built; `asked` says whether a value of it was read."""

    asked = False

    def __getitem__(self, key: str) -> Array:
        self.asked = True
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return a value."""
        self.asked = True
        return super().get(key, default)


class _NotingView(View):
    """A view that notes which expressions a constraint asks for."""

    asked: set[str]

    def __getitem__(self, name: str) -> Any:
        self.asked.add(name)
        return super().__getitem__(name)


@dataclass(frozen=True, eq=False)
class ConstraintReader:
    """Reads builders in the words of one problem.

    Attributes:
        problem: its name, for messages.
        space: its leaves.
        facts: keyword arguments of the `View`.
        convex: whether a constraint that is not convex is refused.
        about: names of further expressions that depend on the point about which constraints are read.
    """

    problem: str
    space: LeafSpace
    facts: Mapping[str, Any]
    convex: bool
    about: frozenset[str] = frozenset()

    def read(self, builders: Sequence[Any], about: Values, further: Mapping[str, Any], only: set[int] | None = None
             ) -> list[Constraint]:
        """Read builders about a point, all or some by their positions.

        Args:
            builders: callables of the `View`, or what they would return.
            about: the reference, where the facts have none.
            further: expressions besides the leaves.
            only: positions.

        Raises:
            StructureError: an unknown variable, a name used twice, a constraint that is not convex but has to be.
        """
        reference = Reference(self.facts.get("reference", about))
        shown = {name: one for name, one in {**self.space.variables, **further}.items() if one is not None}
        view = _NotingView(shown, **{**self.facts, "reference": reference})
        found: list[Constraint] = []
        for number, builder in enumerate(builders):
            if only is not None and number not in only:
                continue
            reference.asked, view.asked = False, set()
            default = getattr(builder, "name", None) or f"constraint {number + 1}"
            built = named(builder(view) if callable(builder) else builder, default)
            moving = reference.asked and "reference" not in self.facts or bool(view.asked & self.about)
            for name, limits in built.items():
                if any(one.name == name and one.builder != number for one in found):
                    raise StructureError(f"there are two constraints named {name!r}; give each its own name")
                first = 0
                # a straight line has no curvature
                for position, limit in enumerate(limit for limit in limits if limit.member.size):
                    one = replace(self._rows(view, name, limit, moving, number), position=position, first=first)
                    if self.convex:
                        one.refuse_nonconvex(self.problem)
                    found.append(one)
                    first += len(one)
        return found

    def _rows(self, view: View, name: str, limit: Limit, moving: bool, number: int) -> Constraint:
        """Return one member as rows on the leaves, where it is affine in them."""
        member, leaves = limit.member, {variable.id: leaf for leaf, variable in self.space.variables.items()}
        foreign = sorted({v.name() for v in member.variables() if v.id not in leaves and not view.owns(v)})
        if foreign:
            raise StructureError(f"constraint {name!r} uses {', '.join(foreign)}, which is not a variable of "
                                 f"{self.problem!r} ({', '.join(self.space.variables)})")
        expression, cone = _in_cone(member)
        parts = None if expression is None else affine_parts(expression)
        if parts is None or any(variable.id not in leaves for variable in parts[0]):
            count = sum(dual.size for dual in member.dual_variables)
            return Constraint(name, limit, "other", np.zeros((count, self.space.size)), np.zeros(count), moving, number)
        rows, right = np.zeros((parts[1].size, self.space.size)), -parts[1]
        for variable, part in parts[0].items():
            rows[:, self.space.places[leaves[variable.id]]] = part.toarray() if hasattr(part, "toarray") else part
        if cone == "psd":
            return Constraint(name, limit, cone, rows, right, moving, number)
        sizes = np.abs(rows) @ self.space.entry_sizes  # no solver sees the units in which a row was written
        sizes = np.where(sizes > NEGLIGIBLE * np.abs(right), sizes, 1.0)
        return Constraint(name, replace(limit, sizes=sizes), cone, rows / sizes[:, None], right / sizes, moving, number)


def _in_cone(member: Member) -> tuple[Any, str]:
    """Return what a member holds in a cone, and the cone; None for a cone that is not read."""
    if isinstance(member, PSD):
        return -member.args[0], "psd"
    return rows_of(member), "zero" if isinstance(member, EQUALITIES) else "below"

"""Constraints of the user, read once into rows on the leaves of a problem.

A builder gets the leaves as CVXPY variables, in the units of the record, and returns CVXPY constraints. Affine ones
become ``g = rows y - right`` with g = 0, g <= 0 or, square, -g positive semidefinite; y are all leaves one after
another. What is not affine in the leaves stays a CVXPY constraint and is measured there. A builder that looked at
values of an iterate is *moving*: it is read again at every iterate.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from cvxpy.constraints.constraint import Constraint as Member
from cvxpy.constraints.psd import PSD

from optid.arrays import Array
from optid.core.leaves import LeafSpace
from optid.core.terms import Values
from optid.errors import StructureError
from optid.program.expressions import affine_parts, flat_value, has_kinks, jacobians, row_sizes
from optid.program.limits import EQUALITIES, Limit, name_limits, rows_of
from optid.program.view import View

NEGLIGIBLE = 64 * float(np.finfo(float).eps)  # share of its constant beneath which a row has no size of its own


@dataclass(frozen=True, eq=False)
class Constraint:
    """One CVXPY constraint of a named group.

    Attributes:
        name: of the group.
        limit: the constraint as the user wrote it, its bound, and what its rows were divided by.
        cone: "zero", "below", "psd", or "other" where CVXPY alone measures it.
        rows: (m, leaves), those of the user but for a matrix divided by their sizes; sparse where there are many,
            without entries where the cone is "other".
        right: (m,).
        expression: of an "other" one what it holds at zero or not above it; None for a cone that is not read.
        moving: whether its builder looked at values of an iterate.
        builder: position of its builder.
        first: its first row among those of its group.
    """

    name: str
    limit: Limit
    cone: str
    rows: Any
    right: Array
    moving: bool = False
    builder: int = 0
    first: int = 0
    expression: Any = None

    def __len__(self) -> int:
        return len(self.right)

    @property
    def is_equality(self) -> bool:
        """Whether its rows are zero."""
        return isinstance(self.limit.member, EQUALITIES)

    @cached_property
    def is_smooth(self) -> bool:
        """Whether it has a slope everywhere: no cone that is not read, no atom with a kink."""
        return self.cone != "other" or self.expression is not None and not has_kinks(self.expression)

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
            return frozenset(name for name, place in space.places.items() if abs(self.rows[:, place]).sum() > 0)
        names: dict[int, str] = {variable.id: name for name, variable in space.variables.items()}
        return frozenset(names.get(variable.id, "an auxiliary variable") for variable in self.limit.member.variables())

    def residual(self, space: LeafSpace, y: Values) -> Array:
        """Return g (m,) at values of the leaves: vec(-M) of a matrix M that must be definite."""
        if self.cone != "other":
            return self.rows @ space.vector(y) - self.right
        space.assign(y)
        if self.expression is None:
            return np.full(len(self), float(np.max(np.asarray(self.limit.member.violation()), initial=0.0)))
        return flat_value(self.expression) / self.sizes

    def slope(self, space: LeafSpace, y: Values) -> Any:
        """Return the derivative (m, leaves) of g at values of the leaves; NaN where CVXPY knows none."""
        if self.cone != "other":
            return self.rows
        space.assign(y)
        parts = None if self.expression is None else jacobians(self.expression)
        if parts is None:
            return np.full((len(self), space.size), np.nan)
        names = {variable.id: name for name, variable in space.variables.items()}
        return space.rows({names[one.id]: sp.diags_array(1 / self.sizes) @ part for one, part in parts.items()
                           if one.id in names}, len(self))

    def violations(self, g: Array) -> Array:
        """Return how far every row is violated at the value g (m,); of a matrix one number, NaN where not finite."""
        if self.cone == "psd":
            finite = np.all(np.isfinite(g))
            return np.array([max(0.0, float(np.linalg.eigvalsh(symmetric_part(g))[-1])) if finite else np.nan])
        return np.abs(g) if self.is_equality else np.maximum(g, 0.0)

    def violation(self, space: LeafSpace, y: Values) -> float:
        """Return the sum of the violations at values of the leaves."""
        return float(np.sum(self.violations(self.residual(space, y))))


def join_by_name(constraints: Sequence[Constraint], parts: Sequence[Array]) -> dict[str, Array]:
    """Join the multipliers of the members of every group, in the order in which these were stated."""
    found: dict[str, list[tuple[int, Array]]] = {}
    for one, part in zip(constraints, parts):
        found.setdefault(one.name, []).append((one.first, part))
    return {name: np.concatenate([part for _, part in sorted(several, key=lambda pair: pair[0])])
            for name, several in found.items()}


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


def read_constraints(problem: Any, x: Values, only: Collection[int] | None = None) -> list[Constraint]:
    """Read the builders of a problem, its own before those of the user, about a point; all or some by their positions.

    Raises:
        StructureError: an unknown variable, a name used twice, a constraint that is not convex but has to be.
    """
    own, reference = len(problem.restrictions), Reference(problem.facts.get("reference", x))
    view = View(problem.expressions(problem.space.variables, x), **{**problem.facts, "reference": reference})
    found: list[Constraint] = []
    convex = problem.has_convex_terms
    for number, builder in enumerate((*problem.restrictions, *problem.builders)):
        if only is not None and number not in only:
            continue
        reference.asked = False
        default = getattr(builder, "name", None) or f"constraint {number - own + 1}"
        built = name_limits(builder(view) if callable(builder) else builder, default)
        moving = view.was_asked(problem.about) or reference.asked and "reference" not in problem.facts
        for name, limits in built.items():
            if any(one.name == name and one.builder != number for one in found):
                raise StructureError(f"there are two constraints named {name!r}; give each its own name")
            first = 0
            for limit in limits:
                if not limit.member.size:  # a straight line has no curvature
                    continue
                one = replace(_read(problem, view, name, limit, number < own), moving=moving, builder=number,
                              first=first)
                if number < own:
                    convex = convex and (one.cone != "other" or limit.member.is_dcp())
                elif convex:
                    one.refuse_nonconvex(problem.name)
                found.append(one)
                first += len(one)
    return found


def _read(problem: Any, view: View, name: str, limit: Limit, own: bool) -> Constraint:
    """Return one member as rows on the leaves, where it is affine in them.

    Those of the user are divided by their sizes; those of the formulation stay as it has written them.
    """
    member, space = limit.member, problem.space
    leaves = {variable.id: leaf for leaf, variable in space.variables.items()}
    foreign = sorted({v.name() for v in member.variables() if v.id not in leaves and not view.owns(v)})
    if foreign:
        raise StructureError(f"constraint {name!r} uses {', '.join(foreign)}, which is not a variable of "
                             f"{problem.name!r} ({', '.join(space.variables)})")
    expression, cone = _in_cone(member)
    parts = None if expression is None else affine_parts(expression)
    if parts is None or any(variable.id not in leaves for variable in parts[0]):
        count = sum(dual.size for dual in member.dual_variables)
        if expression is not None and cone != "psd" and not own:
            limit = replace(limit, sizes=row_sizes(expression, {
                space.variables[leaf].id: size for leaf, size in space.usual_sizes.items()}))
        return Constraint(name, limit, "other", space.rows({}, count), np.zeros(count),
                          expression=expression if cone != "psd" else None)
    rows, right = space.rows({leaves[variable.id]: part for variable, part in parts[0].items()}, parts[1].size
                             ), -parts[1]
    if cone == "psd" or own:
        return Constraint(name, limit, cone, rows, right)
    sizes = abs(rows) @ space.entry_sizes  # no solver sees the units in which a row was written
    sizes = np.where(sizes > NEGLIGIBLE * np.abs(right), sizes, 1.0)
    rows = rows / sizes[:, None] if isinstance(rows, np.ndarray) else sp.diags_array(1 / sizes) @ rows
    return Constraint(name, replace(limit, sizes=sizes), cone, rows, right / sizes)


def _in_cone(member: Member) -> tuple[Any, str]:
    """Return what a member holds in a cone, and the cone; None for a cone that is not read."""
    if isinstance(member, PSD):
        return -member.args[0], "psd"
    return rows_of(member), "zero" if isinstance(member, EQUALITIES) else "below"

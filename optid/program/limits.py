"""The bound of a user's constraint: the rows that move with it, their rates, and a small step of it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.nonpos import Inequality, NonNeg, NonPos
from cvxpy.constraints.second_order import SOC
from cvxpy.constraints.zero import Equality, Zero

from optid.errors import StructureError
from optid.program.expressions import flat_value

EQUALITIES = Equality | Zero
INEQUALITIES = Inequality | NonPos


def rows_of(member: Constraint) -> cp.Expression | None:
    """Return what an equality holds at zero and an inequality not above it; None for a cone."""
    if isinstance(member, EQUALITIES | INEQUALITIES):
        return member.expr
    return -member.args[0] if isinstance(member, NonNeg) else None


@dataclass(frozen=True, eq=False)
class Limit:
    """One CVXPY constraint of a user with its bound.

    The rows read ``row <= shift * t`` (``row = shift * t``) once the bound has moved by t.
    """

    member: Constraint  # the constraint as the user wrote it
    # by how much every row moves per unit of the bound: a number or an expression; for a cone an array or an
    # expression, or a number where that is not known
    shift: Any = 1.0
    bound: str | None = ""  # name of the bound; rows of one name move together. None: each row has its own bound
    # (rows, entries) for an equality that stands for ``|rows @ x| <= t`` with t = 0: the rows
    band: np.ndarray | None = None
    # (independent rows, entries) the equalities that the constraint imposes in their place
    span: np.ndarray | None = None
    # returns what 1 % is in units of the bound, at the assigned point; None takes the size of its terms
    step: Callable[[], float] | None = None
    words: str = ""  # what the step is 1 % of
    # what the rows, flat, were divided by in the programme
    sizes: np.ndarray = field(default_factory=lambda: np.ones(1))

    @classmethod
    def of(cls, member: Constraint) -> "Limit":
        """Read the bound of a constraint off its sides: a number is one bound, an array one for every row."""
        sides = [side for side in member.args if side.is_constant()]
        shared = isinstance(member, EQUALITIES | INEQUALITIES) and any(side.size == 1 for side in sides)
        return cls(member, bound="" if shared else None)

    def impose(self, sizes: np.ndarray) -> Constraint:
        """Return the constraint with its rows divided by sizes; a cone as it is."""
        rows = rows_of(self.member)
        if rows is None or np.all(sizes == 1.0):
            return self.member
        if rows.size > 1:
            scaled = cp.multiply(np.reshape(1 / np.broadcast_to(sizes, (rows.size,)), rows.shape, order="F"), rows)
        else:
            scaled = 1 / sizes.item() * rows
        return scaled == 0 if isinstance(self.member, EQUALITIES) else scaled <= 0

    def speeds(self) -> np.ndarray:
        """Return the shift of every row at the assigned point, flat."""
        shift = flat_value(self.shift) if isinstance(self.shift, cp.Expression) else np.atleast_1d(self.shift)
        return np.broadcast_to(shift, (self.member.size,))


def name_limits(built: Any, default: str) -> dict[str, tuple[Limit, ...]]:
    """Bring what a builder returned, CVXPY constraints or `Limit` objects, into the form {name: (limit, ...)}.

    It returns one of them, a list, or a dictionary of either; the default is the name where it gave none.

    Raises:
        StructureError: when something in it is not a CVXPY constraint.
    """
    if isinstance(built, Mapping):
        groups = {str(name): item for name, item in built.items()}
    elif isinstance(built, list | tuple):
        groups = {default if len(built) == 1 else f"{default}[{i}]": item for i, item in enumerate(built)}
    else:
        groups = {default: built}
    return {name: tuple(_limit(name, one) for one in (item if isinstance(item, list | tuple) else [item]))
            for name, item in groups.items()}


def _limit(name: str, member: Any) -> Limit:
    if not isinstance(member, Constraint | Limit):
        raise StructureError(
            f"constraint {name!r} is a {type(member).__name__}, not a CVXPY constraint such as v['a'][0] <= -1")
    if isinstance(member, SOC):  # in rows, with one multiplier each
        member = cp.norm(member.args[1], 2, axis=None if member.args[1].ndim < 2 else member.axis) <= member.args[0]
    return member if isinstance(member, Limit) else Limit.of(member)

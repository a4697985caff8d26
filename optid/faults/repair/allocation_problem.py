"""What is left of a plant to control: linear dynamics in v = f(u), bounds of v, and what the actuators share."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError

if TYPE_CHECKING:
    from optid.models import HammersteinSS

DEAD_HALF = 1.0
"""Half range that an actuator without one is given where something is divided by it."""


@dataclass(frozen=True, eq=False)
class Member:
    """x+ = A x + B v + d, y = C x + D v + c.

    Attributes:
        A: (n, n), output injection included.
        B: (n, r).
        C: (l, n).
        D: (l, r).
        d: (n,).
        c: (l,).
    """

    A: Array
    B: Array
    C: Array
    D: Array
    d: Array
    c: Array

    @classmethod
    def of(cls, model: "HammersteinSS", gains: Array | None = None, constants: Array | None = None) -> "Member":
        """Take a model, with v replaced by gains v + constants where some of the actuators are broken.

        Raises:
            StructureError: nonlinear feedback, with which the plant is not linear in v.
        """
        if model.feedback:
            raise StructureError(
                "The model has nonlinear feedback: it is not linear in f(u). Use the route 'nlp', which needs no such "
                "structure."
            )
        gains = np.ones(model.B.shape[1]) if gains is None else gains
        constants = np.zeros(model.B.shape[1]) if constants is None else constants
        A, B = model.A + model.L @ model.C, model.B + model.L @ model.D
        d = model.offset_x + model.L @ model.offset_y + B @ constants
        return cls(A, B * gains, model.C, model.D * gains, d, model.offset_y + model.D @ constants)

    def rest_state(self, v: Array) -> Array:
        """Return the state (n,) that rests at v, the nearest where a pole is at 1."""
        rest: Any = np.linalg.lstsq(np.eye(len(self.A)) - self.A, self.B @ v + self.d, rcond=None)[0]
        return rest

    def rest_output(self, v: Array) -> Array:
        """Return the outputs (l,) at rest at v."""
        return np.asarray(self.C @ self.rest_state(v) + self.D @ v + self.c)

    def gain(self) -> Array:
        """Return the static gain (l, r)."""
        return np.asarray(self.C @ np.linalg.lstsq(np.eye(len(self.A)) - self.A, self.B, rcond=None)[0] + self.D)


@dataclass(frozen=True, eq=False)
class AllocationProblem:
    """Numbers of a re-allocation.

    Attributes:
        members: the plant; several where it is not known what is broken.
        low: (r,) least v.
        high: (r,) largest v.
        names: names of the actuators, one per column.
        outputs: names of the outputs.
        weights: (l,) of the outputs.
        norm: (k, r) matrix S of ‖S v‖ <= limit; None for none.
        limit: of the norm.
    """

    members: tuple[Member, ...]
    low: Array
    high: Array
    names: tuple[str, ...]
    outputs: tuple[str, ...]
    weights: Array
    norm: Array | None = None
    limit: float = np.inf
    roots: dict[int, Array] = field(default_factory=dict, repr=False)

    @property
    def columns(self) -> int:
        """Number of columns of v."""
        return self.low.size

    @property
    def middle(self) -> Array:
        """(r,) middle of the ranges."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> Array:
        """(r,) half of the ranges; one for an actuator that does not move."""
        half = (self.high - self.low) / 2
        return np.where(half > 0, half, DEAD_HALF)

    @cached_property
    def scale(self) -> float:
        """Weighted square of what one actuator can do at most to the outputs at rest."""
        reach = np.abs(self.weights[:, None] * self.members[0].gain()) * self.half
        return float(np.max(np.sum(reach**2, axis=0), initial=0.0)) or 1.0

    def tie(self, reference: Array) -> float:
        """Scale of the cost of a target."""
        return self.scale

    def rest(self) -> tuple[Array, Array]:
        """Return state and outputs of the first member at rest in the middle of the ranges."""
        return self.members[0].rest_state(self.middle), self.members[0].rest_output(self.middle)

    def terminal_root(self, number: int) -> Array:
        """Return T with T'T the cost from the end of the horizon on at v at rest, (n, n).

        The cost to go of a stable plant whose v rests; the slowest weight that is finite otherwise: of the plant held
        by its optimal feedback.
        """
        if number not in self.roots:
            from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

            member = self.members[number]
            weighted = self.weights[:, None] * member.C
            if np.max(np.abs(np.linalg.eigvals(member.A)), initial=0.0) < 1 - 1e-9:
                P = solve_discrete_lyapunov(member.A.T, weighted.T @ weighted)
            else:
                R = self.scale * np.diag(1 / self.half**2)
                P = solve_discrete_are(member.A, member.B, weighted.T @ weighted + 1e-9 * np.eye(len(member.A)), R)
            sizes, axes = np.linalg.eigh((P + P.T) / 2)
            self.roots[number] = np.sqrt(np.maximum(sizes, 0.0))[:, None] * axes.T
        return self.roots[number]

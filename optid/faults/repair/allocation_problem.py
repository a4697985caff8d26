"""The plant of a re-allocation: linear dynamics in v = f(u), bounds of v, and a limit shared by the actuators."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.faults.repair.inversion import Inverse

if TYPE_CHECKING:
    from optid.models import HammersteinSS
    from optid.models.nonlinearity import Nonlinearity


@dataclass(frozen=True, eq=False)
class Member:
    """x+ = A x + B v + d, y = C x + D v + c; nonlinear feedback g(y) is a further column of v."""

    A: Array  # (n, n), output injection included
    B: Array  # (n, r)
    C: Array  # (l, n)
    D: Array  # (l, r)
    d: Array  # (n,)
    c: Array  # (l,)

    @classmethod
    def of(cls, model: "HammersteinSS", gains: Any = 1.0, constants: Any = 0.0, added: Any = 0.0) -> "Member":
        """Return the member of a model, with gains v + constants in place of v and a load added to its states."""
        constants = np.broadcast_to(constants, model.B.shape[1])
        A, B = model.A + model.L @ model.C, model.B + model.L @ model.D
        d = model.offset_x + model.L @ model.offset_y + B @ constants + added
        D = np.hstack([model.D * gains, np.zeros((model.l, len(model.feedback)))])
        return cls(A, np.hstack([B * gains, model.E]), model.C, D, d, model.offset_y + model.D @ constants)

    def rest_state(self, v: Array) -> Array:
        """Return the steady state (n,) at v, by least squares where a pole is at 1."""
        rest: Any = np.linalg.lstsq(np.eye(len(self.A)) - self.A, self.B @ v + self.d, rcond=None)[0]
        return rest

    def rest_output(self, v: Array) -> Array:
        """Return the steady outputs (l,) at v."""
        return np.asarray(self.C @ self.rest_state(v) + self.D @ v + self.c)

    def gain(self) -> Array:
        """Return the static gain (l, r)."""
        return np.asarray(self.C @ np.linalg.lstsq(np.eye(len(self.A)) - self.A, self.B, rcond=None)[0] + self.D)


@dataclass(frozen=True, eq=False)
class AllocationProblem:
    """Numbers of a re-allocation of r columns v = f(u) and m inputs u."""

    members: tuple[Member, ...]  # the plant; several where the damage is ambiguous
    low: Array  # (r,) least v
    high: Array  # (r,) largest v
    names: tuple[str, ...]  # of the actuators, one per column
    outputs: tuple[str, ...]  # names of the outputs
    weights: Array  # (l,) of the outputs
    norm: Array | None  # (k, r) matrix S of ‖S v‖ <= limit; None for none
    limit: float  # of the norm
    inverses: tuple[Inverse, ...]  # (r) f and f^-1
    input_of: tuple[int, ...]  # the input of every column
    inputs: tuple[str, ...]  # names of the inputs
    u_low: Array  # (m,) least inputs
    u_high: Array  # (m,) largest inputs
    feedback: "tuple[tuple[Nonlinearity, int], ...]" = ()  # function and output of the columns beyond r

    @property
    def linear(self) -> bool:
        """Whether the plant is linear in v and every v can be chosen independently."""
        return not self.feedback and len(set(self.input_of)) == len(self.input_of)

    @property
    def columns(self) -> int:
        """Number of columns of v, those of the feedback included."""
        return self.low.size + len(self.feedback)

    @property
    def middle(self) -> Array:
        """(r,) middle of the ranges."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> Array:
        """(r,) half of the ranges; one for an actuator without effect."""
        half = (self.high - self.low) / 2
        return np.where(half > 0, half, 1.0)

    @cached_property
    def scale(self) -> float:
        """Weighted square of the largest change of the steady outputs by one actuator."""
        reach = np.abs(self.weights[:, None] * self.members[0].gain()[:, : self.low.size]) * self.half
        return float(np.max(np.sum(reach**2, axis=0), initial=0.0)) or 1.0

"""What is left of a plant to control: linear dynamics in v = f(u), bounds of v, and what the actuators share."""

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
    """x+ = A x + B v + d, y = C x + D v + c; nonlinear feedback g(y) is a further column of v.

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
    def of(cls, model: "HammersteinSS", gains: Any = 1.0, constants: Any = 0.0, added: Any = 0.0) -> "Member":
        """Take a model, with v replaced by gains v + constants where actuators are broken, and a load on its states."""
        constants = np.broadcast_to(constants, model.B.shape[1])
        A, B = model.A + model.L @ model.C, model.B + model.L @ model.D
        d = model.offset_x + model.L @ model.offset_y + B @ constants + added
        D = np.hstack([model.D * gains, np.zeros((model.l, len(model.feedback)))])
        return cls(A, np.hstack([B * gains, model.E]), model.C, D, d, model.offset_y + model.D @ constants)

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

    def terminal_root(self, problem: "AllocationProblem") -> Array:
        """Return T with T'T the cost from the end of the horizon on at v at rest, (n, n).

        The cost to go of a stable plant whose v rests; the slowest weight that is finite otherwise: of the plant held
        by its optimal feedback.
        """
        from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

        weighted, r = problem.weights[:, None] * self.C, problem.low.size
        if np.max(np.abs(np.linalg.eigvals(self.A)), initial=0.0) < 1 - 1e-9:
            P = solve_discrete_lyapunov(self.A.T, weighted.T @ weighted)
        else:
            R = problem.scale * np.diag(1 / problem.half**2)
            P = solve_discrete_are(self.A, self.B[:, :r], weighted.T @ weighted + 1e-9 * np.eye(len(self.A)), R)
        sizes, axes = np.linalg.eigh((P + P.T) / 2)
        return np.asarray(np.sqrt(np.maximum(sizes, 0.0))[:, None] * axes.T)


@dataclass(frozen=True, eq=False)
class AllocationProblem:
    """Numbers of a re-allocation of r columns v = f(u) and m inputs u.

    Attributes:
        members: the plant; several where it is not known what is broken.
        low: (r,) least v.
        high: (r,) largest v.
        names: names of the actuators, one per column.
        outputs: names of the outputs.
        weights: (l,) of the outputs.
        norm: (k, r) matrix S of ‖S v‖ <= limit; None for none.
        limit: of the norm.
        inverses: (r) f and f^-1.
        input_of: the input of every column.
        inputs: names of the inputs.
        u_low: (m,) least inputs.
        u_high: (m,) largest inputs.
        feedback: function and output of the columns beyond r.
    """

    members: tuple[Member, ...]
    low: Array
    high: Array
    names: tuple[str, ...]
    outputs: tuple[str, ...]
    weights: Array
    norm: Array | None
    limit: float
    inverses: tuple[Inverse, ...]
    input_of: tuple[int, ...]
    inputs: tuple[str, ...]
    u_low: Array
    u_high: Array
    feedback: "tuple[tuple[Nonlinearity, int], ...]" = ()

    @property
    def linear(self) -> bool:
        """Whether the plant is linear in v and every v is free of the others."""
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
        """(r,) half of the ranges; one for an actuator that does not move."""
        half = (self.high - self.low) / 2
        return np.where(half > 0, half, 1.0)

    @cached_property
    def scale(self) -> float:
        """Weighted square of what one actuator can do at most to the outputs at rest."""
        reach = np.abs(self.weights[:, None] * self.members[0].gain()[:, : self.low.size]) * self.half
        return float(np.max(np.sum(reach**2, axis=0), initial=0.0)) or 1.0

"""A plant whose inputs are re-allocated: linear dynamics in v = f(u), as under one explanation of its damage."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.models import HammersteinSS


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
    def of(cls, model: HammersteinSS, gains: Any = 1.0, constants: Any = 0.0, added: Any = 0.0) -> "Member":
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

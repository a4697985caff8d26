"""Inputs outside the range that a nonlinearity was identified over: what the actuator does there is not known.

At such samples the effect f(u) may be anything. So it is a disturbance of unlimited variance at these samples, and at
these alone: innovations and signatures are freed of it like of the unknown initial state.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.bases import UserFunctions
from optid.errors import DataError

if TYPE_CHECKING:
    from optid.models import HammersteinSS

TOLERATED = 0.01
"""Share of the range by which an input may leave it without a word."""

MOST = 400
"""Samples outside at most."""


class Outside(NamedTuple):
    """An input that leaves its range.

    Attributes:
        name: of the input.
        column: function of the input.
        interval: its range.
        samples: where it is outside.
    """

    name: str
    column: int
    interval: tuple[float, float]
    samples: np.ndarray

    def __str__(self) -> str:
        """Say which, since when, and what follows."""
        low, high = self.interval
        return (
            f"{self.name} is outside the identified range [{low:.4g}, {high:.4g}] in {self.samples.size} samples, "
            f"first in sample {self.samples[0]}: what the actuator does there is not judged."
        )


def outside(model: "HammersteinSS", u: Array) -> list[Outside]:
    """Return the inputs that leave the range their nonlinearities were identified over.

    Args:
        model: the model; a function without an interval, or one that the user gave, is known everywhere.
        u: (N, m) inputs.
    """
    found = []
    for column, (f, c) in enumerate(zip(model.nonlinearities, model.input_of)):
        interval = f.basis.interval
        if interval is None or isinstance(f.basis, UserFunctions):
            continue
        slack = TOLERATED * (interval[1] - interval[0])
        samples = np.flatnonzero((u[:, c] < interval[0] - slack) | (u[:, c] > interval[1] + slack))
        if samples.size:
            found.append(Outside(model.inputs[c], column, interval, samples))
    return found


def unknown_effects(model: "HammersteinSS", u: Array) -> tuple[Array, Array]:
    """Return what unknown effects outside the range add to the state (N, n, K) and to the output (N, l, K).

    Raises:
        DataError: more samples outside than can be judged without.
    """
    count, there = len(u), outside(model, u)
    total = sum(one.samples.size for one in there)
    if total > min(MOST, count // 2):
        raise DataError(
            f"{' '.join(map(str, there))} So much of the record cannot be judged: identify the model over the wider "
            "range, or cut the record."
        )
    into_state, into_output = np.zeros((count, model.nx, total)), np.zeros((count, model.l, total))
    k = 0
    for one in there:
        for sample in one.samples:
            if sample + 1 < count:
                into_state[sample + 1, :, k] = model.B[:, one.column]
            into_output[sample, :, k] = model.D[:, one.column]
            k += 1
    return into_state, into_output

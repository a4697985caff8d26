"""Inputs outside the range over which a nonlinearity was identified, where the effect of the actuator is unknown.

At such samples the effect f(u) is modelled as a disturbance of unlimited variance, which is removed from innovations
and signatures like the unknown initial state.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.bases import UserFunctions
from optid.errors import DataError
from optid.models.model import impulse_response

if TYPE_CHECKING:
    from optid.models import HammersteinSS

TOLERATED = 0.02
"""Share of the range by which an input may leave it as long as no output shows it."""

UNSEEN = 0.1
"""Largest shift of an output by the unknown effect that is tolerated, in standard deviations of the noise."""

REACH = 50
"""Samples of the impulse response that are considered."""

MOST = 400
"""Largest number of samples outside."""


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
        """State the input, the range and the samples."""
        low, high = self.interval
        return (
            f"{self.name} is outside the identified range [{low:.4g}, {high:.4g}] in {self.samples.size} samples, "
            f"first in sample {self.samples[0]}: its effect there is not judged."
        )


def outside(model: "HammersteinSS", u: Array) -> list[Outside]:
    """Return the inputs (N, m) that leave the range their nonlinearities were identified over.

    A function without an interval, or one that the user gave, is known everywhere.
    """
    found = []
    for column, (low, high) in enumerate(zip(*known_range(model))):
        x = u[:, model.input_of[column]]
        samples = np.flatnonzero((x < low) | (x > high))
        if samples.size:
            interval = model.nonlinearities[column].basis.interval or (low, high)
            found.append(Outside(model.inputs[model.input_of[column]], column, interval, samples))
    return found


def known_range(model: "HammersteinSS") -> tuple[Array, Array]:
    """Return (low, high), both (K,), between which every function of an input is known with sufficient accuracy.

    This is its interval, extended by `TOLERATED` of its length, or by less where the outputs would show the difference
    between a function that is held and one that is extrapolated there.
    """
    low, high = np.full((2, len(model.nonlinearities)), np.inf) * [[-1.0], [1.0]]
    response = impulse_response(model.A, model.B, model.C, model.D, REACH)
    noise = np.sqrt(np.diag(model.noise.innovation)) if model.noise is not None else np.zeros(model.l)
    for column, f in enumerate(model.nonlinearities):
        if f.basis.interval is None or isinstance(f.basis, UserFunctions):
            continue
        first, last = f.basis.interval
        room = TOLERATED * (last - first)
        change = max(abs(f(first + room) - f(first)), abs(f(last) - f(last - room)))
        seen = change * np.max(np.abs(response[:, :, column]), axis=0)  # of every output
        room *= min(1.0, float(np.min(UNSEEN * noise / np.maximum(seen, 1e-300))))
        low[column], high[column] = first - room, last + room
    return low, high


def unsure_since(model: "HammersteinSS", u: Array, memory: int) -> np.ndarray:
    """Return which samples (N,) follow an input outside its range within `memory` samples."""
    edges = np.zeros(len(u) + memory + 2, dtype=int)
    for one in outside(model, u):
        np.add.at(edges, one.samples, 1)
        np.add.at(edges, one.samples + memory + 1, -1)
    return np.cumsum(edges)[: len(u)] > 0


def unknown_effects(model: "HammersteinSS", u: Array) -> tuple[Array, Array]:
    """Return the unknown effects outside the range in the state (N, n, K) and in the output (N, l, K).

    Raises:
        DataError: too many samples outside.
    """
    count, there = len(u), outside(model, u)
    total = sum(one.samples.size for one in there)
    if total > min(MOST, count // 2):
        raise DataError(
            f"{' '.join(map(str, there))} This part is too long to be left out: identify the "
            "model over the wider range, or cut the record."
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

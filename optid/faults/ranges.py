"""Channels outside the range of the identification: how far, since when, and what of a record is used then.

What a model of a smooth plant lacks grows with the distance from the middle of the range. The effect of an actuator is
unknown where its input is outside the range over which its function was identified. A linear function is extrapolated,
for which the covariance of its parameters accounts, up to `FAR` half ranges from the middle; a nonlinear one is known
inside its range. Beyond, the effect f(u) is modelled as a disturbance of unlimited variance, which is removed from
innovations and signatures like the unknown initial state. A record in which a linear input stays there, or which is
outside too often, is used up to that sample.
"""

from typing import NamedTuple

import numpy as np

from optid.arrays import Array
from optid.bases import Linear, UserFunctions
from optid.errors import DataError
from optid.models import HammersteinSS
from optid.models.model import impulse_response

TOLERATED = 0.02  # share of the range by which an input may leave it as long as no output shows it
UNSEEN = 0.1  # largest shift of an output by the unknown effect that is tolerated, in standard deviations of the noise
REACH = 50  # samples of the impulse response that are considered
MOST = 400  # largest number of samples outside
FAR = 1.5  # distance from the middle of the range, in half ranges, up to which a linear function is extrapolated
STAY = 3  # samples in a row outside, from which on a record is not used
BEYOND = 1.1  # distance from the middle of its range, in half ranges, from which a channel is far outside it


def distance(values: Array, ends: Array | None) -> Array:
    """Return how far values (N, c) are from the middle of ranges (2, c), in half ranges; one inside.

    One value only is no range, nor is an infinite one, nor None; a missing value is inside.
    """
    if ends is None:
        return np.ones(values.shape)
    low, high = ends
    with np.errstate(invalid="ignore"):
        span = np.where(np.isfinite(high - low) & (high > low), high - low, np.inf)
        far = np.abs(2 * values - low - high) / span
    return np.where((values < low) | (values > high), np.fmax(far, 1.0), 1.0)


class Outside(NamedTuple):
    """An input that leaves its range."""

    name: str  # of the input
    column: int  # function of the input
    interval: tuple[float, float]  # its range
    samples: np.ndarray  # where it is outside; for a linear function, where it is too far outside
    is_linear: bool  # whether the function is linear

    def __str__(self) -> str:
        """State the input, the range and the samples."""
        low, high = self.interval
        return (
            f"{self.name} is {'far ' * self.is_linear}outside the identified range [{low:.4g}, {high:.4g}] in "
            f"{self.samples.size} samples, first in sample {self.samples[0]}: its effect there is not judged.")


def outside(model: HammersteinSS, u: Array) -> list[Outside]:
    """Return the inputs (N, m) that leave the range their nonlinearities were identified over.

    A function without an interval, or one that the user gave, is known everywhere.
    """
    found = []
    for column, (low, high) in enumerate(zip(*usable_range(model))):
        x = u[:, model.input_of[column]]
        samples = np.flatnonzero((x < low) | (x > high))
        if samples.size:
            basis = model.nonlinearities[column].basis
            found.append(Outside(model.inputs[model.input_of[column]], column, basis.interval or (low, high), samples,
                                 isinstance(basis, Linear)))
    return found


def usable_range(model: HammersteinSS) -> tuple[Array, Array]:
    """Return (low, high), both (K,): `known_range`, and for linear functions how far they are extrapolated."""
    low, high = known_range(model)
    for column, f in enumerate(model.nonlinearities):
        if isinstance(f.basis, Linear) and f.basis.interval is not None:
            middle, half = np.mean(f.basis.interval), (f.basis.interval[1] - f.basis.interval[0]) / 2
            low[column], high[column] = middle - FAR * half, middle + FAR * half
    return low, high


def input_range_notes(model: HammersteinSS, u: Array) -> list[str]:
    """State the inputs (N, m) whose linear functions are extrapolated, and since when."""
    (low, high), notes = known_range(model), []
    for column, f in enumerate(model.nonlinearities):
        x = u[:, model.input_of[column]]
        samples = np.flatnonzero((x < low[column]) | (x > high[column]))
        if samples.size and isinstance(f.basis, Linear) and f.basis.interval is not None:
            first, last = f.basis.interval
            notes.append(f"{model.inputs[model.input_of[column]]} leaves the identified range [{first:.4g}, "
                         f"{last:.4g}], first in sample {samples[0]}: its linear function is extrapolated.")
    return notes


def usable_samples(model: HammersteinSS, u: Array) -> tuple[int, str]:
    """Return how many samples of inputs (N, m) are used, and why not all of them; "" where all are.

    Raises:
        DataError: fewer samples than a diagnosis of the model needs.
    """
    there = outside(model, u)
    too_many = sum(one.samples.size for one in there) > min(MOST, len(u) // 2)
    stays = [(one.samples[k], one) for one in there if one.is_linear or too_many
             for k in np.flatnonzero(one.samples[STAY - 1 :] - one.samples[: 1 - STAY] == STAY - 1)[:1]]
    if not stays:
        return len(u), ""
    count, one = min(stays, key=lambda stay: stay[0])
    if count < 2 * model.nx + 2:
        raise DataError(f"{one} It stays there from sample {count} on, and {count} samples before are too few for "
                        "a diagnosis: identify the model over the wider range.")
    return int(count), (f"The record is used up to sample {count - 1}: {one.name} then stays "
                        f"{'far ' * one.is_linear}outside its identified range [{one.interval[0]:.4g}, "
                        f"{one.interval[1]:.4g}].")


def known_range(model: HammersteinSS) -> tuple[Array, Array]:
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


def by_input(model: HammersteinSS, ends: tuple[Array, Array]) -> Array:
    """Return ranges (2, m) of the inputs, from those of their functions, low and high (K,); infinite without any."""
    found = np.full((2, model.m), np.inf) * [[-1.0], [1.0]]
    np.maximum.at(found[0], list(model.input_of), ends[0])
    np.minimum.at(found[1], list(model.input_of), ends[1])
    return found


def unsure_since(model: HammersteinSS, u: Array, memory: int) -> np.ndarray:
    """Return which samples (N,) follow an input outside its range within `memory` samples."""
    edges = np.zeros(len(u) + memory + 2, dtype=int)
    for one in outside(model, u):
        np.add.at(edges, one.samples, 1)
        np.add.at(edges, one.samples + memory + 1, -1)
    return np.cumsum(edges)[: len(u)] > 0


def unknown_effects(model: HammersteinSS, u: Array) -> tuple[Array, Array]:
    """Return the unknown effects outside the range in the state (N, n, K) and in the output (N, l, K).

    Raises:
        DataError: too many samples outside.
    """
    count, there = len(u), outside(model, u)
    total = sum(one.samples.size for one in there)
    if total > min(MOST, count // 2):
        raise DataError(f"{' '.join(map(str, there))} This part is too long to be left out: identify the model over "
                        "the wider range, or cut the record.")
    into_state, into_output = np.zeros((count, model.nx, total)), np.zeros((count, model.l, total))
    for k, (sample, column) in enumerate((sample, one.column) for one in there for sample in one.samples):
        into_state[sample + 1 : sample + 2, :, k] = model.B[:, column]
        into_output[sample, :, k] = model.D[:, column]
    return into_state, into_output

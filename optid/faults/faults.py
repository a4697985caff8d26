"""Fault models (1.8)-(1.13) of the dissertation, and others of practice.

Timing, for every kind: the onset theta is the first sample of the record that the fault can change. A fault in
the state equation changes x(theta) first, so it is present in the step from theta - 1 to theta; one in the output
equation, a direct feedthrough included, changes y(theta) first.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError, LookupFailed, StructureError
from optid.faults.kinds import FaultKind, kind_of


@dataclass(frozen=True, eq=False)
class Fault:
    """One fault. Build it with the class methods: `step`, `jump`, `ramp`, `loss`, `stuck`, `frozen`, ....

    Attributes:
        name: place: "actuator:u1", "sensor:y2", "process:load" (a direction in the state equation), "state".
        kind: the word of its kind (`optid.faults.kinds`).
        onset: first sample of the record that it can change.
        end: first sample that it no longer changes; None for a lasting fault.
        size: size of an additive fault, share lost of a loss, value of a stuck one; None where the kind has none.
        direction: (n,) or (n, d) direction in the state equation of a "process" fault; None where the name states it.
        bias: constant added to f of a lost actuator, (1 - size) f(u) + bias.
        std: standard deviation of the added noise.
        scale: factor of the standard deviation of the present noise, instead of std.
        covariance: of the added noise, instead of std and scale.
        A: (n, n), (N, n, n) or k -> (n, n): replaces A from the onset on.
        B: (n, r), (N, n, r) or k -> (n, r): replaces B from the onset on.

    Raises:
        StructureError: an unknown kind, a name that does not fit the kind, an onset that is not a nonnegative integer.
    """

    name: str
    kind: str
    onset: int
    end: int | None = None
    size: Any = None
    direction: Any = None
    bias: float = 0.0
    std: float | None = None
    scale: float | None = None
    covariance: Any = None
    A: Any = None
    B: Any = None

    def __post_init__(self) -> None:
        try:
            kind_of(self.kind)
        except LookupFailed as error:
            raise StructureError(f"{self.name}: {error}") from None
        possible = (*self.fault_kind.places, *self.fault_kind.simulated)
        if self.place not in possible:
            raise StructureError(f"{self.name!r} cannot have a fault of kind {self.kind!r}: its name begins with "
                                 f"{' or '.join(map(repr, possible))}, as in 'actuator:u1'.")
        for word, value in (("onset", self.onset), ("end", self.end)):
            if value is not None and (value != int(value) or value < 0):
                raise StructureError(f"{self.name}: {word} = {value!r}; it must be a nonnegative integer.")
        if self.end is not None and self.end <= self.onset:
            raise StructureError(f"{self.name}: end = {self.end} is not after onset = {self.onset}.")

    @property
    def fault_kind(self) -> FaultKind:
        """The record of its kind."""
        return kind_of(self.kind)

    @property
    def place(self) -> str:
        """The part of the name before the colon."""
        return self.name.partition(":")[0]

    @property
    def channel(self) -> str:
        """The part of the name after the colon."""
        return self.name.partition(":")[2]

    def __str__(self) -> str:
        """State place, kind, size and onset."""
        until = "" if self.end is None else f" until {self.end}"
        size = "" if self.size is None else f" {np.array2string(np.asarray(self.size), precision=4)}".replace("'", "")
        return f"{self.name}: {self.kind.replace('_', ' ')}{size} from sample {self.onset}{until}"

    def active(self, count: int) -> slice:
        """Return the samples of a record of `count` that the fault can change.

        Raises:
            DataError: the onset lies beyond the record.
        """
        if self.onset >= count:
            raise DataError(f"{self.name}: onset {self.onset} lies beyond the record of {count} samples.")
        return slice(int(self.onset), count if self.end is None else min(int(self.end), count))

    @classmethod
    def step(cls, name: str, onset: int, size: ArrayLike, *, end: int | None = None,
             direction: ArrayLike | None = None) -> "Fault":
        """Return a constant offset from the onset on, (1.8) and (1.9).

        Args:
            name: "actuator:u1" adds to f(u1); "sensor:y1" to the reading; "process:load" to the state along the
                direction; "state" to the whole state.
            onset: first sample that it can change.
            size: a number, or a vector with one entry per column of the place (several functions of an input, the n
                states).
            end: first sample that it no longer changes.
            direction: (n,) of a "process" fault.
        """
        return cls(name, "bias", onset, end, _finite(name, size, "size"), _finite(name, direction, "direction"))

    @classmethod
    def jump(cls, name: str, onset: int, size: ArrayLike, *, direction: ArrayLike | None = None) -> "Fault":
        """Return an offset in one sample only: a jump of the state, a spike of a sensor. Arguments as `step`."""
        kind = "spike" if name.startswith("sensor") else "jump"
        return cls(name, kind, onset, None, _finite(name, size, "size"), _finite(name, direction, "direction"))

    @classmethod
    def ramp(cls, name: str, onset: int, slope: ArrayLike, *, end: int | None = None,
             direction: ArrayLike | None = None) -> "Fault":
        """Return a drift: slope at the onset, twice the slope one sample later, .... Arguments as `step`."""
        return cls(name, "drift", onset, end, _finite(name, slope, "size"), _finite(name, direction, "direction"))

    drift = ramp

    @classmethod
    def loss(cls, name: str, onset: int, fraction: float, *, bias: float = 0.0, end: int | None = None) -> "Fault":
        """Return a loss of effectiveness, (1.10) and (1.11): (1 - fraction) f(u) + bias, or that of the output.

        The name is "actuator:u1" or "sensor:y1", the fraction the share lost, 0 to 1 (`StructureError` outside), the
        bias in units of f (of the output for a sensor); onset and end as `step`. The noise of a sensor stays.
        """
        if not 0 <= fraction <= 1:
            raise StructureError(f"{name}: fraction = {fraction!r}; it must be a share from 0 to 1.")
        return cls(name, "loss", onset, end, float(fraction), bias=float(bias))

    @classmethod
    def stuck(cls, name: str, onset: int, value: Any = "last", *, end: int | None = None) -> "Fault":
        """Return an actuator that no longer moves, or a sensor that repeats one reading without noise.

        The value is the input at which the actuator is stuck (the reading of the sensor), or "last": the input two
        samples before the onset, which drove the plant last (the reading before the onset); others as `loss`.
        """
        if not isinstance(value, str):
            value = float(_finite(name, value, "value"))
        elif value != "last":
            raise StructureError(f"{name}: value = {value!r}; it must be a number or 'last'.")
        return cls(name, "stuck", onset, end, value)

    @classmethod
    def frozen(cls, name: str, onset: int, *, end: int | None = None) -> "Fault":
        """Return a sensor that repeats its last reading exactly, or an actuator that keeps its last position."""
        return cls(name, "frozen", onset, end, "last")

    @classmethod
    def hard_over(cls, name: str, onset: int, value: float | None = None, *, end: int | None = None) -> "Fault":
        """Return a complete failure.

        The value is None for the complete loss of the dissertation (an actuator without effect, a sensor that reads
        its noise), or the input (reading) at the stop that the channel runs to; others as `loss`.
        """
        return cls(name, "hard_over", onset, end, None if value is None else float(_finite(name, value, "value")))

    @classmethod
    def process_noise(cls, name: str, onset: int, *, std: float | None = None, scale: float | None = None,
                      covariance: ArrayLike | None = None, end: int | None = None,
                      direction: ArrayLike | None = None) -> "Fault":
        """Return additional white noise in the state equation, (1.12).

        The name is "process:load" along a direction, or "process" in all states. Give one (`StructureError`) of std,
        the standard deviation along the direction (of every state), scale, the factor of the standard deviation of the
        present noise, and covariance (n, n); onset, end and direction as `step`.
        """
        return cls(name, "noise", onset, end, None, _finite(name, direction, "direction"), 0.0,
                   *_noise(name, std, scale, covariance))

    @classmethod
    def sensor_noise(cls, name: str, onset: int, *, std: float | None = None, scale: float | None = None,
                     covariance: ArrayLike | None = None, end: int | None = None) -> "Fault":
        """Return additional white noise of a sensor, (1.13); "sensor" alone is all of them. As `process_noise`."""
        return cls(name, "noise", onset, end, None, None, 0.0, *_noise(name, std, scale, covariance))

    @classmethod
    def schedule(cls, onset: int = 0, *, A: Any = None, B: Any = None, end: int | None = None) -> "Fault":
        """Return other matrices A(k) and B(k) of the state equation, (1.8) and (1.10).

        Args:
            onset: first sample that they can change: the step from onset - 1 to onset uses A(onset - 1).
            A: (n, n), (N, n, n) for every sample k of the record, or a function of k; None for an unchanged A.
            B: (n, r), (N, n, r) or a function of k; None for an unchanged B.
            end: first sample that they no longer change.

        Raises:
            StructureError: neither A nor B.
        """
        if A is None and B is None:
            raise StructureError("schedule: give A, B or both.")
        return cls("process", "schedule", onset, end, A=A, B=B)


def _finite(name: str, value: Any, word: str) -> Any:
    if value is None:
        return None
    array = np.asarray(value, dtype=float)
    if not np.isfinite(array).all():
        raise StructureError(f"{name}: {word} = {value!r} is not finite.")
    return np.atleast_1d(array) if word == "size" else array


def _noise(name: str, std: Any, scale: Any, covariance: Any) -> tuple[float | None, float | None, Array | None]:
    if sum(given is not None for given in (std, scale, covariance)) != 1:
        raise StructureError(f"{name}: give one of std, scale and covariance.")
    if std is not None and not (np.isfinite(std) and std >= 0):
        raise StructureError(f"{name}: std = {std!r}; it must be nonnegative.")
    if scale is not None and not (np.isfinite(scale) and scale >= 1):
        raise StructureError(f"{name}: scale = {scale!r}; it must be a factor from 1 on: noise is added, not removed.")
    if covariance is None:
        return None if std is None else float(std), None if scale is None else float(scale), None
    matrix = np.atleast_2d(np.asarray(covariance, dtype=float))
    if matrix.shape[0] != matrix.shape[1] or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix)[0] < \
            -1e-9 * np.abs(matrix).max():
        raise StructureError(f"{name}: covariance is not symmetric and positive semidefinite.")
    return None, None, matrix

"""The signals of a simulated plant with faults; every kind of fault changes them in its own way."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.places import channel_of, functions_of, matrices_of, place_of
from optid.models import HammersteinSS
from optid.models.kalman import NoiseCovariances


class Sensors(NamedTuple):
    """The sensors of a record: a reading is gain * output + shift + noise, unless it is fixed or held."""

    gain: Array  # (N, l)
    shift: Array  # (N, l)
    noise: Array  # (N, l)
    fixed: Array  # (N, l) reading that replaces the output; NaN for none
    hold: Array  # (N, l) whether the reading of the sample before is repeated

    @classmethod
    def healthy(cls, noise: Array) -> "Sensors":
        """Return sensors without a fault."""
        return cls(np.ones(noise.shape), np.zeros(noise.shape), noise, np.full(noise.shape, np.nan),
                   np.zeros(noise.shape, dtype=bool))


class FaultyPlant:
    """The signals of a record of a plant, which faults change.

    Attributes:
        model: the healthy plant.
        u: (N, m) inputs.
        present: covariances of its noise; None without noise.
        process: directions (n,) by name.
        state: (N, r) functions of the inputs in the next state.
        output: (N, r) those in the output.
        jolt: (N, n) added to the next state.
        start: (n,) added to the first one.
        w: (N, n) process noise.
        sensors: the sensors.
        A: (N, n, n).
        B: (N, n, r).
        now: the samples that a fault changes in the output; set for each fault before it acts, as `before` is.
        before: those at which it changes the step to the next state.
        stream: random numbers of its own.
    """

    def __init__(self, model: HammersteinSS, u: Array, present: NoiseCovariances | None,
                 process: Mapping[str, ArrayLike], healthy: np.random.Generator) -> None:
        """Set up a plant without faults, whose noise is drawn from `healthy`."""
        count, n, l = len(u), model.nx, model.l  # noqa: E741
        self.model, self.u, self.present, self.process = model, u, present, process
        drawn = np.zeros((count, n + l))
        if present is not None:
            drawn = draw(healthy, count, np.block([[present.Q, present.S], [present.S.T, present.R]]))
        self.state = model.expand_inputs(u)
        self.output = self.state.copy()
        self.jolt, self.start = np.zeros((count, n)), np.zeros(n)
        self.w, self.sensors = np.ascontiguousarray(drawn[:, :n]), Sensors.healthy(np.ascontiguousarray(drawn[:, n:]))
        self.A: Array = np.broadcast_to(model.A, (count, n, n))
        self.B: Array = np.broadcast_to(model.B, (count, n, self.state.shape[1]))
        self.now, self.before, self.stream = slice(0, 0), slice(0, 0), healthy

    def at(self, now: slice, stream: np.random.Generator) -> "FaultyPlant":
        """Return the plant, ready for a fault at some samples."""
        self.now, self.before, self.stream = now, slice(max(now.start - 1, 0), now.stop - 1), stream
        return self

    def add(self, name: str, size: Any, direction: Any, course: Callable[[np.ndarray], Array]) -> None:
        """Add a size (d,) at a place, with a course by the samples since the onset."""
        into_state, into_output = place_of(self.model, name, direction, self.process)
        size = np.asarray(size)
        if size.shape != (into_state.shape[1],):
            raise StructureError(f"{name}: size of shape {size.shape}; this place has {into_state.shape[1]} columns: "
                                 "give one entry for each.")
        added = np.zeros(len(self.jolt))
        added[self.now] = course(np.arange(self.now.stop - self.now.start))
        if name.startswith("actuator:"):  # through B(k), which may be scheduled
            columns = functions_of(self.model, name)
            self.output[:, columns] += np.outer(added, size)
            self.state[:-1, columns] += np.outer(added[1:], size)
        else:
            self.sensors.shift[:] += np.outer(added, into_output @ size)
            self.jolt[:-1] += np.outer(added[1:], into_state @ size)
        self.start[:] += added[0] * (into_state @ size)

    def drive(self, name: str, changed: Callable[[Array, int], Any]) -> None:
        """Change the functions of an input: `changed` returns the values in place of those (K,) of function i."""
        for values, samples in ((self.output, self.now), (self.state, self.before)):
            for i in functions_of(self.model, name):
                values[samples, i] = changed(values[samples, i], i)

    def stand(self, name: str, value: Any) -> None:
        """Let an actuator or a sensor stand still.

        The value is the input (the reading), "last" for the input two samples before the onset (for the reading before
        it), or None: without effect (noise alone).
        """
        if not name.startswith("actuator"):
            o = channel_of(self.model.outputs, name)
            if value is None:
                self.sensors.gain[self.now, o] = 0.0
            elif isinstance(value, str):
                self.sensors.hold[self.now, o] = True
            else:
                self.sensors.fixed[self.now, o] = value
            return
        c = channel_of(self.model.inputs, name)
        stop = self.u[max(self.now.start - 2, 0), c] if isinstance(value, str) else value
        self.drive(name, lambda _, i: 0.0 if value is None else self.model.nonlinearities[i](stop))

    def scale(self, name: str, left: Any, bias: float) -> None:
        """Multiply the effect of an actuator, or the reading of a sensor, by the share that is left, and add a bias."""
        if name.startswith("actuator"):
            self.drive(name, lambda values, _: left * values + bias)
            return
        o = channel_of(self.model.outputs, name)
        self.sensors.gain[self.now, o] *= left
        self.sensors.shift[self.now, o] += bias

    def disturb(self, name: str, direction: Any, spread: Callable[[Array, Array | None], Array]) -> None:
        """Add white noise at a place.

        `spread` returns its covariance (d, d) from the columns (n, d) or (l, d) of the place and the covariance of the
        noise that is there; None where there is none.
        """
        into_state, into_output = place_of(self.model, name, direction, self.process)
        into, target, samples, word = (into_output, self.sensors.noise, self.now, "R") if into_output.any() else (
            into_state, self.w, self.before, "Q")
        covariance = spread(into, None if self.present is None else getattr(self.present, word))
        target[samples] += draw(self.stream, samples.stop - samples.start, covariance) @ into.T

    def schedule(self, **matrices: Any) -> None:
        """Replace A and B, where they are given."""
        for word, given in matrices.items():
            if given is not None:
                changed, before = np.array(getattr(self, word)), self.before
                changed[before] = matrices_of("schedule", word, given, range(before.start, before.stop),
                                              getattr(self.model, word), len(self.u))
                setattr(self, word, changed)


def draw(rng: np.random.Generator, count: int, covariance: Array) -> Array:
    """Draw (count, d) Gaussian samples of a covariance that may be singular."""
    sizes, axes = np.linalg.eigh(covariance)
    if sizes[0] < -1e-8 * max(sizes[-1], 0.0):
        raise StructureError("The covariance of the noise is not positive semidefinite.")
    return rng.standard_normal((count, len(covariance))) @ (axes * np.sqrt(np.maximum(sizes, 0.0))).T

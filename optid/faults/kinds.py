"""The kinds of faults: one record a kind, which holds all that distinguishes it from the others.

A kind says where it can be, which course its effect takes, what it adds to the equations per unit of each magnitude,
how a simulated plant gets it, what it leaves of the part, and what its magnitudes are called. Everything else asks the
record. A third party's kind is a `FaultKind` of its own in the group `optid.fault_kinds` of entry points.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, LookupFailed, StructureError, nearest
from optid.registry import find_entry_points

if TYPE_CHECKING:
    from optid.models import HammersteinSS

GROUP = "optid.fault_kinds"

LASTING, DRIFT, JUMP, DRIVEN = range(4)
"""The course of a column after its onset, as the kernels know it: 1 1 1 .., 1 2 3 .., 1 0 0 .., or driven by inputs."""

Additions = tuple[Array, Array]  # what a fault adds to the state (N, n, d) and to the output (N, l, d)


@dataclass(frozen=True)
class FaultKind:
    """One kind of fault; the methods are those of an offset.

    Attributes:
        name: its word, in Python, in commands and in files.
        places: where a dictionary looks for it.
        simulated: where it can be simulated besides.
        course: of its columns: `LASTING`, `DRIFT`, `JUMP` or `DRIVEN`; None where there is no signature.
        implied: whether a label is the place alone, because the place implies the kind.
        share: the share of the effect of an actuator that is lost, where the kind is a special case of a broken
            actuator, (1 - share) f(u) + constant; NaN where it is estimated; None for other kinds.
        outlier: whether single readings are wrong and no part is broken.
        leaks: whether a disturbance of unknown direction in the state equation can take the same course.
        waveform: whether the course is arbitrary, and not known.
        noise: whether it increases the noise.
        stands: whether the part no longer moves, so that any constant is added beside the share lost.
        effect: of one unit of the first magnitude, in units of what it multiplies.
        largest: largest possible size.
        size_word: what a magnitude is called.
        without_course: why it cannot be tested as an arbitrary waveform; "" where it can.
    """

    name: str
    places: tuple[str, ...] = ()
    simulated: tuple[str, ...] = ()
    course: int | None = LASTING
    implied: bool = False
    share: float | None = None
    outlier: bool = False
    leaks: bool = False
    waveform: bool = False
    noise: bool = False
    stands: bool = False
    effect: float = 1.0
    largest: float = np.inf
    size_word: str = "size"
    without_course: str = ""

    @property
    def additive(self) -> bool:
        """Whether the signature depends on the model and the onset alone."""
        return self.course is not None and self.course != DRIVEN

    @property
    def lasting(self) -> bool:
        """Whether a signature goes on after its first sample."""
        return self.course is not None and self.course != JUMP

    @property
    def grows(self) -> bool:
        """Whether the effect goes on growing."""
        return self.course == DRIFT

    @property
    def driven(self) -> bool:
        """Whether the signature follows the inputs."""
        return self.course == DRIVEN

    @property
    def loses(self) -> bool:
        """Whether the first magnitude is a share lost, which lies between 0 and 1."""
        return self.driven and self.share is not None

    def own_label(self, place: str) -> str:
        """Return the label of a fault at a place."""
        return place if self.implied else f"{place} {self.name.replace('_', ' ')}"

    def progress(self, since: np.ndarray) -> Array:
        """Return the course (N,) of a fault of unit size, by the samples (N,) since its onset."""
        shape = since == 0 if self.course == JUMP else np.maximum(since + 1, 0) if self.grows else since >= 0
        return np.asarray(shape, dtype=float)

    def dimension(self, candidate: Any) -> int:
        """Return the number of magnitudes of a candidate."""
        return candidate.into_state.shape[1]

    def additions(self, candidate: Any, model: "HammersteinSS", since: np.ndarray, u: Any) -> Additions:
        """Return the additions of one unit of each magnitude.

        Args:
            candidate: with the columns of its place.
            model: the healthy model.
            since: (N,) samples since the onset.
            u: (N, m) inputs, or None.

        Raises:
            StructureError: a candidate without a signature, or one that needs the inputs.
        """
        course = self.progress(since)[:, None, None]
        return course * candidate.into_state, course * candidate.into_output

    def courses(self, first: int, last: int, count: int) -> list[np.ndarray]:
        """Return courses (N,) that span those of a fault with an onset from first to last; last = N: of any course."""
        k = np.arange(count)
        single = last + (self.course == JUMP)
        found = [k == at for at in range(first, min(single, count))]
        if last < count and self.course != JUMP:
            found += [np.maximum(k - last + 1, 0)] * self.grows + [k >= last] * (not self.grows or first < last)
        return found

    def simulate(self, fault: Any, plant: Any) -> None:
        """Change the signals of a simulated plant, `optid.faults.faulty_plant.FaultyPlant`."""
        plant.add(fault.name, fault.size, fault.direction, self.progress)

    def remaining(self, size: Array) -> float:
        """Return the share of the effect of an actuator that a fault of size (d,) leaves."""
        return 1.0

    def size_names(self, place: str, count: int) -> list[str]:
        """Return the names of so many magnitudes of a fault at a place."""
        if count == 1:
            return [self.size_word]
        part = "state" if place.startswith(("state", "process")) else "part"
        return [f"{self.size_word} of {part} {i}" for i in range(1, count + 1)]


@dataclass(frozen=True)
class DrivenKind(FaultKind):
    """A change of the effect of an actuator: f(u) becomes (1 + effect * size) f(u) + c, for an effect of one or -1."""

    course: int | None = DRIVEN
    effect: float = -1.0

    def dimension(self, candidate: Any) -> int:
        """Return the number of magnitudes: of the change, and the constant of every function of the input."""
        return 1 + len(candidate.columns) * candidate.has_constants

    def additions(self, candidate: Any, model: "HammersteinSS", since: np.ndarray, u: Any) -> Additions:
        """Return the additions of a change of size one and of unit constants; arguments as of `FaultKind`."""
        if not candidate.columns:
            return UNKNOWN.additions(candidate, model, since, u)
        if u is None:
            raise StructureError(f"{candidate.label}: its signature depends on the input: pass u (N, m).")
        inputs = np.asarray(u, dtype=float).reshape(since.size, -1)
        if inputs.shape[1] != model.m:
            raise DataError(f"u has {inputs.shape[1]} channels; the model has {model.m}.")
        f = (model.expand_inputs(inputs) - candidate.rest_values(model))[:, list(candidate.columns)]
        on = (since >= 0).astype(float)[:, None]
        before = np.vstack([np.zeros((1, f.shape[1])), f[:-1]])  # x(k) is driven by the input before
        begun = on.copy()
        begun[:1] = 0.0
        into_state = [self.effect * (on * before) @ candidate.into_state.T]
        into_output = [self.effect * (on * f) @ candidate.into_output.T]
        if candidate.has_constants:
            into_state += [begun * b for b in candidate.into_state.T]
            into_output += [on * d for d in candidate.into_output.T]
        return np.stack(into_state, axis=2), np.stack(into_output, axis=2)

    def simulate(self, fault: Any, plant: Any) -> None:
        """Change the effect, or stand still."""
        if self.stands:
            plant.stand(fault.name, fault.size)
        else:
            plant.scale(fault.name, 1.0 + self.effect * np.asarray(fault.size), fault.bias)

    def remaining(self, size: Array) -> float:
        """Return the share of the effect that a change of size (d,) leaves."""
        return float(np.clip(1 - size[0], 0.0, 1.0)) if self.loses else float(1 + self.effect * size[0])

    def size_names(self, place: str, count: int) -> list[str]:
        """Return the name of the change, and those of the constants."""
        several = [f"constant added to function {i}" for i in range(1, count)]
        return [self.size_word, *(["constant added"] if count == 2 else several)][:count]


@dataclass(frozen=True)
class UnsignedKind(FaultKind):
    """A kind without a signature that could be computed beforehand."""

    course: int | None = None
    why: str = "because its course is not known: test it as an arbitrary waveform or by its covariance"

    def progress(self, since: np.ndarray) -> Array:
        """Return the course of an offset, by which places are compared."""
        return np.asarray(since >= 0, dtype=float)

    def additions(self, candidate: Any, model: "HammersteinSS", since: np.ndarray, u: Any) -> Additions:
        """Refuse, with the reason."""
        raise StructureError(f"{candidate.label} has no signature, {self.why}.")

    def simulate(self, fault: Any, plant: Any) -> None:
        """Stand still."""
        plant.stand(fault.name, fault.size)


@dataclass(frozen=True)
class NoiseKind(UnsignedKind):
    """White noise beside that of the plant."""

    noise: bool = True
    size_word: str = "standard deviation"
    without_course: str = "noise has no course (see noise_test)"

    def simulate(self, fault: Any, plant: Any) -> None:
        """Add the noise along its place."""

        def spread(into: Array, present: Array | None) -> Array:
            d = into.shape[1]
            if fault.covariance is not None:
                if fault.covariance.shape != (d, d):
                    raise StructureError(
                        f"{fault.name}: covariance of shape {fault.covariance.shape}; it must be ({d}, {d}).")
                return fault.covariance
            if fault.std is not None:
                return fault.std**2 * np.eye(d)
            if present is None:
                raise StructureError(
                    f"{fault.name}: scale multiplies the noise of the model, which has none: give std.")
            along = np.linalg.pinv(into)
            return (fault.scale**2 - 1) * along @ present @ along.T

        plant.disturb(fault.name, fault.direction, spread)


@dataclass(frozen=True)
class ScheduledKind(UnsignedKind):
    """Known changes of A and B, whose signature depends on the states of a window."""

    size_word: str = "share of the change"
    why: str = "because it depends on the states of a window: see Scan.signature"

    def simulate(self, fault: Any, plant: Any) -> None:
        """Replace the matrices."""
        plant.schedule(A=fault.A, B=fault.B)


UNKNOWN = UnsignedKind("unknown")

EVERYWHERE = ("actuator", "sensor", "process", "state")

KINDS = {
    "bias": FaultKind("bias", ("actuator", "sensor", "process"), ("state",), implied=True, share=0.0, leaks=True),
    "drift": FaultKind("drift", ("actuator", "sensor", "process"), ("state",), DRIFT, size_word="slope", leaks=True),
    "jump": FaultKind("jump", ("state",), ("actuator", "process"), JUMP, implied=True, size_word="jump"),
    "spike": FaultKind("spike", ("sensor",), course=JUMP, outlier=True),
    "loss": DrivenKind("loss", ("actuator", "sensor"), share=np.nan, largest=1.0, size_word="share lost"),
    "stuck": DrivenKind("stuck", ("actuator",), ("sensor",), share=1.0, stands=True, size_word="share lost"),
    "frozen": UnsignedKind("frozen", ("sensor",), ("actuator",), waveform=True, size_word="reading"),
    "noise": NoiseKind("noise", ("sensor", "process"), ("state",)),
    "hard_over": UnsignedKind("hard_over", (), ("actuator", "sensor")),
    "schedule": ScheduledKind("schedule", (), ("process", "state")),
    "saturated": UnsignedKind("saturated", size_word="reading"),
    "dead": UnsignedKind("dead"),
}
"""The kinds by their word."""


@cache
def all_kinds() -> dict[str, FaultKind]:
    """Return the kinds, those of third parties included, by name."""
    return {**KINDS, **{name: replace(point.load(), name=name) for name, point in find_entry_points(GROUP).items()}}


def kind_of(name: str) -> FaultKind:
    """Return a kind by its name; `LookupFailed` where there is none."""
    known = all_kinds()
    if name not in known:
        raise LookupFailed(f"no fault of kind {name!r}. {nearest(str(name), known)}")
    return known[name]

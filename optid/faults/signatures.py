"""Dictionary of possible faults: their signatures in the whitened innovations, and groups that are not isolable."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases import Linear
from optid.errors import DataWarning, LookupFailed, StructureError, nearest
from optid.faults.directions import decouple
from optid.faults.faults import Fault
from optid.faults.kinds import FaultKind, all_kinds, kind_of
from optid.faults.places import channel_of, functions_of, place_of
from optid.faults.ranges import known_range
from optid.faults.whitening import Predictor, predictor
from optid.models import HammersteinSS

STANDING, STATE_JUMP = "stuck", "jump"
"""The kind of an actuator to whose effect any constant is added, and that of the state by default."""

SAME = 1e-3  # sine of the angle between two signatures below which no record isolates them
NEAR = 0.3  # sine of the angle between two signatures below which only large faults are isolable
UNSEEN = 1e-9  # share of its largest possible size below which a signature is zero
FORGOTTEN = 1e-4  # share of its largest value below which a signature has decayed
LONGEST = 4000  # largest number of samples over which signatures are compared


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible fault, or a group of faults that no record isolates from each other.

    Attributes:
        name: place, as in `Fault`.
        kind: the word of its kind (`optid.faults.kinds`).
        into_state: (n, d) where it enters the state equation.
        into_output: (l, d) where it enters the output equation.
        columns: the functions of the input of a loss or a stuck actuator.
        members: labels of all faults with the same signature, its own first.
        places: places of these faults.
        bounded_deflection: whether the signature decays, so that a longer window does not help.
        schedule: the matrices A(k) and B(k) of a scheduled change.
        constants: whether a loss adds constants.
        zero: the input at which the actuator of a loss has no effect; None for the zero of f.
    """

    name: str
    kind: str
    into_state: Array
    into_output: Array
    columns: tuple[int, ...] = ()
    members: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    bounded_deflection: bool = False
    schedule: Fault | None = None
    constants: bool = False
    zero: float | None = None

    @property
    def fault_kind(self) -> FaultKind:
        """The record of its kind."""
        return kind_of(self.kind)

    @property
    def own_label(self) -> str:
        """The name, and the kind unless the name implies it."""
        return self.fault_kind.own_label(self.name)

    @property
    def label(self) -> str:
        """Its name in answers; that of the whole group where it is one."""
        return " | ".join(self.members or (self.own_label,))

    @property
    def additive(self) -> bool:
        """Whether the signature depends on the model and the onset alone."""
        return self.fault_kind.additive

    @property
    def dimension(self) -> int:
        """Number of magnitudes to estimate."""
        return self.fault_kind.dimension(self)

    @property
    def has_constants(self) -> bool:
        """Whether constants are added beside a share lost."""
        return self.constants or self.fault_kind.stands

    @property
    def is_sensor_gain(self) -> bool:
        """Whether a share of the reading of a sensor is lost, which changes the filter and has no signature."""
        return self.fault_kind.driven and not self.columns

    @property
    def widened(self) -> "Candidate":
        """The same actuator with any constant added beside the share lost."""
        return replace(self, kind=STANDING)

    def rest_values(self, model: HammersteinSS) -> Array:
        """Return the functions of the inputs (r,) at the input without effect, from which a share lost counts."""
        if self.zero is None or self.has_constants:
            return np.zeros(model.B.shape[1])
        return model.expand_inputs(np.full((1, model.m), self.zero))[0]


@dataclass(frozen=True, eq=False)
class Dictionary:
    """All faults considered; build it with `dictionary`.

    Attributes:
        model: the healthy model.
        predictor: its steady predictor.
        candidates: the isolable faults, in the order given.
        excluded: {label: why} of those that affect no output.
        sines: (c, c) sine of the smallest angle between the signatures of candidates c with the same onset; NaN where
            one of them depends on the input.
        unknown: whether "none of these" is a possible answer.
    """

    model: HammersteinSS
    predictor: Predictor
    candidates: tuple[Candidate, ...]
    excluded: Mapping[str, str]
    sines: Array = field(repr=False)
    unknown: bool = True

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the candidates."""
        return tuple(c.label for c in self.candidates)

    @property
    def ambiguity_groups(self) -> list[tuple[str, ...]]:
        """The groups of faults that no record isolates from each other."""
        return [c.members for c in self.candidates if len(c.members) > 1]

    @property
    def near(self) -> list[tuple[str, str, float]]:
        """Pairs that are isolable only when the fault is large, with the sine of their angle."""
        rows, columns = np.nonzero(np.triu(np.nan_to_num(self.sines, nan=1.0) < NEAR, 1))
        return [(self.labels[i], self.labels[j], float(self.sines[i, j])) for i, j in zip(rows, columns)]

    def belongs_to(self, model: HammersteinSS) -> bool:
        """Whether it is a dictionary of a model, with disturbances declared or not."""
        same = self.model is model or all(
            np.array_equal(getattr(self.model, name), getattr(model, name)) for name in "ABCDEL")
        return same and self.model.inputs == model.inputs and self.model.outputs == model.outputs

    def with_candidates(self, more: Sequence[Candidate]) -> "Dictionary":
        """Return the dictionary with further candidates appended."""
        count = len(self.candidates) + len(more)
        sines = np.full((count, count), np.nan)
        sines[: len(self.candidates), : len(self.candidates)] = self.sines
        return replace(self, candidates=(*self.candidates, *more), sines=sines)

    def __getitem__(self, name: str) -> Candidate:
        """Return the candidate of a label, of a member of a group, or of a place with one kind.

        Raises:
            LookupFailed: none or several.
        """
        for candidate in self.candidates:
            if name == candidate.label or name in candidate.members:
                return candidate
        here = [c for c in self.candidates if name in c.places]
        if len(here) == 1:
            return here[0]
        if name in self.excluded:
            raise LookupFailed(f"{name!r} is not in the dictionary: {self.excluded[name]}.")
        raise LookupFailed(f"{name!r} is not in the dictionary. {nearest(name, self.labels)}")

    def signature(self, candidate: Candidate | str, count: int, onset: int = 0, u: ArrayLike | None = None,
                  present: Array | None = None) -> Array:
        """Return the whitened innovations (N, l, d) of one unit of each magnitude.

        The magnitudes are the size of a bias, the slope of a drift, the jump of the state, the share lost, or the share
        lost and the constants added (stuck). Arguments and errors as of `additions`; `present` (N, l) marks the
        readings.
        """
        into_state, into_output = self.additions(candidate, count, onset, u)
        return self.predictor.whiten(self.predictor.respond(into_state, into_output, present), present)

    def additions(self, candidate: Candidate | str, count: int, onset: int = 0, u: ArrayLike | None = None
                  ) -> tuple[Array, Array]:
        """Return the additions of one unit of each magnitude to the state (N, n, d) and the output (N, l, d).

        Args:
            candidate: the candidate or its label.
            count: number of samples N.
            onset: first sample that it can change.
            u: (N, m) inputs, for a loss and a stuck actuator.

        Raises:
            StructureError: a frozen sensor or a noise, which have no signature; a loss without u.
        """
        c = self[candidate] if isinstance(candidate, str) else candidate
        return c.fault_kind.additions(c, self.model, np.arange(count) - onset, u)

    def __str__(self) -> str:
        """List the candidates, the groups and the excluded faults."""
        lines = [f"{len(self.candidates)} isolable faults"]
        for c in self.candidates:
            marks = ["transient only"] * c.bounded_deflection + ["not isolable from each other"] * (len(c.members) > 1)
            lines.append(f"  {c.label}" + f"  ({', '.join(marks)})" * bool(marks))
        lines += [f"  {a} and {b} are close: sine {sine:.3f}" for a, b, sine in self.near]
        lines += [f"  excluded: {label}, {why}" for label, why in self.excluded.items()]
        return "\n".join(lines + ["  unknown: none of these"] * self.unknown)


def dictionary(model: HammersteinSS, *, actuators: str | Sequence[str] = "all", sensors: str | Sequence[str] = "all",
               kinds: str | Sequence[str] = ("bias",), process: Mapping[str, ArrayLike] | None = None,
               state_jump: bool = True, schedules: Mapping[str, Fault] | None = None, unknown: bool = True,
               zeros: Mapping[str, float] | None = None, disturbances: Sequence[str] = ()) -> Dictionary:
    """Build the dictionary of possible faults; merge those that are not isolable, exclude those without effect.

    Args:
        model: the healthy model, with noise covariances.
        actuators: "all" or names of inputs.
        sensors: "all" or names of outputs.
        kinds: of "bias", "loss", "stuck", "frozen", "drift", "noise", "spike" and those that are installed; each at its
            possible places.
        process: directions (n,) of disturbances in the state equation, by name.
        state_jump: whether the state may jump, in any direction.
        schedules: known changes of A and B by name.
        unknown: whether "none of these" is a possible answer; a constant disturbance of unknown direction is then, too.
        zeros: {input: the value at which its actuator has no effect}. A loss reduces the effect beyond that value to
            the share (1 - gamma); without it any constant may be added. It must lie where f is known: a linear function
            is extrapolated to it, with a warning.
        disturbances: names, as in `Fault`, of inputs, outputs and directions of `process` with disturbances of any
            course. The predictor is decoupled from them (`optid.faults.directions`), and they are not candidates.

    Raises:
        LookupFailed: an unknown kind or channel.
        StructureError: no noise covariances, no candidate left, a zero outside the range of a nonlinear function.

    Warns:
        DataWarning: faults that were merged or excluded; a zero to which a linear function is extrapolated.
    """
    wanted = [kinds] if isinstance(kinds, str) else list(kinds)
    possible = {name: kind.places for name, kind in all_kinds().items() if kind.places}
    for kind in wanted:
        if kind not in possible:
            raise LookupFailed(f"no fault of kind {kind!r}. {nearest(str(kind), possible)}")
    declared = [disturbances] if isinstance(disturbances, str) else list(disturbances)
    steady = predictor(model)
    if declared:
        model, steady = decouple(model, declared, process)
    apart = {name.partition(":")[2] or name for name in declared}
    names = [f"actuator:{c}" for c in _chosen(actuators, model.inputs)]
    names += [f"sensor:{c}" for c in _chosen(sensors, model.outputs)]
    names = [name for name in names if name.partition(":")[2] not in apart]
    names += [f"process:{c}" for c in process or {} if c not in apart]
    at_rest = {_chosen([name], model.inputs)[0]: float(value) for name, value in (zeros or {}).items()}
    for name, value in at_rest.items():
        _check_zero(model, name, value)
    raw = [candidate_of(model, name, kind, process, at_rest) for kind in wanted for name in names
           if name.partition(":")[0] in possible[kind]]
    of_state = [kind for kind in wanted if "state" in possible[kind]]
    raw += [candidate_of(model, "state", kind) for kind in dict.fromkeys([*of_state, *[STATE_JUMP] * state_jump])]
    excluded: dict[str, str] = {}
    found = [kept for candidate in raw for kept in _seen(steady, candidate, excluded)]
    if not found:
        raise StructureError("None of the faults affects an output: there is no candidate.")
    merged, sines = _merged(steady, found)
    listed = Dictionary(model, steady, merged, excluded, sines, unknown)
    changes = []
    for name, fault in (schedules or {}).items():
        if fault.A is None and fault.B is None:
            raise StructureError(f"{name}: a fault of kind {fault.kind!r}; it must be Fault.schedule(A=, B=).")
        place, label = f"process:{name}", f"process:{name} schedule"
        if label in listed.labels:
            raise StructureError(f"{label} is in the dictionary already.")
        none = np.zeros((model.nx, 1)), np.zeros((model.l, 1))
        changes.append(Candidate(place, fault.kind, *none, members=(label,), places=(place,), schedule=fault))
    return listed.with_candidates(changes) if changes else listed


def _chosen(wanted: str | Sequence[str], names: tuple[str, ...]) -> list[str]:
    if isinstance(wanted, str):
        wanted = names if wanted == "all" else [wanted]
    chosen = [name.partition(":")[2] or name for name in wanted]
    for name in chosen:
        channel_of(names, f":{name}")
    return chosen


def candidate_of(model: HammersteinSS, name: str, kind: str, process: Mapping[str, ArrayLike] | None = None,
                 zeros: Mapping[str, float] | None = None) -> Candidate:
    """Return a candidate by its name and kind; arguments and errors as of `place_of` and `dictionary`."""
    into_state, into_output = place_of(model, name, None, process)
    new = Candidate(name, kind, into_state, into_output, places=(name,))
    if new.fault_kind.driven and name.startswith("actuator"):
        new = replace(new, columns=tuple(functions_of(model, name)), zero=(zeros or {}).get(name.partition(":")[2]))
    return replace(new, members=(new.own_label,))


def _check_zero(model: HammersteinSS, name: str, value: float) -> None:
    """Refuse an input without effect that lies where its function is not known."""
    for column, (low, high) in enumerate(zip(*known_range(model))):
        if model.inputs[model.input_of[column]] != name or low <= value <= high:
            continue
        where = f"the zero {value:g} of {name} lies outside [{low:.4g}, {high:.4g}], the range over which its function "
        where += "was identified"
        if not isinstance(model.nonlinearities[column].basis, Linear):
            raise StructureError(f"{where}: a share lost would be measured from a value that is not known. Leave the "
                                 "zero out (any constant may then be added), or identify f down to it.")
        warnings.warn(f"{where}: the share lost is true as far as the actuator is linear down to it.", DataWarning,
                      stacklevel=3)


def _horizon(steady: Predictor) -> int:
    return min(max(2 * steady.settling, 50), LONGEST)


def response(steady: Predictor, candidate: Candidate, count: int) -> Array:
    """Return the signature (N, l, d) from the onset on; that of a bias for a candidate without a signature."""
    course = candidate.fault_kind.progress(np.arange(count))[:, None, None]
    return steady.whiten(steady.respond(course * candidate.into_state, course * candidate.into_output))


def _seen(steady: Predictor, candidate: Candidate, excluded: dict[str, str]) -> list[Candidate]:
    """Keep the directions that affect an output, and flag a signature that decays; nothing where there are none."""
    trace = response(steady, candidate, _horizon(steady))
    possible = np.linalg.norm(steady.root) * (
        np.linalg.norm(candidate.into_state, axis=0) * max(np.linalg.norm(steady.C), 1e-300)
        + np.linalg.norm(candidate.into_output, axis=0))
    _, sizes, axes = np.linalg.svd(trace.reshape(-1, trace.shape[2]), full_matrices=False)
    there = sizes > UNSEEN * max(float(possible.max(initial=0.0)), 1e-300)
    if not there.any():
        excluded[candidate.own_label] = "it affects no output"
        warnings.warn(
            f"{candidate.own_label}: this fault affects no output; it is excluded.",
            DataWarning, stacklevel=4,
        )
        return []
    if not there.all() and candidate.additive:
        warnings.warn(
            f"{candidate.own_label}: {int(np.sum(~there))} of {there.size} directions affect no output; they are "
            "excluded.", DataWarning, stacklevel=4,
        )
        into_state, into_output = (part @ axes[there].T for part in (candidate.into_state, candidate.into_output))
        candidate = replace(candidate, into_state=into_state, into_output=into_output)
    course = np.linalg.norm(trace.reshape(len(trace), -1), axis=1)
    fades = bool(candidate.additive and course[-1] < FORGOTTEN * course.max())
    return [replace(candidate, bounded_deflection=fades)]


def _merged(steady: Predictor, found: list[Candidate]) -> tuple[tuple[Candidate, ...], Array]:
    """Group candidates whose signatures span the same space; return the sines between the groups, too."""
    groups: list[list[Candidate]] = []
    axes: list[Array | None] = []
    for candidate in found:
        own = None
        if candidate.additive:
            flat = response(steady, candidate, _horizon(steady)).reshape(-1, candidate.into_state.shape[1])
            own = np.linalg.svd(flat / np.linalg.norm(flat, axis=0), full_matrices=False)[0]
        for group, other in zip(groups, axes):
            if own is None or other is None or own.shape != other.shape:
                continue
            sine = float(np.linalg.norm(own - other @ (other.T @ own), 2))
            if sine < SAME:
                group.append(candidate)
                warnings.warn(
                    f"{group[0].own_label} and {candidate.own_label} have the same signature (sine of the angle "
                    f"{sine:.1e}): they are not isolable from each other, and an answer names both.",
                    DataWarning, stacklevel=4,
                )
                break
        else:
            groups.append([candidate])
            axes.append(own)
    sines = np.full((len(groups), len(groups)), np.nan)
    for i, first in enumerate(axes):
        for j, second in enumerate(axes):
            if first is not None and second is not None:
                wide, narrow = (first, second) if first.shape[1] >= second.shape[1] else (second, first)
                sines[i, j] = np.linalg.svd(narrow - wide @ (wide.T @ narrow), compute_uv=False)[-1]
    return tuple(
        replace(group[0], members=tuple(c.own_label for c in group), places=tuple(dict.fromkeys(c.name for c in group)))
        for group in groups
    ), sines

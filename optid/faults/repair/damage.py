"""The damaged plant that an answer of a diagnosis describes: open parameters, lost channels, additions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.bases import Triangular
from optid.faults.diagnosis.answers import Estimate, FaultAnswer
from optid.faults.places import channel_of
from optid.faults.signatures import Candidate
from optid.models import HammersteinSS
from optid.models.nonlinearity import Nonlinearity

DEAD_SHARE = 0.8
"""An actuator whose interval of the share lost holds one counts as dead from this estimate on."""


@dataclass(frozen=True, eq=False)
class Damage:
    """The damage of one explanation of a record."""

    label: str  # the explanation
    posterior: float  # its probability
    onset: int  # first sample that the last of its faults changes
    same_onset: bool  # whether all of its faults began there
    columns: tuple[int, ...]  # functions of the inputs that are damaged
    dead: tuple[int, ...]  # those of them that are constant
    sensors: tuple[str, ...]  # names of outputs whose readings are not used
    offsets: tuple[Candidate, ...]  # faults that add something to the plant
    louder_sensors: Mapping[str, float]  # {output: standard deviation added}
    louder_states: Array  # covariance (n, n) added to the process noise; zeros where there is none
    gains: Array  # (r,) share of each f that is left
    constants: Array  # (r,) added to it
    added: Array  # (n,) constant added in the state equation
    notes: tuple[str, ...]  # remarks for the report

    @property
    def needs_refit(self) -> bool:
        """Whether parameters of the plant itself are to be estimated."""
        return bool(self.columns or self.offsets)

    def with_noise(self, model: HammersteinSS) -> HammersteinSS:
        """Return a model with the added noise of the faults."""
        if model.noise is None or not (self.louder_sensors or self.louder_states.any()):
            return model
        R = np.array(model.noise.R)
        for name, std in self.louder_sensors.items():
            R[model.outputs.index(name), model.outputs.index(name)] += std**2
        from optid.models.kalman import kalman_gain

        Q = model.noise.Q + self.louder_states
        steady = kalman_gain(model.A, model.C, Q, R, model.noise.S)
        return replace(model, K=steady.K, noise=replace(model.noise, Q=Q, R=R, innovation=steady.innovation))

    def nominal_model(self, model: HammersteinSS) -> HammersteinSS:
        """Return the model with the gains and constants of the diagnosis, without a refit."""
        functions = list(model.nonlinearities)
        constants = np.array(self.constants)
        for i in self.columns:
            one = functions[i]
            if i in self.dead or self.gains[i] == 0:
                interval = one.basis.interval or (-1.0, 1.0)
                functions[i] = Nonlinearity(Triangular(1, interval), np.zeros(1))
            else:
                offset = None if one.offset is None else self.gains[i] * one.offset
                functions[i] = replace(one, mu=self.gains[i] * one.mu, offset=offset)
        return replace(
            model, nonlinearities=tuple(functions), offset_x=model.offset_x + model.B @ constants + self.added,
            offset_y=model.offset_y + model.D @ constants, gauge="none")


def damages(model: HammersteinSS, answer: FaultAnswer) -> list[Damage]:
    """Return one explanation of an answer, or one for each part of a group that is not isolable."""
    parts = [[(place, fault) for place in fault.candidate.places or (fault.name,)] for fault in answer.faults]
    variants = list(product(*parts))
    return [_damage(model, parts, answer.posterior / len(variants)) for parts in variants]


def _may_be_none(fault: Estimate) -> bool:
    """Whether no interval of the size of a fault that changes the plant excludes zero."""
    lasting = fault.candidate.fault_kind.lasting and not fault.name.startswith("sensor:")
    intervals = np.asarray(fault.size_interval, dtype=float)
    return lasting and intervals.size > 0 and bool(np.all((intervals[:, 0] <= 0) & (intervals[:, 1] >= 0)))


def merge_equivalent(model: HammersteinSS, broken: list[Damage]) -> list[Damage]:
    """Merge explanations that break the same parts, as a loss and a stuck actuator do, which are refitted alike.

    So are an actuator and a disturbance of the states where it enters. The most probable one is kept, with the sum of
    their probabilities.
    """
    groups: dict[Any, list[Damage]] = {}
    for one in sorted(broken, key=lambda one: -one.posterior):
        key = (frozenset(one.columns), frozenset(one.sensors), frozenset(c.label for c in one.offsets),
               frozenset(one.louder_sensors), bool(one.louder_states.any()))
        groups.setdefault(key, []).append(one)
    found = [replace(group[0], posterior=sum(one.posterior for one in group)) for group in groups.values()]
    for one in list(found):  # what is added where an actuator enters, its refit adds, too
        wider = next((w for w in found if w.columns and not w.offsets and w.sensors == one.sensors
                      and _covers(model.B[:, list(w.columns)], one)), None)
        if wider is not None:
            found.remove(one)
            at = found.index(wider)
            found[at] = replace(wider, posterior=wider.posterior + one.posterior)
    return sorted(found, key=lambda one: -one.posterior)


def _covers(into: Array, other: Damage) -> bool:
    """Whether constants that enter along the columns of (n, r) have the effect of all that an explanation adds."""
    if not other.offsets or other.columns or other.louder_sensors or other.louder_states.any():
        return False
    return all(not c.into_output.any() and np.linalg.matrix_rank(np.hstack([into, c.into_state]), tol=1e-9)
               == np.linalg.matrix_rank(into, tol=1e-9) for c in other.offsets)


def _damage(model: HammersteinSS, parts: Sequence[tuple[str, Estimate]], posterior: float) -> Damage:
    """Collect the damage of faults at some places."""
    r, n = len(model.nonlinearities), model.nx
    found: dict[str, list[Any]] = {"columns": [], "dead": [], "sensors": [], "offsets": [], "notes": []}
    louder: dict[str, float] = {}
    states, gains, constants, added = np.zeros((n, n)), np.ones(r), np.zeros(r), np.zeros(n)
    notes = found["notes"]
    for place, fault in parts:
        part, _, channel = place.partition(":")
        size = np.asarray(fault.size, dtype=float)
        known = bool(np.all(np.isfinite(size)))
        into_state, kind = fault.candidate.into_state, fault.candidate.fault_kind
        if known and _may_be_none(fault):
            notes.append(f"{place}: the interval of its size contains none: the plant stays as it was")
        elif kind.outlier:
            notes.append(f"{channel}: single readings were wrong; no part is broken")
        elif part == "actuator":
            mine = [i for i, of in enumerate(model.input_of) if of == channel_of(model.inputs, place)]
            found["columns"] += mine
            if kind.grows:
                notes.append(f"{channel}: a {kind.name} goes on growing; the model holds the mean since its onset")
            if known and kind.additive:
                constants[mine] += size
            elif known:
                gains[mine] = kind.remaining(size)
                if len(size) == 1 + len(mine):
                    constants[mine] += size[1:]
                low, high = np.asarray(fault.size_interval, dtype=float)[0]
                if kind.loses and size[0] >= DEAD_SHARE and low <= 1 <= high:
                    found["dead"] += mine
                    gains[mine] = 0.0
                    notes.append(f"{channel}: the interval of the share lost includes a total loss: hard-over")
        elif part == "sensor":
            name = model.outputs[channel_of(model.outputs, place)]
            if kind.noise and known:
                louder[name] = float(np.max(np.abs(size)))
            else:
                found["sensors"].append(name)
                if kind.additive and not kind.grows and known:
                    notes.append(f"{channel}: its readings were off by {size[0]:.4g}; they are not used")
        elif kind.noise:
            states = states + into_state * size**2 @ into_state.T if known else states
        elif kind.additive and not kind.lasting:
            notes.append("the state jumped once: the plant is unchanged, the observer restarts")
        else:
            found["offsets"].append(replace(fault.candidate, kind=fault.kind, name=place,
                                            members=fault.candidate.members or (place,)))
            if kind.grows:
                notes.append(f"{place}: a {kind.name} goes on growing; the model holds its last value")
            elif known:
                added = added + into_state @ size
    onsets = [fault.onset for _, fault in parts]
    label = " + ".join(fault.candidate.fault_kind.own_label(place) for place, fault in parts)
    once: dict[str, Any] = {name: tuple(dict.fromkeys(values)) for name, values in found.items() if name != "offsets"}
    return Damage(label, posterior, max(onsets), min(onsets) == max(onsets), offsets=tuple(found["offsets"]),
                  louder_sensors=louder, louder_states=states, gains=gains, constants=constants, added=added, **once)

"""The damaged system as a new problem: its model, its observer, and the control that remains possible.

Everything here is a pure function of a healthy model and a diagnosis; the healthy model is never changed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import check_integer
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults.diagnosis.answers import Diagnosis
from optid.faults.diagnosis.records import record_of
from optid.faults.repair.allocation import Allocation, Target, allocate, robust_allocation
from optid.faults.repair.ambiguity import Ambiguity, advise
from optid.faults.repair.damage import Damage, damages, merge_equivalent
from optid.faults.repair.refitting import NODES, RefitPrior
from optid.faults.repair.schedule import RefitRules, Schedule, refit
from optid.faults.repair.virtual_sensor import Observer, observer, without_sensors
from optid.models import HammersteinSS
from optid.registry import Rendered

WITHOUT_ANSWER = {
    "unknown": "no fault of the dictionary fits, so that no part of the model can be changed. Add candidates to the "
               "dictionary, or fit a new model to the record after the alarm",
    "untestable": "the input does not excite what is suspected. Record with a moving input, or apply "
                  "optid.faults.probe_input",
    "not isolable": "with one output every fault with a free course fits. Add a sensor, or use kinds of faults with a "
                    "course of their own",
}
"""Why verdicts without candidates give no reformulation."""


@dataclass(frozen=True, eq=False)
class MemberModel:
    """The plant under one explanation."""

    damage: Damage  # the explanation
    model: HammersteinSS  # the plant under it
    observer: Observer  # filter on the remaining sensors
    allocation: Allocation | None  # control by the remaining actuators; None where `notes` say why
    schedule: Schedule | None  # how the model was refitted; None where the plant itself is unchanged
    notes: tuple[str, ...]  # remarks

    @property
    def label(self) -> str:
        """The name of the explanation."""
        return self.damage.label

    def __str__(self) -> str:
        parts = [one for one in (self.schedule, self.observer, self.allocation) if one is not None]
        return "\n".join([*map(str, parts), *(f"note: {note}" for note in self.notes)])


@dataclass(frozen=True, eq=False, repr=False)
class Reformulation(Rendered):
    """The damaged system; `print` it, or ask `attainable`.

    Attributes:
        status: "healthy" (unchanged), "refitted", "as diagnosed" (without a refit), "not repaired" (the refit is no
            better than the healthy model, or too uncertain) or "ambiguous".
        healthy: the model before the fault.
        model: the model to use: the healthy one while the diagnosis is ambiguous.
        observer: filter on the remaining sensors; of an ambiguous diagnosis those that no member suspects.
        allocation: control by the remaining actuators; None where it cannot be set up.
        schedule: how the model was refitted; None without a refit.
        members: one per explanation, the most probable first.
        if_ambiguous: advice while there are several; None where there is one.
        notes: remarks.
    """

    status: str
    healthy: HammersteinSS
    model: HammersteinSS
    observer: Observer
    allocation: Allocation | None
    schedule: Schedule | None
    members: tuple[MemberModel, ...]
    if_ambiguous: Ambiguity | None
    notes: tuple[str, ...] = ()

    @property
    def error_bound(self) -> dict[str, float]:
        """{output: upper bound of the rms error of a later run}; empty without a refit."""
        promise = None if self.schedule is None else self.schedule.promise
        return {} if promise is None else dict(zip(promise.outputs, promise.bound.tolist()))

    def attainable(self, reference: ArrayLike) -> Target:
        """Return the steady state nearest to a reference (l,), its distance, and the actuators that limit it.

        While the diagnosis is ambiguous, the distance is that of the worst member.

        Raises:
            StructureError: no allocation, with the reason.
        """
        if self.if_ambiguous is not None and self.if_ambiguous.robust is not None:
            return self.if_ambiguous.robust.attainable(reference)
        if self.allocation is None:
            raise StructureError(f"The attainable outputs are unknown: {'; '.join(self.notes) or 'no allocation'}.")
        return self.allocation.attainable(reference)


def reformulate(
    model: HammersteinSS, diagnosis: Diagnosis, data: Any = None, *,
    constraints: Sequence[Any] | str = "default", prior: RefitPrior | None = None, nodes: int = NODES,
    stage: str = "auto",
    low: ArrayLike | None = None, high: ArrayLike | None = None, weights: ArrayLike | None = None,
    route: str = "auto", if_ambiguous: str = "auto", solver: Any = "auto", seed: int = 0, healthy: Any = None,
) -> Reformulation:
    """Return the damaged system from a healthy model and a diagnosis.

    A broken actuator is refitted from the record after its onset; a broken sensor is replaced by a filter on the
    others; added noise enters the filter. Several explanations give several members, and the model stays the healthy
    one until one of them is left.

    Args:
        model: the healthy model, with noise covariances.
        diagnosis: of the record.
        data: the record with the fault: Data, a pair (u, y) of arrays, or a frame or file with the channels of the
            model as columns; without it the plant has the sizes of the diagnosis.
        constraints: of a damaged nonlinearity: constraints on f or their words; "default": monotone as before and
            nowhere steeper.
        prior: of the refit; by default with the curvature that makes the record most probable.
        nodes: values of a damaged nonlinearity that has no nodes of its own.
        stage: "affected only", "all with prior", or "auto": by hold-out.
        low: (m,) least inputs; the intervals of the bases by default.
        high: (m,) largest inputs.
        weights: (l,) of the outputs in distances and costs.
        route: of the allocation: "qp", "nlp" or "auto".
        if_ambiguous: "wait", "probe", "robust", or "auto".
        solver: back end.
        seed: of draws and probes.
        healthy: a later healthy record, whose error of the healthy model the promised error includes; the samples
            before the fault by default.

    Raises:
        DataError: a record that does not go with the model or the diagnosis.
        StructureError: an unknown word; a diagnosis without candidates; a damaged plant that is not detectable or not
            stabilisable, with the mode; no noise covariances.
        SolverFailed: a refit without a feasible point.

    Warns:
        DataWarning: too few samples for a refit; values without a sample; a nonlinearity without an inverse.
    """
    _check(model, diagnosis, stage, nodes, if_ambiguous)
    if data is not None and not isinstance(data, Data):
        data = record_of(model, data)
    healthy = healthy if healthy is None else record_of(model, healthy)
    rules = RefitRules(constraints, prior, nodes, stage, solver, seed)
    bounds: dict[str, Any] = {"low": low, "high": high, "weights": weights, "solver": solver}

    def try_allocation(plant: HammersteinSS) -> tuple[Allocation | None, list[str]]:
        """Return the allocation, or why there is none: inputs without an interval, when no bounds are given."""
        for f, c in zip(plant.nonlinearities, plant.input_of):
            if f.basis.interval is None and (low is None or high is None):
                return None, [f"no allocation: input {plant.inputs[c]} has no range; give low= and high="]
        found = allocate(plant, route=route, **bounds)
        return found, list(found.messages)

    if diagnosis.verdict == "healthy":
        allocation, notes = try_allocation(model)
        return Reformulation("healthy", model, model, observer(model), allocation, None, (), None, tuple(notes))
    broken, members = merge_equivalent(model,
                                       [one for answer in diagnosis.candidates for one in damages(model, answer)]), []
    for damage in broken:
        watched, schedule = damage.with_noise(model), None
        plant = damage.nominal_model(watched)
        if damage.needs_refit and data is not None:
            plant, schedule = refit(watched, without_sensors(data, damage.sensors), damage, rules, healthy)
        allocation, notes = try_allocation(plant)
        if damage.needs_refit and data is None:
            notes.append("no record: the plant has the sizes of the diagnosis")
        members.append(MemberModel(damage, plant, observer(plant, damage.sensors), allocation, schedule,
                                   (*damage.notes, *notes)))
    if len(members) == 1:
        only = members[0]
        stages = {"prior": "as diagnosed", "none": "not repaired"}
        status = "as diagnosed" if only.schedule is None else stages.get(only.schedule.stage, "refitted")
        return Reformulation(status, model, only.model, only.observer,
                             only.allocation, only.schedule, (only,), None, only.notes)
    distrusted = sorted({name for one in broken for name in one.sensors})
    allocation, notes = try_allocation(model)
    if len(distrusted) == model.l:
        distrusted = []
        notes = ["every sensor is suspected by some member: all are used until one member is left", *notes]
    robust: Allocation | str
    try:
        robust = robust_allocation(model, broken, **bounds)
    except StructureError as error:
        robust = str(error)
    u = None if data is None else np.asarray(data.raw().experiments[0].u)
    advice = advise(model, broken, u, robust, (low, high), action=if_ambiguous, seed=seed)
    return Reformulation("ambiguous", model, model, observer(model, distrusted), allocation, None, tuple(members),
                         advice, tuple(notes))


def _check(model: Any, diagnosis: Any, stage: str, nodes: int, if_ambiguous: str) -> None:
    if getattr(model, "kind", "") != "HammersteinSS":
        raise StructureError(
            f"A {getattr(model, 'title', type(model).__name__)} cannot be reformulated: a state-space model with noise "
            "covariances is needed (formulation hammerstein_ss.asivid).")
    if isinstance(diagnosis, tuple | list):
        raise StructureError("Several diagnoses: reformulate takes one, of one experiment.")
    if not hasattr(diagnosis, "verdict"):
        raise StructureError(f"{type(diagnosis).__name__} is no diagnosis: pass the result of optid.faults.diagnose.")
    if diagnosis.outputs and tuple(diagnosis.outputs) != model.outputs:
        raise DataError(
            f"The diagnosis is of outputs {', '.join(diagnosis.outputs)}; the model has {', '.join(model.outputs)}.")
    if diagnosis.verdict != "healthy" and not diagnosis.candidates:
        why = WITHOUT_ANSWER.get(diagnosis.verdict, "it has no candidates")
        raise StructureError(f"The diagnosis is {diagnosis.verdict!r}: {why}.")
    for word, given, known in (("stage", stage, ("auto", "affected only", "all with prior")),
                               ("if_ambiguous", if_ambiguous, ("auto", "wait", "probe", "robust"))):
        if given not in known:
            raise StructureError(f"{word}={given!r}: use one of {', '.join(map(repr, known))}.")
    check_integer(nodes, "nodes", 3)

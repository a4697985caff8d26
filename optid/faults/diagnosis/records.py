"""Preparation of a diagnosis: the record, the scale of the noise, the uncertainty of the model, lost readings."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from optid.data.record import Data, Experiment
from optid.errors import DataError, StructureError
from optid.faults.diagnosis.answers import Estimate
from optid.faults.nuisance import ModelUncertainty, model_uncertainty
from optid.faults.readings import LostReadings, lost_readings
from optid.faults.screening import check_channels
from optid.faults.signatures import Dictionary, candidate_of
from optid.faults.whitening import Predictor, health, predictor, whiten
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of


def plant_of(model: Any) -> tuple[HammersteinSS, Data | None]:
    """Return the state-space model (else a `StructureError`), and the record it was identified from, of a fit."""
    fitted, data = getattr(model, "model", model), getattr(model, "data", None)
    if getattr(fitted, "kind", "") != "HammersteinSS":
        kind = getattr(fitted, "title", type(fitted).__name__)
        raise StructureError(f"A diagnosis requires a state-space model with noise covariances; this is a {kind}. Fit "
                             "one, for example with optid.fit(data, 'hammerstein_ss.asivid', nx=...).")
    return fitted, data if isinstance(data, Data) else None


def record_of(model: HammersteinSS, data: Any) -> Data:
    """Return a record in raw units with the channels of the model, from any of the forms that `diagnose` takes.

    Raises:
        DataError: other channels, another sampling time, a missing input, no reading at all.
    """
    if isinstance(data, Data):
        record = data
    elif isinstance(data, tuple | list) and len(data) == 2:
        if data[1] is None:
            raise DataError("The outputs are missing: give data, or the pair (u, y).")
        samples = Data(data[0], data[1], model.dt, list(model.inputs), list(model.outputs))
        record = Data.of_experiments(samples.experiments, model.dt, model.inputs, model.outputs,
                                     time_unit=model.time_unit)
    else:
        from optid.data.readers import read

        record = read(data, inputs=list(model.inputs), outputs=list(model.outputs), dt=model.dt)
    raw = in_units_of(model, record)
    for number, part in enumerate(raw.experiments, start=1):
        missing = np.argwhere(np.isnan(part.u))
        if missing.size:
            k, c = missing[0]
            raise DataError(
                f"experiment {number}: " * (raw.n_experiments > 1)
                + f"input {raw.inputs[c]!r} is missing at sample {k}: a diagnosis requires every input. Fill it, "
                "or cut the record there.")
    return raw


def steady_predictor(model: HammersteinSS, healthy: Any, rescale: bool) -> Predictor | None:
    """Return the predictor with the noise scale of a healthy record; None for that of the model.

    Raises:
        DataError: innovations that are not white or of another size, swapped channels, a change of unit.
        StructureError: `rescale` without a healthy record.
    """
    if healthy is None:
        if rescale:
            raise StructureError("rescale=True takes the scale of the noise from a healthy record: pass healthy=data.")
        return None
    record = record_of(model, healthy)
    check_channels(model, record)
    found = health(whiten(model, record)).predictor(predictor(model), rescale=rescale)
    return found if rescale else None


def uncertainty_of(model: HammersteinSS, data: Data | None, wanted: Any,
                   decoupled: Predictor | None = None) -> tuple[ModelUncertainty | None, str]:
    """Return the uncertainty of the model to use, and a remark for the report.

    Wanted is None (where the record of the identification is known), "use" (without it a `StructureError`), "ignore",
    or a `ModelUncertainty`; `decoupled` is a predictor decoupled from declared disturbances.
    """
    if isinstance(wanted, ModelUncertainty):
        if decoupled is not None and not wanted.predictor.silent:
            raise StructureError(
                "The predictor of this uncertainty is not decoupled from the declared disturbances: pass the fit in "
                "place of the model, or model_uncertainty(faults.model, data, decoupled=faults.predictor).")
        return wanted, wanted.remark
    if wanted not in (None, "use", "ignore"):
        raise StructureError(f"model_uncertainty={wanted!r}: it must be 'use', 'ignore' or a ModelUncertainty.")
    if wanted == "use" and data is None:
        raise StructureError("model_uncertainty='use' requires the covariance of the model: pass the fit in place of "
                             "the model, or optid.faults.model_uncertainty(model, data) with the record it was "
                             "identified from. 'ignore' takes the model as exact.")
    if wanted == "ignore" or data is None:
        return None, ""
    found = model_uncertainty(model, data, decoupled=decoupled)
    return found, f"The uncertainty of the identified model is treated as noise. {found.remark}".strip()


def without_lost_readings(record: Data, number: int) -> tuple[Experiment, tuple[LostReadings, ...]]:
    """Remove the readings of frozen and saturated sensors of an experiment, but the first, which may be a true one."""
    part = record.experiments[number]
    lines, y = lost_readings(part.y, record.outputs, number), np.array(part.y)
    for line in lines:
        own = y[line.first + 1 :, record.outputs.index(line.name.partition(":")[2])]
        changes = np.flatnonzero(~np.isnan(own) & (own != line.value))
        if not line.is_dead:
            own[: changes[0] if changes.size else None] = np.nan
    return replace(part, y=y) if lines else part, lines


def lost_sensors(lines: Sequence[LostReadings], found: Dictionary, edge: int) -> tuple[Estimate, ...]:
    """Return the frozen, saturated and dead sensors, each at its longest stretch, whether in the dictionary or not.

    The first of the equal readings may be a true one: the fault begins with the second. A stretch that begins within
    `edge` samples of the start of the record may have begun before it.
    """
    longest = {line.name: line for line in sorted(lines, key=lambda line: line.count)}
    known, faults = {(c.kind, place): c for c in reversed(found.candidates) for place in c.places}, []
    for name, line in longest.items():
        candidate = known.get((line.condition, name)) or candidate_of(found.model, name, line.condition)
        onset, censored = line.first + (not line.is_dead), line.first < edge
        value = np.array([] if line.is_dead else [line.value])
        faults.append(Estimate(
            candidate.label, name, line.condition, candidate, onset, (0 if censored else onset, onset), censored, value,
            np.stack([value, value], axis=1), np.zeros((value.size, value.size)), float("inf"),
        ))
    return tuple(sorted(faults, key=lambda fault: fault.onset))

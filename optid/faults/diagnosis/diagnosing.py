"""Diagnosis of a record: is something wrong, what is it, since when, how large, and how sure is all that?"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.errors import StructureError
from optid.faults.diagnosis.judgement import judge
from optid.faults.diagnosis.record_search import Question
from optid.faults.diagnosis.records import plant_of, record_of, steady_predictor, uncertainty_of
from optid.faults.nuisance import uncertain_start
from optid.faults.search.calibration import Thresholds
from optid.faults.signatures import Dictionary, dictionary

if TYPE_CHECKING:
    from optid.models import HammersteinSS

KINDS = "bias", "loss", "spike"
"""Kinds of faults that are thought possible where no dictionary is given."""


def diagnose(
    model: Any, data: Any, faults: Dictionary | None = None, *, false_alarm: float = 0.01, max_faults: int = 1,
    method: str = "exact", model_uncertainty: Any = None, coverage: float = 0.95, robust: bool = False,
    healthy: Any = None, rescale: bool = False, thresholds: Thresholds | None = None, seed: int | None = 0,
    solver: Any = "auto",
) -> Any:
    """Find out what a record says about the health of a plant.

    Every candidate of the dictionary is tried at every onset; the answer is a set of candidates that holds the true one
    with the probability `coverage`, with intervals of onset and size that account for the search.

    Args:
        model: the healthy state-space model with noise covariances, or the fit it comes from.
        data: the record: Data, a pair (u, y) of arrays, or a frame or file with the channels of the model as columns.
        faults: what may have happened; offsets of every channel, losses of every actuator, outliers of every sensor and
            a jump of the state by default.
        false_alarm: probability of an alarm of a healthy plant, over all candidates and onsets.
        max_faults: faults that may be in one record. Where no single fault fits, outliers and two faults are tried in
            any case.
        method: "exact" (exhaustive search, one or two faults), "sparse" (group-sparse programme), "sparse+polish" (the
            same as a screen before an exact search; three faults and more), or "set" (proof by bounds of the noise).
        model_uncertainty: "use" (of an identified model: give the fit in place of the model), "ignore", or what
            `optid.faults.model_uncertainty` returned; by default it is used where a fit is given.
        coverage: nominal probability of the set and of the intervals.
        robust: bound the influence of outliers (Huber), and take single wild readings out.
        healthy: a healthy record; the answer is refused where its innovations are not white or not of the size that the
            model says.
        rescale: take the scale of the noise from the healthy record.
        thresholds: from `optid.faults.thresholds` for this dictionary and length; simulated by default.
        seed: of the simulation.
        solver: for the methods that need one.

    Returns:
        A `Diagnosis`; a tuple for several experiments.

    Raises:
        DataError: a record that does not fit the model, a missing input, outputs that look swapped or change their
            unit, a healthy record with other noise, too few samples.
        StructureError: no noise covariances, impossible arguments, "use" without the covariance of the model.
    """
    asked = Question(false_alarm, max_faults, method, coverage, robust, thresholds, seed, solver)
    plant, origin = plant_of(model)
    record, found = record_of(plant, data), _dictionary(plant, faults)
    steady, decoupled = steady_predictor(plant, healthy, rescale), None
    if found.predictor.silent:
        plant, decoupled = found.model, found.predictor
    uncertainty, remark = uncertainty_of(plant, origin, model_uncertainty, decoupled)
    if steady is None or decoupled is not None:  # the covariance of the former counts what the fit took
        steady = found.predictor if uncertainty is None else uncertainty.predictor
    if steady is not found.predictor:
        found = replace(found, predictor=steady)
    if uncertainty is None:
        uncertainty = uncertain_start(plant, found.predictor)
    noise = {"uncertainty": replace(uncertainty, predictor=found.predictor), "scale": found.predictor}
    results = [judge(record, k, found, asked, noise, remark) for k in range(record.n_experiments)]
    return results[0] if len(results) == 1 else tuple(results)


def _dictionary(model: "HammersteinSS", faults: Dictionary | None) -> Dictionary:
    if faults is None:
        return dictionary(model, kinds=KINDS)
    if not isinstance(faults, Dictionary):
        raise StructureError(
            f"faults is a {type(faults).__name__}: pass the dictionary of optid.faults.dictionary(model, kinds=[...])."
        )
    same = faults.model is model or all(
        np.array_equal(getattr(faults.model, name), getattr(model, name)) for name in ("A", "B", "C", "D")
    )
    if not same or faults.model.inputs != model.inputs or faults.model.outputs != model.outputs:
        raise StructureError("The dictionary is of another model: build it with optid.faults.dictionary(model, ...).")
    return faults

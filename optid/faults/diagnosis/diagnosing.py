"""Diagnosis of a record: healthy or faulty, which fault, its onset and size, with probabilities."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.data.timeline import Timeline
from optid.errors import StructureError
from optid.faults.diagnosis import records
from optid.faults.diagnosis.alternatives import final_effect
from optid.faults.diagnosis.answers import Certificate, Diagnosis, Estimate, FaultAnswer, SearchEvidence
from optid.faults.diagnosis.courses import LONGEST
from optid.faults.diagnosis.posterior import estimates
from optid.faults.diagnosis.ranking import NOTHING, RankedExplanation, explain_record
from optid.faults.diagnosis.record_search import Question, RecordSearch, search_record
from optid.faults.false_alarms import Thresholds
from optid.faults.nuisance import uncertain_start
from optid.faults.ranges import input_range_notes, outside, usable_samples
from optid.faults.screening import check_channels
from optid.faults.signatures import Dictionary, dictionary
from optid.models import HammersteinSS
from optid.threads import one_thread

KINDS = "bias", "loss", "spike"  # kinds of faults of the default dictionary


@one_thread
def diagnose(model: Any, data: Any, faults: Dictionary | None = None, *, false_alarm: float = 0.01, max_faults: int = 1,
             method: str = "exact", model_uncertainty: Any = None, coverage: float = 0.95, robust: bool = False,
             healthy: Any = None, rescale: bool = False, thresholds: Thresholds | None = None, seed: int | None = 0,
             solver: Any = "auto") -> Any:
    """Diagnose a record: healthy or faulty, which fault, its onset and size.

    Every candidate of the dictionary is tried at every onset; the answer is a set of candidates that contains the true
    one with probability `coverage`, with intervals of onset and size that account for the search.

    Args:
        model: the healthy state-space model with noise covariances, or the fit it comes from.
        data: the record: Data, a pair (u, y) of arrays, or a frame or file with the channels of the model as columns.
        faults: the possible faults; offsets of every channel, losses of every actuator, outliers of every sensor and a
            jump of the state by default.
        false_alarm: probability of an alarm of a healthy plant, over all candidates and onsets.
        max_faults: largest number of faults in the record. Where no single fault fits, outliers and two faults are
            tried in any case.
        method: "exact" (exhaustive search, one or two faults), "sparse" (group-sparse programme), "sparse+polish" (the
            same as a screen before an exact search; three faults and more), or "set" (proof by bounds of the noise).
        model_uncertainty: "use" (of an identified model: pass the fit in place of the model), "ignore", or the result
            of `optid.faults.model_uncertainty`; by default it is used where a fit is given.
        coverage: nominal probability of the set and of the intervals.
        robust: bound the influence of outliers (Huber), and remove single outliers.
        healthy: a healthy record; a model is refused whose innovations there are not white or not of the predicted
            size.
        rescale: take the scale of the noise from the healthy record.
        thresholds: from `optid.faults.thresholds` for this dictionary and length; simulated by default.
        seed: of the simulation.
        solver: for the methods that need one.

    Returns:
        A `Diagnosis`; a tuple for several experiments.

    Raises:
        DataError: a record that does not fit the model, a missing input, swapped outputs, a change of unit, a healthy
            record with other noise, too few samples.
        StructureError: no noise covariances, impossible arguments, "use" without the covariance of the model.
    """
    asked = Question(false_alarm, max_faults, method, coverage, robust, thresholds, seed, solver)
    plant, origin = records.plant_of(model)
    record, found = records.record_of(plant, data), _dictionary(plant, faults)
    steady, decoupled = records.steady_predictor(plant, healthy, rescale), None
    if found.predictor.silent:
        plant, decoupled = found.model, found.predictor
    uncertainty, remark = records.uncertainty_of(plant, origin, model_uncertainty, decoupled)
    if steady is None or decoupled is not None:  # an uncertain model has its own scale
        steady = found.predictor if uncertainty is None else uncertainty.predictor
    if steady is not found.predictor:
        found = replace(found, predictor=steady)
    if uncertainty is None:
        uncertainty = uncertain_start(plant, found.predictor)
    noise = {"uncertainty": replace(uncertainty, predictor=found.predictor), "scale": found.predictor}
    results = [_judged(record, k, found, asked, noise, remark) for k in range(record.n_experiments)]
    return results[0] if len(results) == 1 else tuple(results)


def _dictionary(model: HammersteinSS, faults: Dictionary | None) -> Dictionary:
    if faults is None:
        return dictionary(model, kinds=KINDS)
    if not isinstance(faults, Dictionary):
        raise StructureError(
            f"faults is a {type(faults).__name__}: pass the dictionary of optid.faults.dictionary(model, kinds=[...]).")
    if not faults.belongs_to(model):
        raise StructureError("The dictionary is of another model: build it with optid.faults.dictionary(model, ...).")
    return faults


def _judged(record: Data, number: int, found: Dictionary, asked: Question, noise: Mapping[str, Any], remark: str
          ) -> Diagnosis:
    """Return the diagnosis of an experiment; `noise` are arguments of `whiten`, and the remark is reported."""
    model = found.model
    part, lines = records.without_lost_readings(record, number)
    count, cut = usable_samples(model, part.u)
    part = replace(part, u=part.u[:count], y=part.y[:count])
    stuck = records.lost_sensors(lines, found, 2 * model.nx)
    first = search_record(record, part, found, asked, noise)
    notes = [remark, cut, *(f"{line}." for line in lines), _outliers(first), *map(str, outside(model, part.u)),
             *input_range_notes(model, part.u), *first.extrapolated]
    seen, ranking, alarm = explain_record(first)
    notes.append(ranking.note)
    fits = ranking.fits if not found.unknown or ranking.explains else ()
    if alarm and not fits:
        check_channels(model, record)
    if alarm and fits and model.l == 1:
        notes.append("With one output only faults with a known course are isolable.")
    timeline = record.timelines[number]
    answers = _answers(seen, fits, stuck, timeline)
    certificate = ranking.certificate if fits or ranking.certificate.parity_vector is not None else NOTHING
    if stuck and not fits:
        certificate = Certificate("flat line", float(max(line.count for line in lines)))
    remaining = None
    if alarm:
        remaining = ranking.fits[0].remaining if ranking.fits else seen.healthy
    verdict = "untestable" if seen.lost and not seen.tested else "unknown" if alarm else "healthy"
    if alarm and model.l == 1 and any(c.fault_kind.waveform for c in seen.dictionary.candidates):
        verdict = "not isolable"
    white, search = seen.whitened, seen.search
    fitted = fits[0].fitted if fits else np.zeros_like(white.r)
    return Diagnosis(
        verdict="faulty" if stuck or fits else verdict,
        detected=bool(alarm or stuck),
        best=answers[0] if answers and certificate.proved else None, candidates=answers,
        p_value=0.0 if stuck else first.p_value, certificate=certificate,
        untestable=dict(seen.lost) | _not_searched(seen), window=len(white.r), false_alarm=asked.false_alarm,
        coverage=asked.coverage, method=asked.method,
        status=timeline.with_times(" ".join(note for note in notes if note)),
        model=model.title, outputs=model.outputs, dt=model.dt, remaining=remaining,
        evidence=SearchEvidence(white.r, white.present, fitted, seen.gains, () if search is None else search.labels,
                                search),
        timeline=timeline, findings=record.findings,
    )


def _not_searched(seen: RecordSearch) -> dict[str, str]:
    """Return the candidates that are not tested, and why."""
    found, model = seen.dictionary, seen.dictionary.model
    lost: dict[str, str] = {}
    if model.feedback or np.any(model.L):
        why = "the model feeds readings back into its state, so that a faulty one changes the plant"
        lost = {c.label: why for c in found.candidates if c.is_sensor_gain}
    if seen.whitened.r.size > LONGEST:
        why = f"the record has more than {LONGEST} readings, too many for this kind: cut it"
        return lost | {c.label: why for c in found.candidates
                       if c.fault_kind.waveform or c.fault_kind.noise}
    why = "with one output a fault of arbitrary course explains every record"
    return lost | {c.label: why for c in found.candidates if c.fault_kind.waveform and model.l == 1}


def _answers(seen: RecordSearch, fits: tuple[RankedExplanation, ...], stuck: tuple[Estimate, ...], timeline: Timeline
             ) -> tuple[FaultAnswer, ...]:
    """Return the set of answers, each with the sensors that repeat one reading."""
    model, result = seen.dictionary.model, []
    if not fits and stuck:
        return (FaultAnswer(tuple(_timed(fault, timeline) for fault in stuck), 1.0, float("inf")),)
    for fit in fits:
        faults = estimates(fit.explanation, seen.asked.coverage, len(fit.fitted), 2 * model.nx)
        faults = tuple(replace(one, effect=final_effect(model, one.name, one.size)) for one in faults)
        merged = sorted((*stuck, *faults), key=lambda fault: fault.onset)
        result.append(FaultAnswer(tuple(_timed(fault, timeline) for fault in merged), fit.probability, fit.gain))
    return tuple(result)


def _timed(fault: Estimate, timeline: Timeline) -> Estimate:
    low, high = fault.onset_interval
    return replace(fault, onset_time=timeline.text(fault.onset),
                   onset_interval_time=(timeline.text(low), timeline.text(high)))


def _outliers(seen: RecordSearch) -> str:
    if not seen.outliers:
        return ""
    listed = ", ".join(f"{seen.record.outputs[o]} at sample {k}" for k, o in seen.outliers[:5])
    more = f" and {len(seen.outliers) - 5} more" if len(seen.outliers) > 5 else ""
    return f"Removed as outliers: {listed}{more}."

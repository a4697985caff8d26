"""From the search of one experiment to a verdict."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from optid.data.record import Data
from optid.faults.consistency.standstill import Frozen, frozen
from optid.faults.diagnosis.alternatives import final_effect
from optid.faults.diagnosis.answers import Answer, Certificate, Diagnosis, Evidence
from optid.faults.diagnosis.courses import LONGEST
from optid.faults.diagnosis.intervals import estimates
from optid.faults.diagnosis.ranking import NOTHING, Fit, find
from optid.faults.diagnosis.record_search import Question, RecordSearch, search_record
from optid.faults.diagnosis.records import without_flat_lines
from optid.faults.ranges import outside
from optid.faults.screening import check_channels
from optid.faults.signatures import Dictionary


def judge(record: Data, number: int, found: Dictionary, asked: Question, noise: Mapping[str, Any], remark: str
          ) -> Diagnosis:
    """Search one experiment, judge it, and widen the search where one fault is not enough.

    Args:
        record: in raw units.
        number: of the experiment, from 0.
        found: the candidates.
        asked: what is asked.
        noise: arguments of `whiten`: uncertainty and scale.
        remark: for the report in any case.
    """
    model = found.model
    still = without_flat_lines(record, number)
    stuck = frozen(still, record, found, 2 * model.nx)
    first = search_record(record, still.part, found, asked, noise)
    notes = [remark, *(f"{line}." for line in still.lines), _outliers(first), *map(str, outside(model, still.part.u))]
    seen, ranking, alarm = find(first)
    notes.append(ranking.note)
    fits = ranking.fits if not found.unknown or ranking.explains else ()
    if alarm and not fits:
        check_channels(model, record)
    if alarm and fits and model.l == 1:
        notes.append("With one output only faults of a known course can be told apart.")
    answers = _answers(seen, fits, stuck)
    certificate = ranking.certificate if fits or ranking.certificate.kind == "infeasible healthy" else NOTHING
    if stuck.faults and not fits:
        certificate = Certificate("flat line", float(stuck.count))
    remaining = None
    if alarm:
        remaining = ranking.fits[0].remaining if ranking.fits else seen.healthy
    white, search = seen.whitened, seen.search
    fitted = fits[0].fitted if fits else np.zeros_like(white.r)
    return Diagnosis(
        verdict="faulty" if stuck.faults or fits else _without_answer(seen, alarm),
        detected=bool(alarm or stuck.faults),
        best=answers[0] if answers and certificate.kind != "none" else None, candidates=answers,
        p_value=0.0 if stuck.faults else first.p_value, certificate=certificate,
        untestable=dict(seen.lost) | _not_searched(seen), window=len(white.r), false_alarm=asked.false_alarm,
        coverage=asked.coverage, method=asked.method, status=" ".join(note for note in notes if note),
        model=model.title, outputs=model.outputs, dt=model.dt, remaining=remaining,
        evidence=Evidence(white.r, white.present, fitted, seen.gains, () if search is None else search.labels, search),
    )


def _without_answer(seen: RecordSearch, alarm: bool) -> str:
    """The verdict where there is no answer."""
    found, nothing = seen.dictionary, bool(seen.lost) and not seen.tested
    if alarm and found.model.l == 1 and any(c.kind == "frozen" for c in found.candidates):
        return "not isolable"
    return "untestable" if nothing else "unknown" if alarm else "healthy"


def _not_searched(seen: RecordSearch) -> dict[str, str]:
    """The candidates that no search covers, and why."""
    found, model = seen.dictionary, seen.dictionary.model
    lost: dict[str, str] = {}
    if model.feedback or np.any(model.L):
        why = "the model feeds readings back into its state, so that a wrong one changes the plant"
        lost = {c.label: why for c in found.candidates if c.kind == "loss" and not c.columns}
    if seen.whitened.r.size > LONGEST:
        why = f"the record has more than {LONGEST} readings, too many for this kind: cut it"
        return lost | {c.label: why for c in found.candidates if c.kind in ("frozen", "noise")}
    why = "with one output a fault of any course explains every record"
    return lost | {c.label: why for c in found.candidates if c.kind == "frozen" and model.l == 1}


def _answers(seen: RecordSearch, fits: tuple[Fit, ...], stuck: Frozen) -> tuple[Answer, ...]:
    """The set of answers, sensors that stand still in each of them."""
    model, result = seen.dictionary.model, []
    if not fits and stuck.faults:
        return (Answer(stuck.faults, 1.0, float("inf")),)
    for fit in fits:
        faults = estimates(fit.explanation, seen.asked.coverage, len(fit.fitted), 2 * model.nx)
        faults = tuple(replace(one, effect=final_effect(model, one.name, one.size)) for one in faults)
        merged = tuple(sorted((*stuck.faults, *faults), key=lambda fault: fault.onset))
        result.append(Answer(merged, fit.probability, fit.gain))
    return tuple(result)


def _outliers(seen: RecordSearch) -> str:
    if not seen.outliers:
        return ""
    listed = ", ".join(f"{seen.record.outputs[o]} at sample {k}" for k, o in seen.outliers[:5])
    more = f" and {len(seen.outliers) - 5} more" if len(seen.outliers) > 5 else ""
    return f"Taken out as outliers: {listed}{more}."

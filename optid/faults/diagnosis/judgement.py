"""From the search of one experiment to a verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.data.record import Data, Experiment
from optid.faults.consistency.standstill import frozen
from optid.faults.diagnosis.alternatives import final_effect
from optid.faults.diagnosis.answers import Answer, Certificate, Diagnosis, Estimate
from optid.faults.diagnosis.courses import LONGEST
from optid.faults.diagnosis.evidence import Evidence
from optid.faults.diagnosis.explaining import Fit, Ranking, doubles, ranked, singles
from optid.faults.diagnosis.intervals import estimates
from optid.faults.diagnosis.looking import Seen, look
from optid.faults.diagnosis.methods import Way, by_bounds, by_programme
from optid.faults.diagnosis.outliers import with_spikes
from optid.faults.diagnosis.records import without_flat_lines
from optid.faults.ranges import outside
from optid.faults.screening import check_channels
from optid.faults.signatures import Dictionary

if TYPE_CHECKING:
    from optid.faults.diagnosis.diagnosing import Question

NOTHING = Certificate("none", float("nan"))


@dataclass(frozen=True, eq=False)
class Job:
    """The diagnosis of one experiment.

    Attributes:
        record: in raw units.
        number: of the experiment, from 0.
        found: the candidates.
        asked: what is asked.
        noise: arguments of `whiten`: uncertainty and scale.
        remark: what is to be said in any case.
    """

    record: Data
    number: int
    found: Dictionary
    asked: "Question"
    noise: Mapping[str, Any]
    remark: str

    def run(self) -> Diagnosis:
        """Search, judge, and widen the search where one fault is not enough."""
        model, asked = self.found.model, self.asked
        still = without_flat_lines(self.record, self.number)
        stuck = frozen(still, self.record, self.found, 2 * model.nx)
        seen = look(self.record, still.part, self.found, asked, self.noise)
        notes = [self.remark, *(f"{line}." for line in still.lines), _outliers(seen, model.outputs),
                 *map(str, outside(model, still.part.u))]
        p_value = seen.p_value(asked, self.found.unknown)
        seen, way, alarm = self.way(seen, still.part, p_value <= asked.false_alarm)
        ranking = way.ranking
        notes.append(way.note)
        fits = ranking.fits if not self.found.unknown or _explains(ranking) else ()
        if alarm and not fits:
            check_channels(model, self.record)
        if alarm and fits and model.l == 1:
            notes.append("With one output only faults of a known course can be told apart.")
        verdict = self.verdict(seen, alarm, bool(fits), bool(stuck.faults))
        answers = self.answers(fits, stuck.faults)
        certificate = way.certificate if fits or way.certificate.kind == "infeasible healthy" else NOTHING
        if stuck.faults and not fits:
            certificate = Certificate("flat line", float(stuck.count))
        remaining = None
        if alarm:
            remaining = fits[0].remaining if fits else ranking.fits[0].remaining if ranking.fits else seen.healthy
        lost = dict(seen.lost) | self.untold(seen)
        return Diagnosis(
            verdict=verdict, detected=bool(alarm or stuck.faults),
            best=answers[0] if answers and certificate.kind != "none" else None, candidates=answers,
            p_value=0.0 if stuck.faults else p_value, certificate=certificate, untestable=lost,
            window=len(seen.whitened.r), false_alarm=asked.false_alarm, coverage=asked.coverage, method=asked.method,
            status=" ".join(note for note in notes if note), model=model.title, outputs=model.outputs, dt=model.dt,
            remaining=remaining, evidence=_evidence(seen, fits),
        )

    def way(self, seen: Seen, part: Experiment, alarm: bool) -> tuple[Seen, Way, bool]:
        """Return what the method asked for finds, and whether the record is not healthy.

        Args:
            seen: the search.
            part: the experiment.
            alarm: whether the statistics raise an alarm.
        """
        unproved = ""
        if self.asked.method == "set":
            found, proved = by_bounds(self.record, seen, self.asked)
            if proved and not _explains(found.ranking):  # no single fault: what is proved is that something is wrong
                seen, ranking, note = self.explained(seen, part)
                return seen, found._replace(ranking=ranking, note=" ".join((found.note, note)).strip()), True
            if proved or not alarm:
                return seen, found, proved
            unproved = f"{found.note} The answer is that of the exact search."
        if not alarm:
            return seen, Way(Ranking((), np.inf, True), NOTHING), False
        if self.asked.method.startswith("sparse"):
            return seen, by_programme(seen, self.asked), True
        seen, ranking, note = self.explained(seen, part)
        note = " ".join(words for words in (unproved, note) if words)
        if not ranking.fits:
            return seen, Way(ranking, NOTHING, note), True
        on_grid = any(c.kind == "noise" for c in ranking.fits[0].explanation.candidates)  # whose onsets are sampled
        kind = "exhaustive" if ranking.exhaustive and not on_grid else "grid"
        return seen, Way(ranking, Certificate(kind, ranking.fits[0].gain, ranking.odds), note), True

    def explained(self, seen: Seen, part: Experiment) -> tuple[Seen, Ranking, str]:
        """Return what may have happened: by the candidates, with outliers beside them, by two faults.

        Args:
            seen: the search.
            part: the experiment, for a search with more candidates.
        """
        asked = self.asked
        ranking = self.ranking(seen, asked.max_faults)
        if _explains(ranking) or seen.search is None or not self.found.unknown:
            return seen, ranking, _grid(ranking)
        wide = look(self.record, part, with_spikes(self.found), replace(asked, thresholds=None), self.noise)
        for count in dict.fromkeys((asked.max_faults, 2)):
            wider = self.ranking(wide, count)
            if _explains(wider):
                several = "No single fault explains the record: two were searched." * (count > asked.max_faults)
                return wide, wider, " ".join(note for note in (several, _grid(wider)) if note)
        return seen, ranking, _grid(ranking)

    def ranking(self, seen: Seen, count: int) -> Ranking:
        """Return the set of explanations by so many faults at most."""
        explanations, exhaustive = singles(seen), True
        if count > 1 and seen.tested:
            together, exhaustive = doubles(seen)
            explanations += together
        return ranked(seen, explanations, self.asked.false_alarm, self.asked.coverage, exhaustive)

    def verdict(self, seen: Seen, alarm: bool, fits: bool, stuck: bool) -> str:
        """Return the word for it."""
        if stuck or fits:
            return "faulty"
        if not alarm:
            return "untestable" if seen.lost and not seen.tested else "healthy"
        if self.found.model.l == 1 and any(c.kind == "frozen" for c in self.found.candidates):
            return "not isolable"
        return "untestable" if not seen.tested and seen.lost else "unknown"

    def untold(self, seen: Seen) -> dict[str, str]:
        """Return the candidates that no search covers, and why."""
        found = self.found
        gains = [c.label for c in found.candidates if c.kind == "loss" and not c.columns]
        if gains and (found.model.feedback or np.any(found.model.L)):
            why = "the model feeds readings back into its state, so that a wrong one changes the plant"
            return dict.fromkeys(gains, why) | self._too_long(seen)
        return self._too_long(seen)

    def _too_long(self, seen: Seen) -> dict[str, str]:
        found = self.found
        if seen.whitened.r.size > LONGEST:
            why = f"the record has more than {LONGEST} readings, too many for this kind: cut it"
            return {c.label: why for c in found.candidates if c.kind in ("frozen", "noise")}
        why = "with one output a fault of any course explains every record"
        return {c.label: why for c in found.candidates if c.kind == "frozen" and found.model.l == 1}

    def answers(self, fits: Sequence[Fit], stuck: tuple[Estimate, ...]) -> tuple[Answer, ...]:
        """Return the set of answers, sensors that stand still in each of them."""
        model, asked = self.found.model, self.asked
        if not fits:
            return (Answer(stuck, 1.0, float("inf")),) if stuck else ()
        result = []
        for fit in fits:
            faults = estimates(fit.explanation, asked.coverage, len(fit.fitted), 2 * model.nx)
            faults = tuple(replace(one, effect=final_effect(model, one.name, one.size)) for one in faults)
            merged = tuple(sorted((*stuck, *faults), key=lambda fault: fault.onset))
            result.append(Answer(merged, fit.probability, fit.gain))
        return tuple(result)


def _explains(ranking: Ranking) -> bool:
    return any(fit.fits for fit in ranking.fits)


def _grid(ranking: Ranking) -> str:
    return "" if ranking.exhaustive else "Two faults were searched on a grid of onsets."


def _outliers(seen: Seen, outputs: tuple[str, ...]) -> str:
    if not seen.outliers:
        return ""
    listed = ", ".join(f"{outputs[o]} at sample {k}" for k, o in seen.outliers[:5])
    more = f" and {len(seen.outliers) - 5} more" if len(seen.outliers) > 5 else ""
    return f"Taken out as outliers: {listed}{more}."


def _evidence(seen: Seen, fits: Sequence[Fit]) -> Evidence:
    white = seen.whitened
    return Evidence(
        white.r, white.present, fits[0].fitted if fits else np.zeros_like(white.r), seen.gains,
        tuple(seen.search.labels) if seen.search is not None else (), seen.part.y, seen.part.y - white.innovations,
        seen.search,
    )

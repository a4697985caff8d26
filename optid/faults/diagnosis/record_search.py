"""Search of one experiment: innovations, statistics, thresholds, and untestable candidates."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer, check_probability
from optid.data.record import Data, Experiment
from optid.errors import DataError, StructureError, nearest
from optid.faults.diagnosis.alternatives import with_unlisted_candidates
from optid.faults.diagnosis.answers import Remaining
from optid.faults.diagnosis.courses import courses, without_signature
from optid.faults.diagnosis.leftover import further_fault, remainder_test
from optid.faults.diagnosis.outliers import cleaned, with_spikes
from optid.faults.diagnosis.posterior import Explanation
from optid.faults.diagnosis.sensor_gains import sensor_gains
from optid.faults.false_alarms import EXCEEDING, Thresholds
from optid.faults.search.scanning import Scan, scan, thresholds
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened, whiten

METHODS = "exact", "sparse", "sparse+polish", "set"

UNKNOWN_SHARE = 0.1  # share of the false-alarm probability for deviations outside the dictionary
COURSE_SHARE = 0.1  # share for candidates without a signature, where there are some
SIMULATED = 2_000_000  # total of samples above which fewer windows are simulated
LEAST = 4.0  # least deflection of a complete loss beside a constant offset that is testable
DRAWS, MOST_DRAWS = 20_000, 500_000  # simulated windows for the thresholds of a short record, and the largest number


@dataclass(frozen=True, eq=False)
class Question:
    """Options of a diagnosis; the attributes are arguments of `optid.faults.diagnose`."""

    false_alarm: float
    max_faults: int
    method: str
    coverage: float
    robust: bool
    thresholds: Thresholds | None
    seed: int | None
    solver: Any

    def __post_init__(self) -> None:
        for word, value in (("false_alarm", self.false_alarm), ("coverage", self.coverage)):
            check_probability(value, word)
        if self.method not in METHODS:
            raise StructureError(f"method={self.method!r}. {nearest(str(self.method), METHODS)}")
        check_integer(self.max_faults, "max_faults")
        if self.method == "exact" and self.max_faults > 2:
            raise StructureError(
                f"max_faults={self.max_faults}: the exact search is limited to two faults. Use method='sparse+polish'.")


@dataclass(frozen=True, eq=False)
class RecordSearch:
    """One experiment, searched; `search_record` makes it."""

    record: Data  # of the experiment
    given: Experiment  # the experiment, without flat lines
    dictionary: Dictionary  # the candidates
    asked: Question  # options
    noise: Mapping[str, Any]  # arguments of `whiten`: uncertainty and scale
    part: Experiment  # the experiment without outliers
    whitened: Whitened  # its innovations, clipped at outliers
    search: Scan | None  # of the innovations; None where no candidate has a signature
    limits: Thresholds | None  # thresholds of the search; None without a search
    gains: Array  # (C, N) statistics less thresholds; NaN where a candidate is not tested or not testable
    lost: dict[str, str]  # {label: why} of candidates that are not testable
    healthy: Remaining  # residual of the healthy plant
    outliers: tuple[tuple[int, int], ...]  # (sample, output) of the removed readings
    narrower: "RecordSearch | None" = None  # the search of the same readings with fewer candidates; None without one

    @property
    def tested(self) -> list[Candidate]:
        """The tested candidates."""
        return [c for c, gains in zip(self.dictionary.candidates, self.gains) if not np.isnan(gains).all()]

    @cached_property
    def extrapolated(self) -> list[str]:
        """The outputs that leave the range over which an uncertain model was identified, in words."""
        return self.noise["uncertainty"].output_range_notes(self.part.y)

    @cached_property
    def p_value(self) -> float:
        """p-value of the healthy plant; there is an alarm at or below the false-alarm probability."""
        values = [1.0]
        if self.limits is not None:
            rate = self.limits.false_alarm
            values.append(further_fault(self.gains, rate) * self.asked.false_alarm / rate)
        if self.dictionary.unknown:
            values.append(self.healthy.p_value / UNKNOWN_SHARE)
        if self.courses:
            # by Markov's inequality an averaged likelihood ratio exceeds 1 / p with probability p at most
            log = np.logaddexp.reduce([c.log_evidence for c in self.courses]) - np.log(len(self.courses))
            values.append(float(np.exp(-log)) / COURSE_SHARE)
        return min(values)

    @cached_property
    def beside(self) -> Scan | None:
        """The search for candidates beside the dictionary; None without any."""
        more = with_unlisted_candidates(self.dictionary)
        return None if more is None else scan(more, self.whitened, self.part.u)

    @cached_property
    def courses(self) -> list[Explanation]:
        """Explanations by frozen sensors and increased noise."""
        if self.narrower is not None:
            return self.narrower.courses
        return courses(self.dictionary, self.whitened, self.part)

    @cached_property
    def gains_of_sensors(self) -> list[Explanation]:
        """Explanations by sensors that lost a share of their reading."""
        if self.narrower is not None:
            return self.narrower.gains_of_sensors
        return sensor_gains(self.dictionary, self.whitened, self.part, self.noise.get("uncertainty"))

    def widened(self) -> "RecordSearch":
        """Return the search with the outliers of all sensors among the candidates."""
        asked = replace(self.asked, thresholds=None)
        wide = search_record(self.record, self.given, with_spikes(self.dictionary), asked, self.noise)
        return wide if asked.robust else replace(wide, narrower=self)  # where outliers are removed, others may be


def search_record(record: Data, part: Experiment, found: Dictionary, asked: Question,
                  noise: Mapping[str, Any]) -> RecordSearch:
    """Search one experiment; the arguments are attributes of `RecordSearch`.

    Raises:
        DataError: too few samples.
        StructureError: thresholds of another length or dictionary.
    """

    def whitened_of(one: Experiment) -> Whitened:
        alone = Data(one.u, one.y, record.dt, record.inputs, record.outputs, start=one.start)
        white, least = whiten(found.model, alone, **noise), 2 * found.model.nx + 2
        seen = int(white.present.any(axis=1).sum())
        if seen < least:
            raise DataError(f"The record has {seen} samples with a reading (repeated readings of flat lines do not "
                            f"count): {found.model.nx} states require {least}.")
        return white

    given, outliers = part, ()
    search, limits, lost = None, None, {}
    if any(c.additive or c.columns or c.schedule is not None for c in found.candidates):
        if asked.robust:
            search, part, outliers = cleaned(found, part, whitened_of)
        else:
            search = scan(found, whitened_of(part), part.u)
        white = search.whitened
        limits, lost = _limits(found, white, part.u, asked), untestable(search)
        gains = search.gains(limits)
        gains[[label in lost for label in found.labels]] = np.nan
    else:
        white = whitened_of(part)
        gains = np.full((len(found.candidates), len(white.r)), np.nan)
    healthy = remainder_test(white, white.r, found.model.nx)
    return RecordSearch(record, given, found, asked, noise, part, white, search, limits, gains, lost, healthy, outliers)


def _limits(found: Dictionary, white: Whitened, u: Array, asked: Question) -> Thresholds:
    given, count = asked.thresholds, len(white.r)
    if given is not None:
        if given.window != count:
            raise StructureError(f"The thresholds are for windows of {given.window} samples; the record has {count}. "
                                 f"Calibrate them with thresholds(faults, {count}, ...), or leave them out.")
        return given
    rate = asked.false_alarm * (1 - UNKNOWN_SHARE * found.unknown - COURSE_SHARE * any(without_signature(found)))
    needed = int(np.ceil(EXCEEDING / rate))
    if needed > MOST_DRAWS:
        raise DataError(f"false_alarm={asked.false_alarm:g}: thresholds for so rare an alarm need {needed} simulated "
                        f"windows; {MOST_DRAWS} are the most ({EXCEEDING / MOST_DRAWS:g} is the rarest alarm). Ask for "
                        "a higher probability, or simulate them yourself: thresholds(..., draws=...).")
    draws = max(needed, min(DRAWS, SIMULATED // count))
    inputs = u if any(c.columns or c.schedule is not None for c in found.candidates) else None
    return thresholds(found, white, rate, u=inputs, draws=draws, seed=asked.seed)


def untestable(found: Scan) -> dict[str, str]:
    """Return the candidates that a record cannot test, and why.

    Where the input is constant, a loss is an offset of the actuator, and where its function is zero, it has no effect.
    The criterion is the deflection of a complete loss beside a constant offset of the same actuator.
    """
    result = {}
    for c, candidate in enumerate(found.dictionary.candidates):
        if candidate.columns and found.u is not None:
            white = found.whitened
            into_state, into_output = found.dictionary.additions(candidate.widened, len(white.r), 0, found.u)
            trace = white.whiten_signature(white.predictor.respond(into_state, into_output, white.present))
            flat = trace.reshape(-1, trace.shape[2])
            beside = flat[:, 1:]
            rest = flat[:, 0] - beside @ np.linalg.lstsq(beside, flat[:, 0], rcond=1e-9)[0]
            deflection = round(float(np.linalg.norm(rest)), 6)
            if deflection < LEAST:
                value = float(np.linalg.eigvalsh(flat.T @ flat)[0])
                result[candidate.label] = (
                    f"no excitation: a complete loss would have a deflection of {deflection:.2g} beside a constant "
                    f"offset, {LEAST:g} is required (smallest Gram eigenvalue {max(value, 0.0):.2g})")
        elif (candidate.additive or candidate.columns) and np.isnan(found.statistic[c]).all():
            result[candidate.label] = "it has no effect in this record"
    return result

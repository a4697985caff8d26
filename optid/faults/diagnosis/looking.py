"""The search of one experiment: innovations, statistics, thresholds, and what the record cannot tell."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data, Experiment
from optid.errors import DataError, StructureError
from optid.faults.consistency.excitation import untestable
from optid.faults.consistency.leftover import alarm_probability, left_over
from optid.faults.diagnosis.alternatives import extended
from optid.faults.diagnosis.courses import courses, without_signature
from optid.faults.diagnosis.outliers import cleaned
from optid.faults.diagnosis.posterior import Explanation
from optid.faults.diagnosis.records import enough, one_record
from optid.faults.diagnosis.sensor_gains import sensor_gains
from optid.faults.nuisance import ModelUncertainty
from optid.faults.search.calibration import EXCEEDING, Thresholds, thresholds
from optid.faults.search.scanning import Scan, scan
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Whitened, whiten

if TYPE_CHECKING:
    from optid.faults.diagnosis.answers import Remaining
    from optid.faults.diagnosis.diagnosing import Question

UNKNOWN_SHARE = 0.1
"""Share of the false alarms that goes to departures from health that no candidate describes."""

COURSE_SHARE = 0.1
"""Share that goes to candidates without a signature, where there are some."""

SIMULATED = 2_000_000
"""Samples of all simulated windows together, above which fewer windows are simulated."""

DRAWS, MOST_DRAWS = 20_000, 500_000
"""Simulated windows behind the thresholds of a short record, and the most that are simulated."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One experiment as the search sees it.

    Attributes:
        dictionary: the candidates.
        part: the record, without readings that were taken out.
        whitened: its innovations, bounded where outliers are.
        search: of the innovations; None where no candidate has a signature.
        limits: thresholds of the search; None without a search.
        gains: (C, N) statistics less thresholds; NaN where a candidate is not tested or not testable.
        lost: {label: why} of candidates that are not testable.
        healthy: what is left of the record if nothing is wrong.
        outliers: (sample, output) of readings that were taken out.
        uncertainty: of the identified model; None where it is exact.
    """

    dictionary: Dictionary
    part: Experiment
    whitened: Whitened
    search: Scan | None
    limits: Thresholds | None
    gains: Array
    lost: dict[str, str]
    healthy: "Remaining"
    outliers: tuple[tuple[int, int], ...]
    uncertainty: ModelUncertainty | None = None

    @property
    def tested(self) -> list[Candidate]:
        """The candidates that may be the answer."""
        if self.search is None:
            return []
        return [c for c, gains in zip(self.dictionary.candidates, self.gains) if not np.isnan(gains).all()]

    @property
    def nx(self) -> int:
        """Number of states of the model."""
        return self.dictionary.model.nx

    def p_value(self, asked: "Question", unknown: bool) -> float:
        """Return the probability of so strong a departure from health; an alarm is at or below the false-alarm rate.

        Args:
            asked: with the false-alarm rate.
            unknown: whether departures that no candidate describes count.
        """
        values = [1.0]
        if self.limits is not None and not np.isnan(self.gains).all():
            rate = self.limits.false_alarm
            values.append(alarm_probability(float(np.nanmax(self.gains)), rate) * asked.false_alarm / rate)
        if unknown:
            values.append(self.healthy.p_value / UNKNOWN_SHARE)
        if self.courses:
            # a likelihood averaged over what may be exceeds 1 / p in healthy records with probability p at most
            log = np.logaddexp.reduce([c.log_evidence for c in self.courses]) - np.log(len(self.courses))
            values.append(float(np.exp(-log)) / COURSE_SHARE)
        return min(values)

    @cached_property
    def beside(self) -> Scan | None:
        """The search for what is thought possible beside the dictionary; None where that is nothing."""
        more = extended(self.dictionary)
        return None if more is None else scan(more, self.whitened, self.part.u)

    @cached_property
    def gains_of_sensors(self) -> list[Explanation]:
        """Sensors that may have lost a share of their reading."""
        return sensor_gains(self.dictionary, self.whitened, self.part)

    @cached_property
    def courses(self) -> list[Explanation]:
        """Sensors that may be frozen and noises that may have grown."""
        return courses(self, self.dictionary)


def look(
    record: Data, part: Experiment, found: Dictionary, asked: "Question", noise: Mapping[str, Any]
) -> Seen:
    """Search one experiment.

    Args:
        record: that it belongs to.
        part: the experiment, without readings that stand still.
        found: the candidates.
        asked: what is asked.
        noise: arguments of `whiten`: uncertainty and scale.

    Raises:
        DataError: too few samples.
        StructureError: thresholds of another length or dictionary.
    """

    def whitened_of(experiment: Experiment) -> Whitened:
        white = whiten(found.model, one_record(record, experiment), **noise)
        enough(white, found.model.nx)
        return white

    white = whitened_of(part)
    outliers: tuple[tuple[int, int], ...] = ()
    search = limits = None
    gains, lost = np.full((len(found.candidates), len(white.r)), np.nan), {}
    if any(c.additive or c.columns or c.schedule is not None for c in found.candidates):
        if asked.robust:
            search, part, outliers = cleaned(found, part, whitened_of)
        else:
            search = scan(found, white, part.u)
        white = search.whitened
        limits = _limits(found, white, part.u, asked)
        lost = untestable(search)
        gains = search.gains(limits)
        gains[[label in lost for label in found.labels]] = np.nan
    healthy = left_over(white, white.r, found.model.nx)
    return Seen(found, part, white, search, limits, gains, lost, healthy, outliers, noise.get("uncertainty"))


def _limits(found: Dictionary, white: Whitened, u: Array, asked: "Question") -> Thresholds:
    given, count = asked.thresholds, len(white.r)
    if given is not None:
        if given.window != count:
            raise StructureError(
                f"The thresholds are for windows of {given.window} samples; the record has {count}. Calibrate them "
                f"with thresholds(faults, {count}, ...), or leave them out."
            )
        return given
    rate = asked.false_alarm * (1 - UNKNOWN_SHARE * found.unknown - COURSE_SHARE * any(without_signature(found)))
    needed = int(np.ceil(EXCEEDING / rate))
    if needed > MOST_DRAWS:
        raise DataError(
            f"false_alarm={asked.false_alarm:g}: thresholds for so rare an alarm need {needed} simulated windows; "
            f"{MOST_DRAWS} are the most ({EXCEEDING / MOST_DRAWS:g} is the rarest alarm). Ask for a higher "
            "probability, or simulate them yourself: thresholds(..., draws=...)."
        )
    draws = max(needed, min(DRAWS, SIMULATED // count))
    inputs = u if any(c.columns or c.schedule is not None for c in found.candidates) else None
    return thresholds(found, white, rate, u=inputs, draws=draws, seed=asked.seed)

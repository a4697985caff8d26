"""Results of a diagnosis: verdict, set of answers with probabilities, estimates with intervals, certificate."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin

import numpy as np

from optid.arrays import Array
from optid.data.timeline import Timeline
from optid.errors import StructureError
from optid.faults.signatures import Candidate
from optid.registry import Rendered, render

if TYPE_CHECKING:
    from optid.faults.consistency.profiles import Profile
    from optid.faults.search.scanning import Scan

FORMAT = "optid diagnosis"
VERSION = 1

CANDIDATE = "into_state", "into_output", "columns", "members", "places", "bounded_deflection"
"""Saved fields of the candidate of an estimate, beside its name and kind."""

VERDICTS = ("healthy", "faulty", "unknown", "untestable", "not isolable")
"""Possible verdicts: no fault; these faults; a fault outside the dictionary; no verdict without excitation of the
candidates; no verdict with one output only."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One fault of an answer.

    Attributes:
        label: its label; that of the whole group where its members are not isolable from each other.
        name: its place, as in `Fault`; of a group the first member.
        kind: a kind of the dictionary ("bias", "loss", "stuck", "jump", "drift", "frozen", "noise", "spike",
            "schedule"), or "saturated" or "dead" of a sensor.
        candidate: the entry of the dictionary; read from a file, without the matrices of a scheduled change.
        onset: most probable first sample that it changes.
        onset_interval: first and last sample of its interval.
        onset_censored: whether the onset is so near the start (or end) of the record that only the interval of the size
            is known; it is then "at or before" the end of its interval (or "at or after" its start).
        size: (d,) estimates of the magnitudes: size of a bias, slope of a drift, jump of the state, share lost of a
            loss, share lost and constants added of a stuck actuator, standard deviation of an added noise, reading of a
            frozen or saturated sensor, share of a scheduled change; NaN where only the interval is known; none of a
            dead sensor.
        size_interval: (d, 2) intervals that account for the search for the onset; shares lost and their intervals lie
            between 0 and 1.
        covariance: (d, d) of the size, with the spread over the onsets.
        deflection: norm of the whitened signature.
        effect: {output: steady-state change} of a lasting disturbance whose direction was estimated.
        onset_time: date or time of the onset; "" where the record has no known unit of time.
        onset_interval_time: dates or times of the ends of its interval.
    """

    label: str
    name: str
    kind: str
    candidate: Candidate
    onset: int
    onset_interval: tuple[int, int]
    onset_censored: bool
    size: Array
    size_interval: Array
    covariance: Array
    deflection: float
    effect: Mapping[str, float] = field(default_factory=dict)
    onset_time: str = ""
    onset_interval_time: tuple[str, str] = ("", "")

    def __str__(self) -> str:
        """State label, onset and size, with the intervals."""
        return render(self)


@dataclass(frozen=True, eq=False)
class FaultAnswer:
    """One explanation of the record.

    Attributes:
        faults: one or several estimates, in the order of their onsets.
        posterior: probability of this explanation among those considered, marginalised over magnitudes and onsets.
        gain: energy that it explains beyond the thresholds of its faults.
    """

    faults: tuple[Estimate, ...]
    posterior: float
    gain: float

    def __post_init__(self) -> None:
        if not self.faults:
            raise ValueError("an answer has no fault.")

    @property
    def label(self) -> str:
        """The labels of its faults, joined."""
        return " + ".join(fault.label for fault in self.faults)

    @property
    def labels(self) -> tuple[str, ...]:
        """The labels of its faults."""
        return tuple(fault.label for fault in self.faults)

    def __str__(self) -> str:
        """List its faults."""
        return "\n".join(str(fault) for fault in self.faults)


@dataclass(frozen=True, eq=False)
class Certificate:
    """Evidence that the best answer is the best.

    Attributes:
        basis: "exhaustive" (every candidate and onset was tried), "grid" (every candidate at some onsets), "duality
            gap" (of a convex programme), "infeasible healthy" (no healthy record within the bounds of the noise), "flat
            line" (identical readings), or "none".
        value: energy explained beyond the threshold, duality gap, the least factor of the bounds of the noise, or the
            number of identical readings.
        runner_up_margin: twice the log-odds of the best answer against the next one; inf where there is no other.
        parity_vector: (N, l) multipliers of the proof "infeasible healthy"; None without it.
    """

    basis: str
    value: float
    runner_up_margin: float = float("inf")
    parity_vector: Array | None = None

    @property
    def proved(self) -> bool:
        """Whether there is evidence."""
        return self.basis != "none"


@dataclass(frozen=True, eq=False)
class Remaining:
    """Residual of the best answer, or of the healthy plant where there is none."""

    energy: float  # sum of squares of the residual, whitened
    readings: int  # their number, less the estimated magnitudes; about the energy where the answer is right
    p_value: float  # smallest p-value of the tests of the residual, corrected for their number
    test: str  # the test with this p-value: "energy", "period", "burst" or "candidate"
    direction: Array  # (l,) unit vector of the outputs, in their units, with most of the energy
    frequency: float  # peak of the spectrum of the residual, in cycles per sample
    share: float  # of the energy, within one line of that frequency


@dataclass(frozen=True, eq=False)
class SearchEvidence:
    """Innovations and statistics of a diagnosis, for figures and for the course of a fault."""

    r: Array  # (N, l) whitened innovations
    present: np.ndarray  # (N, l) whether there is a reading
    fitted: Array  # (N, l) fit of the best answer; zero where there is none
    gains: Array  # (C, N) energy explained less the threshold, NaN where a candidate is not tested
    labels: tuple[str, ...]  # the C candidates
    search: "Scan | None"  # the scan; None where no candidate has a signature


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Rendered):
    """Diagnosis of a record; `print`, `explain()` or `plot()` it.

    Attributes:
        verdict: one of `VERDICTS`.
        detected: whether there was an alarm.
        best: the most probable answer; None where healthy, unknown, or without a certificate.
        candidates: the smallest set of answers that holds `coverage` of the probability, the most probable first; never
            empty when a fault was detected, except for the verdicts "unknown" and "not isolable".
        p_value: of the healthy plant.
        certificate: evidence of the best answer.
        untestable: {label: why} of candidates that this record cannot test.
        window: samples N of the record.
        false_alarm: probability of an alarm of a healthy plant.
        coverage: nominal probability of the set and of the intervals.
        method: of the search.
        status: remarks.
        model: title of the model.
        outputs: names of the outputs.
        dt: sampling time.
        remaining: residual; None where there was no alarm.
        evidence: innovations and statistics; not saved.
        timeline: when the samples were taken.
        findings: what reading the record derived, assumed or repaired.
    """

    verdict: str
    detected: bool
    best: FaultAnswer | None
    candidates: tuple[FaultAnswer, ...]
    p_value: float
    certificate: Certificate
    untestable: Mapping[str, str]
    window: int
    false_alarm: float
    coverage: float
    method: str
    status: str
    model: str
    outputs: tuple[str, ...] = ()
    dt: float = 1.0
    remaining: Remaining | None = None
    evidence: SearchEvidence | None = field(default=None, repr=False)
    timeline: Timeline = Timeline()
    findings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise StructureError(f"verdict {self.verdict!r}: it must be one of {', '.join(VERDICTS)}.")
        if self.best is not None and not self.candidates:
            raise StructureError("A best answer belongs to the set of candidates, which is empty.")

    @property
    def unique(self) -> bool:
        """Whether the set has exactly one answer."""
        return self.verdict == "faulty" and len(self.candidates) == 1

    @property
    def onset(self) -> int | None:
        """Onset of the first fault of the best answer."""
        return None if self.best is None else self.best.faults[0].onset

    @property
    def onset_interval(self) -> tuple[int, int] | None:
        """Its interval."""
        return None if self.best is None else self.best.faults[0].onset_interval

    @property
    def size(self) -> Array | None:
        """Size (d,) of the first fault of the best answer."""
        return None if self.best is None else self.best.faults[0].size

    @property
    def size_interval(self) -> Array | None:
        """Its interval, (d, 2)."""
        return None if self.best is None else self.best.faults[0].size_interval

    def explain(self) -> str:
        """State in three sentences the result, its probability and its evidence."""
        return render(self, "sentences")

    def profile(self, prior: str = "auto", **how: Any) -> "Profile":
        """Estimate the course over time of the most probable fault, whatever its kind in the search.

        Args:
            prior: as in `optid.faults.profile`.
            how: its other arguments.

        Raises:
            StructureError: no fault, several at once, one without a course, or a diagnosis read from a file.
        """
        from optid.faults.programmes import profile

        if self.best is None or len(set(self.best.labels)) != 1:  # one place may change several times
            raise StructureError("A course is estimated for one fault; this diagnosis names none, or several at once.")
        if self.evidence is None or self.evidence.search is None:
            raise StructureError("The record is not in a diagnosis that was read from a file: diagnose it again.")
        return profile(self.evidence.search, self.best.faults[0].label, prior, **how)

    def to_dict(self) -> dict[str, Any]:
        """Return it in JSON types, without the evidence."""
        best = None if self.best is None else self.candidates.index(self.best)
        return _described(replace(self, evidence=None)) | {"best": best}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Diagnosis":
        """Build a diagnosis from the result of `to_dict`."""
        found = _built(cls, {**content, "best": None})
        if content["best"] is None:
            return found
        if not 0 <= int(content["best"]) < len(found.candidates):
            raise ValueError("the best answer is not among its candidates.")
        return replace(found, best=found.candidates[int(content["best"])])

    def save(self, path: str | Path) -> Path:
        """Write it to a JSON file, which is replaced when it exists, without loss of precision."""
        from optid.models.files import write

        return write(self.to_dict(), path, FORMAT, VERSION)


def load_diagnosis(path: str | Path) -> Diagnosis:
    """Read a diagnosis from a file written by `Diagnosis.save`.

    Raises:
        FileNotFoundError: no such file.
        ModelFileError: the file is truncated, damaged, of another version, or not a diagnosis.
    """
    from optid.models.files import read

    return read(path, FORMAT, VERSION, Diagnosis.from_dict)


def _described(value: Any) -> Any:
    """The fields of a result as JSON types, numbers that are not finite as words."""
    if is_dataclass(value):
        if isinstance(value, Candidate):
            return {word: _described(getattr(value, word)) for word in CANDIDATE}
        return {part.name: _described(getattr(value, part.name)) for part in fields(value) if part.name != "evidence"}
    if isinstance(value, Mapping):
        return {name: _described(part) for name, part in value.items()}
    if isinstance(value, tuple | list | np.ndarray):
        return [_described(part) for part in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else str(float(value))
    return value.item() if isinstance(value, np.generic) else value


def _built(kind: Any, value: Any) -> Any:
    """Undo `_described`: build a value of an annotated type; fields that an earlier release lacks keep defaults."""
    origin, parts = get_origin(kind), get_args(kind)
    if kind in (str, int, bool):
        return kind(value)
    if kind is float or origin is np.ndarray:
        return np.asarray(value, dtype=float)[()]
    if origin is Mapping:
        return {str(name): _built(parts[1], part) for name, part in value.items()}
    if origin is tuple:
        if parts[-1] is not ... and len(value) != len(parts):
            raise ValueError(f"{len(value)} values in place of {len(parts)}.")
        return tuple(_built(parts[0], part) for part in value)
    if type(None) in parts:
        return None if value is None else _built(parts[0], value)
    if kind is Estimate:
        value = {**value, "candidate": {"name": value["name"], "kind": value["kind"], **value["candidate"]}}
    return kind(**{
        part.name: _built(part.type, value[part.name]) for part in fields(kind)
        if part.name in value or part.default is part.default_factory is MISSING})

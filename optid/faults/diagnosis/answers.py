"""What a diagnosis says: a verdict, a set of answers with probabilities, estimates with intervals, and a proof."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.errors import StructureError
from optid.faults.signatures import Candidate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optid.faults.consistency.profiles import Profile
    from optid.faults.diagnosis.evidence import Evidence

FORMAT = "optid diagnosis"
VERSION = 1

VERDICTS = ("healthy", "faulty", "unknown", "untestable", "not isolable")
"""What a diagnosis may say: nothing is wrong, these faults, a fault that is none of these, the record cannot tell
because the input does not move what is suspected, the record cannot tell because there is one output only."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One fault of an answer.

    Attributes:
        label: what it is called; the whole group where no record can tell its members apart.
        name: where it is, as in `Fault`; of a group the first member.
        kind: a kind of the dictionary ("bias", "loss", "stuck", "jump", "drift", "frozen", "noise", "spike",
            "schedule").
        candidate: the entry of the dictionary; read from a file, without the matrices of a scheduled change.
        onset: most probable first sample that it changes.
        onset_interval: first and last sample of its interval.
        onset_censored: whether the record starts (or ends) so near the onset that only the interval of the size is
            known; the onset is then "at or before" the end of its interval (or "at or after" its start).
        size: (d,) estimates of the magnitudes: size of a bias, slope of a drift, jump of the state, share lost of a
            loss, share lost and constants added of a stuck actuator, standard deviation of an added noise, reading of a
            frozen sensor, share of a scheduled change; NaN where only the interval is known.
        size_interval: (d, 2) intervals that account for the search for the onset. Not cut to what is possible: the
            interval of a share lost may reach above one, and does where all is lost.
        covariance: (d, d) of the size, with the spread over the onsets.
        deflection: sigma per sample times root of samples.
        effect: {output: change that it makes in the end} of a lasting disturbance whose direction was estimated.
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

    def __str__(self) -> str:
        """Say what, since when and how large, with the intervals."""
        from optid.faults.diagnosis.words import estimate_line

        return estimate_line(self)

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        c = self.candidate
        return {
            "label": self.label, "name": self.name, "kind": self.kind,
            "candidate": {
                "into_state": c.into_state.tolist(), "into_output": c.into_output.tolist(), "columns": list(c.columns),
                "members": list(c.members), "places": list(c.places), "bounded_deflection": c.bounded_deflection,
            },
            "onset": self.onset, "onset_interval": list(self.onset_interval), "onset_censored": self.onset_censored,
            "size": _listed(self.size), "size_interval": _listed(self.size_interval),
            "covariance": _listed(self.covariance), "deflection": _listed(self.deflection),
            "effect": {name: _listed(value) for name, value in self.effect.items()},
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Estimate":
        """Build what `to_dict` described."""
        c = content["candidate"]
        candidate = Candidate(
            content["name"], content["kind"], np.array(c["into_state"], dtype=float),
            np.array(c["into_output"], dtype=float), tuple(int(i) for i in c["columns"]), tuple(c["members"]),
            tuple(c["places"]), bool(c["bounded_deflection"]),
        )
        low, high = content["onset_interval"]
        return cls(
            str(content["label"]), str(content["name"]), str(content["kind"]), candidate, int(content["onset"]),
            (int(low), int(high)), bool(content["onset_censored"]), _array(content["size"]),
            _array(content["size_interval"]), _array(content["covariance"]), float(_array(content["deflection"])),
            {str(name): float(_array(value)) for name, value in content.get("effect", {}).items()},
        )


@dataclass(frozen=True, eq=False)
class Answer:
    """One explanation of the record.

    Attributes:
        faults: one or several estimates, in the order of their onsets.
        posterior: probability of this explanation among those considered, magnitudes and onsets summed out.
        gain: energy that it explains beyond the thresholds of its faults.
    """

    faults: tuple[Estimate, ...]
    posterior: float
    gain: float

    @property
    def label(self) -> str:
        """The names of its faults."""
        return " + ".join(fault.label for fault in self.faults)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of its faults, one by one."""
        return tuple(fault.label for fault in self.faults)

    def __str__(self) -> str:
        """List its faults."""
        return "\n".join(str(fault) for fault in self.faults)

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        return {"faults": [fault.to_dict() for fault in self.faults], "posterior": _listed(self.posterior),
                "gain": _listed(self.gain)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Answer":
        """Build what `to_dict` described."""
        faults = tuple(Estimate.from_dict(fault) for fault in content["faults"])
        if not faults:
            raise ValueError("an answer has no fault.")
        return cls(faults, float(_array(content["posterior"])), float(_array(content["gain"])))


@dataclass(frozen=True, eq=False)
class Certificate:
    """Why the best answer is the best.

    Attributes:
        kind: "exhaustive" (every candidate and onset was tried), "grid" (every candidate at some onsets), "duality gap"
            (of a convex programme), "infeasible healthy" (no healthy record within the bounds of the noise), "flat
            line" (readings identical to the bit), or "none".
        value: energy explained beyond the threshold, duality gap, the factor by which the bounds of the noise would
            have to grow, or the number of equal readings.
        runner_up_margin: twice the logarithm of the odds of the best answer against the next one, comparable with an
            energy; inf where there is no other.
        parity_vector: (N, l) multipliers of the proof "infeasible healthy"; None for the other kinds.
    """

    kind: str
    value: float
    runner_up_margin: float = float("inf")
    parity_vector: Array | None = None

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        parity = None if self.parity_vector is None else _listed(self.parity_vector)
        return {"kind": self.kind, "value": _listed(self.value), "runner_up_margin": _listed(self.runner_up_margin),
                "parity_vector": parity}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Certificate":
        """Build what `to_dict` described."""
        parity = content["parity_vector"]
        return cls(str(content["kind"]), float(_array(content["value"])), float(_array(content["runner_up_margin"])),
                   None if parity is None else _array(parity))


@dataclass(frozen=True, eq=False)
class Remaining:
    """What the best answer (or health, where there is none) leaves unexplained.

    Attributes:
        energy: sum of squares of the whitened innovations that are left.
        readings: their number, less the magnitudes estimated; about the energy where the answer is right.
        p_value: probability of so much, so concentrated in time or so periodic a rest, were the answer right.
        test: which of the tests is the one that fails: "energy", "period", "burst" or "candidate".
        direction: (l,) unit vector of the outputs, in their units, along which most of it lies.
        frequency: cycles per sample where the spectrum of the rest is largest.
        share: of the energy, within one line of that frequency.
    """

    energy: float
    readings: int
    p_value: float
    test: str
    direction: Array
    frequency: float
    share: float

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        return {"energy": _listed(self.energy), "readings": self.readings, "p_value": _listed(self.p_value),
                "test": self.test, "direction": _listed(self.direction), "frequency": _listed(self.frequency),
                "share": _listed(self.share)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Remaining":
        """Build what `to_dict` described."""
        number = {word: float(_array(content[word])) for word in ("energy", "p_value", "frequency", "share")}
        return cls(readings=int(content["readings"]), test=str(content["test"]),
                   direction=_array(content["direction"]), **number)


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a record says about the health of a plant; `print`, `explain()` or `plot()` it.

    Attributes:
        verdict: one of `VERDICTS`.
        detected: whether there was an alarm.
        best: the most probable answer; None where healthy, unknown, or without a certificate.
        candidates: the smallest set of answers that holds `coverage` of the probability, the most probable first; never
            empty when a fault was detected, except for the verdicts "unknown" and "not isolable".
        p_value: probability of so strong an alarm from a healthy plant.
        certificate: why the best answer is the best.
        untestable: {label: why} of candidates that this record can say nothing about.
        window: samples N of the record.
        false_alarm: probability of an alarm of a healthy plant.
        coverage: nominal probability of the set and of the intervals.
        method: how it was found.
        status: what else is to know: one sentence, "" where nothing.
        model: title of the model.
        outputs: names of the outputs.
        dt: sampling time.
        remaining: what is left unexplained; None where there was no alarm.
        evidence: the record and the statistics behind it, for the picture; not saved.
    """

    verdict: str
    detected: bool
    best: Answer | None
    candidates: tuple[Answer, ...]
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
    evidence: "Evidence | None" = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise StructureError(f"verdict {self.verdict!r}: one of {', '.join(VERDICTS)} is needed.")
        if self.best is not None and not self.candidates:
            raise StructureError("A best answer belongs to the set of candidates, which is empty.")

    @property
    def unique(self) -> bool:
        """Whether exactly one answer is left."""
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

    def __str__(self) -> str:
        """Print the verdict, the set with probabilities, the estimates and the proof, in 80 columns."""
        from optid.faults.diagnosis.words import printed

        return printed(self)

    def explain(self) -> str:
        """Say in three sentences what was found, how sure that is, and what it rests on."""
        from optid.faults.diagnosis.words import explained

        return " ".join(explained(self))

    def profile(self, prior: str = "auto", **how: Any) -> "Profile":
        """Estimate the course over time of the most probable fault, whatever kind of course was searched for.

        Args:
            prior: as in `optid.faults.profile`.
            how: its other arguments.

        Raises:
            StructureError: no fault, several at once, one without a course, or a diagnosis read from a file.
        """
        from optid.faults.search.programmes import profile

        if self.best is None or len(set(self.best.labels)) != 1:  # one place may change several times
            raise StructureError("A course is estimated of one fault; this diagnosis names none, or several at once.")
        if self.evidence is None or self.evidence.search is None:
            raise StructureError("The record is not in a diagnosis that was read from a file: diagnose it again.")
        return profile(self.evidence.search, self.best.faults[0].label, prior, **how)

    def plot(self) -> "Figure":
        """Draw the innovations, the statistic over onset and candidate, and the signature of the best answer.

        Raises:
            StructureError: a diagnosis read from a file: the record is not in it.
        """
        from optid.faults.diagnosis.picture import draw

        return draw(self)

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types, without the record."""
        return {
            "verdict": self.verdict, "detected": self.detected,
            "best": None if self.best is None else self.candidates.index(self.best),
            "candidates": [answer.to_dict() for answer in self.candidates], "p_value": _listed(self.p_value),
            "certificate": self.certificate.to_dict(), "untestable": dict(self.untestable), "window": self.window,
            "false_alarm": self.false_alarm, "coverage": self.coverage, "method": self.method, "status": self.status,
            "model": self.model, "outputs": list(self.outputs), "dt": self.dt,
            "remaining": None if self.remaining is None else self.remaining.to_dict(),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Diagnosis":
        """Build what `to_dict` described."""
        candidates = tuple(Answer.from_dict(answer) for answer in content["candidates"])
        best, remaining = content["best"], content["remaining"]
        return cls(
            str(content["verdict"]), bool(content["detected"]), None if best is None else candidates[int(best)],
            candidates, float(_array(content["p_value"])), Certificate.from_dict(content["certificate"]),
            {str(label): str(why) for label, why in content["untestable"].items()}, int(content["window"]),
            float(content["false_alarm"]), float(content["coverage"]), str(content["method"]), str(content["status"]),
            str(content["model"]), tuple(content["outputs"]), float(content["dt"]),
            None if remaining is None else Remaining.from_dict(remaining),
        )

    def save(self, path: str | Path) -> Path:
        """Write it to a JSON file, every digit of it.

        Args:
            path: the file, replaced when it exists.
        """
        from optid.models.files import write

        return write(self.to_dict(), path, FORMAT, VERSION)


def load_diagnosis(path: str | Path) -> Diagnosis:
    """Read a diagnosis from a file written by `Diagnosis.save`.

    Args:
        path: the file.

    Raises:
        FileNotFoundError: no such file.
        ModelFileError: the file is truncated, damaged, of another version, or not a diagnosis.
    """
    from optid.models.files import read

    return read(path, FORMAT, VERSION, _built)


def _built(content: Mapping[str, Any]) -> Diagnosis:
    try:
        return Diagnosis.from_dict(content)
    except IndexError:
        raise ValueError("the best answer is not among its candidates.") from None


def _listed(values: Any) -> Any:
    """Numbers as JSON types; what is not finite, which JSON does not know, by its word."""
    array = np.asarray(values, dtype=float)
    if array.ndim:
        return [_listed(value) for value in array]
    return float(array) if np.isfinite(array) else str(float(array))


def _array(values: Any) -> Array:
    """Undo `_listed`."""
    return np.asarray(values, dtype=float)

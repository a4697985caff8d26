"""The events of a monitor and the faults that it carries."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.faults.diagnosis.answers import FaultAnswer


@dataclass(frozen=True)
class Event:
    """An event reported by the monitor.

    Attributes:
        kind: "alarm"; "isolated" (one candidate is left, or several after the time allowed); "revised" (fewer kinds of
            an isolated actuator are left, another one, or several faults); "cleared"; "untestable" (a total loss is not
            detectable, or not isolable from a constant), "testable" (again); "outside" (an input left the identified
            range), "inside" (again); "untrusted" (a channel is far outside the range of the identification since
            before the onset, and the model does not describe the plant there: no fault is named until a window after
            it is back, which is "cleared"); or "adapted" (the thresholds, to the colour of the noise).
        sample: counted from the first sample of the stream.
        candidates: (label, posterior) of the 95 % set, most probable first, labels of faults at once joined by " + ";
            ("unknown", 1.0) where none explains it.
        onset: first sample of the fault, of the first candidate; for "untestable" the first untestable sample.
        size: magnitudes of the first candidate, as in `Dictionary.signature`.
        statistic: energy explained by the first candidate; of "untestable" that of a total loss.
        note: remark.
    """

    kind: str
    sample: int
    candidates: tuple[tuple[str, float], ...] = ()
    onset: int | None = None
    size: tuple[float, ...] = ()
    statistic: float = 0.0
    note: str = ""

    @classmethod
    def of_answers(cls, kind: str, sample: int, answers: Sequence[FaultAnswer]) -> "Event":
        """Return the event of a diagnosis; the sizes of several faults follow one another."""
        first = answers[0]
        sizes = np.concatenate([one.size for one in first.faults])
        sizes = sizes if np.isfinite(sizes).all() else sizes[:0]  # not known at the ends of the samples
        note = "more than one fault" if all(len(one.faults) > 1 for one in answers) else ""
        return cls(kind, sample, tuple((one.label, one.posterior) for one in answers), first.faults[0].onset,
                   tuple(sizes.tolist()), first.gain, note)

    @property
    def labels(self) -> list[str]:
        """The labels of the candidates."""
        return [label for label, _ in self.candidates]

    def tells(self, labels: Sequence[str]) -> bool:
        """Whether these are its labels; the order of faults at once, that of their onsets, does not count."""
        own, others = ([set(label.split(" + ")) for label in found] for found in (self.labels, labels))
        return own == others

    @property
    def isolates(self) -> bool:
        """Whether candidates are named, or none is left."""
        return self.kind == "isolated"

    @property
    def ends_fault(self) -> bool:
        """Whether a fault that was named is over."""
        return self.kind == "cleared" and bool(self.candidates)

    def __str__(self) -> str:
        """Return the event in one line."""
        return self.in_words()

    def in_words(self, time: str = "", onset_time: str = "") -> str:
        """Return the event in one line, with the times of its sample and of its onset where they are given."""
        text = f"{self.sample}{f' ({time})' if time else ''}: {self.kind}"
        if self.candidates:
            names = [label if p >= 0.995 else f"{label} ({p:.0%})" for label, p in self.candidates[:3]]
            more = len(self.candidates) - len(names)
            text += ": " + ", ".join(names) + (f" and {more} more" if more else "")
        if self.onset is not None:
            at = f" ({onset_time})" if onset_time else ""
            text += f"{'' if self.kind == 'untestable' else ','} since {self.onset}{at}"
        if self.size:
            text += ", size " + " ".join(f"{value:.4g}" for value in self.size)
        return text + (f" ({self.note})" if self.note else "")

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        return {**self.__dict__, "candidates": [[label, p] for label, p in self.candidates], "size": list(self.size)}


@dataclass(frozen=True)
class Carried:
    """An isolated fault whose effect is compensated."""

    label: str  # the candidate
    size: tuple[float, ...]  # its magnitudes, as in `Dictionary.signature`
    deviation: tuple[float, ...]  # their standard deviations
    interval: tuple[tuple[float, float], ...]  # their 95 % intervals

    def __str__(self) -> str:
        """Return the fault in one line."""
        ends = zip(self.size, self.interval)
        sizes = ", ".join(f"{size:.4g} ({low:.4g} to {high:.4g})" for size, (low, high) in ends)
        return f"carried: {self.label}, size {sizes}"

"""What a monitor says."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes:
        kind: "alarm", "isolated" (the set of candidates shrank to one, or did not in time), "cleared", "untestable" (a
            whole loss of the actuator would go unnoticed, or be taken for a constant), "testable" (again), "outside"
            (an input left the identified range) or "inside" (again).
        sample: when, counted from the first sample that the monitor saw.
        candidates: (label, posterior), most probable first, those of the 95 % set; ("unknown", 1.0) where nothing
            explains the alarm.
        onset: sample that the fault began at, of the first candidate; for "untestable" the sample since when.
        size: magnitudes of the first candidate, as in `Dictionary.signature`.
        statistic: energy that the first candidate explains; of "untestable" the energy that a whole loss would have.
        note: what else is to be known.
    """

    kind: str
    sample: int
    candidates: tuple[tuple[str, float], ...] = ()
    onset: int | None = None
    size: tuple[float, ...] = ()
    statistic: float = 0.0
    note: str = ""

    def __str__(self) -> str:
        """Say it in one line."""
        text = f"{self.sample}: {self.kind}"
        if self.candidates:
            names = [label if p >= 0.995 else f"{label} ({p:.0%})" for label, p in self.candidates[:3]]
            more = len(self.candidates) - len(names)
            text += ": " + ", ".join(names) + (f" and {more} more" if more else "")
        if self.onset is not None:
            text += f"{'' if self.kind == 'untestable' else ','} since {self.onset}"
        if self.size:
            text += ", size " + " ".join(f"{value:.4g}" for value in self.size)
        return text + (f" ({self.note})" if self.note else "")

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        return {**self.__dict__, "candidates": [[label, p] for label, p in self.candidates], "size": list(self.size)}


@dataclass(frozen=True)
class Carried:
    """A fault that was named and is accounted for since.

    Attributes:
        label: the candidate.
        size: its magnitudes.
        deviation: their standard deviations; zero once they are known well enough and no longer estimated.
    """

    label: str
    size: tuple[float, ...]
    deviation: tuple[float, ...]

    def __str__(self) -> str:
        """Say it in one line."""
        sizes = ", ".join(f"{size:.4g} +- {spread:.2g}" for size, spread in zip(self.size, self.deviation))
        return f"carried: {self.label}, size {sizes}"

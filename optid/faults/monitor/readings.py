"""Checks of a stream before any search: sensors without true readings, inputs outside the identified range."""

from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.faults.monitor.events import Event
from optid.faults.ranges import BEYOND, by_input, distance, known_range, usable_range
from optid.faults.readings import SensorChecks
from optid.models import HammersteinSS

REMEMBERED = 2  # windows for which excursions are kept


class Screened(NamedTuple):
    """A block of samples after the checks."""

    y: Array  # (T, l) readings; those of frozen sensors are missing
    unsure: np.ndarray  # (T, m) inputs that are missing or so far outside their range that their effect is unknown
    distance: Array  # (T,) largest distance of a channel from the middle of its range, in half ranges; at least one
    repeating: np.ndarray  # (T,) whether a sensor repeats the reading of the sample before
    events: list[Event]  # in the order of their samples
    frozen: dict[int, int]  # {sample of the block: onset in samples of the stream} of the sensors found frozen


class ReadingChecks:
    """Checks of one stream.

    Attributes:
        model: the plant.
        known, usable: (2, m) identified ranges of the inputs, and those over which they are used.
        sensors: the checks of the readings.
        levels: (2, l) lowest and highest readings of the identification; None where they are not known.
        excursions: [channel, first sample, last sample or None] of channels far outside their range.
    """

    def __init__(self, model: HammersteinSS, window: int, levels: Array | None = None) -> None:
        """Begin a stream; `levels` (2, l) are the lowest and highest readings of the identification, if known."""
        self.model, self.window, self.levels = model, window, levels
        self.known, self.usable = by_input(model, known_range(model)), by_input(model, usable_range(model))
        self.sensors, self._outside = SensorChecks(model.l), [-1] * model.m
        self.excursions: list[Any] = []

    @property
    def memory(self) -> dict[str, Any]:
        """Counters by sensor, and where channels left their range, in JSON types."""
        return {**self.sensors.memory, "outside": self._outside, "excursions": self.excursions,
                "levels": None if self.levels is None else np.asarray(self.levels).tolist()}

    @memory.setter
    def memory(self, kept: dict[str, Any]) -> None:
        self.levels = None if kept["levels"] is None else np.array(kept["levels"])
        self.sensors.memory, self._outside = {word: kept[word] for word in self.sensors.memory}, kept["outside"]
        self.excursions = kept["excursions"]

    def excursion(self, since: int, before: int) -> tuple[str, int] | None:
        """Return a channel that was far outside its range after `since`, having left it `before` a sample, and when."""
        for name, first, last in self.excursions:
            if first < before and (last is None or last >= since):
                return name, first
        return None

    def _follow(self, both: Array, far: np.ndarray, start: int) -> None:
        """Keep the excursions of channels (T, m + l) that are far outside their range."""
        kept: list[Any] = []
        names = [f"input:{name}" for name in self.model.inputs] + [f"output:{name}" for name in self.model.outputs]
        unknown, open_ = np.isnan(both), {one[0]: one for one in self.excursions if one[2] is None}
        for c, name in enumerate(names):
            if not far[:, c].any() and name not in open_:
                continue
            line, known = far[:, c], np.flatnonzero(~unknown[:, c])
            changes = known[np.flatnonzero(np.diff(line[known], prepend=name in open_))]
            for k in changes.tolist():
                if line[k]:
                    open_[name] = [name, start + k, None]
                    kept.append(open_[name])
                else:
                    open_.pop(name)[2] = start + k - 1
        oldest = start - REMEMBERED * self.window
        self.excursions = [one for one in self.excursions + kept if one[2] is None or one[2] >= oldest]

    def screen(self, u: Array, y: Array, start: int) -> Screened:
        """Check a block of inputs (T, m) and readings (T, l) that begins at the sample `start` of the stream."""
        outside, unsure = (np.asarray((u < low) | (u > high)) for low, high in (self.known, self.usable))
        away = np.hstack([distance(u, self.known), distance(y, self.levels)])
        blind, far = np.asarray(np.isnan(u).any(axis=1)), away > BEYOND
        far[:, : u.shape[1]] &= unsure  # a linear function of an input is extrapolated further
        self._follow(np.hstack([u, y]), far, start)
        clean, repeating, findings = self.sensors.screen(y, blind, start)
        found = Screened(clean, unsure | np.isnan(u), away.max(axis=1), repeating, [], {})
        for c in range(u.shape[1]):
            self._range(c, u[:, c], outside[:, c], start, found.events)
        for one in findings:
            label = ((f"sensor:{self.model.outputs[one.output]} {one.condition}", 1.0),)
            if one.ended:
                found.events.append(Event("cleared", one.sample, label))
                continue
            found.events.append(Event("isolated", one.sample, label, one.onset, note=one.note))
            if not one.is_dead:
                k = one.sample - start
                found.frozen[k] = min(one.onset, found.frozen.get(k, one.onset))
        found.events.sort(key=lambda e: e.sample)
        return found

    def _range(self, c: int, u: Array, outside: np.ndarray, start: int, events: list[Event]) -> None:
        since, name = self._outside, (("input:" + self.model.inputs[c], 1.0),)
        if since[c] < 0 and not outside.any():
            return
        for k in range(len(u)):
            if outside[k] and since[c] < 0:
                since[c] = start + k
                low, high = self.known[:, c]
                note = f"{u[k]:.4g} is outside {low:.4g} .. {high:.4g}, the identified range"
                events.append(Event("outside", start + k, name, start + k, note=note))
            elif not outside[k] and since[c] >= 0 and not np.isnan(u[k]):
                events.append(Event("inside", start + k, name, since[c]))
                since[c] = -1

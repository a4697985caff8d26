"""Checks of the readings before any search: dead and frozen sensors, inputs outside the identified range."""

from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.faults.monitor.events import Event
from optid.faults.ranges import known_range
from optid.models import HammersteinSS

DEAD = 10
"""Consecutive missing readings of a sensor, while the inputs are present, after which it is dead."""

FROZEN = 5
"""Fewest consecutive identical readings of a frozen sensor."""

CHANCE = 1e-10
"""Largest probability of that many identical readings of a healthy sensor."""


class Screened(NamedTuple):
    """A block of samples after the checks."""

    y: Array  # (T, l) readings; those of frozen sensors are missing
    unsure: np.ndarray  # (T, m) inputs that are missing or outside their range
    distance: Array  # (T,) largest distance of such an input from the middle of its range, in half ranges; at least one
    repeating: np.ndarray  # (T,) whether a sensor repeats the reading of the sample before
    events: list[Event]  # in the order of their samples
    frozen: dict[int, int]  # {sample of the block: onset in samples of the stream} of the sensors found frozen


class ReadingChecks:
    """Checks of one stream.

    Attributes:
        model: the plant.
        low, high: (m,) identified range of the inputs, infinite where none is known.
        memory: counters by sensor, and the samples at which inputs left their range; saved with the monitor.
    """

    def __init__(self, model: HammersteinSS) -> None:
        """Begin a stream."""
        m, l = model.m, model.l  # noqa: E741
        self.model, self.low, self.high = model, np.full(m, -np.inf), np.full(m, np.inf)
        for c, low, high in zip(model.input_of, *known_range(model)):
            self.low[c], self.high[c] = max(self.low[c], low), min(self.high[c], high)
        self.memory: dict[str, Any] = {"last": [None] * l, "frozen": [False] * l, "outside": [-1] * m}
        self.memory |= {word: [0] * l for word in ("run", "repeats", "seen", "missing")}

    def screen(self, u: Array, y: Array, start: int) -> Screened:
        """Check a block of inputs (T, m) and readings (T, l) that begins at the sample `start` of the stream."""
        outside, blind = np.asarray((u < self.low) | (u > self.high)), np.asarray(np.isnan(u).any(axis=1))
        distance, (at, c) = np.ones(len(u)), np.nonzero(outside)
        np.maximum.at(distance, at, np.abs(2 * u[at, c] - self.low[c] - self.high[c]) / (self.high[c] - self.low[c]))
        found = Screened(y.copy(), outside | np.isnan(u), distance, np.zeros(len(y), dtype=bool), [], {})
        for c in range(u.shape[1]):
            self._range(c, u[:, c], outside[:, c], start, found.events)
        for o in range(y.shape[1]):
            self._sensor(o, blind, start, found)
        found.events.sort(key=lambda e: e.sample)
        return found

    def _range(self, c: int, u: Array, outside: np.ndarray, start: int, events: list[Event]) -> None:
        since, name = self.memory["outside"], (("input:" + self.model.inputs[c], 1.0),)
        if since[c] < 0 and not outside.any():
            return
        for k in range(len(u)):
            if outside[k] and since[c] < 0:
                since[c] = start + k
                note = f"{u[k]:.4g} is outside {self.low[c]:.4g} .. {self.high[c]:.4g}, the identified range"
                events.append(Event("outside", start + k, name, start + k, note=note))
            elif not outside[k] and since[c] >= 0 and not np.isnan(u[k]):
                events.append(Event("inside", start + k, name, since[c]))
                since[c] = -1

    def _sensor(self, o: int, blind: np.ndarray, start: int, found: Screened) -> None:
        own = {word: values[o] for word, values in self.memory.items() if word != "outside"}
        y, name = found.y[:, o], f"sensor:{self.model.outputs[o]}"
        before = np.concatenate([[np.nan if own["last"] is None else own["last"]], y[:-1]])
        if not (own["run"] or own["missing"] or own["frozen"] or np.isnan(y).any() or np.any(y == before)):
            self.memory["seen"][o] += len(y)
            self.memory["last"][o] = float(y[-1]) if len(y) else own["last"]
            return

        def tell(kind: str, what: str, onset: int | None = None, note: str = "") -> None:
            found.events.append(Event(kind, now, ((f"{name} {what}", 1.0),), onset, note=note))

        for k, value in enumerate(y.tolist()):
            now = start + k
            if np.isnan(value):
                own["missing"] += int(not blind[k])
                if own["missing"] == DEAD and not blind[k]:
                    tell("isolated", "dead", now - DEAD + 1, f"no reading for {DEAD} samples")
                continue
            if own["missing"] >= DEAD:
                tell("cleared", "dead")
            own["missing"] = 0
            if value == own["last"]:
                own["run"] += 1
                found.repeating[k] = True
                most = max(FROZEN - 1, np.log(CHANCE) / np.log((own["repeats"] + 1) / (own["seen"] + 2)))
                if not own["frozen"] and own["run"] >= most:
                    own["frozen"], onset = True, now - own["run"]
                    tell("isolated", "frozen", onset, f"{own['run'] + 1} identical readings")
                    found.frozen[k] = min(onset, found.frozen.get(k, onset))
                if own["frozen"]:
                    y[k] = np.nan
                continue
            if own["frozen"]:
                tell("cleared", "frozen")
            else:
                own["repeats"] += own["run"]
                own["seen"] += own["run"] + 1
            own["run"], own["frozen"], own["last"] = 0, False, value
        for word, value in own.items():
            self.memory[word][o] = value

"""What the readings themselves show before any search: dead and frozen sensors, inputs outside the identified range."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.faults.monitor.events import Event
from optid.models import HammersteinSS

DEAD = 10
"""Readings of a sensor missing in a row, the inputs being there, after which it is dead."""

FROZEN = 5
"""Fewest identical readings in a row of a sensor that is frozen."""

CHANCE = 1e-10
"""Probability of so many identical readings in a row from a healthy sensor, at most."""

MARGIN = 0.02
"""Share of the identified range by which an input may leave it."""


@dataclass(frozen=True, eq=False)
class Screened:
    """A block of samples after the checks.

    Attributes:
        y: (T, l) readings; those of frozen sensors are missing.
        unsure: (T, m) inputs that are missing or outside their range.
        repeating: (T,) whether a sensor shows the reading of the sample before.
        events: in the order of their samples.
        frozen: {sample of the block: onset in samples of the stream} of the sensors found frozen.
    """

    y: Array
    unsure: np.ndarray
    repeating: np.ndarray
    events: list[Event]
    frozen: dict[int, int]


@dataclass(eq=False)
class ReadingChecks:
    """Checks of one stream.

    Attributes:
        model: the plant.
        low, high: (m,) identified range of the inputs, infinite where none is known.
        memory: numbers that a saved monitor keeps.
    """

    model: HammersteinSS
    low: Array = field(init=False)
    high: Array = field(init=False)
    memory: dict[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        m, l = self.model.m, self.model.l  # noqa: E741
        self.low, self.high = np.full(m, -np.inf), np.full(m, np.inf)
        for c, function in zip(self.model.input_of, self.model.nonlinearities):
            interval = function.basis.interval
            if interval is not None:
                self.low[c], self.high[c] = max(self.low[c], interval[0]), min(self.high[c], interval[1])
        room = MARGIN * np.where(np.isfinite(self.high - self.low), self.high - self.low, 0.0)
        self.low, self.high = self.low - room, self.high + room
        self.memory = {"last": [None] * l, "run": [0] * l, "repeats": [0] * l, "seen": [0] * l, "frozen": [False] * l,
                       "missing": [0] * l, "outside": [-1] * m}

    def screen(self, u: Array, y: Array, start: int) -> Screened:
        """Check a block.

        Args:
            u: (T, m) inputs.
            y: (T, l) readings.
            start: sample of the stream at which it begins.
        """
        outside = (u < self.low) | (u > self.high)
        events: list[Event] = []
        for c in range(u.shape[1]):
            self._range(c, u[:, c], outside[:, c], start, events)
        y, frozen = y.copy(), dict[int, int]()
        repeating, blind = np.zeros(len(y), dtype=bool), np.asarray(np.isnan(u).any(axis=1))
        for o in range(y.shape[1]):
            self._sensor(o, y[:, o], blind, start, repeating, events, frozen)
        return Screened(y, outside | np.isnan(u), repeating, sorted(events, key=lambda e: e.sample), frozen)

    def _range(self, c: int, u: Array, outside: np.ndarray, start: int, events: list[Event]) -> None:
        since = self.memory["outside"]
        if since[c] < 0 and not outside.any():
            return
        name = (("input:" + self.model.inputs[c], 1.0),)
        for k in range(len(u)):
            if outside[k] and since[c] < 0:
                since[c] = start + k
                note = f"{u[k]:.4g} is outside {self.low[c]:.4g} .. {self.high[c]:.4g}, the identified range"
                events.append(Event("outside", start + k, name, start + k, note=note))
            elif not outside[k] and since[c] >= 0 and not np.isnan(u[k]):
                events.append(Event("inside", start + k, name, since[c]))
                since[c] = -1

    def _sensor(self, o: int, y: Array, blind: np.ndarray, start: int, repeating: np.ndarray, events: list[Event],
                frozen: dict[int, int]) -> None:
        own = self.memory
        before = np.concatenate([[np.nan if own["last"][o] is None else own["last"][o]], y[:-1]])
        if not (own["run"][o] or own["missing"][o] or own["frozen"][o] or np.isnan(y).any() or np.any(y == before)):
            own["seen"][o] += len(y)
            own["last"][o] = float(y[-1]) if len(y) else own["last"][o]
            return
        name = f"sensor:{self.model.outputs[o]}"
        for k, value in enumerate(y.tolist()):
            now = start + k
            if np.isnan(value):
                own["missing"][o] += not blind[k]
                if own["missing"][o] == DEAD and not blind[k]:
                    events.append(_named(name + " dead", now, now - DEAD + 1, f"no reading for {DEAD} samples"))
                continue
            if own["missing"][o] >= DEAD:
                events.append(Event("cleared", now, ((name + " dead", 1.0),)))
            own["missing"][o] = 0
            if value == own["last"][o]:
                own["run"][o] += 1
                repeating[k] = True
                most = max(FROZEN - 1, np.log(CHANCE) / np.log((own["repeats"][o] + 1) / (own["seen"][o] + 2)))
                if not own["frozen"][o] and own["run"][o] >= most:
                    own["frozen"][o], onset = True, now - own["run"][o]
                    events.append(_named(name + " frozen", now, onset, f"{own['run'][o] + 1} identical readings"))
                    frozen[k] = min(onset, frozen.get(k, onset))
                if own["frozen"][o]:
                    y[k] = np.nan
                continue
            if own["frozen"][o]:
                events.append(Event("cleared", now, ((name + " frozen", 1.0),)))
            else:
                own["repeats"][o] += own["run"][o]
                own["seen"][o] += own["run"][o] + 1
            own["run"][o], own["frozen"][o], own["last"][o] = 0, False, value


def _named(label: str, sample: int, onset: int, note: str) -> Event:
    return Event("isolated", sample, ((label, 1.0),), onset, note=note)

"""One check of readings before any search: frozen, saturated and dead sensors, on a stream or on a record."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array

DEAD = 10  # consecutive missing readings of a sensor, while the inputs are present, after which it is dead
FROZEN = 5  # fewest consecutive identical readings of a frozen sensor
CHANCE = 1e-10  # largest probability of that many identical readings of a healthy sensor

FLAT = 3
"""Identical readings of a frozen sensor that repeats no other reading in a record.

A sensor that repeats readings with the probability p shows this in N healthy ones with a probability of about
N p^2 exp(-N p), at most .5 / N.
"""

USUAL = 2  # a gap of a record is dead if it is more than so many times as long as any other one of the sensor


class SensorFinding(NamedTuple):
    """A sensor whose readings say nothing, or say something again."""

    condition: str  # "frozen", "saturated" or "dead"
    output: int
    sample: int  # at which it is noticed
    onset: int  # first sample of the identical readings or of the missing ones
    ended: bool  # whether it has ended
    note: str = ""

    @property
    def is_dead(self) -> bool:
        """Whether there is no reading any more."""
        return self.condition == "dead"


@dataclass(frozen=True, eq=False)
class LostReadings:
    """A stretch of a record in which a sensor is frozen, saturated or dead."""

    name: str  # "sensor:y1"
    condition: str  # "frozen", "saturated" or "dead"
    experiment: int  # index of the experiment
    first: int  # first sample of the equal readings or of the missing ones
    count: int  # number of these readings
    value: float  # the reading; NaN of a dead sensor

    @property
    def is_dead(self) -> bool:
        """Whether there is no reading any more."""
        return self.condition == "dead"

    def __str__(self) -> str:
        """State sensor, reading and samples."""
        if self.is_dead:
            return f"{self.name}: no reading in {self.count} samples from sample {self.first} on"
        limit = ", which it reaches again and again" if self.condition == "saturated" else ""
        return f"{self.name}: {self.count} readings of exactly {self.value:.6g}{limit} from sample {self.first} on"


class SensorChecks:
    """Checks of the readings of one stream.

    A sensor is frozen when it repeats its reading more often than its resolution explains, and saturated when this
    reading is the largest or smallest one, from which it has returned before. Repeats at such a limit say nothing about
    the resolution unless the limit is exceeded later.

    Attributes:
        memory: counters by sensor, in JSON types.
    """

    def __init__(self, count: int) -> None:
        """Begin a stream of so many sensors."""
        self.memory: dict[str, Any] = {"last": [None] * count, "condition": [""] * count}
        self.memory |= {word: [0] * count for word in ("run", "repeats", "seen", "missing", "since")}
        self.memory |= {"ends": [[None, None] for _ in range(count)]}
        self.memory |= {word: [[0, 0] for _ in range(count)] for word in ("visits", "held")}

    def screen(self, y: Array, blind: np.ndarray, start: int) -> tuple[Array, np.ndarray, list[SensorFinding]]:
        """Check a block of readings (T, l) that begins at the sample `start`; `blind` (T,) are samples without inputs.

        Returns:
            The readings without those of frozen and saturated sensors, from the sample on at which they are noticed;
            whether a sensor repeats its reading (T,); the findings.
        """
        clean, repeating, found = y.copy(), np.zeros(len(y), dtype=bool), []
        for o in range(y.shape[1]):
            self._sensor(o, clean[:, o], repeating, blind, start, found)
        return clean, repeating, sorted(found, key=lambda one: one.sample)

    def _sensor(self, o: int, y: Array, repeating: np.ndarray, blind: np.ndarray, start: int, found: list[SensorFinding]
                ) -> None:
        own = {word: values[o] for word, values in self.memory.items()}
        before = np.concatenate([[np.nan if own["last"] is None else own["last"]], y[:-1]])
        if not (own["run"] or own["missing"] or own["condition"] or np.isnan(y).any() or np.any(y == before)):
            self.memory["seen"][o] += len(y)
            self.memory["last"][o] = float(y[-1]) if len(y) else own["last"]
            self._reach(own, y)
            self.memory["repeats"][o] = own["repeats"]
            return
        for k, value in enumerate(y.tolist()):
            now = start + k
            if np.isnan(value):
                own["missing"] += int(not blind[k])
                if own["missing"] == DEAD and not blind[k]:
                    found.append(SensorFinding("dead", o, now, now - DEAD + 1, False, f"no reading for {DEAD} samples"))
                continue
            if own["missing"] >= DEAD:
                found.append(SensorFinding("dead", o, now, now, True))
            own["missing"] = 0
            if value == own["last"]:
                own["run"] += 1
                repeating[k] = True
                most = max(FROZEN - 1, np.log(CHANCE) / np.log((own["repeats"] + 1) / (own["seen"] + 2)))
                if not own["condition"] and own["run"] >= most:
                    at_end = [visits for end, visits in zip(own["ends"], own["visits"]) if end == value]
                    own["condition"] = "saturated" if at_end and max(at_end) > 1 else "frozen"
                    note = f"{own['run'] + 1} identical readings" + (
                        f" of {value:.6g}, the limit of the sensor" if own["condition"] == "saturated" else "")
                    found.append(SensorFinding(own["condition"], o, now, own["since"], False, note))
                if own["condition"]:
                    y[k] = np.nan
                continue
            if own["condition"]:
                found.append(SensorFinding(own["condition"], o, now, now, True))
            else:
                if own["last"] in own["ends"]:
                    own["held"][own["ends"].index(own["last"])] += own["run"]
                else:
                    own["repeats"] += own["run"]
                own["seen"] += own["run"] + 1
            own["run"], own["condition"], own["last"], own["since"] = 0, "", value, now
            self._reach(own, np.array([value]))
        for word, value in own.items():
            self.memory[word][o] = value

    def _reach(self, own: dict[str, Any], y: Array) -> None:
        """Count how often the smallest and the largest reading was reached, by readings (T,) that differ in turn."""
        for end, best in enumerate((y.min(initial=np.inf), y.max(initial=-np.inf))):
            known, visits = own["ends"][end], int(np.sum(y == best))
            if not visits:
                continue
            if known is None or (best < known if end == 0 else best > known):
                own["repeats"] += own["held"][end]
                own["ends"][end], own["visits"][end], own["held"][end] = float(best), visits, 0
            elif best == known:
                own["visits"][end] += visits


def lost_readings(y: Array, outputs: Sequence[str], experiment: int = 0) -> tuple[LostReadings, ...]:
    """Return the stretches of a record (N, l) in which a sensor is frozen, saturated or dead.

    All runs at the limit of a sensor that is saturated once are saturated. `FLAT` readings are enough where a sensor
    repeats no other. Gaps as long as a sensor often has are no fault.
    """
    _, _, found = SensorChecks(y.shape[1]).screen(y, np.zeros(len(y), dtype=bool), 0)
    lines = []
    for one in (one for one in found if not one.ended):
        last = next((e.sample for e in found if e.ended and e.output == one.output and e.sample > one.sample), len(y))
        own = y[one.onset : last, one.output]
        value = float("nan") if one.is_dead else float(own[0])
        count = int(np.sum(np.isnan(own) if one.is_dead else own == value))
        lines.append(LostReadings(f"sensor:{outputs[one.output]}", one.condition, experiment, one.onset, count, value))
    for o in set(range(y.shape[1])) - {one.output for one in found if not one.is_dead}:
        repeats = np.flatnonzero(y[1:, o] == y[:-1, o])
        if repeats.size >= FLAT - 1 and np.ptp(repeats) == repeats.size - 1 < 0.1 * len(y):
            first = int(repeats[0])
            lines.append(LostReadings(f"sensor:{outputs[o]}", "frozen", experiment, first, repeats.size + 1,
                                      float(y[first, o])))
    limits = {(one.name, one.value) for one in lines if one.condition == "saturated"}
    return tuple(replace(one, condition="saturated") if (one.name, one.value) in limits else one for one in lines
                 if not one.is_dead or one.count > USUAL * _longest_other_gap(y, outputs, one))


def _longest_other_gap(y: Array, outputs: Sequence[str], one: LostReadings) -> int:
    """Return the length of the longest gap of a sensor outside a stretch, between two readings."""
    present = np.flatnonzero(~np.isnan(y[:, list(outputs).index(one.name.partition(":")[2])]))
    gaps = [int(b - a - 1) for a, b in zip(present[:-1], present[1:]) if not a < one.first < b]
    return max(gaps, default=0)

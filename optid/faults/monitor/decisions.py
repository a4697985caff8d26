"""The decisions of a monitor: raise an alarm, isolate, carry and clear a fault."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.answers import FaultAnswer
from optid.faults.false_alarms import common_excess
from optid.faults.monitor.actuator_kinds import groups_of, is_grouped, kinds, likeliest
from optid.faults.monitor.columns import Columns, Window
from optid.faults.monitor.events import Event
from optid.faults.monitor.noisy_sensor import excess, noisy_sensor
from optid.faults.monitor.running_filter import RunningFilter
from optid.faults.monitor.search_kernel import DRIFT
from optid.faults.monitor.sizes import Recent
from optid.faults.signatures import Candidate

WINDOWS, CHANGED = 40, 0.2
"""Windows from which the colour of the noise is taken, and the least change, of the logarithm, of the thresholds."""

WATCHING, NAMING, SETTLING, LOST, UNTRUSTED = range(5)
"""Phases: no alarm; alarm, not isolated; isolated, the size not yet settled; an alarm that no candidate explains alone;
the plant is where the model was not identified, and the model does not describe it there."""

Excursion = Callable[[int, int], tuple[str, int] | None]
"""(since, before) -> channel that was far outside its range after `since`, and when it left it, `before` a sample."""

AGAIN_AT = 1.25  # growth of the samples since an onset after which the kind of a carried actuator is judged again

SEVERAL_AT = 2.0
"""Growth of the samples since an alarm that no candidate explains after which several faults are searched again."""

UNKNOWN = "unknown"  # label of a fault that no candidate explains
NOTHING = -1  # no candidate is isolated


@dataclass(eq=False)
class Decisions:
    """State of the decisions."""

    columns: Columns  # of the candidates
    labels: tuple[str, ...]  # of the candidates
    q: Array  # (C,) their thresholds
    spreads: Array  # (C,) factors of the variances of their sizes, because the model is uncertain
    rules: dict[str, float]  # numbers, see `RULES`
    outputs: tuple[str, ...]  # names of the sensors
    testable: np.ndarray  # (C,) whether a total loss is detectable
    passing: list[list[int]]  # [candidate, sample at which it has faded] of transients
    listed: tuple[Candidate, ...]  # candidates of the dictionary
    phase: int = WATCHING
    alarm: int = 0  # sample of the alarm
    named: int = NOTHING  # isolated candidate
    named_at: int = 0  # sample at which it was isolated
    quiet: int = 0  # consecutive samples with statistics below the release level
    begun: int = 0  # first sample after the last unknown input
    # [sample, factor of the thresholds] of inputs outside their range in the last window, the factors falling
    raised: list[list[float]] = field(default_factory=list)
    # [candidate, labels] of carried actuators whose kind is not decided yet
    undecided: list[list[Any]] = field(default_factory=list)
    told: list[str] = field(default_factory=list)  # labels of the last isolated fault
    onsets: list[list[int]] = field(default_factory=list)  # [candidate, first sample] of the carried faults
    kept: list[Array] | None = None  # the statistics (T, C) of all samples, where they are requested

    common: float = float("nan")  # energy over its threshold that a tenth of the simulated windows reach
    highest: float = 0.0  # energy over its threshold since the last multiple of the window
    windows: list[float] = field(default_factory=list)  # those of the last windows
    adapted: float = 1.0  # factor of the thresholds for the colour of the noise

    recent: Recent | None = None  # the last samples

    KEPT = ("phase", "alarm", "named", "named_at", "quiet", "begun", "raised", "passing", "undecided", "told",
            "onsets", "highest", "windows", "adapted")

    @cached_property
    def groups(self) -> tuple[int, ...]:
        """Number of the first candidate of the group of each."""
        return groups_of(self.columns.candidates)

    def group(self, number: int) -> list[int]:
        """Return the candidates of the group of one."""
        return [c for c, first in enumerate(self.groups) if first == self.groups[number]]

    def _family(self, number: int, window: Window) -> list[int]:
        """Return those of the group of one that have any constant and an onset."""
        return [c for c in self.group(number) if self.columns.candidates[c].has_constants and window.peak[c]]

    @property
    def thresholds(self) -> Array:
        """(C,) thresholds at this sample."""
        return self.q * (self.raised[0][1] if self.raised else 1.0) * self.adapted

    @property
    def limit(self) -> Array:
        """(C,) energies at which the search must stop for a decision."""
        return self.thresholds if self.phase == WATCHING else np.zeros(len(self.q))

    def leave_range(self, now: int, distance: float) -> None:
        """Raise the thresholds for inputs so many half ranges from the middle of their range at the sample `now`."""
        factor = min(distance**4, self.rules["beyond"])
        while self.raised and self.raised[-1][1] <= factor:
            self.raised.pop()
        self.raised.append([now, factor])

    def forget_range(self, oldest: int) -> None:
        """Discard inputs outside their range before the sample `oldest`."""
        while self.raised and self.raised[0][0] < oldest:
            self.raised.pop(0)

    @property
    def waiting(self) -> bool:
        """Whether the next samples can be searched as a block."""
        return self.phase == WATCHING and not self.passing

    def count_quiet(self, statistic: Array) -> None:
        """Count the samples at the end of a block with all statistics (T, C) below the release level."""
        loud = np.flatnonzero(np.any(statistic > self.rules["release"] * self.thresholds, axis=1))
        self.quiet = self.quiet + len(statistic) if not loud.size else len(statistic) - 1 - int(loud[-1])
        self.highest = max(self.highest, float(np.max(statistic / self.q)))
        if self.kept is not None:
            self.kept.append(statistic)

    def adapt(self, now: int) -> list[Event]:
        """Adapt the thresholds to the colour of the noise at the end of a window; return what has changed."""
        if self.phase == WATCHING or self.highest > 1:
            self.windows = [*self.windows, self.highest][-WINDOWS:]
        self.highest, factor = 0.0, 1.0
        if len(self.windows) >= WINDOWS // 2:
            factor = min(common_excess(np.array(self.windows), self.common), self.rules["adapt"])
        if abs(np.log(factor / self.adapted)) < CHANGED:
            return []
        self.adapted = factor
        note = (f"thresholds times {factor:.2f} for the colour of the noise: a fault must be {np.sqrt(factor):.2f} "
                f"times as large, or is found about {factor:.1f} times as late")
        return [Event("adapted", now, note=note)]

    def excitation(self, weight: Array, now: int, window: int) -> list[Event]:
        """Return the events "testable" and "untestable" of weights (T, C) of samples from `now` on."""
        events, samples = [], now + np.arange(len(weight))
        for c, candidate in enumerate(self.columns.candidates):
            if candidate.additive:
                continue
            line, label = weight[:, c], ((self.labels[c], 1.0),)
            clear = (line < self.q[c]) | (line > 1.2 * self.q[c])
            at = np.flatnonzero(clear & (line >= 0) & (samples - self.begun >= window))
            enough = line[at] > self.q[c]
            for t in at[enough != np.concatenate([self.testable[[c]], enough])[:-1]].tolist():
                self.testable[c] = line[t] > self.q[c]
                events.append(Event("testable", now + t, label, statistic=float(line[t])) if self.testable[c] else
                              Event("untestable", now + t, label, now + t - window + 1, statistic=float(line[t])))
        return sorted(events, key=lambda e: e.sample)

    def judge(self, now: int, window: Window, plant: RunningFilter, excursion: Excursion, *, hold: bool = False
              ) -> Event | None:
        """Return the event of the last sample; no fault is isolated while a sensor repeats its reading (`hold`)."""
        if self.phase == UNTRUSTED:
            if excursion(now - window.length, now + 1) is None:
                window.restart()
                return self._clear(now)
            return None
        gains = np.where(window.peak > 0, window.statistic - self.thresholds, -np.inf)
        best, watching = int(np.argmax(gains)), self.phase == WATCHING
        if watching and gains[best] > 0:
            onset = now - int(window.peak[best]) + 1
            if left := excursion(onset - window.length, onset):  # a fault drives channels out after its onset only
                return self._distrust(now, left)
            self.phase, self.alarm = NAMING, now
            return self._event("alarm", now, best, gains, window)
        if watching:
            return self._review(now, window, plant)
        if not np.isfinite(gains[best]):
            return None
        if self.phase == LOST:
            return self._judged_again(now, window)
        if hold:
            return None
        event = self._name(now, best, gains, window, plant)
        if self.phase == LOST and (left := excursion(self.alarm - window.length, self.alarm + 1)):
            return self._distrust(now, left)  # what no fault explains is an error of the model
        if event is None or not event.isolates or self.recent is None or not np.isfinite(self.rules["odd"]):
            return event
        if self.phase == LOST:
            return self._by_several(event, self.recent.answers(self.listed, now + 1))
        return self._beside(event, self.recent, window, plant)

    def _distrust(self, now: int, left: tuple[str, int]) -> Event:
        name, since = left
        self.phase, self.named, self.quiet = UNTRUSTED, NOTHING, 0
        return Event("untrusted", now, ((name, 1.0),), since,
                     note="the model does not describe the plant there; no fault is named until it is back")

    def _clear(self, now: int) -> Event:
        self.phase, self.named = WATCHING, NOTHING
        return Event("cleared", now)

    def _name(self, now: int, best: int, gains: Array, window: Window, plant: RunningFilter) -> Event | None:
        rule, noise = self.rules, noisy_sensor(now, window, self.outputs)
        louder = (0.0 if noise is None else noise.statistic) - float(self.thresholds.max())  # an answer, too
        rivals = [gains[self.group(c)].max() for c in sorted(set(self.groups))]
        share = np.exp(np.clip(np.append(rivals, louder) - gains[best], -700, 700) / 2)
        sure = 1 / share.sum() >= rule["certainty"]
        chosen, old = best, int(window.peak[best]) + 1  # an onset must not leave the window before it is isolated
        if self.phase == NAMING:
            odd, free = self._left_over(best, window)
            waited = now - self.alarm
            late = waited >= rule["patience"] or (waited >= rule["settle"] and old + rule["settle"] >= window.length)
            if self.quiet >= rule["still"] or (late and gains[best] <= 0):
                return self._clear(now)
            if louder > gains[best] and (late or share[-1] >= rule["certainty"] * share.sum()):
                return self._lost(now, best, window, noise)
            if not late and not (sure and gains[best] > 0 and free >= 4 and self._is_testable(best)):
                return None
        else:
            if now - self.named_at < rule["settle"] and old < window.length:
                return None
            chosen = best if sure or self.groups[best] == self.groups[self.named] else self.named
            if window.peak[chosen] == 0:
                return self._clear(now)
            odd, free = self._left_over(chosen, window)
        if odd > rule["odd"]:
            return self._lost(now, chosen, window, noise)
        if self.phase == NAMING or self.groups[chosen] != self.groups[self.named]:
            self.phase, self.named, self.named_at = SETTLING, chosen, now
            event = self._event("isolated", now, chosen, gains, window)
            self.told = event.labels
            return event
        return self._carry(now, chosen, window, plant)

    def label_of(self, owner: int) -> str:
        """Return the likeliest label of a carried candidate."""
        return next((labels[0] for number, labels in self.undecided if number == owner), self.labels[owner])

    def _is_testable(self, number: int) -> bool:
        return any(self.columns.candidates[c].additive or self.testable[c] for c in self.group(number))

    def _carry(self, now: int, chosen: int, window: Window, plant: RunningFilter) -> Event | None:
        """Compensate a fault from now on, an actuator of undecided kind with share and constants."""
        onset = now - int(window.peak[chosen]) + 1
        weights, event = self._judged(chosen, onset, now) or self._kinds(chosen, window), None
        said = likeliest(weights)
        labels = [label for label, _ in said]
        if labels != [label for label in self.told if label in weights]:
            event = self._told("revised", now, said, chosen, window)
        family = self._family(chosen, window)
        if family and (len(labels) > 1 or not self.columns.candidates[chosen].additive):
            chosen = family[0]
            self.undecided = [one for one in self.undecided if one[0] != chosen] + [[chosen, labels]]
        self.onsets = [one for one in self.onsets if one[0] != chosen] + [[chosen, onset]]
        plant.room(2 * int(self.columns.size.max()))
        left = plant.carry(chosen, window)
        if np.isfinite(left):
            self.passing.append([chosen, now + plant.fades_after(left, self.rules["faded"])])
        self.forgive(window)
        return event

    def _judged(self, number: int, onset: int, now: int) -> dict[str, float]:
        """Return {label: likelihood} of the group of a candidate by a diagnosis of the last samples; empty without."""
        name, beside = self.columns.candidates[number].name, [one for one in self.onsets if one[0] != number]
        if self.recent is None or beside or not name.startswith("actuator:"):
            return {}
        labels = [c.label for c in self.listed if c.name == name and is_grouped(c)]
        logs = self.recent.evidence(labels, onset, self.listed, now + 1)
        most = max(logs.values(), default=0.0)
        return {label: float(np.exp(log - most)) for label, log in logs.items()}

    def _kinds(self, number: int, window: Window) -> dict[str, float]:
        """Return {label: likelihood} of the group of a candidate."""
        logs: dict[str, float] = {}
        here, family = self.group(number), self._family(number, window)
        for c in here:
            if window.peak[c] and (c in family or not (family and self.columns.candidates[c].additive)):
                sizes, covariance, _ = window.estimate(c)
                for label, log in self._evidence(c, sizes, covariance).items():
                    logs[label] = max(log, logs.get(label, -np.inf))
        most = max(logs.values())
        for c in here:  # too few samples for a share: it may be anything
            if not window.peak[c]:
                logs[self.labels[c]] = most
        return {label: float(np.exp(log - most)) for label, log in logs.items()}

    def _evidence(self, number: int, sizes: Array, covariance: Array) -> dict[str, float]:
        """Return {label: logarithm of the likelihood} of an estimate in the order of the columns."""
        candidate = self.columns.candidates[number]
        if not is_grouped(candidate):
            return {self.labels[number]: 0.0}
        first = int(candidate.has_constants)
        turned = np.roll(covariance, (first, first), axis=(0, 1))
        return kinds(candidate, np.roll(sizes, first), self.spreads[number] * turned, self.listed)

    def forgive(self, window: Window) -> None:
        """Discard the alarm from the next sample on."""
        window.restart()
        self.phase, self.named, self.quiet = WATCHING, NOTHING, 0

    def _give_up(self, window: Window) -> None:
        """Go on with an alarm that no candidate explains alone."""
        self.phase, self.named, self.quiet, self.told = LOST, NOTHING, 0, []
        window.restart()

    def _lost(self, now: int, best: int, window: Window, noise: Event | None) -> Event:
        """Return more noise of a sensor, or that no candidate explains the alarm."""
        onset, energy = now - int(window.peak[best]) + 1, float(window.statistic[best])
        self._give_up(window)
        if noise is not None and noise.statistic > self.thresholds.max():
            return noise
        return Event("isolated", now, ((UNKNOWN, 1.0),), onset, (), energy, "no candidate explains it")

    def _judged_again(self, now: int, window: Window) -> Event | None:
        """Return what is known now of an alarm that no candidate explains alone; no other fault is named beside it."""
        if self.quiet >= self.rules["still"]:
            return self._clear(now)
        age = now - self.alarm
        if self.recent is None or not _is_due(age, SEVERAL_AT) or age >= self.recent.last(0):
            return None
        noise, found = noisy_sensor(now, window, self.outputs), self.recent.answers(self.listed, now + 1)
        if noise is None or noise.statistic <= self.thresholds.max():
            noise = Event("revised", now, ((UNKNOWN, 1.0),), note="no candidate explains it")
        return None if found is None else self._by_several(replace(noise, kind="revised"), found)

    def _beside(self, event: Event, recent: Recent, window: Window, plant: RunningFilter) -> Event | None:
        """Return the event of a fault named soon after others, unless other faults explain the last samples."""
        young = [number for number, onset in self.onsets if event.sample - onset < recent.last(0)]
        found = recent.answers(self.listed, event.sample + 1) if young else None
        names = {c.name for c in self.listed if c.label in dict(event.candidates)}
        names |= {self.columns.candidates[number].name for number in young}
        if not found or any({fault.name for fault in one.faults} <= names for one in found):
            return event
        for number in young:
            self._release(number, window, plant)
        self._give_up(window)
        return self._by_several(replace(event, candidates=((UNKNOWN, 1.0),)), found)

    def _by_several(self, other: Event, found: tuple[FaultAnswer, ...] | None) -> Event | None:
        """Return the answers of a diagnosis, several faults among them, where they explain more than another event.

        What was told before is not repeated.
        """
        rival = other.statistic - float(self.thresholds.max())
        if found and (other.candidates[0][0] == UNKNOWN or found[0].gain > rival):
            other = Event.of_answers(other.kind, other.sample, found)
        if other.tells(self.told):
            return None
        self.told = other.labels
        return other

    def _left_over(self, number: int, window: Window) -> tuple[float, float]:
        """Excess of the residual since the onset of a candidate in standard deviations, and degrees of freedom."""
        if not np.isfinite(self.rules["odd"]):
            return 0.0, np.inf
        energy, free = window.since(number)
        free -= float(self.columns.size[number])
        if free < 1:
            return 0.0, free
        explained = (1 + self.rules["wrong"]) * float(window.statistic[number])
        return float(excess(max(energy - explained, 0.0), free)), free

    def _event(self, kind: str, now: int, best: int, gains: Array, window: Window) -> Event:
        weights: dict[str, float] = {}
        for first in sorted(set(self.groups), key=lambda c: c != self.groups[best]):
            top = gains[self.group(first)].max() - gains[best]
            own = self._kinds(first, window) if np.isfinite(top) else {}
            for label, weight in own.items():
                weights[label] = float(np.exp(top / 2)) * weight / sum(own.values())
        said, note = likeliest(weights), ""
        hidden = [c for c in self.group(best) if not (self.columns.candidates[c].additive or self.testable[c])]
        if kind == "isolated" and hidden and (best in hidden or len(said) > 1):
            note = "the actuator hardly moves: its loss is not isolable from a constant"
        elif kind == "isolated" and len(said) > 1:
            note = "not isolated in time"
        return self._told(kind, now, said, best, window, note)

    def _told(self, kind: str, now: int, said: tuple[tuple[str, float], ...], best: int, window: Window, note: str = ""
              ) -> Event:
        """Return an event with onset and size of its first label; one of no candidate is in the group of the best."""
        same = [c for c, label in enumerate(self.labels) if label == said[0][0] and window.peak[c]]
        family = self._family(same[0] if same else best, window)
        is_offset = bool(same) and self.columns.candidates[same[0]].additive
        number = family[0] if family and not is_offset else (same or [best])[0]
        sizes, _, _ = window.estimate(number)
        return Event(kind, now, said, now - int(window.peak[number]) + 1, self.columns.in_order(number, sizes),
                     float(window.statistic[number]), note)

    def _review(self, now: int, window: Window, plant: RunningFilter) -> Event | None:
        """Clear carried faults that have vanished, hold those that have converged; return the first one cleared."""
        for number, (owner, until) in enumerate(self.passing):
            if now >= until:
                del self.passing[number]
                self.onsets = [one for one in self.onsets if one[0] != owner]
                return Event("cleared", now, ((self.labels[owner], 1.0),))
        n = plant.model.nx
        for owner in dict.fromkeys(one.owner for one in plant.directions):
            if self.columns.course[self.columns.first[owner]] == DRIFT:
                continue
            rows = [p for p, one in enumerate(plant.directions) if one.owner == owner]
            at = [n + p for p in rows]
            own = self.columns.of(owner)
            whole = np.zeros((own.stop - own.start, len(rows)))  # a part may be carried twice, after a repair
            whole[[plant.directions[p].column - own.start for p in rows], range(len(rows))] = 1.0
            sizes, covariance = plant.held[own] + whole @ plant.x[at], whole @ plant.P[np.ix_(at, at)] @ whole.T
            energy = float(sizes @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ sizes)
            if energy < self.rules["forgiven"] * self.q[owner]:
                self._release(owner, window, plant)
                return Event("cleared", now, ((self.labels[owner], 1.0),))
            if event := self._revise(now, owner, sizes, covariance):
                return event
            left = sum(window.length * plant.directions[p].power * plant.P[n + p, n + p] for p in rows)
            seen = min(plant.directions[p].age for p in rows) >= window.length
            if seen and 0 < left < self.rules["learned"]:
                for p in reversed(rows):
                    plant.forget(p, window)
        return None

    def _release(self, owner: int, window: Window, plant: RunningFilter) -> None:
        """Stop compensating a fault."""
        rows = [p for p, one in enumerate(plant.directions) if one.owner == owner]
        plant.release(rows, self.columns.of(owner), window)
        self.undecided, self.onsets = ([one for one in kept if one[0] != owner]
                                       for kept in (self.undecided, self.onsets))

    def _revise(self, now: int, owner: int, sizes: Array, covariance: Array) -> Event | None:
        """Return the event of a carried actuator whose kind has become clearer."""
        for one in self.undecided:
            if one[0] != owner:
                continue
            weights = self._weights(now, owner, sizes, covariance)
            if not weights:
                continue
            said = likeliest(weights)
            labels = [label for label, _ in said]
            if set(labels) < set(one[1]) or (said[0][1] >= self.rules["certainty"] and labels != one[1]):
                one[1] = labels
                return Event("revised", now, said, size=self.columns.in_order(owner, sizes))
        return None

    def _weights(self, now: int, owner: int, sizes: Array, covariance: Array) -> dict[str, float]:
        """Return {label: likelihood} of a carried actuator; empty where nothing new is to be expected yet."""
        if self.recent is not None and len(self.onsets) == 1:
            age = max(now - self.onsets[0][1], 1)
            if not _is_due(age, AGAIN_AT):
                return {}
            if age < self.recent.last(0):
                return self._judged(owner, self.onsets[0][1], now)
        logs = self._evidence(owner, sizes, covariance)
        most = max(logs.values())
        return {label: float(np.exp(log - most)) for label, log in logs.items()}


def _is_due(age: int, growth: float) -> bool:
    """Whether something so old is judged again, at ages that grow by a factor."""
    return age > 0 and int(np.log(age + 1) / np.log(growth)) > int(np.log(age) / np.log(growth))

"""The decisions of a monitor: raise an alarm, isolate, carry and clear a fault."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.answers import FaultAnswer
from optid.faults.monitor.actuator_kinds import groups_of, is_grouped, kinds, likeliest, likelihoods
from optid.faults.monitor.columns import Window
from optid.faults.monitor.events import Event
from optid.faults.monitor.limits import Limits
from optid.faults.monitor.noisy_sensor import excess, noisy_sensor
from optid.faults.monitor.running_filter import RunningFilter
from optid.faults.monitor.search_kernel import DRIFT
from optid.faults.monitor.sizes import Recent
from optid.faults.signatures import Candidate

WATCHING, NAMING, SETTLING, LOST, UNTRUSTED = range(5)
"""Phases: no alarm; alarm, not isolated; isolated, the size not yet settled; an alarm that no candidate explains alone;
the plant is where the model was not identified, and the model does not describe it there."""

AGAIN_AT = 1.25  # growth of the samples since an onset after which the kind of a carried actuator is judged again
SEVERAL_AT = 2.0  # that since an alarm that no candidate explains after which several faults are searched again
UNKNOWN = "unknown"  # label of a fault that no candidate explains
NOTHING = -1  # no candidate is isolated


@dataclass(eq=False)
class Decisions:
    """State of the decisions."""

    window: Window
    plant: RunningFilter
    excursion: Callable[[int, int], tuple[str, int] | None]  # `ReadingChecks.excursion`
    rules: dict[str, float]  # numbers, see `RULES`
    listed: tuple[Candidate, ...]  # candidates of the dictionary
    recent: Recent | None  # the last samples
    phase: int = WATCHING
    alarm: int = 0  # sample of the alarm
    named: int = NOTHING  # isolated candidate
    named_at: int = 0  # sample at which it was isolated
    quiet: int = 0  # consecutive samples with statistics below the release level
    begun: int = 0  # first sample after the last unknown input
    passing: list[list[int]] = field(default_factory=list)  # [candidate, sample at which it has faded] of transients
    undecided: dict[int, list[str]] = field(default_factory=dict)  # labels of carried actuators of undecided kind
    told: list[str] = field(default_factory=list)  # labels of the last isolated fault
    onsets: dict[int, int] = field(default_factory=dict)  # {candidate: first sample} of the carried faults
    kept: list[Array] | None = None  # the statistics (T, C) of all samples, where they are requested

    KEPT = "phase", "alarm", "named", "named_at", "quiet", "begun", "passing", "undecided", "told", "onsets"

    def __post_init__(self) -> None:
        self.columns, self.model = self.window.columns, self.plant.model
        self.labels = tuple(c.label for c in self.columns.candidates)
        self.groups = groups_of(self.columns.candidates)  # number of the first candidate of the group of each
        self.limits = Limits(np.full(len(self.labels), np.inf), self.rules)
        self.spreads: Array = np.ones(len(self.labels))  # (C,) factors of the variances of sizes
        self.testable = np.ones(len(self.labels), dtype=bool)  # (C,) whether a total loss is detectable

    def group(self, number: int) -> list[int]:
        """Return the candidates of the group of one."""
        return [c for c, first in enumerate(self.groups) if first == self.groups[number]]

    def _family(self, number: int) -> list[int]:
        """Return those of the group of one that have any constant and an onset."""
        return [c for c in self.group(number) if self.columns.candidates[c].has_constants and self.window.peak[c]]

    @property
    def limit(self) -> Array:
        """(C,) energies at which the search must stop for a decision."""
        return self.limits.thresholds if self.phase == WATCHING else np.zeros(len(self.labels))

    def count_quiet(self, statistic: Array) -> None:
        """Count the samples at the end of a block with all statistics (T, C) below the release level."""
        loud = np.flatnonzero(np.any(statistic > self.rules["release"] * self.limits.thresholds, axis=1))
        self.quiet = self.quiet + len(statistic) if not loud.size else len(statistic) - 1 - int(loud[-1])
        self.limits.highest = max(self.limits.highest, float(np.max(statistic / self.limits.q)))
        if self.kept is not None:
            self.kept.append(statistic)

    def excitation(self, weight: Array, now: int) -> list[Event]:
        """Return the events "testable" and "untestable" of weights (T, C) of samples from `now` on."""
        events, samples, window, q = [], now + np.arange(len(weight)), self.window.length, self.limits.q
        for c, candidate in enumerate(self.columns.candidates):
            if candidate.additive:
                continue
            line, label = weight[:, c], ((self.labels[c], 1.0),)
            clear = (line < q[c]) | (line > 1.2 * q[c])
            at = np.flatnonzero(clear & (line >= 0) & (samples - self.begun >= window))
            enough = line[at] > q[c]
            for t in at[enough != np.concatenate([self.testable[[c]], enough])[:-1]].tolist():
                self.testable[c] = line[t] > q[c]
                events.append(Event("testable", now + t, label, statistic=float(line[t])) if self.testable[c] else
                              Event("untestable", now + t, label, now + t - window + 1, statistic=float(line[t])))
        return sorted(events, key=lambda e: e.sample)

    def judge(self, now: int, *, hold: bool = False) -> Event | None:
        """Return the event of the last sample; no fault is isolated while a sensor repeats its reading (`hold`)."""
        window, excursion = self.window, self.excursion
        if self.phase == UNTRUSTED:
            if excursion(now - window.length, now + 1) is None:
                window.restart()
                return self._clear(now)
            return None
        gains = np.where(window.peak > 0, window.statistic - self.limits.thresholds, -np.inf)
        best, watching = int(np.argmax(gains)), self.phase == WATCHING
        if watching and gains[best] > 0:
            onset = now - int(window.peak[best]) + 1
            if left := excursion(onset - window.length, onset):  # a fault drives channels out after its onset only
                return self._distrust(now, left)
            self.phase, self.alarm = NAMING, now
            return self._event("alarm", now, best, gains)
        if watching:
            return self._review(now)
        if not np.isfinite(gains[best]):
            return None
        if self.phase == LOST:
            return self._judged_again(now)
        if hold:
            return None
        event = self._name(now, best, gains)
        if self.phase == LOST and (left := excursion(self.alarm - window.length, self.alarm + 1)):
            return self._distrust(now, left)  # what no fault explains is an error of the model
        if event is None or not event.isolates or self.recent is None or not np.isfinite(self.rules["odd"]):
            return event
        if self.phase == LOST:
            return self._by_several(event, self.recent.answers(self.listed, now + 1))
        return self._beside(event, self.recent)

    def _distrust(self, now: int, left: tuple[str, int]) -> Event:
        name, since = left
        self._enter(UNTRUSTED)
        return Event("untrusted", now, ((name, 1.0),), since,
                     note="the model does not describe the plant there; no fault is named until it is back")

    def _clear(self, now: int) -> Event:
        self._enter(WATCHING)
        return Event("cleared", now)

    def _enter(self, phase: int) -> None:
        self.phase, self.named, self.quiet = phase, NOTHING, 0

    def _name(self, now: int, best: int, gains: Array) -> Event | None:
        rule, window = self.rules, self.window
        noise = noisy_sensor(now, window, self.model.outputs)
        louder = (0.0 if noise is None else noise.statistic) - float(self.limits.thresholds.max())  # an answer, too
        rivals = [gains[self.group(c)].max() for c in sorted(set(self.groups))]
        share = np.exp(np.clip(np.append(rivals, louder) - gains[best], -700, 700) / 2)
        sure = 1 / share.sum() >= rule["certainty"]
        chosen, old = best, int(window.peak[best]) + 1  # an onset must not leave the window before it is isolated
        if self.phase == NAMING:
            odd, free = self._left_over(best)
            waited = now - self.alarm
            late = waited >= rule["patience"] or (waited >= rule["settle"] and old + rule["settle"] >= window.length)
            if self.quiet >= rule["still"] or (late and gains[best] <= 0):
                return self._clear(now)
            if louder > gains[best] and (late or share[-1] >= rule["certainty"] * share.sum()):
                return self._lost(now, best, noise)
            is_seen = len(self._hidden(best)) < len(self.group(best))
            if not late and not (sure and gains[best] > 0 and free >= 4 and is_seen):
                return None
        else:
            if now - self.named_at < rule["settle"] and old < window.length:
                return None
            chosen = best if sure or self.groups[best] == self.groups[self.named] else self.named
            if window.peak[chosen] == 0:
                return self._clear(now)
            odd, free = self._left_over(chosen)
        if odd > rule["odd"]:
            return self._lost(now, chosen, noise)
        if self.phase == NAMING or self.groups[chosen] != self.groups[self.named]:
            self.phase, self.named, self.named_at = SETTLING, chosen, now
            event = self._event("isolated", now, chosen, gains)
            self.told = event.labels
            return event
        return self._carry(now, chosen)

    def label_of(self, owner: int) -> str:
        """Return the likeliest label of a carried candidate."""
        return self.undecided.get(owner, [self.labels[owner]])[0]

    def _hidden(self, number: int) -> list[int]:
        """Return those of the group of one whose total loss is not detectable."""
        return [c for c in self.group(number) if not (self.columns.candidates[c].additive or self.testable[c])]

    def _carry(self, now: int, chosen: int) -> Event | None:
        """Compensate a fault from now on, an actuator of undecided kind with share and constants."""
        onset = now - int(self.window.peak[chosen]) + 1
        weights, event = self._judged(chosen, onset, now) or self._kinds(chosen), None
        said = likeliest(weights)
        labels = [label for label, _ in said]
        if labels != [label for label in self.told if label in weights]:
            event = self._told("revised", now, said, chosen)
        family = self._family(chosen)
        if family and (len(labels) > 1 or not self.columns.candidates[chosen].additive):
            chosen = family[0]
            _put_last(self.undecided, chosen, labels)
        _put_last(self.onsets, chosen, onset)
        self.plant.room(2 * int(self.columns.size.max()))
        left = self.plant.carry(chosen, self.window)
        if np.isfinite(left):
            self.passing.append([chosen, now + self.plant.fades_after(left, self.rules["faded"])])
        self.forgive()
        return event

    def _judged(self, number: int, onset: int, now: int) -> dict[str, float]:
        """Return {label: likelihood} of the group of a candidate by a diagnosis of the last samples; empty without."""
        name = self.columns.candidates[number].name
        if self.recent is None or set(self.onsets) - {number} or not name.startswith("actuator:"):
            return {}
        labels = [c.label for c in self.listed if c.name == name and is_grouped(c)]
        return likelihoods(self.recent.evidence(labels, onset, self.listed, now + 1))

    def _kinds(self, number: int) -> dict[str, float]:
        """Return {label: likelihood} of the group of a candidate."""
        logs: dict[str, float] = {}
        here, family, window = self.group(number), self._family(number), self.window
        for c in here:
            if window.peak[c] and (c in family or not (family and self.columns.candidates[c].additive)):
                sizes, covariance, _ = window.estimate(c)
                for label, log in self._evidence(c, sizes, covariance).items():
                    logs[label] = max(log, logs.get(label, -np.inf))
        # too few samples for a share: it may be anything
        return likelihoods(logs | {self.labels[c]: max(logs.values()) for c in here if not window.peak[c]})

    def _evidence(self, number: int, sizes: Array, covariance: Array) -> dict[str, float]:
        """Return {label: logarithm of the likelihood} of an estimate in the order of the columns."""
        candidate = self.columns.candidates[number]
        if not is_grouped(candidate):
            return {self.labels[number]: 0.0}
        first = int(candidate.has_constants)
        turned = np.roll(covariance, (first, first), axis=(0, 1))
        return kinds(candidate, np.roll(sizes, first), self.spreads[number] * turned, self.listed)

    def forgive(self) -> None:
        """Discard the alarm from the next sample on."""
        self.window.restart()
        self._enter(WATCHING)

    def _give_up(self) -> None:
        """Go on with an alarm that no candidate explains alone."""
        self.window.restart()
        self._enter(LOST)
        self.told = []

    def _lost(self, now: int, best: int, noise: Event | None) -> Event:
        """Return more noise of a sensor, or that no candidate explains the alarm."""
        onset, energy = now - int(self.window.peak[best]) + 1, float(self.window.statistic[best])
        self._give_up()
        if noise is not None and noise.statistic > self.limits.thresholds.max():
            return noise
        return Event("isolated", now, ((UNKNOWN, 1.0),), onset, (), energy, "no candidate explains it")

    def _judged_again(self, now: int) -> Event | None:
        """Return what is known now of an alarm that no candidate explains alone; no other fault is named beside it."""
        if self.quiet >= self.rules["still"]:
            return self._clear(now)
        age = now - self.alarm
        if self.recent is None or not _is_due(age, SEVERAL_AT) or age >= self.recent.last(0):
            return None
        noise = noisy_sensor(now, self.window, self.model.outputs)
        found = self.recent.answers(self.listed, now + 1)
        if noise is None or noise.statistic <= self.limits.thresholds.max():
            noise = Event("revised", now, ((UNKNOWN, 1.0),), note="no candidate explains it")
        return None if found is None else self._by_several(replace(noise, kind="revised"), found)

    def _beside(self, event: Event, recent: Recent) -> Event | None:
        """Return the event of a fault named soon after others, unless other faults explain the last samples."""
        young = [number for number, onset in self.onsets.items() if event.sample - onset < recent.last(0)]
        found = recent.answers(self.listed, event.sample + 1) if young else None
        names = {c.name for c in self.listed if c.label in dict(event.candidates)}
        names |= {self.columns.candidates[number].name for number in young}
        if not found or any({fault.name for fault in one.faults} <= names for one in found):
            return event
        for number in young:
            self._release(number)
        self._give_up()
        return self._by_several(replace(event, candidates=((UNKNOWN, 1.0),)), found)

    def _by_several(self, other: Event, found: tuple[FaultAnswer, ...] | None) -> Event | None:
        """Return the answers of a diagnosis where they explain more than another event, unless they were told."""
        rival = other.statistic - float(self.limits.thresholds.max())
        if found and (other.candidates[0][0] == UNKNOWN or found[0].gain > rival):
            other = Event.of_answers(other.kind, other.sample, found)
        if other.tells(self.told):
            return None
        self.told = other.labels
        return other

    def _left_over(self, number: int) -> tuple[float, float]:
        """Excess of the residual since the onset of a candidate in standard deviations, and degrees of freedom."""
        if not np.isfinite(self.rules["odd"]):
            return 0.0, np.inf
        energy, free = self.window.since(number)
        free -= float(self.columns.size[number])
        if free < 1:
            return 0.0, free
        explained = (1 + self.rules["wrong"]) * float(self.window.statistic[number])
        return float(excess(max(energy - explained, 0.0), free)), free

    def _event(self, kind: str, now: int, best: int, gains: Array) -> Event:
        weights: dict[str, float] = {}
        for first in sorted(set(self.groups), key=lambda c: c != self.groups[best]):
            top = gains[self.group(first)].max() - gains[best]
            own = self._kinds(first) if np.isfinite(top) else {}
            for label, weight in own.items():
                weights[label] = float(np.exp(top / 2)) * weight / sum(own.values())
        said, note = likeliest(weights), ""
        hidden = self._hidden(best)
        if kind == "isolated" and hidden and (best in hidden or len(said) > 1):
            note = "the actuator hardly moves: its loss is not isolable from a constant"
        elif kind == "isolated" and len(said) > 1:
            note = "not isolated in time"
        return self._told(kind, now, said, best, note)

    def _told(self, kind: str, now: int, said: tuple[tuple[str, float], ...], best: int, note: str = "") -> Event:
        """Return an event with onset and size of its first label; one of no candidate is in the group of the best."""
        window = self.window
        same = [c for c, label in enumerate(self.labels) if label == said[0][0] and window.peak[c]]
        family = self._family(same[0] if same else best)
        is_offset = bool(same) and self.columns.candidates[same[0]].additive
        number = family[0] if family and not is_offset else (same or [best])[0]
        sizes, _, _ = window.estimate(number)
        return Event(kind, now, said, now - int(window.peak[number]) + 1, self.columns.in_order(number, sizes),
                     float(window.statistic[number]), note)

    def _review(self, now: int) -> Event | None:
        """Clear carried faults that have vanished, hold those that have converged; return the first one cleared."""
        for number, (owner, until) in enumerate(self.passing):
            if now >= until:
                del self.passing[number]
                self.onsets.pop(owner, None)
                return Event("cleared", now, ((self.labels[owner], 1.0),))
        plant, window, n = self.plant, self.window, self.model.nx
        for owner in dict.fromkeys(one.owner for one in plant.directions):
            if self.columns.course[self.columns.first[owner]] == DRIFT:
                continue
            sizes, covariance = plant.estimate(owner)
            energy = float(sizes @ np.linalg.pinv(covariance, rcond=1e-12, hermitian=True) @ sizes)
            if energy < self.rules["forgiven"] * self.limits.q[owner]:
                self._release(owner)
                return Event("cleared", now, ((self.labels[owner], 1.0),))
            if event := self._revise(now, owner, sizes, covariance):
                return event
            rows = plant.rows_of(owner)
            left = sum(window.length * plant.directions[p].power * plant.P[n + p, n + p] for p in rows)
            seen = min(plant.directions[p].age for p in rows) >= window.length
            if seen and 0 < left < self.rules["learned"]:
                for p in reversed(rows):
                    plant.forget(p, window)
        return None

    def _release(self, owner: int) -> None:
        """Stop compensating a fault."""
        self.plant.release(self.plant.rows_of(owner), self.columns.of(owner), self.window)
        self.undecided.pop(owner, None)
        self.onsets.pop(owner, None)

    def _revise(self, now: int, owner: int, sizes: Array, covariance: Array) -> Event | None:
        """Return the event of a carried actuator whose kind has become clearer."""
        before = self.undecided.get(owner, [])
        weights = self._weights(now, owner, sizes, covariance) if before else {}
        if not weights:
            return None
        said = likeliest(weights)
        labels = [label for label, _ in said]
        if not (set(labels) < set(before) or (said[0][1] >= self.rules["certainty"] and labels != before)):
            return None
        self.undecided[owner] = labels
        return Event("revised", now, said, size=self.columns.in_order(owner, sizes))

    def _weights(self, now: int, owner: int, sizes: Array, covariance: Array) -> dict[str, float]:
        """Return {label: likelihood} of a carried actuator; empty where nothing new is to be expected yet."""
        if self.recent is not None and len(self.onsets) == 1:
            (onset,) = self.onsets.values()
            age = max(now - onset, 1)
            if not _is_due(age, AGAIN_AT):
                return {}
            if age < self.recent.last(0):
                return self._judged(owner, onset, now)
        return likelihoods(self._evidence(owner, sizes, covariance))


def _put_last(kept: dict[int, Any], number: int, value: Any) -> None:
    """Write what is kept of a candidate behind what is kept of the others."""
    kept.pop(number, None)
    kept[number] = value


def _is_due(age: int, growth: float) -> bool:
    """Whether something so old is judged again, at ages that grow by a factor."""
    return age > 0 and int(np.log(age + 1) / np.log(growth)) > int(np.log(age) / np.log(growth))

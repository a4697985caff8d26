"""The monitor: the search for faults on a stream, sample by sample."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.faults.diagnosis.diagnosing import KINDS
from optid.faults.false_alarms import Calibration, given_thresholds, raise_thresholds
from optid.faults.monitor import file
from optid.faults.monitor.actuator_kinds import searched
from optid.faults.monitor.arl import calibrate, reference_inputs
from optid.faults.monitor.columns import SPARE, Window, columns_of
from optid.faults.monitor.decisions import NAMING, WATCHING, Decisions
from optid.faults.monitor.events import Carried, Event
from optid.faults.monitor.healthy_noise import parameter_effect, with_noise_of, without_drift
from optid.faults.monitor.limits import RULES
from optid.faults.monitor.readings import ReadingChecks
from optid.faults.monitor.running_filter import RunningFilter
from optid.faults.monitor.search_kernel import expand
from optid.faults.monitor.sizes import Recent
from optid.faults.nuisance import ModelUncertainty, model_uncertainty, uncertain_start
from optid.faults.signatures import Dictionary, dictionary
from optid.identify.recursive.state import as_block
from optid.models import HammersteinSS
from optid.models.experiments import state_like
from optid.models.feedback_tables import tabulate

NORMAL = 1.96  # standard deviations of the ends of a 95 % interval
BLOCK = 4096  # samples searched at a time


class Monitor:
    """A search for the faults of a dictionary on a stream.

    `step` and `run` change its state. Missing readings are left out. The effect of an input is unknown while it is
    missing or outside the range in which the model was identified.

    Attributes:
        dictionary: the faults; its model has the noise of the healthy records where that differs.
        labels: of the candidates searched for.
        skipped: {label: reason} of the others.
        calibration: the thresholds and their basis.
        window: samples of the window.
        seed: of the simulation.
        remark: on the parameters of the model and the noise of the healthy records; empty without.
        source: origin of the stream in JSON types, kept with the state.
    """

    def __init__(self, model: HammersteinSS, faults: Dictionary | None = None, arl0: float = 10_000, window: int = 100,
                 seed: int | None = 0, thresholds: Any = None, *, x0: Any = "unknown", healthy: Data | None = None,
                 uncertainty: Data | ModelUncertainty | None = None, u: ArrayLike | None = None,
                 samples: int | None = None, extrapolate: bool = False, drift: float | None = None,
                 **rules: float) -> None:
        """Set up a monitor; the thresholds are simulated unless they are known.

        Args:
            model: the healthy model, with noise covariances.
            faults: the dictionary; by default biases, losses, spikes and a jump of the state.
            arl0: mean number of samples between false alarms.
            window: samples in which an onset is searched.
            seed: of the simulation.
            thresholds: a `Calibration` of an earlier monitor, {label: threshold} or (C,), instead of a simulation.
            x0: the state before the first sample: "unknown", "zero" or (n,).
            healthy: a healthy record other than that of the identification: its noise is used, and the thresholds are
                raised to its rate of alarms.
            uncertainty: the record of the identification, or `model_uncertainty` of it: the uncertainty of the
                parameters raises the thresholds.
            u: (N, m) inputs typical of the healthy plant, for the thresholds of losses and stuck actuators; levels over
                the intervals of the nonlinearities by default.
            samples: length of the simulation.
            extrapolate: whether thresholds may be extrapolated beyond what the simulation supports.
            drift: samples over which slow disturbances that are no faults change, such as those of a season; a fault
                that grows as slowly is not found.
            rules: numbers of the decisions, see `RULES`.

        Raises:
            StructureError: a dictionary of another model, a window that is too short, an unknown rule, no candidate.
            DataError: a simulation too short for the ARL0; a healthy record that is too short.

        Warns:
            DataWarning: candidates that a monitor cannot search for; a healthy record with other noise than the model;
                a model whose parameters are not the most likely ones.
        """
        found = dictionary(model, kinds=KINDS) if faults is None else faults
        if not found.belongs_to(model):
            raise StructureError("faults: the dictionary belongs to another model; build it from this one.")
        least = 2 * model.nx + 2
        if isinstance(window, bool) or int(window) != window or window < least:
            raise StructureError(f"window={window!r}: it must be at least {least} samples for {model.nx} states.")
        if unknown := set(rules) - set(RULES):
            raise StructureError(f"{', '.join(sorted(unknown))}: no such argument. Rules: {', '.join(RULES)}.")
        effect, inputs, known, remarks = None, None, uncertainty, []
        if known is not None:
            if not isinstance(known, ModelUncertainty):
                silent = found.predictor if found.predictor.silent else None
                known = model_uncertainty(found.model, known, decoupled=silent)
            found = replace(found, predictor=known.predictor)
            remarks.append(known.remark)
        sized = uncertain_start(found.model, found.predictor) if known is None else known
        if drift is not None:
            found, sized = without_drift(found, drift), None
        if healthy is not None:
            found, remark = with_noise_of(found, healthy)
            remarks.append(remark)
        self.remark = " ".join(filter(None, remarks))
        for remark in filter(None, remarks):
            warnings.warn(remark, DataWarning, stacklevel=2)
        if known is not None and isinstance(uncertainty, Data):
            effect, inputs = parameter_effect(known, uncertainty, found.predictor)
        exact = {"beyond": 1.0, "wrong": 0.0} if known is None else {}  # an exact model has no errors
        rules = {**RULES, **exact, **rules, **({} if found.unknown else {"odd": np.inf})}
        self._set(found, int(window), seed, rules, sized, None if known is None else known.levels)
        for c in found.candidates:
            if c.label in self.skipped and not c.is_sensor_gain:  # the gains of sensors are among the kinds by default
                warnings.warn(f"{c.label} is not monitored: {self.skipped[c.label]}.", DataWarning, stacklevel=2)
        if thresholds is not None:
            self.calibration = given_thresholds(thresholds, self.labels, arl0, self.window)
        else:
            if inputs is None:
                inputs = np.zeros((0, found.model.B.shape[1]))
                if self.columns.losses:
                    inputs = reference_inputs(found.model, u, self.window, seed)
            self.calibration = calibrate(self.search, inputs, arl0, samples=samples, seed=seed, extrapolate=extrapolate,
                                         effect=effect)
            if healthy is not None:
                self.calibration = raise_thresholds(self.calibration, found.model, healthy, self.watched)
        self._use(self.calibration)
        if isinstance(x0, str) and x0 == "unknown":
            self.plant.lose()
        elif not (isinstance(x0, str) and x0 == "zero"):
            self.plant.x[:] = state_like(x0, (model.nx,))

    def _set(self, found: Dictionary, window: int, seed: int | None, rules: dict[str, float],
             known: ModelUncertainty | None = None, levels: Array | None = None) -> None:
        """Set up everything but the thresholds; `known` is the model by which sizes are estimated."""
        self.dictionary, self.window, self.seed, self.source = found, window, seed, None
        chosen = searched([c for c in found.candidates if c.additive or c.columns])
        if not chosen:
            raise StructureError("No candidate has a signature that a monitor can search for: add the kind 'bias'.")
        self.labels = tuple(c.label for c in chosen)
        self.skipped = {
            c.label: "it is detected from the readings in any case" if c.fault_kind.waveform or c.fault_kind.noise else
            "it has no signature that a running search can search for"
            for c in found.candidates if c.label not in self.labels}
        model, steady = found.model, found.predictor
        if not model.parts.tables.compiled:
            raise StructureError(
                "The feedback has functions of the user, which cannot be compiled. Fit them by another basis first.")
        self.columns = columns_of(model, chosen)
        self.search = Window(self.columns, window, model.nx + SPARE + 2 * int(self.columns.size.max()), steady)
        self.plant = RunningFilter(model, steady, self.columns)
        self.checks = ReadingChecks(model, window, levels)
        self.samples, self.recent = 0, None if known is None else Recent(known, window)
        self.decisions = Decisions(self.search, self.plant, self.checks.excursion, rules, found.candidates, self.recent)
        self._functions = tabulate(model.nonlinearities)
        self._input_of, self._output_of = (np.array(of, dtype=np.int64) for of in (model.input_of, model.output_of))

    def _use(self, found: Calibration) -> None:
        """Decide by a calibration."""
        self.calibration, own = found, self.decisions
        own.limits.q, own.limits.common, own.spreads = found.q, found.common, found.spreads
        if own.rules["adapt"] > 1 and not np.isfinite(found.common):
            raise StructureError("adapt: thresholds that are given have no simulated windows to compare with; leave "
                                 "either out.")

    def step(self, u: ArrayLike, y: ArrayLike) -> list[Event]:
        """Process one sample, (m,) inputs and (l,) readings; NaN is a missing value.

        Raises:
            DataError: another number of channels, or an infinite value.
        """
        model = self.dictionary.model
        try:
            rows = [np.array(part, dtype=float).reshape(1, size) for part, size in ((u, model.m), (y, model.l))]
        except (ValueError, TypeError):
            raise DataError(f"sample {self.samples}: u = {u!r} and y = {y!r}; give {model.m} and {model.l} "
                            "numbers, NaN for a missing one.") from None
        return self.run(*rows)

    def run(self, u: ArrayLike, y: ArrayLike) -> list[Event]:
        """Process a block of inputs (N, m) and readings (N, l), with the same result as `step` for each sample.

        Raises:
            DataError: other channels than the model's, unequal lengths, or an infinite value.
        """
        model = self.dictionary.model
        u, y = (np.ascontiguousarray(as_block(part, names, what, self.samples))
                for part, names, what in ((u, model.inputs, "u"), (y, model.outputs, "y")))
        if len(u) != len(y):
            raise DataError(f"u has {len(u)} samples and y has {len(y)}: they must be equally long.")
        return [event for start in range(0, len(u), BLOCK)
                for event in self._process_block(u[start : start + BLOCK], y[start : start + BLOCK])]

    def watched(self, u: Array, y: Array) -> Array:
        """Return the statistics (N, C) along a record in raw units without decisions; the monitor is unchanged."""
        twin = Monitor.__new__(Monitor)
        twin._set(self.dictionary, self.window, self.seed, self.decisions.rules)  # with thresholds that are infinite
        twin.plant.lose()
        twin.decisions.kept = []
        twin.run(u, y)
        return np.vstack(twin.decisions.kept)

    def _process_block(self, u: Array, y: Array) -> list[Event]:
        start, count = self.samples, len(u)
        f, screened = self._expanded(u), self.checks.screen(u, y, start)
        y, fed, unsure = screened.y, self._fed(screened.y), screened.unsure[:, self._input_of]
        frozen = np.isin(np.arange(count), list(screened.frozen))
        alone = np.isnan(y).any(axis=1) | screened.unsure.any(axis=1) | screened.repeating | frozen
        alone |= screened.distance > 1
        if self.recent is not None:
            self.recent.append(u, y, start)
        stops, events, k = np.append(np.flatnonzero(alone), count), list(screened.events), 0
        decisions, limits = self.decisions, self.decisions.limits
        adapts = decisions.rules["adapt"] > 1
        while k < count:
            limits.forget_range(self.samples - self.window)
            clean, due = int(stops[np.searchsorted(stops, k)]), np.inf
            if limits.raised:  # the thresholds stay the same up to here
                clean = min(clean, k + int(limits.raised[0][0]) + self.window + 1 - self.samples)
            if adapts:  # at multiples of the window
                clean = min(clean, k + self.window - self.samples % self.window)
            if self.recent is not None:
                due = self.recent.next_final(decisions.onsets, self.samples)
                clean = int(min(clean, k + due - self.samples))
            if clean > k and self.plant.certain and decisions.phase == WATCHING and not decisions.passing:
                k += self._search_block(f[k:clean], fed[k:clean], y[k:clean], events)
            else:
                if k in screened.frozen:
                    self._clear_fault(screened.frozen[k])
                if screened.distance[k] > 1:
                    limits.leave_range(self.samples, float(screened.distance[k]))
                hold = bool(screened.repeating[k])
                if self.plant.certain and not (np.isnan(y[k]).any() or unsure[k].any()):
                    self._search_block(f[k : k + 1], fed[k : k + 1], y[k : k + 1], events, hold)
                else:
                    self._search_sample(f[k], y[k], unsure[k], events, hold)
                k += 1
            if adapts and self.samples % self.window == 0:
                events += limits.adapt(self.samples - 1, decisions.phase == WATCHING)
            if self.recent is not None:
                if self.samples >= due:
                    self.recent.keep(decisions.onsets, self._estimates(), self.samples)
                if events and events[-1].ends_fault and events[-1].sample == self.samples - 1:
                    self.recent.discard(self.samples, decisions.onsets)
        return sorted(events, key=lambda e: e.sample)

    def _search_block(self, f: Array, fed: Array, y: Array, events: list[Event], hold: bool = False) -> int:
        """Search samples by the steady predictor until a decision is due; return their number."""
        plant = self.plant
        x, r = plant.run(f, fed, y)
        moving = self.columns.signals(np.vstack([plant.before, f[:-1]]), f)
        done, statistic, weight = self.search.advance(moving, r, self.decisions.limit)
        plant.x, plant.before = x[done].copy(), f[done - 1].copy()
        self._decide(statistic, weight, events, hold)
        return done

    def _search_sample(self, f: Array, y: Array, unsure: np.ndarray, events: list[Event], hold: bool) -> None:
        """Search a sample while more than the noise is uncertain."""
        used = np.where(np.isnan(f), self.plant.before, f)
        moving = self.columns.signals(self.plant.before[None], used[None])
        innovation, matrices = self.plant.step(used, lambda y: self._fed(y[None])[0], y, unsure)
        _, statistic, weight = self.search.advance(moving, innovation[None], self.decisions.limit, matrices,
                                                   int(np.count_nonzero(matrices[3].any(axis=1))))
        if unsure.any():
            self.decisions.begun = self.samples + 1
        self._decide(statistic, weight, events, hold)

    def _decide(self, statistic: Array, weight: Array, events: list[Event], hold: bool) -> None:
        decisions, now = self.decisions, self.samples
        self.samples += len(statistic)
        decisions.count_quiet(statistic)
        watching, last = decisions.phase == WATCHING, decisions.judge(self.samples - 1, hold=hold)
        if watching:
            events += decisions.excitation(weight if last is None else weight[:-1], now)
        events += [] if last is None else [last]

    def acknowledge(self) -> None:
        """Discard the alarm, and search again from the next sample on."""
        self.decisions.forgive()

    def rebase(self) -> None:
        """Take a new baseline, after a repair: discard the alarm and all carried faults."""
        plant, decisions = self.plant, self.decisions
        plant.release(list(range(len(plant.directions))), slice(0, len(plant.held)), self.search)
        for kept in (decisions.passing, decisions.undecided, decisions.onsets, decisions.limits.windows):
            kept.clear()
        if self.recent is not None:
            self.recent.discard(self.samples)
        self.acknowledge()
        plant.lose()

    def skip(self, count: int) -> None:
        """Count samples without a search, during maintenance; the state of the plant is unknown after them."""
        self.samples += count
        self.acknowledge()
        self.plant.lose()

    def _clear_fault(self, onset: int) -> None:
        """Discard the effects of a sensor that has been found frozen."""
        if self.decisions.phase != WATCHING and self.search.peak.any() and self.decisions.alarm >= onset:
            self.decisions.forgive()
        self.search.restart()
        self.plant.lose()

    def _estimates(self) -> dict[int, Carried]:
        """Return {number of the candidate: the fault} of the carried faults that the last samples show."""
        if self.recent is None:
            return {}
        numbers = {self.decisions.label_of(number): number for number in self.decisions.onsets}
        onsets = {label: self.decisions.onsets[number] for label, number in numbers.items()}
        found = self.recent.estimate(onsets, self.dictionary.candidates, self.samples)
        return {numbers[label]: one for label, one in found.items()}

    def _expanded(self, u: Array) -> Array:
        model = self.dictionary.model
        if self._functions.compiled:
            return self._values(self._functions, self._input_of, u, "an input is outside the interval of its basis.")
        return np.vstack([model.expand_inputs(u[k : k + 1]) for k in range(len(u))])  # the same digits for any block

    def _fed(self, y: Array) -> Array:
        return self._values(self.dictionary.model.parts.tables, self._output_of, y,
                            "an output leaves the interval of a feedback basis.")

    def _values(self, functions: Any, channels: np.ndarray, signals: Array, refused: str) -> Array:
        values = np.empty((len(signals), len(channels)))
        bad = expand(functions, channels, signals, values) if values.size else -1
        if bad >= 0:
            raise DataError(f"sample {self.samples + bad}: {refused}")
        return values

    def __str__(self) -> str:
        """Return the thresholds, the samples processed, and the carried faults."""
        lines = [f"{self.samples} samples seen, window {self.window}" + ", in alarm" * self.alarmed]
        lines += [str(self.calibration), *(f"  not monitored: {label}" for label in self.skipped)]
        return "\n".join([*lines, *map(str, self.carried)])

    @property
    def statistics(self) -> dict[str, float]:
        """{label: largest energy explained over the onsets of the window} at the last sample."""
        return dict(zip(self.labels, self.search.statistic.tolist()))

    @property
    def onsets(self) -> dict[str, int]:
        """{label: best onset}; -1 where none can be searched yet."""
        peaks = self.search.peak
        return dict(zip(self.labels, np.where(peaks > 0, self.samples - peaks, -1).tolist()))

    @property
    def carried(self) -> tuple[Carried, ...]:
        """The isolated faults whose effect is compensated."""
        plant, (size, variance), found = self.plant, self.plant.magnitudes(), []
        estimates = self._estimates() | (self.recent.final if self.recent is not None else {})
        for number in range(len(self.labels)):
            own, label = self.columns.of(number), self.decisions.label_of(number)
            if size[own].any() or plant.rows_of(number):
                if number in estimates and estimates[number].label == label:
                    found.append(estimates[number])
                    continue
                spread = np.sqrt(self.decisions.spreads[number] * variance[own])
                sizes, spreads = (np.array(self.columns.in_order(number, part)) for part in (size[own], spread))
                ends = zip(sizes - NORMAL * spreads, sizes + NORMAL * spreads)
                found.append(Carried(label, tuple(sizes.tolist()), tuple(spreads.tolist()), tuple(ends)))
        return tuple(found)

    @property
    def alarmed(self) -> bool:
        """Whether there is an alarm that is neither cleared nor explained by a carried fault."""
        return self.decisions.phase >= NAMING

    @property
    def state(self) -> Array:
        """(n,) expected state before the next sample, carried faults included."""
        return np.array(self.plant.x[: self.dictionary.model.nx])

    def save(self, path: str | Path) -> Path:
        """Write the state and the thresholds to an npz file, from which `load` continues bit for bit."""
        return file.save(self, path)

    @classmethod
    def load(cls, path: str | Path, functions: dict[str, Any] | None = None) -> "Monitor":
        """Restore a monitor.

        Args:
            path: file written by `save`.
            functions: the functions of UserFunctions bases by name, which a file does not hold.

        Raises:
            ModelFileError: truncated, of another version, or not the state of a monitor.
        """
        monitor = cls.__new__(cls)
        file.load(monitor, path, functions)
        return monitor

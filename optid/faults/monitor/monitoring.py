"""The monitor: the search for faults on a stream, sample by sample."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.faults.false_alarms import Calibration, given_thresholds, raise_thresholds
from optid.faults.kinds import DRIFT
from optid.faults.monitor import file
from optid.faults.monitor.actuator_kinds import searched
from optid.faults.monitor.arl import calibrate, reference_inputs
from optid.faults.monitor.columns import SPARE, Window, columns_of
from optid.faults.monitor.decisions import NAMING, WATCHING, Decisions
from optid.faults.monitor.events import Carried, Event
from optid.faults.monitor.healthy_noise import parameter_effect, with_noise_of, without_drift
from optid.faults.monitor.readings import ReadingChecks
from optid.faults.monitor.rules import RULES
from optid.faults.monitor.running_filter import RunningFilter
from optid.faults.monitor.search_kernel import expand
from optid.faults.monitor.sizes import Recent
from optid.faults.nuisance import ModelUncertainty, model_uncertainty, uncertain_start
from optid.faults.signatures import Dictionary, dictionary
from optid.identify.recursive.state import as_block
from optid.models.experiments import state_like
from optid.models.feedback_tables import tabulate

if TYPE_CHECKING:
    from optid.models import HammersteinSS

KINDS_BY_DEFAULT = ("bias", "loss", "spike")

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

    def __init__(
        self, model: "HammersteinSS", faults: Dictionary | None = None, arl0: float = 10_000, window: int = 100,
        seed: int | None = 0, thresholds: Any = None, *, x0: Any = "unknown", healthy: Data | None = None,
        uncertainty: Data | ModelUncertainty | None = None, u: ArrayLike | None = None, samples: int | None = None,
        extrapolate: bool = False, drift: float | None = None, **rules: float,
    ) -> None:
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
        found = dictionary(model, kinds=KINDS_BY_DEFAULT) if faults is None else faults
        if not found.belongs_to(model):
            raise StructureError("faults: the dictionary belongs to another model; build it from this one.")
        least = 2 * model.nx + 2
        if isinstance(window, bool) or int(window) != window or window < least:
            raise StructureError(f"window={window!r}: it must be at least {least} samples for {model.nx} states.")
        unknown = set(rules) - set(RULES)
        if unknown:
            raise StructureError(f"{', '.join(sorted(unknown))}: no such argument. Rules: {', '.join(RULES)}.")
        effect, inputs, known, remarks = None, None, uncertainty, []
        if known is not None:
            silent = found.predictor if found.predictor.silent else None
            if not isinstance(known, ModelUncertainty):
                known = model_uncertainty(found.model, known, decoupled=silent)
            found = replace(found, predictor=known.predictor)
            remarks.append(known.remark)
        sized = uncertain_start(found.model, found.predictor) if known is None else known
        if drift is not None:
            found, sized = without_drift(found, drift), None
        if healthy is not None:
            found, remark = with_noise_of(found, healthy)
            remarks.append(remark)
        for remark in filter(None, remarks):
            warnings.warn(remark, DataWarning, stacklevel=2)
        self.remark = " ".join(filter(None, remarks))
        if known is not None and isinstance(uncertainty, Data):
            effect, inputs = parameter_effect(known, uncertainty, found.predictor)
        exact = {"beyond": 1.0, "wrong": 0.0} if known is None else {}  # an exact model has no errors
        rules = {**RULES, **exact, **rules}
        self._set(found, int(window), seed, rules | ({} if found.unknown else {"odd": np.inf}),
                  sized, None if known is None else known.levels)
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
            for c in found.candidates if c.label not in self.labels
        }
        model, steady = found.model, found.predictor
        if not model.parts.tables.compiled:
            raise StructureError(
                "The feedback has functions of the user, which cannot be compiled. Fit them by another basis first.")
        self.columns = columns_of(model, chosen)
        self.search = Window(self.columns, window, model.nx + SPARE + 2 * int(self.columns.size.max()), steady)
        self.plant = RunningFilter(model, steady, self.columns)
        self.checks = ReadingChecks(model, window, levels)
        self.decisions = Decisions(self.columns, self.labels, np.full(len(chosen), np.inf), np.ones(len(chosen)), rules,
                                   model.outputs, np.ones(len(chosen), dtype=bool), [], found.candidates)
        self.samples = 0
        self.recent = self.decisions.recent = None if known is None else Recent(known, window)
        self._functions = tabulate(model.nonlinearities)
        self._input_of, self._output_of = (np.array(of, dtype=np.int64) for of in (model.input_of, model.output_of))

    def _use(self, found: Calibration) -> None:
        """Decide by a calibration."""
        self.calibration, own = found, self.decisions
        own.q, own.spreads, own.common = found.q, found.spreads, found.common
        if own.rules["adapt"] > 1 and not np.isfinite(found.common):
            raise StructureError("adapt: thresholds that are given have no simulated windows to compare with; leave "
                                 "either out.")

    # -- samples -------------------------------------------------------------------------------------------------

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
        while k < count:
            self.decisions.forget_range(self.samples - self.window)
            clean = int(stops[np.searchsorted(stops, k)])
            if self.decisions.raised:  # the thresholds stay the same up to here
                clean = min(clean, k + int(self.decisions.raised[0][0]) + self.window + 1 - self.samples)
            adapts = self.decisions.rules["adapt"] > 1
            if adapts:  # at multiples of the window
                clean = min(clean, k + self.window - self.samples % self.window)
            due = self._next_final()
            clean = int(min(clean, k + due - self.samples))
            if clean > k and self.plant.certain and self.decisions.waiting:
                k += self._search_block(f[k:clean], fed[k:clean], y[k:clean], events)
                events += self._adapt() if adapts else []
                self._keep_sizes(due, events)
                continue
            if k in screened.frozen:
                self._clear_fault(screened.frozen[k])
            if screened.distance[k] > 1:
                self.decisions.leave_range(self.samples, float(screened.distance[k]))
            self._search_sample(f[k], fed[k], y[k], unsure[k], bool(screened.repeating[k]), events)
            events += self._adapt() if adapts else []
            self._keep_sizes(due, events)
            k += 1
        return sorted(events, key=lambda e: e.sample)

    def _search_block(self, f: Array, fed: Array, y: Array, events: list[Event]) -> int:
        """Search samples by the steady predictor until a decision is due; return their number."""
        plant, decisions, now = self.plant, self.decisions, self.samples
        x, r = plant.run(f, fed, y)
        moving = self.columns.signals(np.vstack([plant.before, f[:-1]]), f)
        done, statistic, weight = self.search.advance(moving, r, decisions.limit)
        plant.x, plant.before = x[done].copy(), f[done - 1].copy()
        self.samples += done
        decisions.count_quiet(statistic)
        last = decisions.judge(self.samples - 1, self.search, plant, self.checks.excursion)
        events += decisions.excitation(weight if last is None else weight[:-1], now, self.window)
        events += [] if last is None else [last]
        return done

    def _search_sample(self, f: Array, fed: Array, y: Array, unsure: np.ndarray, repeating: bool, events: list[Event]
                       ) -> None:
        plant, decisions, now = self.plant, self.decisions, self.samples
        used = np.where(np.isnan(f), plant.before, f)
        moving, limit = self.columns.signals(plant.before[None], used[None]), np.full(len(self.labels), np.inf)
        if plant.certain and not (np.isnan(y).any() or unsure.any()):
            x, r = plant.run(used[None], fed[None], y[None])
            plant.x, plant.before = x[1].copy(), used.copy()
            _, statistic, weight = self.search.advance(moving, r, limit)
        else:
            innovation, matrices = plant.step(used, lambda y: self._fed(y[None])[0], y, unsure)
            _, statistic, weight = self.search.advance(moving, innovation[None], limit, matrices,
                                                       int(np.count_nonzero(matrices[3].any(axis=1))))
        self.samples += 1
        if unsure.any():
            decisions.begun = now + 1
        decisions.count_quiet(statistic)
        watching = decisions.phase == WATCHING
        event = decisions.judge(now, self.search, plant, self.checks.excursion, hold=repeating)
        if event is not None:
            events.append(event)
        elif watching and decisions.phase == WATCHING:
            events += decisions.excitation(weight, now, self.window)

    def _adapt(self) -> list[Event]:
        return [] if self.samples % self.window else self.decisions.adapt(self.samples - 1)

    # -- sizes ----------------------------------------------------------------------------------------------------

    def _next_final(self) -> float:
        """Return the next sample at which the size of a carried fault becomes final."""
        if self.recent is None:
            return np.inf
        last = (self.recent.last(onset) for number, onset in self.decisions.onsets if number not in self.recent.final)
        return min((sample for sample in last if sample > self.samples), default=np.inf)

    def _keep_sizes(self, due: float, events: list[Event]) -> None:
        """Keep sizes that are final at this sample, and discard samples with a fault that is over."""
        recent, onsets = self.recent, {number: onset for number, onset in self.decisions.onsets}
        if recent is None:
            return
        if self.samples >= due:
            recent.final |= {number: one for number, one in self._estimates().items()
                             if recent.last(onsets[number]) <= self.samples}
        if events and events[-1].ends_fault and events[-1].sample == self.samples - 1:
            recent.discard(self.samples)
            recent.final = {number: one for number, one in recent.final.items() if number in onsets}

    def _estimates(self) -> dict[int, Carried]:
        """Return {number of the candidate: the fault} of the carried faults that the last samples show."""
        if self.recent is None:
            return {}
        numbered = {self.decisions.label_of(number): (number, onset) for number, onset in self.decisions.onsets}
        onsets = {label: onset for label, (_, onset) in numbered.items()}
        found = self.recent.estimate(onsets, self.dictionary.candidates, self.samples)
        return {numbered[label][0]: one for label, one in found.items()}

    # -- operators -------------------------------------------------------------------------------------------------

    def acknowledge(self) -> None:
        """Discard the alarm, and search again from the next sample on."""
        self.decisions.forgive(self.search)

    def rebase(self) -> None:
        """Take a new baseline, after a repair: discard the alarm and all carried faults."""
        plant = self.plant
        plant.release(list(range(len(plant.directions))), slice(0, len(plant.held)), self.search)
        self.decisions.passing, self.decisions.undecided, self.decisions.windows = [], [], []
        self.decisions.onsets = []
        if self.recent is not None:
            self.recent.discard(self.samples)
            self.recent.final = {}
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
            self.decisions.forgive(self.search)
        self.search.restart()
        self.plant.lose()

    def _expanded(self, u: Array) -> Array:
        model = self.dictionary.model
        if self._functions.compiled:
            f = np.empty((len(u), model.B.shape[1]))
            bad = expand(self._functions, self._input_of, u, f)
            if bad >= 0:
                raise DataError(f"sample {self.samples + bad}: an input is outside the interval of its basis.")
            return f
        return np.vstack([model.expand_inputs(u[k : k + 1]) for k in range(len(u))])  # the same digits for any block

    def _fed(self, y: Array) -> Array:
        fed = np.empty((len(y), len(self._output_of)))
        if fed.size and expand(self.dictionary.model.parts.tables, self._output_of, y, fed) >= 0:
            raise DataError(f"sample {self.samples}: an output leaves the interval of a feedback basis.")
        return fed

    def __str__(self) -> str:
        """Return the thresholds, the samples processed, and the carried faults."""
        lines = [f"{self.samples} samples seen, window {self.window}" + ", in alarm" * self.alarmed]
        lines += [str(self.calibration), *(f"  not monitored: {label}" for label in self.skipped)]
        return "\n".join([*lines, *map(str, self.carried)])

    # -- current state --------------------------------------------------------------------------------------------

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
        plant, size, found = self.plant, self.plant.held.copy(), []
        variance = plant.held_variance.copy()
        estimates = self._estimates() | (self.recent.final if self.recent is not None else {})
        for at, one in enumerate(plant.directions, self.dictionary.model.nx):
            if self.columns.course[one.column] != DRIFT or one.growth > 0:
                size[one.column] += plant.x[at]
                variance[one.column] += plant.P[at, at]
        for number in range(len(self.labels)):
            own, label = self.columns.of(number), self.decisions.label_of(number)
            if size[own].any() or any(one.owner == number for one in plant.directions):
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

    # -- files -----------------------------------------------------------------------------------------------------

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

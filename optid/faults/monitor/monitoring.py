"""The monitor: the search for faults on a stream, sample by sample."""

import hashlib
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.bases.expansions import UserFunctions
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.faults.monitor import layout as at
from optid.faults.monitor.arl import Calibration, calibrate, held_levels
from optid.faults.monitor.events import Carried, Event
from optid.faults.monitor.layout import State, Tables
from optid.faults.monitor.tables import blank, monitored, tables, with_thresholds
from optid.faults.signatures import Dictionary, dictionary
from optid.faults.whitening import health, whiten
from optid.identify.recursive.intake import as_block
from optid.models.experiments import state_like
from optid.models.feedback_tables import tabulated

if TYPE_CHECKING:
    from optid.models import HammersteinSS

RULES = {
    "certainty": 0.98, "release": 0.5, "patience": 40.0, "settle": 10.0, "still": 10.0, "faded": 1e-8, "learned": 0.02,
    "forgiven": 0.3, "wide": 0.0, "odd": 4.3,
}
"""Numbers of the decisions, in the order of `optid.faults.monitor.decide_kernels`.

A fault is named once its posterior reaches `certainty`, or after `patience` samples. An alarm ends after `still`
samples with all statistics below `release` of their thresholds. A named fault is carried `settle` samples later.
A transient is dropped when what is left of it has this energy (`faded`). A carried fault is no longer estimated when
the error of its size has this energy in a window (`learned`), and is gone when its significance falls below this share
of the threshold (`forgiven`). `wide` is the variance of an unknown state, set by the model. Nothing explains an alarm
when the energy that is left is so many standard deviations too large (`odd`).
"""

WIDE = 1e8
"""Energy that a state of which nothing is known may have in one innovation."""

KINDS = ("alarm", "isolated", "cleared", "untestable", "testable", "isolated")
KINDS_BY_DEFAULT = ("bias", "loss", "spike")

EVENTS = 64
"""Events taken out of the compiled loop at a time."""

INPUTS = 20_000
"""Samples of simulated input for the calibration."""

_KNOWN: dict[str, Calibration] = {}


class Monitor:
    """A search for the faults of a dictionary on a stream.

    It is a state: `step` and `run` change it. Missing readings correct nothing and count for nothing; after a missing
    input the state of the plant is taken as unknown.

    Attributes:
        dictionary: the faults.
        labels: of those that are looked for.
        skipped: {label: why} of the others.
        calibration: the thresholds and what they rest on.
        window: samples of the window.
        seed: of the simulation.
        source: JSON types that are kept with the state: where the stream came from.
    """

    def __init__(
        self,
        model: "HammersteinSS",
        faults: Dictionary | None = None,
        arl0: float = 10_000,
        window: int = 100,
        seed: int | None = 0,
        thresholds: Any = None,
        *,
        x0: Any = "unknown",
        healthy: Data | None = None,
        rescale: bool = False,
        u: ArrayLike | None = None,
        samples: int | None = None,
        extrapolate: bool = False,
        **rules: float,
    ) -> None:
        """Set up a monitor; the thresholds are simulated unless they are known.

        Args:
            model: the healthy model, with noise covariances.
            faults: what is thought possible; by default biases, losses, spikes and a jump of the state.
            arl0: mean number of samples between false alarms.
            window: samples that an onset is looked for in.
            seed: of the simulation.
            thresholds: a `Calibration` of an earlier monitor, {label: threshold} or (C,), instead of a simulation.
            x0: the state before the first sample: "unknown", "zero" or (n,).
            healthy: a healthy record, whose innovations must be white and of the size that the model says.
            rescale: take the scale of the noise from the healthy record.
            u: (N, m) inputs typical of the healthy plant, for the thresholds of losses and stuck actuators; levels over
                the intervals of the nonlinearities by default.
            samples: length of the simulation.
            extrapolate: whether thresholds may be extrapolated beyond what the simulation supports.
            rules: numbers of the decisions, see `RULES`.

        Raises:
            StructureError: a dictionary of another model, a window that is too short, an unknown rule, no candidate.
            DataError: a simulation too short for the ARL0; a healthy record whose innovations are not white or of
                another size.

        Warns:
            DataWarning: candidates that a monitor cannot look for.
        """
        found = dictionary(model, kinds=KINDS_BY_DEFAULT) if faults is None else faults
        if found.model is not model:
            raise StructureError("faults: the dictionary belongs to another model; build it from this one.")
        least = 2 * model.nx + 2
        if isinstance(window, bool) or int(window) != window or window < least:
            raise StructureError(f"window={window!r}: at least {least} samples are needed for {model.nx} states.")
        unknown = set(rules) - (set(RULES) - {"wide"})
        if unknown:
            raise StructureError(f"{', '.join(sorted(unknown))}: no such argument. Rules: {', '.join(RULES)}.")
        if healthy is not None:
            judged = health(whiten(model, healthy))
            found = replace(found, predictor=judged.predictor(found.predictor, rescale=rescale))
        self._of(found, int(window), seed)
        for label, why in self.skipped.items():
            warnings.warn(f"{label} is not monitored: {why}.", DataWarning, stacklevel=2)
        strength = float(np.max(np.sum((found.predictor.root @ found.predictor.C) ** 2, axis=0), initial=1e-300))
        numbers = {**RULES, **rules} | {"wide": WIDE / strength} | ({} if found.unknown else {"odd": np.inf})
        t = tables(found, self._chosen, self.window, list(numbers.values()))
        self.calibration = self._calibrated(t, arl0, thresholds, u, samples, extrapolate)
        self._start(with_thresholds(t, self.calibration.q), blank(t))
        if isinstance(x0, str) and x0 == "unknown":
            from optid.faults.monitor.carry_kernels import lose_state

            lose_state(self._tables, self._state)
        elif not (isinstance(x0, str) and x0 == "zero"):
            self._state.v[at.X, : model.nx] = state_like(x0, (model.nx,))

    def _of(self, found: Dictionary, window: int, seed: int | None) -> None:
        self.dictionary, self.window, self.seed, self.source = found, window, seed, None
        self._chosen = tuple(c for c in found.candidates if monitored(c))
        if not self._chosen:
            raise StructureError("No candidate has a signature that a monitor could look for: add the kind 'bias'.")
        self.labels = tuple(c.label for c in self._chosen)
        self.skipped = {
            c.label: "its course may be anything, which only a record can be tested for"
            for c in found.candidates if not monitored(c)
        }

    def _start(self, t: Tables, s: State) -> None:
        self._tables, self._state = t, s
        model = self.dictionary.model
        self._feedback, self._functions = model.parts.tables, tabulated(model.nonlinearities)
        self._plain = all(
            isinstance(g.basis, UserFunctions) and g.basis.size == len(g.basis.functions)
            and (g.basis.interval is None or g.basis.outside != "error") for g in model.nonlinearities
        )
        self._one = np.empty(1)
        self._sample = np.empty(model.m + model.l)  # one array, so that one look finds what is infinite
        self._u, self._y = self._sample[None, : model.m], self._sample[None, model.m :]
        self._f = np.empty((1, int(t.i[0, at.NF])))
        self._input_of = np.array(model.input_of, dtype=np.int64)
        width = 6 + len(self.labels) + max(c.dimension for c in self._chosen)
        self._events, self._event = np.zeros((EVENTS, width)), np.zeros((1, width))

    def _calibrated(
        self, t: Tables, arl0: float, thresholds: Any, u: ArrayLike | None, samples: int | None, extrapolate: bool
    ) -> Calibration:
        if thresholds is not None:
            return self._given(thresholds, arl0)
        f = self._rehearsed(u)
        key = hashlib.sha256(repr((self.labels, float(arl0), samples, self.seed, extrapolate)).encode())
        for part in (f, t.m, t.i, t.w):
            key.update(np.ascontiguousarray(part).tobytes())
        name = key.hexdigest()
        if name not in _KNOWN:
            _KNOWN[name] = calibrate(
                t, self.labels, f, arl0, samples=samples, seed=self.seed, extrapolate=extrapolate
            )
        return _KNOWN[name]

    def _given(self, thresholds: Any, arl0: float) -> Calibration:
        if isinstance(thresholds, Calibration):
            if thresholds.labels != self.labels or thresholds.window != self.window:
                raise StructureError(
                    f"thresholds: they are those of {', '.join(thresholds.labels)} in a window of "
                    f"{thresholds.window}; this monitor looks for {', '.join(self.labels)} in {self.window}."
                )
            return thresholds
        if isinstance(thresholds, Mapping):
            missing = [label for label in self.labels if label not in thresholds]
            if missing:
                raise StructureError(f"thresholds: none for {', '.join(missing)}.")
            thresholds = [thresholds[label] for label in self.labels]
        q = np.array(thresholds, dtype=float)
        if q.shape != (len(self.labels),) or not np.all(q > 0):
            raise StructureError(f"thresholds: one positive number for each of {', '.join(self.labels)} is needed.")
        return Calibration(self.labels, q, float(arl0), self.window, 0, 0, None)

    def _rehearsed(self, u: ArrayLike | None) -> Array:
        model = self.dictionary.model
        if not any(c.columns for c in self._chosen):
            return np.zeros((0, model.B.shape[1]))
        if u is not None:
            inputs = np.asarray(u, dtype=float).reshape(len(np.asarray(u)), -1)
            if inputs.shape[1] != model.m or not np.isfinite(inputs).all() or len(inputs) < self.window:
                raise DataError(
                    f"u has shape {np.shape(u)}: at least {self.window} samples of {model.m} inputs, none missing."
                )
            return model.expanded(inputs)
        spans = [(-1.0, 1.0)] * model.m
        for c, nonlinearity in zip(model.input_of, model.nonlinearities):
            spans[c] = nonlinearity.basis.interval or spans[c]
        low, high = np.array(spans).T
        return model.expanded(held_levels(low, high, INPUTS, self.seed))

    # -- samples -------------------------------------------------------------------------------------------------

    @property
    def samples(self) -> int:
        """Samples seen."""
        return int(self._state.counts[at.NOW])

    def step(self, u: ArrayLike, y: ArrayLike) -> Event | None:
        """Take in one sample; NaN is a missing value.

        Args:
            u: (m,) inputs.
            y: (l,) readings.

        Returns:
            what happened, if anything; at most one event per sample.

        Raises:
            DataError: another number of channels, or an infinite value.
        """
        from optid.faults.monitor.decide_kernels import march

        try:
            if np.size(u) != self._u.size or np.size(y) != self._y.size:
                raise ValueError
            self._u[0], self._y[0] = u, y
        except (ValueError, TypeError):
            raise DataError(
                f"sample {self.samples}: u = {u!r} and y = {y!r}; {self._u.size} and {self._y.size} numbers are "
                "needed, NaN for one that is missing."
            ) from None
        if np.isinf(self._sample).any():
            raise DataError(f"sample {self.samples}: an infinite value; use NaN for one that is missing.")
        self._expand(self._u, self._f)
        _, found, refused = march(self._tables, self._state, self._feedback, self._f, self._y, self._event)
        if refused:
            self._refuse()
        return self._told(self._event[0]) if found else None

    def run(self, u: ArrayLike, y: ArrayLike) -> list[Event]:
        """Take in a block of samples, with the same result as `step` for each of them.

        Args:
            u: (N, m) inputs.
            y: (N, l) readings.

        Raises:
            DataError: other channels than the model's, unequal lengths, or an infinite value.
        """
        from optid.faults.monitor.decide_kernels import march

        model = self.dictionary.model
        u, y = (np.ascontiguousarray(as_block(part, names, what, self.samples))
                for part, names, what in ((u, model.inputs, "u"), (y, model.outputs, "y")))
        if len(u) != len(y):
            raise DataError(f"u has {len(u)} samples and y has {len(y)}: give as many of each.")
        f = np.empty((len(u), self._f.shape[1]))
        self._expand(u, f)
        events, done = [], 0
        while done < len(y):
            taken, found, refused = march(self._tables, self._state, self._feedback, f[done:], y[done:], self._events)
            events += [self._told(line) for line in self._events[:found]]
            if refused:
                self._refuse()
            done += taken
        return events

    def _expand(self, u: Array, f: Array) -> None:
        if self._functions.compiled:
            from optid.faults.monitor.predict_kernels import expand

            bad = expand(self._functions, self._input_of, u, f)
            if bad >= 0:
                raise DataError(f"sample {self.samples + bad}: an input is outside the interval of its basis.")
        elif len(u) > 1 or not self._plain:
            f[:] = self.dictionary.model.expanded(u)
        else:  # as the bases do it, without their tables
            for j, (nonlinearity, c) in enumerate(zip(self.dictionary.model.nonlinearities, self._input_of)):
                basis: Any = nonlinearity.basis
                self._one[0] = u[0, c]
                if basis.outside == "clamp" and basis.interval is not None:
                    np.clip(self._one, *basis.interval, out=self._one)
                total = nonlinearity.offset or 0.0
                for function, weight in zip(basis.functions, nonlinearity.mu):
                    total += weight * function(self._one)[0]
                f[0, j] = total

    def _refuse(self) -> None:
        raise DataError(f"sample {self.samples}: an output leaves the interval of a feedback basis that refuses it.")

    def _told(self, line: Array) -> Event:
        code, sample, best, onset = (int(value) for value in line[:4])
        kind, count = KINDS[code], len(self.labels)
        label = self.labels[best] if best >= 0 else ""
        if code in (at.UNTESTABLE, at.TESTABLE):
            since = sample - self.window + 1 if code == at.UNTESTABLE else None
            return Event(kind, sample, ((label, 1.0),), since, (), float(line[4]))
        if code == at.CLEARED:
            return Event(kind, sample, ((label, 1.0),) if label else (), None, (), 0.0)
        if code == at.STRANGE:
            return Event(kind, sample, (("unknown", 1.0),), onset, (), float(line[4]), "no candidate explains it")
        gains = line[5 : 5 + count]
        weight = np.exp((gains - gains.max()) / 2)
        weight /= weight.sum()
        order = [best, *(int(c) for c in np.argsort(-weight, kind="stable") if c != best)]
        kept = int(np.searchsorted(np.cumsum(weight[order]), 0.95)) + 1
        size = tuple(float(v) for v in line[5 + count : 5 + count + self._chosen[best].dimension])
        named = tuple((self.labels[c], float(weight[c])) for c in order[:kept])
        note = ""
        if code == at.ISOLATED and not (self._chosen[best].additive or line[-1]):
            note = "the actuator hardly moves: its loss cannot be told from a constant"
        elif code == at.ISOLATED and kept > 1:
            note = "not told apart in time"
        return Event(kind, sample, named, onset, size, float(line[4]), note)

    def __str__(self) -> str:
        """Say what is looked for, what the thresholds rest on, what was seen, and what is carried."""
        lines = [f"{self.samples} samples seen, window {self.window}" + ", in alarm" * self.alarmed]
        lines.append(str(self.calibration))
        lines += [f"  not monitored: {label}" for label in self.skipped]
        for fault in self.carried:
            sizes = ", ".join(f"{size:.4g} +- {spread:.2g}" for size, spread in zip(fault.size, fault.deviation))
            lines.append(f"carried: {fault.label}, size {sizes}")
        return "\n".join(lines)

    # -- what is known now ---------------------------------------------------------------------------------------

    @property
    def statistics(self) -> dict[str, float]:
        """{label: largest energy explained over the onsets of the window} at the last sample."""
        return dict(zip(self.labels, self._state.v[at.STATISTIC].tolist()))

    @property
    def onsets(self) -> dict[str, int]:
        """{label: onset at which it explains most}; -1 where it cannot be looked for yet."""
        return dict(zip(self.labels, self._state.i[at.PEAK].tolist()))

    @property
    def carried(self) -> tuple[Carried, ...]:
        """The faults that were named and are accounted for."""
        s, first = self._state, 0
        owners = s.i[at.OWNER, : s.counts[at.ACTIVE]]
        found = []
        for number, (label, c) in enumerate(zip(self.labels, self._chosen)):
            own = slice(first, first + c.dimension)
            first += c.dimension
            size = np.array(s.v[at.SLOPE if c.kind == "drift" else at.HELD, own])
            variance, mine = np.zeros(c.dimension), np.flatnonzero(owners == number)
            for q in mine:
                if c.kind != "drift" or s.v[at.GROWTH, q] > 0:
                    size[s.i[at.COLUMN, q] - own.start] += s.v[at.NU, q]
                    variance[s.i[at.COLUMN, q] - own.start] += s.m[at.P, q, q]
            if mine.size or size.any():
                found.append(Carried(label, tuple(size.tolist()), tuple(np.sqrt(variance).tolist())))
        return tuple(found)

    @property
    def alarmed(self) -> bool:
        """Whether there is an alarm that has not been cleared or answered by carrying the fault."""
        return bool(self._state.counts[at.PHASE] != at.WATCHING)

    @property
    def state(self) -> Array:
        """(n,) expected state before the next sample, carried faults included."""
        return np.array(self._state.v[at.X, : self.dictionary.model.nx])

    # -- files -----------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> Path:
        """Write the whole state to an npz file, from which `load` continues bit for bit; thresholds included."""
        from optid.faults.monitor.file import save

        return save(self, path)

    @classmethod
    def load(cls, path: str | Path, functions: dict[str, Any] | None = None) -> "Monitor":
        """Restore a monitor.

        Args:
            path: file written by `save`.
            functions: the functions of UserFunctions bases by name, which a file does not hold.

        Raises:
            ModelFileError: truncated, of another version, or not the state of a monitor.
        """
        from optid.faults.monitor.file import load

        monitor = cls.__new__(cls)
        load(monitor, path, functions)
        return monitor

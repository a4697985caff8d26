"""Records of inputs and outputs: one or several experiments with names, units and a sampling time."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from optid.arrays import as_list, as_records, import_pandas, one_or_all, read_only
from optid.data import experiments as parts
from optid.data import preprocessing
from optid.data.channels import Channel, Ports, Transform, as_name_list, channel_fields, interval_text, sampling_time
from optid.data.description import DataDescription
from optid.data.experiments import Experiment
from optid.data.timeline import Timeline, read_times, starts_of
from optid.errors import DataError
from optid.phrases import plural
from optid.registry import render


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Data(Ports):
    """Inputs and outputs of one or several experiments, sampled every dt.

    Attributes:
        experiments: the records, each with read-only arrays u (N, m) and y (N, l).
        dt, inputs, outputs, input_units, output_units, name: as given, a name and a unit ("" where unknown) for each.
        time_unit: unit of dt: "s" where it is known, "" where dt counts samples.
        dated: whether the times of the samples are dates; then the starts of experiments are seconds since 1970 (UTC).
        findings: what reading the record derived, assumed or repaired, one sentence each.
        transform: how to return to raw units; identity unless `detrend` or `scale` was used.
    """

    experiments: tuple[Experiment, ...]
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    name: str
    time_unit: str
    dated: bool
    findings: tuple[str, ...] = field(repr=False)
    transform: Transform = field(repr=False)

    def __init__(self, u: Any, y: Any, dt: float | None = None, inputs: str | Sequence[str] | None = None,
                 outputs: str | Sequence[str] | None = None, input_units: str | Sequence[str] | None = None,
                 output_units: str | Sequence[str] | None = None, name: str = "", start: Any = 0.0,
                 times: Any = None) -> None:
        """Copy and check the record.

        Args:
            u: (N,) or (N, m), or a list of such arrays, one per experiment; NaN = missing.
            y: (N,) or (N, l), or a list of as many arrays; NaN = missing.
            dt: sampling time in seconds, positive; when not given 1, and time counts samples.
            inputs: names of the inputs; u, or u1, u2, ... when not given.
            outputs: names of the outputs; y, or y1, y2, ... when not given.
            input_units: one unit per input.
            output_units: one unit per output.
            name: name of the data set, for reports.
            start: time of the first sample, one for all experiments or one for each: seconds, or dates (datetime64,
                ISO text).
            times: times of the samples in place of start, in seconds or as dates: (N,), or a list of as many arrays.
                Where they are no multiples of a sampling time only processes in continuous time take the record, and
                dt is what counts as one, the median step when not given.

        Raises:
            DataError: wrong shape or type, infinite sample, different lengths, wrong number of names; the message
                names the channel and the sample.

        Warns:
            DataWarning: integer samples that look saturated or wrapped around.
        """
        us = as_records(u, "u", as_name_list(inputs))
        ys = as_records(y, "y", as_name_list(outputs))
        if len(us) != len(ys):
            raise DataError(f"u has {len(us)} experiments and y has {len(ys)}; give one array of each per experiment.")
        starts, dated = starts_of(start, len(us))
        stamps: Sequence[np.ndarray | None] = [None] * len(us)
        if times is not None:
            starts, dated, stamps, dt = read_times(times, [len(ue) for ue in us], dt)
        experiments = []
        for k, (ue, ye, s, t) in enumerate(zip(us, ys, np.broadcast_to(starts, len(us)), stamps)):
            try:
                experiments.append(Experiment(ue, ye, float(s), t))
            except DataError as error:
                raise DataError(f"experiment {k + 1}: {error}" if len(us) > 1 else str(error)) from None
        self._complete(experiments, dt, inputs, outputs, input_units, output_units, name=str(name), dated=dated)

    @classmethod
    def of_experiments(cls, experiments: Sequence[Experiment], dt: float | None, inputs: Sequence[str],
                       outputs: Sequence[str], input_units: Any = None, output_units: Any = None, name: str = "",
                       **more: Any) -> "Data":
        """Return data of experiments with checked samples, without a copy.

        Arguments as of the class; `more` are the attributes time_unit, dated and findings.
        """
        data = object.__new__(cls)
        data._complete(experiments, dt, inputs, outputs, input_units, output_units, name=name, **more)
        return data

    def _complete(self, experiments: Sequence[Experiment], dt: float | None, inputs: Any, outputs: Any,
                  input_units: Any, output_units: Any, **more: Any) -> None:
        m, l = experiments[0].u.shape[1], experiments[0].y.shape[1]  # noqa: E741
        names = channel_fields(m, l, inputs, outputs, input_units, output_units)
        more = {"time_unit": "" if dt is None else "s", "dated": False, "findings": ()} | more
        _filled(self, experiments=tuple(experiments), dt=sampling_time(1.0 if dt is None else dt),
                transform=Transform.identity(m, l), **names, **more)
        for channel, share in self.missing.items():
            if share == 1.0:
                raise DataError(f"channel {channel!r}: every sample is missing. Check the column, or leave it out.")

    # -- sizes and arrays ---------------------------------------------------------------------------------------

    @property
    def n_samples(self) -> int:
        """Number of samples of all experiments together."""
        return sum(e.n_samples for e in self.experiments)

    @property
    def n_experiments(self) -> int:
        """Number of experiments."""
        return len(self.experiments)

    @property
    def records(self) -> list[np.ndarray]:
        """Channels [u | y], (N, m + l), one array per experiment."""
        return [np.hstack([e.u, e.y]) for e in self.experiments]

    @property
    def u(self) -> Any:
        """Inputs (N, m), or a tuple of such arrays when there are several experiments."""
        return one_or_all([e.u for e in self.experiments])

    @property
    def y(self) -> Any:
        """Outputs (N, l), or a tuple of such arrays when there are several experiments."""
        return one_or_all([e.y for e in self.experiments])

    @property
    def start(self) -> Any:
        """Time of the first sample, a date (datetime64) where the record is dated; a tuple for several experiments."""
        return one_or_all([timeline.instants([0])[0] for timeline in self.timelines])

    @property
    def time(self) -> Any:
        """Sampling instants (N,), dates where the record is dated; a tuple of such arrays for several experiments."""
        return one_or_all([line.instants(np.arange(e.n_samples)) for line, e in zip(self.timelines, self.experiments)])

    @property
    def timelines(self) -> tuple[Timeline, ...]:
        """When the samples of each experiment were taken."""
        return tuple(Timeline(e.start, self.dt, self.time_unit, self.dated, e.stamps) for e in self.experiments)

    @property
    def is_regular(self) -> bool:
        """Whether the samples of every experiment were taken every dt."""
        return all(e.stamps is None for e in self.experiments)

    def refuse_irregular(self, what: str) -> None:
        """Refuse a record whose samples were not taken every dt; the message says what needs them (`DataError`)."""
        if self.is_regular:
            return
        steps = np.concatenate([np.diff(e.stamps) for e in self.experiments if e.stamps is not None])
        raise DataError(f"{what} needs samples at even distances; the times of this record step by {steps.min():.4g} "
                        f"to {steps.max():.4g} {self.time_unit or 'samples'}. Read it with "
                        f"resample='{self.dt:.6g}s', or fit 'process.exact', which takes any times.")

    # -- what the data look like ---------------------------------------------------------------------------------

    @cached_property
    def missing(self) -> dict[str, float]:
        """Share of missing samples of each channel, 0 to 1."""
        lost = np.zeros(self.m + self.l)
        for e in self.experiments:
            for samples, columns in ((e.u, slice(0, self.m)), (e.y, slice(self.m, None))):
                nan = np.isnan(samples)
                if nan.any():  # a long record without gaps is told at once
                    lost[columns] += nan.sum(axis=0)
        return dict(zip(self.inputs + self.outputs, (lost / self.n_samples).tolist()))

    @cached_property
    def channels(self) -> tuple[Channel, ...]:
        """Range, mean, standard deviation, distinct values and missing share of each channel, inputs first."""
        named = zip(self.inputs + self.outputs, self.input_units + self.output_units)
        return tuple(Channel.of(np.concatenate([e.u[:, c] if c < self.m else e.y[:, c - self.m]
                                                for e in self.experiments]),
                                name, unit, "input" if c < self.m else "output")
                     for c, (name, unit) in enumerate(named))

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest sample of every input, (m,) each; NaN where every sample is missing."""
        low, high = np.full(self.m, np.nan), np.full(self.m, np.nan)
        for e in self.experiments:
            if e.n_samples:
                channels = np.ascontiguousarray(e.u.T)  # the reduction of long rows is compiled for it
                low = np.fmin(low, np.fmin.reduce(channels, axis=1))
                high = np.fmax(high, np.fmax.reduce(channels, axis=1))
        return low, high

    def __repr__(self) -> str:
        runs = f"{self.n_experiments} experiments, " if self.n_experiments > 1 else ""
        channels = f"{', '.join(self.inputs)} -> {', '.join(self.outputs)}"
        return f"Data({self.name!r}: {runs}{plural(self.n_samples, 'sample', '')} every {self.interval}, {channels})"

    @property
    def interval(self) -> str:
        """The sampling time with its unit, as text."""
        return interval_text(self.dt, self.time_unit)

    def __str__(self) -> str:
        units = "" if self.transform.is_identity else "\n  detrended or scaled; reports are in raw units"
        return f"{self.describe()}{units}"

    def describe(self) -> DataDescription:
        """Return range, mean, distinct levels and missing samples of each channel, and how it is sampled."""
        ends = [line.instants([0, e.n_samples - 1]) for line, e in zip(self.timelines, self.experiments)]
        return DataDescription(self.name, self.interval, tuple(e.n_samples for e in self.experiments),
                               tuple((a, b) for a, b in ends), self.channels, self.findings)

    def _repr_html_(self) -> str:
        return render(self, "html")

    def plot(self) -> Any:
        """Return a matplotlib figure of every channel over time."""
        return render(self, "figure")

    def to_pandas(self) -> Any:
        """Return a pandas frame with one column a channel; the index is the time, after the experiment where several.

        Raises:
            DataError: pandas is not installed.
        """
        pd = import_pandas()
        times = [pd.Index(time, name="time") for time in as_list(self.time)]
        frames = [pd.DataFrame(record, index, [*self.inputs, *self.outputs])
                  for record, index in zip(self.records, times)]
        return frames[0] if len(frames) == 1 else pd.concat(
            frames, keys=range(1, len(frames) + 1), names=["experiment", "time"])

    def to_csv(self, path: Any) -> Any:
        """Write the samples as a CSV file that `optid.read` reads back, and return its path.

        The columns are time, as dates where the record is dated, and the channels; a row after the header holds the
        units, NaN marks missing samples. Several experiments have a column "experiment"
        (``optid.read(..., experiment="experiment")``); a record without a unit of time has no column of time.

        Raises:
            DataError: a channel named "time" or "experiment", names or units that would be read as samples.
        """
        from optid.data.writers import write_csv

        return write_csv(self, path)

    # -- parts -----------------------------------------------------------------------------------------------------

    split, window, select, join = parts.split, parts.window, parts.select, staticmethod(parts.join)
    __getitem__ = parts.take
    __iter__ = None  # neither samples nor experiments are meant more than the other

    def __len__(self) -> int:
        return self.n_samples

    # -- changes of the samples --------------------------------------------------------------------------------------

    detrend, scale, decimate = preprocessing.detrend, preprocessing.scale, preprocessing.decimate
    resample, filter = preprocessing.resample, preprocessing.filter

    def raw(self) -> "Data":
        """Return the data in raw units, with `detrend` and `scale` undone (a removed drift stays removed).

        It is the same object every time, so that what is known of a record is computed once.
        """
        if self.transform.is_identity:
            return self
        if self not in _RAW:
            _RAW[self] = self.map_signals(self.transform.raw_u, self.transform.raw_y,
                                          transform=Transform.identity(self.m, self.l))
        return _RAW[self]

    def with_findings(self, findings: Iterable[str]) -> "Data":
        """Return the same record with other findings."""
        return self.with_fields(findings=tuple(findings))

    def without_transform(self) -> "Data":
        """Return the same samples without the way back to raw units."""
        return self.with_fields(transform=Transform.identity(self.m, self.l))

    def map_signals(self, of_u: Callable, of_y: Callable, **changes: Any) -> "Data":
        """Return data with every u (N, m) and y (N, l) replaced by of_u(u) and of_y(y), and other fields by `changes`.

        The functions must not change their arguments.
        """
        experiments = tuple(replace(e, u=read_only(of_u(e.u)), y=read_only(of_y(e.y))) for e in self.experiments)
        return self.with_fields(experiments=experiments, **changes)

    def with_fields(self, **changes: Any) -> "Data":
        """Return the record with other values of some attributes, which are not checked."""
        return _filled(object.__new__(Data), **{f.name: getattr(self, f.name) for f in fields(self)} | changes)


_RAW: WeakKeyDictionary[Data, Data] = WeakKeyDictionary()


def _filled(data: Data, **values: Any) -> Data:
    for name, value in values.items():
        object.__setattr__(data, name, value)
    return data


def not_a_record(data: Any, what: str) -> str:
    """Return a message for a function called `what` that was given something else than a record."""
    kind = type(data).__name__
    if isinstance(data, str):
        return f"{what} takes a record, not the name of a file: {what}(optid.read({data!r}, inputs=..., outputs=...))."
    if hasattr(data, "columns") or hasattr(data, "data_vars") or isinstance(data, dict | np.ndarray | list):
        return (f"{what} takes optid.Data, not {kind}: {what}(optid.read(df, inputs=[...], outputs=[...], dt=...)) for "
                "a frame, dictionary or array df with one column a channel.")
    return f"{what} takes optid.Data (or a stream), not {kind}; use optid.read(df, ...) or optid.Data(u=, y=, dt=)."

"""Records larger than memory: files, folders and Dask collections, read in chunks on every pass."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from optid.arrays import check_integer
from optid.data.channels import Ports, Transform, channel_fields, interval_text, sampling_time
from optid.data.reading.chunks import Channels, Chunk, End, Survey, join_surveys, survey_part
from optid.data.reading.clock import TimeColumn, clock_columns
from optid.data.reading.columns import Wanted, choose
from optid.data.reading.format import Format
from optid.data.reading.parts import Part
from optid.data.reading.rival_clocks import settle
from optid.data.reading.sources import open_source
from optid.data.reading.tables import Source
from optid.data.reading.uniform import COARSE, agreed_step, share_of_repeats, uniform_step
from optid.data.reduction import available_cores, fetch_part, reduce_parts
from optid.errors import DataError

CHUNK = 131072  # samples read at a time: two channels of float64 fit into the second-level cache of a common processor

Result = TypeVar("Result")


@dataclass(frozen=True)
class Stream(Ports):
    """A record that is read chunk by chunk; every iteration is a new pass.

    Iterating yields (u (n, m), y (n, l)), float64, in time order; NaN = missing. An infinite sample raises a
    `DataError` that names the channel and the sample when its chunk is reached.

    Attributes:
        dt, inputs, outputs, input_units, output_units, name, time_unit, findings: as of `Data`.
        n_samples: number of samples, None if only a pass gives it (CSV, Dask data frames).
        parts: parts that can be read independently, in order; empty if the record is read from its beginning to its
            end.
        scheduler: the Dask cluster that reads the parts; None for this machine.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    name: str
    n_samples: int | None
    _channels: Channels = field(repr=False, compare=False)
    _whole: Part | None = field(repr=False, compare=False)
    parts: tuple[Part, ...] = field(default=(), repr=False)
    scheduler: Any = field(default=None, repr=False)
    time_unit: str = ""
    findings: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        if self.n_experiments > 1:
            raise DataError(f"this stream has {self.n_experiments} experiments; only one can be read in order.")
        return self._in_order()

    def _in_order(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the samples of the only experiment, with a clock that continues from part to part."""
        last, done = None, 0
        for part in self._sources():
            begun = False
            for u, y, stamps in self._channels.read(part):
                if stamps is not None and stamps.size:
                    if not begun:
                        self._channels.check_border(last, End(part.label, part.experiment, stamps[:1]))
                    begun, last = True, End(part.label, part.experiment, stamps[-1:].copy())
                done += len(u)
                yield u, y
        if not done:
            raise self._no_rows()

    def _no_rows(self) -> DataError:
        return DataError(f"{self.name if self._whole is None else self._whole.label} has no rows.")

    def _sources(self) -> Iterator[Part]:
        """Yield the parts, with computed Dask content, or the whole record."""
        yield from (fetch_part(part, self.scheduler) for part in self.parts)
        if not self.parts and self._whole is not None:
            yield self._whole

    @property
    def n_experiments(self) -> int:
        """Number of experiments."""
        return self.parts[-1].experiment + 1 if self.parts else 1

    @property
    def interval(self) -> str:
        """The sampling time with its unit, as text."""
        return interval_text(self.dt, self.time_unit)

    @property
    def transform(self) -> Transform:
        """Identity: a stream is in raw units."""
        return Transform.identity(self.m, self.l)

    def with_findings(self, findings: Iterable[str]) -> "Stream":
        """Return the same record with other findings."""
        return replace(self, findings=tuple(findings))

    def in_units(self, units: Transform) -> "Stream":
        """Return the same record in other units: ``raw = value * scale + offset`` with the raw values of this one."""
        found = replace(self, _channels=replace(self._channels, units=units))
        if "_survey" in self.__dict__:  # counting its samples once is enough
            found.__dict__["_survey"] = self._survey
        return found

    def first_chunk(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (u, y) of the first chunk in which every output has a sample; of the last one where none has."""
        found = np.empty((0, self.m)), np.empty((0, self.l))
        for u, y, _ in self._channels.read(next(self._sources())):
            found = u, y
            if not np.isnan(y).all(axis=0).any():
                break
        return found

    def reduce(self, leaf: Callable[[Part, Iterable[Chunk]], Result], merge: Callable[[Sequence[Result]], Result],
               threads: int = 1) -> Result:
        """Reduce the parts, each with its chunks, where they are stored; see `optid.data.reduction.reduce_parts`."""
        return reduce_parts(self.parts, partial(_of_part, leaf, self._channels), merge, self.scheduler, threads)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Samples of each experiment, by a pass if necessary."""
        if self.n_samples is None:
            return tuple(self._survey.lengths[i] for i in range(self.n_experiments))
        if not self.parts:
            return (self.n_samples,)
        totals = [0] * self.n_experiments
        for part in self.parts:
            totals[part.experiment] += part.n_samples or 0
        return tuple(totals)

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest and the largest sample (m,) of each input, from one pass that is made once.

        Raises:
            DataError: every sample of an input is missing.
        """
        for name, value in zip(self.inputs, self._survey.lo):
            if np.isnan(value):
                raise DataError(f"channel {name!r}: every sample is missing. Check the column, or leave it out.")
        units = self._channels.units or self.transform
        return units.apply_u(self._survey.lo), units.apply_u(self._survey.hi)

    @cached_property
    def _survey(self) -> Survey:
        channels = replace(self._channels, units=None)
        if self.parts:
            found = reduce_parts(self.parts, partial(_of_part, survey_part, channels), partial(join_surveys, channels),
                                 self.scheduler, available_cores(None))
        else:
            whole = next(self._sources())
            found = survey_part(whole, channels.read(whole))
        if not any(found.lengths.values()):
            raise self._no_rows()
        return found


def open_stream(  # noqa: D417 - the others stand with `read`
    source: Any, inputs: Wanted = None, outputs: Wanted = None, dt: float | None = None, chunk: int = CHUNK, *,
    time: str | int | bool | None = None, name: str | None = None, scheduler: Any = None,
    format: Format | None = None, **words: Any,
) -> Stream:
    """Open a record that need not fit into memory; nothing but headers is read yet.

    The arguments that are not listed are those of `optid.data.readers.read`.

    Args:
        source: path of a .csv, .txt, .parquet or .npy file; {channel: path of an .npy file (N,)}; a folder whose
            .parquet files, in the order of their names (2 before 10), are one experiment; a Dask data frame, a Dask
            array (N, channels) or {channel: Dask array (N,)}; or a list of these, one per experiment. An npy file holds
            (N, channels) numbers; it is read, not mapped, because mapped pages count as resident memory.
        dt: sampling time; when not given from the first block or part with two time stamps, 1 without stamps.
        chunk: samples read at a time.
        time: column of time stamps, checked on every pass.
        scheduler: address of a Dask scheduler ("tcp://host:8786"), or an open `distributed.Client`, whose workers read
            the parts of the record: row groups of Parquet files, whole files of another kind, partitions of Dask
            collections. They must see files under the same path, and run the same versions. The result of a fit is the
            same to the last digit on any number of workers, and on this machine when it reads the same parts. A fit
            makes two passes: `persist` a Dask collection that is costly to compute.
        words: fields of `Format`; those that repair (gaps, resample, quality, ``from_``, to) need the record in memory.

    Raises:
        DataError: as `read`, here or when the chunk is reached.
        ClusterError: the cluster cannot be used.
    """
    chunk = check_integer(chunk, "chunk", error=DataError)
    how = Format.of(format, words)
    if repairs := [one for one in ("gaps", "resample", "quality", "from_", "to") if getattr(how, one) is not None]:
        raise DataError(f"a stream is not repaired: {repairs[0]}= needs the record in memory; use read.")
    several = list(source) if isinstance(source, list | tuple) else [source]
    if not several:
        raise DataError("the list of sources is empty; give at least one.")
    opened = [open_source(one, chunk, how) for one in several]
    ins, outs, clocks = _chosen(opened, inputs, outputs, time)
    how, units = opened[0].how, opened[0].units
    names = channel_fields(len(ins), len(outs), list(ins), list(outs),
                           how.input_units or [units.get(column, "") for column in ins.values()],
                           how.output_units or [units.get(column, "") for column in outs.values()])
    dt = None if dt is None else sampling_time(dt)
    if scheduler is not None:
        from optid.data.clusters import connect_cluster

        with connect_cluster(scheduler):  # refused now, not at the first pass
            pass
    parts: list[Part] = []
    read = [*ins.values(), *outs.values(), *clocks]
    if scheduler is not None or len(opened) > 1 or opened[0].whole is None:
        parts = [replace(part, experiment=i) for i, one in enumerate(opened) for part in one.parts(read)]
        if len({part.experiment for part in parts}) < len(opened):
            raise DataError("a source of the list has no rows.")
    clock, step, said = None, dt, list[str]()
    if clocks:
        sources = (fetch_part(part, scheduler) for part in parts) if parts else (one.whole for one in opened)
        clock, step, said = _clock_and_step(sources, clocks, opened[0], dt, time is not None and time is not True)
    findings = [note for one in opened for note in one.findings]
    findings += said
    if step is None:
        findings.insert(0, "no time column: 1 sample = 1; pass dt= (seconds)")
    lengths = [one.n_samples for one in opened]
    label = Path(several[0]).stem if isinstance(several[0], str | Path) else ""
    return Stream(
        **names, dt=1.0 if step is None else step, name=label if name is None else name,
        n_samples=None if None in lengths else sum(n for n in lengths if n is not None),
        _channels=Channels(ins, outs, clock, 1.0 if step is None else step, how), _whole=opened[0].whole,
        parts=tuple(parts), scheduler=scheduler, time_unit="" if step is None else "s",
        findings=tuple(dict.fromkeys(findings)),
    )


def _chosen(opened: Sequence[Source], inputs: Wanted, outputs: Wanted, time: str | int | bool | None
            ) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """Return {channel: column} of inputs and outputs and the columns that may be the clock, equal for all sources."""
    found = []
    for one in opened:
        ins, outs = (choose(one.names, wanted, c, one.label) for wanted, c in ((inputs, "u"), (outputs, "y")))
        clocks = clock_columns(one.names, time, [*ins.values(), *outs.values()], one.label, dated=one.dates)
        found.append((ins, outs, clocks))
        if found[-1][:2] != found[0][:2] or clocks[:1] != found[0][2][:1]:
            raise DataError(f"{one.label} has channels {found[-1][:2]} and clock {clocks[:1]!r}, {opened[0].label} "
                            f"has {found[0][:2]} and {found[0][2][:1]!r}: name the columns, or pass time=False.")
    return *found[0][:2], [name for name in found[0][2] if all(name in clocks for _, _, clocks in found)]


def _clock_and_step(sources: Iterable[Any], columns: Sequence[str], table: Source, dt: float | None, asked: bool
                    ) -> tuple[TimeColumn | None, float | None, list[str]]:
    """Return the clock, the sampling time of the first source with two stamps, or dt, and what is to be said of it."""
    clock, said = None, list[str]()
    for one in sources:
        table = replace(table, label=one.label)
        block = _first_rows(one.blocks(columns, dict.fromkeys(columns, "clock")))
        if not block:
            continue
        clock, stamps, said = settle(block, columns, table, asked)
        if stamps.size > 1:
            if dt is not None and share_of_repeats(stamps) > COARSE:
                raise DataError(f"{one.label}: rows share each time stamp, and a stream does not spread them: pass "
                                f"time=False with dt={dt:g}, or use read.")
            found = uniform_step(stamps, table.how.time_tolerance, one.label)
            return clock, agreed_step(found, dt, table.how.time_tolerance, one.label), said
    return clock, dt, said


def _first_rows(blocks: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the first blocks as one of at least two rows, where there are so many; {} where there are none."""
    found: dict[str, Any] = {}
    for block in blocks:
        found = {name: np.concatenate([found[name], column]) if found else column for name, column in block.items()}
        if len(next(iter(found.values()))) > 1:
            break
    return found if found and len(next(iter(found.values()))) else {}


def _of_part(leaf: Callable[[Part, Iterable[Chunk]], Any], channels: Channels, part: Part) -> Any:
    return leaf(part, channels.read(part))

"""The experiments of a record, and the parts of records: the methods of `Data` that cut, select and join them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from optid.arrays import is_number, read_only
from optid.data.channels import Transform, as_name_list
from optid.data.description import instant
from optid.data.timeline import seconds_of
from optid.errors import DataError, nearest

Record = TypeVar("Record", bound=Any)
"""A record, `optid.Data`."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """One uninterrupted record.

    Attributes:
        u: (N, m) inputs, float64, read-only; NaN = missing.
        y: (N, l) outputs, float64, read-only; NaN = missing.
        start: time of the first sample.
        stamps: (N,) times after the first sample where these are irregular, None where they are multiples of dt.
    """

    u: np.ndarray
    y: np.ndarray
    start: float = 0.0
    stamps: np.ndarray | None = None

    def __post_init__(self) -> None:
        if self.u.shape[0] != self.y.shape[0]:
            raise DataError(f"u has {self.u.shape[0]} samples and y has {self.y.shape[0]}. Cut both to the samples "
                            "that were recorded together, or fill the lost ones with NaN.")
        if self.stamps is not None and self.stamps.shape != (self.u.shape[0],):
            raise DataError(f"{self.stamps.size} irregular times for {self.u.shape[0]} samples: give one for each.")

    @property
    def n_samples(self) -> int:
        """Number of samples N."""
        return self.u.shape[0]

    def cut(self, first: int, last: int, dt: float) -> "Experiment":
        """Return samples first to last - 1, sampled every dt where the times are regular."""
        if self.stamps is None:
            return Experiment(self.u[first:last], self.y[first:last], self.start + first * dt)
        t = self.stamps[first:last]
        return Experiment(self.u[first:last], self.y[first:last], self.start + float(t[0]), read_only(t - t[0]))


def split(data: Record, at: float | int) -> tuple[Record, Record]:
    """Cut every experiment in two, for estimation and validation.

    Args:
        data: the record.
        at: a float in (0, 1) is the share of the samples of each experiment that goes to the first part; an int
            is a number of samples.

    Raises:
        DataError: a part would be empty.
    """
    if not is_number(at):
        raise DataError(f"split at {at!r}: must be a share such as 0.7 or a number of samples.")
    whole = isinstance(at, int | np.integer)
    if not whole and not 0 < at < 1:
        raise DataError(f"split at {at}: a share lies between 0 and 1; write int({at}) for a number of samples.")
    first, second = [], []
    for k, e in enumerate(data.experiments):
        cut = int(at) if whole else round(float(at) * e.n_samples)
        if not 0 < cut < e.n_samples:
            raise DataError(f"split at {at} leaves an empty part of experiment {k + 1} of {e.n_samples} samples.")
        first.append(e.cut(0, cut, data.dt))
        second.append(e.cut(cut, e.n_samples, data.dt))
    return data.with_fields(experiments=tuple(first)), data.with_fields(experiments=tuple(second))


def window(data: Record, first: int, last: int) -> Record:
    """Return samples first to last - 1 of every experiment.

    Raises:
        DataError: the window does not lie inside an experiment.
    """
    for k, e in enumerate(data.experiments):
        if not 0 <= first < last <= e.n_samples:
            raise DataError(f"window {first}:{last} is not inside experiment {k + 1} of {e.n_samples} samples.")
    return data.with_fields(experiments=tuple(e.cut(first, last, data.dt) for e in data.experiments))


def take(data: Record, part: slice) -> Record:
    """Return data[first:last] by samples (integers, as of a list) or by time (floats, dates), of every experiment.

    Raises:
        DataError: not a slice, a step, samples mixed with times, or a part without samples.
    """
    if not isinstance(part, slice) or part.step is not None:
        raise DataError("data[first:last] takes samples (data[100:200]) or times (data[1.0:2.0]), and no step; "
                        "use decimate for every k-th sample, .u and .y for arrays.")
    first, last = (seconds_of(end) if data.dated and end is not None else end for end in (part.start, part.stop))
    ends = [end for end in (first, last) if end is not None]
    whole = all(isinstance(end, int | np.integer) and not isinstance(end, bool) for end in ends)
    if not whole and not all(isinstance(end, float | np.floating) and end == end for end in ends):
        raise DataError(f"data[{part.start!r}:{part.stop!r}]: two integers are samples, two floats are times.")

    def sample(end: Any, e: Experiment) -> int | None:
        """The first sample not before a time, with 1e-6 of a step for the rounding of the times."""
        if end is None or whole:
            return end
        if e.stamps is not None:
            return int(np.searchsorted(e.stamps, end - e.start - 1e-6 * data.dt))
        return int(np.ceil(min(max((end - e.start) / data.dt - 1e-6, 0.0), e.n_samples)))

    spans = [slice(sample(first, e), sample(last, e)).indices(e.n_samples) for e in data.experiments]
    kept = [e.cut(begin, end, data.dt) for e, (begin, end, _) in zip(data.experiments, spans) if begin < end]
    if not kept:
        raise DataError(f"data[{part.start}:{part.stop}] holds no samples; there are "
                        f"{', '.join(str(e.n_samples) for e in data.experiments)} "
                        f"from time {', '.join(instant(line.instants([0])[0]) for line in data.timelines)}.")
    return data.with_fields(experiments=tuple(kept))


def select(data: Record, inputs: str | Sequence[str] | None = None, outputs: str | Sequence[str] | None = None,
           experiments: int | Sequence[int] | None = None) -> Record:
    """Keep some channels and some experiments, in the order given.

    Args:
        data: the record.
        inputs: names of inputs; all when not given.
        outputs: names of outputs; all when not given.
        experiments: indices of experiments, from 0; all when not given.

    Raises:
        DataError: unknown name (the nearest is named) or index.
    """
    i = _positions(inputs, data.inputs, "input")
    o = _positions(outputs, data.outputs, "output")
    picked = range(data.n_experiments) if experiments is None else np.atleast_1d(experiments).tolist()
    for k in picked:
        if not 0 <= k < data.n_experiments:
            raise DataError(f"experiment {k} does not exist; there are {data.n_experiments}, counted from 0.")
    if not (i and o and len(picked)):
        raise DataError("select leaves no input, no output or no experiment; name at least one of each.")
    kept = [data.experiments[k] for k in picked]
    t = data.transform
    return data.with_fields(
        experiments=tuple(Experiment(read_only(e.u[:, i]), read_only(e.y[:, o]), e.start, e.stamps) for e in kept),
        inputs=_take(data.inputs, i), outputs=_take(data.outputs, o), input_units=_take(data.input_units, i),
        output_units=_take(data.output_units, o),
        transform=Transform(_take(t.u_scale, i), _take(t.u_offset, i), _take(t.y_scale, o), _take(t.y_offset, o)),
    )


def join(*parts: Record) -> Record:
    """Return the experiments of several data sets as one data set.

    Raises:
        DataError: names, units, sampling times or transforms differ, or the times are dates in some of them only.
    """
    if not parts:
        raise DataError("join needs at least one data set.")
    head = parts[0]
    for k, part in enumerate(parts[1:], start=2):
        for what in ("inputs", "outputs", "input_units", "output_units"):
            if getattr(part, what) != getattr(head, what):
                raise DataError(f"data set {k} has {what} {getattr(part, what)}, the first has "
                                f"{getattr(head, what)}; give them the same names and units, or use select.")
        if abs(part.dt - head.dt) > 1e-9 * head.dt:
            raise DataError(f"data set {k} is sampled every {part.interval}, the first every {head.interval}; "
                            "decimate the faster one.")
        if part.transform != head.transform:
            raise DataError(f"data set {k} was detrended or scaled differently; join first, or call raw() on both.")
        if part.dated != head.dated:
            raise DataError(f"the times of data set {k} are {'dates' if part.dated else 'numbers'}, those of the "
                            f"first are {'dates' if head.dated else 'numbers'}; give both dates (start=).")
    units = {part.time_unit for part in parts}
    return head.with_fields(experiments=tuple(e for part in parts for e in part.experiments),
                            time_unit=head.time_unit if len(units) == 1 else "",
                            findings=tuple(dict.fromkeys(finding for part in parts for finding in part.findings)))


def _positions(wanted: str | Sequence[str] | None, known: tuple[str, ...], what: str) -> list[int]:
    wanted = list(known) if wanted is None else as_name_list(wanted)
    for name in wanted or ():
        if name not in known:
            raise DataError(f"no {what} {name!r}. {nearest(name, known)}")
    return [known.index(name) for name in wanted or ()]


def _take(values: tuple, positions: Sequence[int]) -> tuple:
    return tuple(values[p] for p in positions)

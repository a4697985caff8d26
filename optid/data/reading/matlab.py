"""MAT files of versions 4 to 7.3, read in a child process: a damaged file may crash the library or exhaust memory."""

from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from optid.data.reading.clock import is_time_name
from optid.data.reading.format import Format
from optid.data.reading.mat_contents import MatContents, file_contents
from optid.data.reading.tables import RawTable
from optid.errors import DataError
from optid.processes import run_apart

MEMORY, EXPANSION = 4 << 30, 32  # memory limit in bytes, or `EXPANSION` times the size of the file if that is more
SECONDS, PACE = 60.0, 1 << 30  # time limit, and again for each `PACE` bytes


def mat_contents(path: Path, names: Sequence[str] | None = None) -> MatContents:
    """Return the variables of these names, by default only the names of all, their clocks and what is refused.

    `DataError`: a damaged file, a link to another file, too much time or memory for its size, h5py is missing, no such
    name, or an experiment that lacks a variable that others have.
    """
    size, damaged = path.stat().st_size, f"{path.name} is damaged, or not a MAT file"
    try:
        return run_apart(file_contents, path, names, quiet=True, seconds=SECONDS * (1 + size / PACE),
                         memory=max(MEMORY, EXPANSION * size))
    except TimeoutError:
        raise DataError(f"{damaged}: reading it took more than {SECONDS:g} s.") from None
    except ChildProcessError as death:
        raise DataError(f"{damaged}: the process that read it crashed ({death}).") from None


def mat_table(path: Path, how: Format) -> RawTable:
    """Return the table of a MAT file, to be split into experiments; errors as of `mat_contents`."""
    listing = mat_contents(path)
    names = list(listing.experiments[0])
    if not set(names) - listing.refused.keys():
        reasons = " ".join(f"{name!r} {reason}" for name, reason in list(listing.refused.items())[:3])
        raise DataError(f"{path.name} holds no arrays of numbers. {reasons}".rstrip())
    return RawTable(path.name, names, lambda wanted, _: mat_contents(path, wanted).experiments[0], how,
                    split=partial(_experiments, path, listing, how), inputs=listing.inputs or None,
                    outputs=listing.outputs or None)


def _experiments(path: Path, listing: MatContents, how: Format, signals: Sequence[str], time: Any) -> list[RawTable]:
    """Return the table of each experiment of some signals, with the clock beside them.

    `time` is as of `optid.data.readers.read`; None and True take the clock beside the signals. `DataError`: a signal or
    its clock cannot be read, or time is True and there is none; loading raises it also where the clocks of the signals
    differ, or where an experiment lacks a signal that another one has.
    """
    by_default = time is None or time is True
    clocks = [listing.clocks[name] for name in signals if name in listing.clocks] if by_default else []
    clocks = [name for name in dict.fromkeys(clocks) if name not in signals]
    if time is True and not clocks:
        raise DataError(f"{path.name} has no time vector t or time, and no scalar Ts or fs, beside the signals.")
    for name in [name for name in (*signals, *clocks) if name in listing.refused]:
        ignored = " (time=False ignores it)" if name in clocks else ""
        raise DataError(f"{path.name}: {name!r} {listing.refused[name]}{ignored}")
    vectors = [name for name in clocks if name not in listing.steps]
    beside = {name: listing.clocks.get(name, "") for name in vectors}
    rivals = [rival for name, rival in beside.items() if rival.rpartition(".")[0] == name.rpartition(".")[0]]
    steps = {name: listing.steps[name] for name in (*clocks, *rivals) if name in listing.steps}
    if steps and max(steps.values()) > min(steps.values()) * (1 + 1e-9):
        raise DataError(f"{path.name}: the sampling times of the signals differ: {steps}. Resample the signals.")
    count = max(listing.counts[name] for name in signals)

    @cache
    def read(wanted: tuple[str, ...]) -> Sequence[dict[str, Any]]:
        used = vectors if set(vectors) & set(wanted) else []
        contents = mat_contents(path, list(dict.fromkeys([*wanted, *used])))
        for name, reason in contents.refused.items():
            raise DataError(f"{path.name}: {name!r} {reason}")
        if len(contents.experiments) != count:
            raise DataError(f"{path.name}: the inputs and outputs have {count} experiments, with "
                            f"{', '.join(wanted)} there are {len(contents.experiments)}.")
        for arrays in contents.experiments:
            arrays |= {name: step * np.arange(len(arrays[signals[0]])) for name, step in contents.steps.items()}
            if not all(_is_same(arrays[name], arrays[used[0]]) for name in used):
                raise DataError(f"{path.name}: the clocks of its signals differ ({', '.join(used)}). Resample the "
                                "signals onto one of them, or pass time=False and dt.")
        return contents.experiments

    def load(number: int, wanted: Sequence[str], *_: Any) -> dict[str, Any]:
        arrays = read(tuple(wanted))[number]
        return {name: arrays[name] for name in wanted}

    names = [name for name in listing.experiments[0] if not by_default or name in signals or not is_time_name(name)]
    return [RawTable(path.name if count == 1 else f"{path.name}, experiment {number + 1}", names,
                     partial(load, number), how, vectors[0] if vectors else None, units=listing.units,
                     step=next(iter(steps.values()), None)) for number in range(count)]


def _is_same(one: np.ndarray, other: np.ndarray) -> bool:
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-9, equal_nan=True)

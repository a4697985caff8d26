"""The record of a cell, read or simulated, with its hold-out samples."""

from dataclasses import dataclass

import numpy as np

from optid.data.record import Data
from optid.errors import DataError
from optid.studies.definition import DataEntry
from optid.studies.grid import Cell
from optid.studies.sources.systems import simulate
from optid.studies.sources.truth import Truth

ANOTHER = 2**31  # added to the seed of a simulated record for the hold-out record


@dataclass(frozen=True, eq=False)
class Record:
    """The record of a cell."""

    data: Data  # what the fit sees
    holdout: Data | None  # for validation; None where nothing is held out
    truth: Truth | None  # the system behind a simulated record; None for a file


def load(cell: Cell) -> Record:
    """Read or simulate the record of a cell.

    Of a file the last samples of every experiment are held out. A simulated record keeps its length, and a second one
    with another seed is held out, of the length that gives the share. `DataError` as of `optid.read`.
    """
    entry = cell.data_source
    if entry.system is None:
        whole = read_entry(entry)
        return Record(*(whole.split(1.0 - cell.holdout) if cell.holdout else (whole, None)), truth=None)
    if cell.samples is None or cell.seed is None:
        raise DataError(f"the simulated record {entry.name!r} needs a length and a seed")
    data, truth = simulate(entry.system, cell.samples, cell.noise, cell.seed)
    if not cell.holdout:
        return Record(data, None, truth)
    length = int(np.ceil(cell.samples * cell.holdout / (1.0 - cell.holdout)))
    return Record(data, simulate(entry.system, length, cell.noise, cell.seed + ANOTHER)[0], truth)


def read_entry(entry: DataEntry) -> Data:
    """Return the record of an entry that is not simulated; `DataError` as of `optid.read`."""
    if entry.record is not None:
        return entry.record
    from optid.data.readers import read

    return read(list(entry.files), **entry.options)

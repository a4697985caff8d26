"""Files of plants and test rigs that libraries of the extra `plant` read: Excel, LabVIEW TDMS and ASAM MDF."""

import gc
import sys
import traceback
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from optid.errors import DataError

PLANT = 'pip install "optid[plant]"'

LIBRARIES = {".xlsx": "fastexcel", ".tdms": "npTDMS", ".mf4": "asammdf"}
"""The library that reads each kind of file."""


class PlantTable(NamedTuple):
    """A table of a file."""

    label: str
    frame: Any
    units: Mapping[str, str] = {}
    findings: tuple[str, ...] = ()  # what is worth saying of the file


def plant_tables(path: Path, kind: str) -> list[PlantTable]:
    """Return the tables of a file.

    An Excel file has one table for each sheet; a TDMS file one for each group; an MDF file one for each group of
    channels with their own clock.

    Raises:
        DataError: the library is missing (with its pip line), or the file is damaged.
    """
    read = {".xlsx": _of_excel, ".tdms": _of_tdms, ".mf4": _of_mdf}[kind]
    try:
        with warnings.catch_warnings(action="ignore"):  # about one another's versions
            found = read(path)
    except ImportError:
        raise DataError(f"{path.name}: files of kind {kind} are read by {LIBRARIES[kind]}: {PLANT}") from None
    except (DataError, MemoryError):
        raise
    except Exception as error:  # whatever a library raises on a damaged file
        _dispose(error)
        raise DataError(f"{path.name} is damaged, or not a file of kind {kind}: {str(error)[:300]}") from error
    if not found:
        raise DataError(f"{path.name} holds no samples.")
    return found


def _dispose(error: Exception) -> None:
    """Let go of what a reader left half built; what its finalisers then raise would be printed as a traceback."""
    shown, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        while error is not None:
            traceback.clear_frames(error.__traceback__)
            error = error.__context__  # type: ignore[assignment]
        gc.collect()  # they refer to one another
    finally:
        sys.unraisablehook = shown


def _of_excel(path: Path) -> list[PlantTable]:
    import fastexcel  # noqa: F401 - the reader that polars uses
    import polars as pl

    sheets: dict[str, Any] = pl.read_excel(path, sheet_id=0, raise_if_empty=False)
    full = {name: frame for name, frame in sheets.items() if frame.width}
    return [PlantTable(path.name if len(full) == 1 else f"{path.name}, sheet {name!r}", frame)
            for name, frame in full.items()]


def _of_tdms(path: Path) -> list[PlantTable]:
    import polars as pl
    from nptdms import TdmsFile

    found, file = [], TdmsFile.read(path)
    cut = ("the file ends within a segment: its last samples are lost",) * file.file_status.incomplete_final_segment
    for group in file.groups():
        channels = {channel.name: channel for channel in group.channels() if len(channel)}
        if not channels:
            continue
        lengths = {name: len(channel) for name, channel in channels.items()}
        if len(set(lengths.values())) > 1:
            raise DataError(f"{path.name}, group {group.name!r}: the channels have different lengths: {lengths}.")
        columns = {name: channel[:] for name, channel in channels.items()}
        clock = next((c for c in channels.values() if "wf_increment" in c.properties), None)
        if clock is not None:
            columns = {"time (s)": _waveform_time(clock)} | columns
        units = {name: str(channel.properties.get("unit_string", "")) for name, channel in channels.items()}
        found.append(PlantTable(f"{path.name}, group {group.name!r}", pl.DataFrame(columns), units, cut))
    return _named(path, found)


def _named(path: Path, found: list[PlantTable]) -> list[PlantTable]:
    """Name the only table of a file after the file."""
    return [found[0]._replace(label=path.name)] if len(found) == 1 else found


def _waveform_time(channel: Any) -> np.ndarray:
    """Return the instants of a waveform, dates where it says when it started."""
    step, offset = (float(channel.properties.get(key, 0.0)) for key in ("wf_increment", "wf_start_offset"))
    seconds = offset + step * np.arange(len(channel))
    start = channel.properties.get("wf_start_time")
    if not isinstance(start, np.datetime64):
        return seconds
    return start.astype("M8[ns]") + np.round(seconds * 1e9).astype("m8[ns]")


def _of_mdf(path: Path) -> list[PlantTable]:
    import polars as pl
    from asammdf import MDF

    found = []
    with MDF(path) as file:
        for number, group in enumerate(file.iter_groups(raw=False, ignore_value2text_conversions=True)):
            if not len(group):
                continue
            columns: dict[str, Any] = {"time (s)": group.index.to_numpy(dtype=float)}
            columns |= {str(name): group[name].to_numpy() for name in group.columns if group[name].dtype.kind in "iufb"}
            units = {channel.name: channel.unit or "" for channel in file.groups[number].channels}
            found.append(PlantTable(f"{path.name}, group {number}", pl.DataFrame(columns), units))
    return _named(path, found)

"""The part of a study on a Dask worker: local worker processes, one per thread, and their data files."""

import pickle
import platform
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from optid.errors import ClusterError, StudyError
from optid.studies.execution.workers import Pool
from optid.studies.grid import Cell, content_hash


@dataclass
class _Hands:
    """The pools of one study in this process, each of one local worker process."""

    idle: list[Pool] = field(default_factory=list)
    busy: list[Pool] = field(default_factory=list)
    ended: bool = False


_lock = threading.Lock()
_studies: dict[str, _Hands] = {}


def run(study: str, function: bytes, packed: bytes, contents: Sequence[bytes] | None) -> dict[str, Any] | None:
    """Run a pickled cell in a local worker process, which is kept for the run of a study, and return its row.

    `function` makes the row of a cell, pickled; `contents` are those of the cell's data files, or None. It returns None
    if this machine lacks the data files; `StudyError` if worker processes do not start.
    """
    cell: Cell = pickle.loads(packed)
    here = _with_files(cell, contents)
    if here is None:
        return None
    try:
        with _pool(study, function) as pool:
            rows = list(pool.run(deque([here])))
    except StudyError as error:
        raise StudyError(f"on machine {platform.node()!r}: {error}") from None
    if not rows:
        raise ClusterError("the study ended while this cell ran")
    return rows[0] | {"file": ", ".join(cell.data_source.files) or None}


def end(study: str) -> None:
    """End the worker processes of a run, also while they run a cell, and all idle ones of other runs."""
    with _lock:
        hands = _studies.setdefault(study, _Hands())
        hands.ended = True
        for pool in hands.busy:
            pool.kill()
        left = [pool for each in _studies.values() for pool in each.idle]
        for each in _studies.values():
            each.idle.clear()
    for pool in left:
        pool.close()


@contextmanager
def _pool(study: str, function: bytes) -> Iterator[Pool]:
    """Give a pool of a study for exclusive use."""
    with _lock:
        hands = _studies.setdefault(study, _Hands())
        if hands.ended:
            raise ClusterError("the study has ended")
        pool = hands.idle.pop() if hands.idle else Pool(pickle.loads(function), 1)
        hands.busy.append(pool)
    try:
        yield pool
    finally:
        with _lock:
            hands.busy.remove(pool)
            if not (ended := hands.ended):
                hands.idle.append(pool)
        if ended:
            pool.close()


def _with_files(cell: Cell, contents: Sequence[bytes] | None) -> Cell | None:
    """Return the cell with data files on this machine, None if there are none with its content."""
    entry = cell.data_source
    if not entry.files or _content(entry.files) == cell.data_hash:
        return cell
    folder = _folder() / cell.data_hash
    files = tuple(str(folder / str(i) / Path(name).name) for i, name in enumerate(entry.files))
    if contents is not None and not folder.is_dir():
        scratch = Path(mkdtemp(dir=_folder()))
        for i, (name, content) in enumerate(zip(entry.files, contents)):
            (scratch / str(i)).mkdir()
            (scratch / str(i) / Path(name).name).write_bytes(content)
        with suppress(OSError):  # another thread was first
            scratch.rename(folder)
    return replace(cell, data_source=replace(entry, files=files)) if folder.is_dir() else None


def _folder() -> Path:
    """Return the folder for received data files, which is removed with the Dask worker."""
    from distributed import get_worker

    folder = Path(get_worker().local_directory) / "optid-data"
    folder.mkdir(exist_ok=True)
    return folder


def _content(files: tuple[str, ...]) -> str:
    try:
        stats = [Path(name).stat() for name in files]
    except OSError:
        return "not here"
    return _hash(files, tuple((stat.st_size, stat.st_mtime_ns) for stat in stats))


@lru_cache(maxsize=64)
def _hash(files: tuple[str, ...], _: tuple[tuple[int, int], ...]) -> str:
    from optid.studies.definition import DataEntry

    try:
        return content_hash(DataEntry(name="files", files=files))
    except OSError as error:
        return f"unreadable: {error}"

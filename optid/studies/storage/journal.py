"""One writer at a time, and rows that outlive it: the lock and the journal beside a database.

A row is in the journal from the moment it is there, so that a run that is killed loses only what it had not finished;
the database gets rows in batches. Whoever runs next finds the rest in the journal.
"""

import errno
import fcntl
import json
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from optid.errors import DatabaseError
from optid.studies.storage.rows import complete


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a database; the system releases it when the process ends, however it ends.

    Args:
        path: the database, which need not be there yet.

    Raises:
        DatabaseError: another run holds it (says which), its folder cannot be written, or its file system has no locks.
    """
    path = path.resolve()
    name = path.with_name(path.name + ".lock")
    handle = _acquired(path, name)
    try:
        os.ftruncate(handle, 0)
        holder = f"process {os.getpid()} on {platform.node()} since {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
        with suppress(OSError):  # a full disk, of which the first row tells; the lock holds without these words
            os.write(handle, holder.encode())
        yield
    finally:
        name.unlink(missing_ok=True)  # before the lock goes: nobody locks a name that is about to vanish
        os.close(handle)


def _acquired(path: Path, name: Path) -> int:
    while True:
        try:
            handle = os.open(name, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise DatabaseError(f"{path} cannot be written: {error.strerror}: {name}") from None
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(handle, 200, 0).decode(errors="replace") or "a process that has only just started"
            os.close(handle)
            raise DatabaseError(f"another run is writing to {path}: {holder}. Wait until it ends, stop it, or give "
                                "another database") from None
        except OSError as error:
            os.close(handle)
            raise DatabaseError(f"{path} cannot be locked: {error.strerror}: {name}. Give a database on a disk of this "
                                "machine") from None
        try:
            if os.stat(name).st_ino == os.fstat(handle).st_ino:
                return handle
        except FileNotFoundError:
            pass
        os.close(handle)  # its former holder removed it between our two steps


def path_beside(database: Path) -> Path:
    """Return the path of the journal of a database."""
    return database.with_name(database.name + ".journal")


def kept(database: str | Path) -> list[dict[str, Any]]:
    """Return the rows in the journal of a database; a last line that a killed process left unfinished is none.

    Args:
        database: its path, or a link to it.

    Raises:
        DatabaseError: the journal cannot be read, or holds what is no row of this version.
    """
    path = path_beside(Path(database).resolve())
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise DatabaseError(f"{path} cannot be read: {error.strerror}") from None
    try:
        return [complete(json.loads(line)) for line in content.split(b"\n")[:-1]]
    except (ValueError, TypeError) as error:
        raise DatabaseError(f"{path} holds what is no row of this version ({error}). Remove it: the cells that only it "
                            "knows are run again") from error


class Journal:
    """Rows that are not in the database yet, one line of JSON each."""

    def __init__(self, database: Path) -> None:
        """Open the journal of a database.

        Args:
            database: its path.

        Raises:
            DatabaseError: it cannot be written.
        """
        self.path = path_beside(database)
        try:
            self._handle = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise DatabaseError(f"{self.path} cannot be written: {error.strerror}") from None

    def add(self, row: Mapping[str, Any]) -> None:
        """Write a row down.

        Raises:
            DatabaseError: it cannot be written, such as on a full disk.
        """
        line = json.dumps(row, allow_nan=False).encode() + b"\n"
        size = os.fstat(self._handle).st_size
        try:
            written = os.write(self._handle, line)
            if written < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            os.ftruncate(self._handle, size)  # half a row is none
            raise DatabaseError(f"{self.path} cannot be written: {error.strerror}") from error

    def clear(self) -> None:
        """Forget everything: it is in the database."""
        os.ftruncate(self._handle, 0)

    def close(self) -> None:
        """Close it, and remove it when nothing is in it."""
        if os.fstat(self._handle).st_size == 0:
            self.path.unlink(missing_ok=True)
        os.close(self._handle)

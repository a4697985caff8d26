"""The file of a monitor's state: it is replaced as a whole, and locked against a second monitor."""

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Self

from optid.errors import DataError
from optid.models.files import complete


class StateFile:
    """A state file that one monitor holds.

    The lock is that of the file itself (`flock`), so that it ends with the process and leaves no other file behind. A
    new file is locked before it replaces the old one. Windows cannot rename open files: there is no lock there.
    """

    def __init__(self, path: Path) -> None:
        """Lock the file; it is empty where there is none yet.

        Raises:
            DataError: another process holds it.
        """
        self.path = path
        self._held: IO[bytes] | None = None
        while sys.platform != "win32":
            try:
                held = path.open("rb" if path.exists() else "ab")
            except OSError:  # it cannot be written either, which is reported when it is saved
                return
            if not _lock(held):
                held.close()
                raise DataError(f"{path} is the state of another monitor, which is running: stop it, or name another "
                                "file")
            with suppress(OSError):
                if os.path.samestat(os.fstat(held.fileno()), path.stat()):  # else it was replaced in the meantime
                    self._held = held
                    return
            held.close()

    @property
    def is_empty(self) -> bool:
        """Whether no state has been saved."""
        return not self.path.exists() or self.path.stat().st_size == 0

    def replace(self, write: Callable[[Path], object], finish: Callable[[], object]) -> None:
        """Write a new state, call `finish`, and put the state in place of the old one; `OSError` leaves the old one."""
        new: IO[bytes] | None = None
        try:
            with complete(self.path) as part:
                write(part)
                if sys.platform != "win32":
                    new = part.open("rb")
                    _lock(new)
                finish()
        except BaseException:
            if new is not None:
                new.close()
            raise
        self._held, old = new, self._held
        if old is not None:
            old.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock, and remove a file that is still empty."""
        if self._held is not None:
            if os.fstat(self._held.fileno()).st_size == 0:
                with suppress(OSError):
                    self.path.unlink()
            self._held.close()
            self._held = None


def _lock(file: IO[bytes]) -> bool:
    """Lock a file for this process; False where another one has it."""
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True

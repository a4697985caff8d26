"""The code of a worker process.

pebble manages the processes: it gives them cells, ends those beyond their time limit and replaces those that die (loky
has no time limit for a task, and one crash breaks its executor). Added here are a memory limit for each cell, the last
error message of a crashed process, a row kept before the second solve of a cell, and the end of a process and its
children together with its parent.
"""

import ctypes
import faulthandler
import json
import os
import pickle
import resource
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from optid.child import limit_memory
from optid.studies.execution.machine import MB, resident_mb
from optid.studies.storage.rows import ERROR, MEMORY_LIMIT

RETIRED = 77  # exit code of a worker that holds too much memory of earlier cells; another one takes its cell
KEPT, KEPT_MB = 0.5, 150.0  # share of the limit, and MB, that a worker may hold of earlier cells
TOLD, LONGEST = 100_000, 300  # bytes of the standard error that are searched, characters of it in a reason

_function: Callable[[Any], Mapping[str, Any]]
_folder: Path | None = None
_kept: Path | None = None
_fresh_mb = 0.0


def start(folder: str, packed: bytes, parent: int) -> None:
    """Prepare a new process of a parent; `packed` are the pickled function of a cell and its preparation, or None.

    The folder takes the standard error as PROCESS.words, by the token of a cell a file with the process id, as old as
    the run of the cell, and as TOKEN.row the row that `keep` was given.
    """
    global _function, _folder, _fresh_mb
    _folder = Path(folder)
    os.setsid()  # a kill of its group takes its children along, and Ctrl-C in the terminal does not reach it
    _die_with(parent)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # ends a solver that never returns from its own code, too
    with open(_folder / f"{os.getpid()}.words", "wb") as file, open(os.devnull, "wb") as null:
        os.dup2(file.fileno(), 2)
        os.dup2(null.fileno(), 1)
    faulthandler.enable()  # a segmentation fault then says where
    resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))  # no files of crashes
    _function, prepare = pickle.loads(packed)
    if prepare is not None:
        prepare()
    _fresh_mb = resident_mb()


def run(token: str, packed: bytes, memory_limit: float) -> tuple[dict[str, Any] | None, str, str]:
    """Run the pickled cell of a token within so many MB.

    Returns:
        The row; or None, an outcome and a reason if the function raised an exception.
    """
    global _kept
    held = resident_mb()
    if held > max(KEPT * memory_limit, _fresh_mb + KEPT_MB):
        os._exit(RETIRED)
    if _folder is not None:
        os.ftruncate(2, 0)
        os.lseek(2, 0, os.SEEK_SET)
        (_folder / token).write_text(str(os.getpid()))
        _kept = _folder / f"{token}.row"
    before = resource.getrlimit(resource.RLIMIT_AS)
    try:
        limit_memory(int((memory_limit - held) * MB))  # what is reserved and not used is free
        return dict(_function(pickle.loads(packed))), "", ""
    except MemoryError as error:
        return None, MEMORY_LIMIT, f"got no more memory ({error}); the limit is {memory_limit:g} MB"
    except BaseException as error:
        return None, ERROR, f"{type(error).__name__}: {error}"
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def keep(row: Mapping[str, Any]) -> None:
    """Keep the row of the current cell, valid if the rest of the cell fails; does nothing outside a worker."""
    if _kept is not None:
        _kept.write_text(json.dumps(dict(row)))


def last_words(path: Path) -> str:
    """Return where Python reports a crash, else the last line written; empty if there is none."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TOLD))
            lines = [line.strip() for line in file.read().decode(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    fatal = [k for k, line in enumerate(lines) if line.startswith("Fatal Python error")]
    if fatal:
        said = lines[fatal[-1] - 1] if fatal[-1] and "alloc" in lines[fatal[-1] - 1] else ""
        places = [line for line in lines[fatal[-1]:] if line.startswith("File ")]
        return said or (f"at {places[0]}" if places else "")
    return lines[-1][-LONGEST:] if lines else ""


def _die_with(parent: int) -> None:
    """Let the system kill this process when its parent ends, even inside a solver."""
    if sys.platform == "linux":
        die = 1  # PR_SET_PDEATHSIG of <sys/prctl.h>
        ctypes.CDLL(None).prctl(die, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)

"""MAT files of version 5 and 7.3, read by a process of its own; see `optid.data.reading.matlab_process`."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from optid.data.reading.npyfile import load_npy
from optid.errors import DataError

MAT = 'pip install "optid[mat]"'

MEMORY = 4 << 30  # bytes of address space that a MAT file may take, or `EXPANSION` times its size where that is more

EXPANSION = 32

SECONDS = 60.0  # time that a MAT file may take, and as much again for each `PACE` bytes

PACE = 1 << 30


def mat_names(path: Path) -> list[str]:
    """Return the names of the numeric variables, those of the fields of structures as "structure.field".

    Raises:
        DataError: a damaged file, a link to another file, more time or memory than a file of its size may take, or
            h5py is missing.
    """
    return _run(path, "", None)


def mat_variables(path: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return some variables by name; errors as of `mat_names`."""
    with TemporaryDirectory(prefix="optid-mat-") as folder:
        _run(path, folder, names)
        return {name: load_npy(Path(folder, f"{number}.npy"), path.name) for number, name in enumerate(names)}


def _run(path: Path, folder: str, names: Sequence[str] | None) -> list[str]:
    size = path.stat().st_size
    job = json.dumps([str(path.absolute()), folder, names, max(MEMORY, EXPANSION * size)])
    script = Path(__file__).with_name("matlab_process.py")
    damaged = f"{path.name} is damaged, or not a MAT file"
    try:
        # Without -P the script's folder would come before the installed packages.
        done = subprocess.run([sys.executable, "-P", str(script), job], capture_output=True, stdin=subprocess.DEVNULL,
                              timeout=SECONDS * (1 + size / PACE))
    except subprocess.TimeoutExpired:
        raise DataError(f"{damaged}: reading it took more than {SECONDS:g} s.") from None
    try:
        answer = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        raise DataError(f"{damaged}: the process that read it crashed (exit code {done.returncode}).") from None
    if "error" not in answer:
        return answer["names"]
    if answer["error"] in ("ImportError", "ModuleNotFoundError") and "h5py" in answer["text"]:
        raise DataError(f"{path.name} is a MAT file of version 7.3, which needs h5py: {MAT}")
    raise DataError(f"{damaged}: {answer['text'] or answer['error']}")

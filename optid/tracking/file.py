"""The state of a tracker on disk: one npz file, restored bit for bit, read without running code."""

import json
import os
import zipfile
from pathlib import Path

import numpy as np

from optid.errors import ModelFileError, OptidError
from optid.tracking.tracker import SubspaceTracker

VERSION = 1
ARRAYS = ("W", "root", "sums", "counts")
SETTINGS = ("n", "r", "method", "forgetting", "missing", "names")


def save(state: SubspaceTracker, path: str | Path) -> Path:
    """Write the whole state; the file appears complete or not at all."""
    path = Path(path)
    head = {"optid": "tracker", "version": VERSION, "settings": {name: getattr(state, name) for name in SETTINGS}}
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        np.savez(file, head=np.array(json.dumps(head)), **{name: getattr(state, name) for name in ARRAYS})
    os.replace(part, path)
    return path


def load_tracker(path: str | Path) -> SubspaceTracker:
    """Restore a tracker.

    Raises:
        ModelFileError: truncated, of another version, or not the state of a tracker.
    """
    path = Path(path)
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as file:
            head, arrays = json.loads(str(file["head"])), {name: file[name] for name in ARRAYS}
    except (ValueError, KeyError, EOFError, IndexError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise ModelFileError(f"{path} is not the complete state of a tracker: {error}.") from error
    if not isinstance(head, dict) or head.get("optid") != "tracker" or head.get("version") != VERSION:
        raise ModelFileError(f"{path} is not the state of a tracker of version {VERSION}.")
    try:
        state = SubspaceTracker(**head["settings"])
    except (KeyError, TypeError, OptidError) as error:
        raise ModelFileError(f"{path}: the settings in the file cannot be read ({error}).") from error
    for name, array in arrays.items():
        wanted = getattr(state, name)
        if array.dtype != wanted.dtype or array.shape != wanted.shape:
            raise ModelFileError(f"{path}: {name} is {array.dtype} {array.shape}; {wanted.dtype} {wanted.shape} "
                                 "is needed.")
        setattr(state, name, np.ascontiguousarray(array))
    return state

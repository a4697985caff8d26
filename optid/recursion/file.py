"""The state of a recursion on disk: one npz file, restored bit for bit, read without running code."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from optid.bases import from_dict
from optid.errors import ModelFileError
from optid.recursion.recursive_arx import RecursiveARX

VERSION = 1
"""Version of the file."""

COUNTS = ("samples", "candidates", "rows", "since_restart")
ARRAYS = ("root", "past_u", "past_y")


def save(state: RecursiveARX, path: str | Path) -> Path:
    """Write the whole state; the file appears complete or not at all."""
    path, layout = Path(path), state.layout
    settings = {
        "na": int(layout.na), "nb": [int(b) for b in layout.nb], "nk": [int(k) for k in layout.nk],
        "inputs": layout.inputs, "outputs": layout.outputs, "input_units": state.input_units,
        "output_units": state.output_units, "dt": state.dt, "forgetting": state.forgetting,
    }
    head = {
        "optid": "recursion", "version": VERSION, "settings": settings,
        "bases": [basis.to_dict() for basis in layout.bases], "counts": {name: getattr(state, name) for name in COUNTS},
    }
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        np.savez(file, head=np.array(json.dumps(head)), **{name: getattr(state, name) for name in ARRAYS})
    os.replace(part, path)
    return path


def load(path: str | Path, functions: dict[str, Any] | None = None) -> RecursiveARX:
    """Restore a state.

    Args:
        path: file written by `save`.
        functions: the functions of UserFunctions bases by name.

    Raises:
        ModelFileError: truncated, of another version, or not a state of a recursion.
    """
    path = Path(path)
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as file:
            head, arrays = json.loads(str(file["head"])), {name: file[name] for name in ARRAYS}
    except (ValueError, KeyError, EOFError, IndexError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise ModelFileError(f"{path} is not the complete state of a recursion: {error}.") from error
    if not isinstance(head, dict) or head.get("optid") != "recursion":
        raise ModelFileError(f"{path} is not the state of a recursion.")
    if head.get("version") != VERSION:
        raise ModelFileError(f"{path} has version {head.get('version')!r}; this optid reads version {VERSION}.")
    try:
        state = RecursiveARX(basis=[from_dict(basis, functions) for basis in head["bases"]], **head["settings"])
        for name in COUNTS:
            setattr(state, name, int(head["counts"][name]))
    except (KeyError, TypeError, AttributeError) as error:
        raise ModelFileError(f"{path}: the settings in the file cannot be read ({error}).") from error
    for name, array in arrays.items():
        shape = getattr(state, name).shape
        if array.dtype != np.float64 or array.shape != shape:
            raise ModelFileError(f"{path}: {name} is {array.dtype} {array.shape}; float64 {shape} is needed.")
        setattr(state, name, array)
    return state

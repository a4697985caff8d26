"""The state of something that runs on: one npz file, restored bit for bit, read without running code."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import ModelFileError
from optid.models.files import complete


def write_state(path: str | Path, kind: str, version: int, head: Mapping[str, Any], arrays: Mapping[str, Any]) -> Path:
    """Write a state; the file appears complete or not at all.

    Args:
        path: the file, replaced when it exists.
        kind: what runs, e.g. "tracker".
        version: of the form of its file.
        head: JSON types.
        arrays: by name.
    """
    path = Path(path)
    content = json.dumps({"optid": kind, "version": version, **head})
    with complete(path) as part, part.open("wb") as file:
        np.savez(file, head=np.array(content), **arrays)
    return path


def read_state(
    path: str | Path, kind: str, version: int, names: Sequence[str]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read what `write_state` wrote: the head, and the arrays of these names.

    Raises:
        ModelFileError: truncated, of another version, or the state of something else.
    """
    path = Path(path)
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as file:
            head, arrays = json.loads(str(file["head"])), {name: file[name] for name in names}
    except (ValueError, KeyError, EOFError, IndexError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise ModelFileError(f"{path} is not the complete state of a {kind}: {error}.") from error
    if not isinstance(head, dict) or head.get("optid") != kind:
        raise ModelFileError(f"{path} is not the state of a {kind} (version {version}).")
    if head.get("version") != version:
        raise ModelFileError(f"{path} has version {head.get('version')!r}; this optid reads version {version}.")
    return head, arrays


def set_arrays(state: Any, arrays: Mapping[str, np.ndarray], path: str | Path) -> None:
    """Give a fresh state the arrays of a file.

    Raises:
        ModelFileError: another type or shape than the fresh one's.
    """
    for name, array in arrays.items():
        wanted = getattr(state, name)
        if array.dtype != wanted.dtype or array.shape != wanted.shape:
            raise ModelFileError(
                f"{path}: {name} is {array.dtype} {array.shape}; {wanted.dtype} {wanted.shape} is needed."
            )
        setattr(state, name, np.ascontiguousarray(array))

"""Model files: JSON with every digit, read without running any code."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optid.bases import from_dict
from optid.errors import LookupFailed, ModelFileError, StructureError
from optid.models.nonlinearity import Nonlinearity

if TYPE_CHECKING:
    from optid.models import HammersteinARX

FORMAT = "optid model"
VERSION = 1


def save(model: "HammersteinARX", path: str | Path) -> Path:
    """Write a model to a JSON file; numbers are written so that they are read back to the last bit.

    Args:
        model: the model.
        path: the file, replaced when it exists.

    Returns:
        The path.
    """
    path = Path(path)
    text = json.dumps({"format": FORMAT, "version": VERSION, **to_dict(model)}, indent=1, allow_nan=False)
    # a file that is complete or not there: an interrupted write must not leave half a model
    unfinished = path.with_name(path.name + ".part")
    unfinished.write_text(text, encoding="utf-8")
    os.replace(unfinished, path)
    return path


def load(path: str | Path, functions: dict[str, Any] | None = None) -> "HammersteinARX":
    """Read a model from a file written by `save`.

    Args:
        path: the file.
        functions: for a basis of UserFunctions, the functions by name: {name: function} or {name: (function, slope)}.

    Raises:
        FileNotFoundError: no such file.
        ModelFileError: the file is truncated, of another version, or not a model.
        StructureError: functions that the model needs are not supplied.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ModelFileError(
            f"{path} is not a model: it is not text. Use a file written by model.save(...)."
        ) from error
    if not text.strip():
        raise ModelFileError(f"{path} is empty. Save the model again.")
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        if text.lstrip()[0] == "{" and f'"{FORMAT}"' in text:
            raise ModelFileError(f"{path} is truncated or damaged ({error}). Save the model again.") from error
        raise ModelFileError(
            f"{path} is not a model: it is not JSON. Use a file written by model.save(...)."
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ModelFileError(f"{path} is JSON but not a model. Use a file written by model.save(...).")
    if content.get("version") != VERSION:
        raise ModelFileError(
            f"{path} is of version {content.get('version')!r}; this release reads version {VERSION}. "
            "Load it with the release that wrote it and save it again, or install that release."
        )
    try:
        return from_content(content, functions)
    except KeyError as error:
        raise ModelFileError(f"{path} lacks {error}: it is damaged. Save the model again.") from error
    except (TypeError, ValueError, AttributeError, LookupFailed) as error:
        if isinstance(error, StructureError) and "functions=" in str(error):
            raise
        raise ModelFileError(f"{path} is damaged: {error} Save the model again.") from error


def to_dict(model: "HammersteinARX") -> dict[str, Any]:
    """Describe a model in JSON types."""
    return {
        "kind": "HammersteinARX",
        "a": model.a.tolist(),
        "b": [b.tolist() for b in model.b],
        "nonlinearities": [{"basis": f.basis.to_dict(), "mu": f.mu.tolist()} for f in model.nonlinearities],
        "nk": list(model.nk),
        "offset": model.offset.tolist(),
        "dt": model.dt,
        "inputs": list(model.inputs),
        "outputs": list(model.outputs),
        "input_units": list(model.input_units),
        "output_units": list(model.output_units),
        "gauge": model.gauge,
    }


def from_content(content: dict[str, Any], functions: dict[str, Any] | None = None) -> "HammersteinARX":
    """Build the model that `to_dict` described; the errors are those of the parts."""
    import numpy as np

    from optid.models import HammersteinARX

    if content["kind"] != "HammersteinARX":
        raise ValueError(f"unknown kind of model {content['kind']!r}.")
    outputs = len(content["outputs"])
    a = np.array(content["a"], dtype=float)
    return HammersteinARX(
        a=a if a.size or outputs == 1 else a.reshape(0, outputs, outputs),
        b=tuple(np.array(b, dtype=float) for b in content["b"]),
        nonlinearities=tuple(
            Nonlinearity(from_dict(f["basis"], functions), np.array(f["mu"], dtype=float))
            for f in content["nonlinearities"]
        ),
        nk=tuple(content["nk"]),
        offset=np.array(content["offset"], dtype=float),
        dt=content["dt"],
        inputs=tuple(content["inputs"]),
        outputs=tuple(content["outputs"]),
        input_units=tuple(content["input_units"]),
        output_units=tuple(content["output_units"]),
        gauge=content["gauge"],
    )

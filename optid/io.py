"""Model files: JSON with every digit, read without running any code."""

import json
import os
from importlib import import_module
from pathlib import Path
from typing import Any

from optid.errors import LookupFailed, ModelFileError, StructureError

FORMAT = "optid model"
VERSION = 1

KINDS = {
    "HammersteinARX": "optid.models.hammerstein_arx",
    "HammersteinTF": "optid.models.hammerstein_tf",
    "HammersteinSS": "optid.models.hammerstein_ss",
}
"""The module of every class of model, by the word that stands in the file."""


def save(model: Any, path: str | Path) -> Path:
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


def load(path: str | Path, functions: dict[str, Any] | None = None) -> Any:
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


def to_dict(model: Any) -> dict[str, Any]:
    """Describe a model in JSON types."""
    return model.to_dict()


def from_content(content: dict[str, Any], functions: dict[str, Any] | None = None) -> Any:
    """Build the model that `to_dict` described; the errors are those of the parts."""
    kind = content["kind"]
    if kind not in KINDS:
        raise ValueError(f"unknown kind of model {kind!r}.")
    return getattr(import_module(KINDS[kind]), kind).from_dict(content, functions)

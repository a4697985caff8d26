"""Model files: JSON with every digit, read without running any code."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optid.errors import LookupFailed, ModelFileError, StructureError

FORMAT = "optid model"
VERSION = 1

KINDS: dict[str, Callable[[dict[str, Any], dict[str, Any] | None], Any]] = {}
"""What builds a model from the content of its file, by the kind written there; every class enters itself."""


def load(path: str | Path, functions: dict[str, Any] | None = None) -> Any:
    """Read a model from a file that its `save` wrote.

    Args:
        path: the file.
        functions: for a basis of UserFunctions, the functions by name: {name: function} or {name: (function, slope)}.

    Raises:
        FileNotFoundError: no such file.
        ModelFileError: the file is truncated, of another version, or not a model.
        StructureError: functions that the model needs are not supplied.
    """
    return read(path, FORMAT, VERSION, lambda content: from_content(content, functions))


def write(content: dict[str, Any], path: str | Path, form: str, version: int) -> Path:
    """Write JSON types to a file that says of what form and version it is, and is complete or not there.

    Args:
        content: what to write.
        path: the file, replaced when it exists.
        form: "optid " and what it is.
        version: of that form.
    """
    path = Path(path)
    text = json.dumps({"format": form, "version": version, **content}, indent=1, allow_nan=False)
    with complete(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


@contextmanager
def complete(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes the file at the end: an interrupted write must not leave half of it."""
    part = path.with_name(path.name + ".part")
    yield part
    os.replace(part, path)


def read(path: str | Path, form: str, version: int, build: Callable[[dict[str, Any]], Any]) -> Any:
    """Read a file written by `write`.

    Args:
        path: the file.
        form: what it has to be.
        version: the version that is read.
        build: makes the object of the content.

    Raises:
        FileNotFoundError: no such file.
        ModelFileError: the file is truncated, damaged, of another version, or of another form.
    """
    path, what = Path(path), form.removeprefix("optid ")
    remedy = f"Use a file written by {what}.save(...)."
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ModelFileError(f"{path} is not a {what}: it is not text. {remedy}") from error
    if not text.strip():
        raise ModelFileError(f"{path} is empty. Save the {what} again.")
    try:
        content = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        if text.lstrip()[0] == "{" and f'"{form}"' in text:
            raise ModelFileError(f"{path} is truncated or damaged ({error}). Save the {what} again.") from error
        raise ModelFileError(f"{path} is not a {what}: it is not JSON. {remedy}") from error
    if not isinstance(content, dict) or content.get("format") != form:
        raise ModelFileError(f"{path} is JSON but not a {what}. {remedy}")
    if content.get("version") != version:
        raise ModelFileError(
            f"{path} is of version {content.get('version')!r}; this release reads version {version}. "
            "Load it with the release that wrote it and save it again, or install that release."
        )
    try:
        return build(content)
    except KeyError as error:
        raise ModelFileError(f"{path} lacks {error}: it is damaged. Save the {what} again.") from error
    except (TypeError, ValueError, AttributeError, LookupFailed) as error:
        if isinstance(error, StructureError) and "functions=" in str(error):
            raise
        raise ModelFileError(f"{path} is damaged: {error} Save the {what} again.") from error


def from_content(content: dict[str, Any], functions: dict[str, Any] | None = None) -> Any:
    """Build the model that its `to_dict` described; the errors are those of the parts."""
    kind = content["kind"]
    if kind not in KINDS:
        raise ValueError(f"unknown kind of model {kind!r}.")
    return KINDS[kind](content, functions)

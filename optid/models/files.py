"""Files without code: models as JSON with every digit, the states of what runs on as npz, restored bit for bit."""

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import ModelFileError, StructureError

FORMAT = "optid model"
VERSION = 1

# module and class of a model by the kind written in its file; imported when there is one
KINDS = {"HammersteinTF": ("hammerstein_tf", "HammersteinTF"), "HammersteinARX": ("hammerstein_tf", "HammersteinTF"),
         "HammersteinSS": ("hammerstein_ss", "HammersteinSS"), "PhysicalModel": ("physical", "PhysicalModel"),
         "ProcessModel": ("process", "ProcessModel")}


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


def record_of(path: str | Path) -> dict[str, Any] | None:
    """Return the entry of a model file about the record of the identification; None without one.

    That are ``files``, absolute paths, and how they are read. Errors as of `load`.
    """
    def build(content: dict[str, Any]) -> dict[str, Any] | None:
        named = content.get("record")
        if named is not None and not (
                isinstance(named, dict) and isinstance(named.get("files"), list) and named["files"]
                and all(isinstance(name, str) for name in named["files"])):
            raise ValueError("'record' lists no files")
        return named

    return read(path, FORMAT, VERSION, build)


def write(content: dict[str, Any], path: str | Path, form: str, version: int) -> Path:
    """Write JSON types to a file with its form ("optid model") and version; it replaces an older one."""
    path = Path(path)
    text = json.dumps({"format": form, "version": version, **content}, indent=1, allow_nan=False)
    with complete(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


@contextmanager
def complete(path: Path) -> Iterator[Path]:
    """Give a path to write to, which becomes the file at the end: a failed write leaves neither half of it."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise


def read(path: str | Path, form: str, version: int, build: Callable[[dict[str, Any]], Any]) -> Any:
    """Return what `build` makes of the content of a file that `write` wrote in this form; errors as of `load`."""
    path, what = Path(path), form.removeprefix("optid ")
    remedy = f"Use a file written by {what}.save(...)."
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ModelFileError(f"{path} is not a {what}: it is not text. {remedy}") from error
    if not text.strip():
        raise ModelFileError(f"{path} is empty. Save the {what} again.")
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_constant=_refused)
    except (ValueError, RecursionError) as error:
        if text.lstrip()[0] == "{" and f'"{form}"' in text:
            raise ModelFileError(f"{path} is truncated or damaged ({error}). Save the {what} again.") from error
        raise ModelFileError(f"{path} is not a {what}: it is not JSON. {remedy}") from error
    if not isinstance(content, dict) or content.get("format") != form:
        raise ModelFileError(f"{path} is JSON but not a {what}. {remedy}")
    if content.get("version") != version:
        raise ModelFileError(f"{path} is of version {content.get('version')!r}; this release reads version {version}. "
                             "Load it with the release that wrote it and save it again, or install that release.")
    try:
        return build(content)
    except KeyError as error:
        raise ModelFileError(f"{path} lacks {error}: it is damaged. Save the {what} again.") from error
    except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError, RecursionError, MemoryError) as error:
        if isinstance(error, StructureError) and "functions=" in str(error):
            raise
        text = str(error)[:500].rstrip(".")
        raise ModelFileError(f"{path} is damaged: {text}. Save the {what} again.") from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(key for key in keys if keys.count(key) > 1)!r} occurs twice in one object")
    return content


def _refused(word: str) -> None:
    raise ValueError(f"{word} is no number of JSON")


def from_content(content: dict[str, Any], functions: dict[str, Any] | None = None) -> Any:
    """Build the model that its `to_dict` described; the errors are those of the parts."""
    kind = content["kind"]
    if kind not in KINDS:
        raise ValueError(f"unknown kind of model {kind!r}.")
    module, name = KINDS[kind]
    return getattr(import_module(f"optid.models.{module}"), name).from_dict(content, functions)


def write_state(path: str | Path, kind: str, version: int, head: Mapping[str, Any], arrays: Mapping[str, Any]) -> Path:
    """Write the state of a `kind` of estimator: a head of JSON types, and arrays by name; it replaces an older file."""
    path = Path(path)
    content = json.dumps({"optid": kind, "version": version, **head})
    buffer = io.BytesIO()  # an archive on a full disk cannot be closed
    np.savez(buffer, head=np.array(content), **arrays)
    with complete(path) as part:
        part.write_bytes(buffer.getvalue())
    return path


def read_state(path: str | Path, kind: str, version: int, names: Sequence[str]
               ) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the head, and the arrays of these names, that `write_state` wrote; refuse others (`ModelFileError`)."""
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

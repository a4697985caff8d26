"""Check the values of arguments against the annotations of a function, so that a wrong one is named at once."""

import sys
import types
from collections.abc import Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np

from optid.arrays import LARGEST_INTEGER, is_number, one_of, short_repr
from optid.errors import StructureError

PLAIN = bool | np.bool_ | int | float | complex | np.number | str | bytes | list | tuple | set | dict | None
WORDS = {int: "an integer", float: "a finite number", bool: "True or False", str: "a word", types.NoneType: "None"}


def check_values(arguments: Mapping[str, Any], annotations: Mapping[str, Any]) -> None:
    """Refuse a value that its annotation excludes, with the name of the argument (`StructureError`).

    Numbers must be finite, integers have at most 64 bits. A text as annotation, and parts of one that are no numbers,
    words, sequences or classes, exclude nothing.
    """
    for name, value in arguments.items():
        kind = annotations.get(name, Any)
        if not _is_of(value, kind):
            raise StructureError(f"{name}={short_repr(value)}: it must be {_described(kind)}.")


def check_words(arguments: Mapping[str, Any], annotations: Mapping[str, Any]) -> None:
    """Refuse a word that is none of those of its annotation, a `Literal` (`StructureError`)."""
    for name, value in arguments.items():
        if get_origin(kind := annotations.get(name)) is Literal:
            one_of(name, value, get_args(kind))


def _is_of(value: Any, kind: Any) -> bool:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return any(_is_of(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is Sequence:
        if isinstance(value, np.ndarray):
            return value.ndim == 1 and all(_is_of(one, parts[0]) for one in value)
        return not isinstance(value, PLAIN) or isinstance(value, list | tuple) and all(
            _is_of(one, parts[0]) for one in value)
    if kind in (None, types.NoneType):
        return value is None
    if kind is bool:
        return isinstance(value, bool | np.bool_)
    if kind is int:
        return is_number(value) and isinstance(value, int | np.integer) and bool(abs(value) <= LARGEST_INTEGER)
    if kind is float:
        return is_number(value) and bool(abs(value) < np.inf) and (
            not isinstance(value, int) or abs(value) <= sys.float_info.max)
    if kind is str:
        return isinstance(value, str)
    if isinstance(kind, type) and kind is not Any:
        return isinstance(value, kind) if isinstance(value, PLAIN | np.ndarray) else True
    return True


def _described(kind: Any) -> str:
    """Return what an annotation admits, in words."""
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(map(_described, get_args(kind)))
    if get_origin(kind) is Literal:
        return " or ".join(map(repr, get_args(kind)))
    if get_origin(kind) is Sequence:
        return "a sequence of such"
    return WORDS.get(kind) or getattr(kind, "__name__", str(kind))

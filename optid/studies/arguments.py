"""The arguments of a formulation in a study: checked by its signature, and lists of them as a grid."""

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from math import prod
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import ConfigDict, TypeAdapter, ValidationError

from optid.bases import parse
from optid.errors import OptidError, nearest
from optid.studies.messages import Problem

MOST = 10_000
"""Formulations of one grid."""


def arguments(function: Callable[..., Any]) -> dict[str, inspect.Parameter] | None:
    """Return the keyword arguments of a formulation by name; None where it takes any."""
    try:
        parameters = inspect.signature(function, eval_str=True).parameters
    except NameError:  # an annotation that is imported for type checkers only
        parameters = inspect.signature(function).parameters
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return None
    return {key: p for key, p in parameters.items() if p.kind is p.KEYWORD_ONLY}


def argument_problems(name: str, function: Callable[..., Any], options: Mapping[str, Any], others: Sequence[str]
                      ) -> Iterator[Problem]:
    """Yield what is wrong with the options of a formulation of this name; `others` are further keys of its entry."""
    takes = arguments(function)
    if takes is None:
        return
    for key, value in options.items():
        if key not in takes:
            yield (key,), f"formulation {name!r} takes no argument {key!r}. {nearest(key, [*takes, *others])}"
        elif not accepts(takes[key].annotation, value):
            yield (key,), f"must be {_spoken(takes[key].annotation)}; {value!r} is not"
        elif "basis" in key:
            for text in value if isinstance(value, list | tuple) else [value]:
                try:
                    if text != "none":  # an output that is not fed back
                        parse(text)
                except OptidError as error:
                    yield (key,), str(error)
    missing = [key for key, p in takes.items() if p.default is p.empty and key not in options]
    if missing:
        yield (), f"formulation {name!r} needs {', '.join(missing)}"


@cache
def _adapter(annotation: Any) -> TypeAdapter[Any]:
    return TypeAdapter(annotation, config=ConfigDict(strict=True, arbitrary_types_allowed=True))


def accepts(annotation: Any, value: Any) -> bool:
    """Whether a value is of an annotated type; what cannot be decided here is left to the formulation."""
    if isinstance(annotation, str) or annotation is inspect.Parameter.empty:
        return True
    try:
        _adapter(annotation).validate_python(value)
    except ValidationError:
        return False
    return True


def points(function: Callable[..., Any], raw: Mapping[str, Any], one_input: bool) -> list[dict[str, Any]]:
    """Return the arguments of every point of the grid over those with several values: one point where there is none.

    A list holds several values where the argument takes no list, or where it is a list of lists. An argument that
    takes one value or one per input has several values if the data have one input.

    Raises:
        ValueError: more than `MOST` points.
    """
    takes = arguments(function) or {}
    axes = {key: value for key, value in raw.items() if key in takes and isinstance(value, list | tuple) and value
            and _is_axis(takes[key].annotation, value, one_input)}
    if (count := prod(map(len, axes.values()))) > MOST:
        raise ValueError(f"{', '.join(axes)} form a grid of {count:,} formulations; the limit is {MOST:,}")
    return [dict(zip(axes, values)) for values in product(*axes.values())]


def _is_axis(annotation: Any, values: Sequence[Any], one_input: bool) -> bool:
    if all(isinstance(one, list | tuple) for one in values):
        return True
    members = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    scalar = any(member in (int, float, str, bool) for member in members)
    if Any in members or any(map(_is_list, members)):
        return scalar and len(values) > 1 and one_input
    return scalar


def _is_list(annotation: Any) -> bool:
    origin = get_origin(annotation) or annotation
    return isinstance(origin, type) and issubclass(origin, Sequence) and origin is not str


def _spoken(annotation: Any) -> str:
    """Write a type for people: "an integer or a list of integers"."""
    words = {"int": "an integer", "float": "a number", "str": "a text", "bool": "true or false", "None": "left out"}
    text = re.sub(r"[\w.]*\.", "", annotation.__name__ if isinstance(annotation, type) else str(annotation))
    plural = {"int": "integers", "float": "numbers", "str": "texts", "bool": "true and false"}
    text = re.sub(r"Literal\[(.*)\]", r"one of \1", text)
    text = re.sub(r"Sequence\[(.*)\]", lambda m: "a list of " + plural.get(m[1], m[1]), text)
    return " or ".join(words.get(word, word) for word in text.split(" | "))

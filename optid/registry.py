"""Formulations, constraints and renderers by name: entry points, so that a third party's are on equal footing."""

import inspect
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from optid.errors import LookupFailed, StructureError, nearest

FORMULATIONS = "optid.formulations"
CONSTRAINTS = "optid.constraints"
FAULTS = "optid.fault_formulations"
RENDERERS = "optid.renderers"
_NOUNS = {FORMULATIONS: "formulation", CONSTRAINTS: "constraint", FAULTS: "programme about faults",
          RENDERERS: "renderer"}


@cache
def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name."""
    return {point.name: point for point in entry_points(group=group)}


def formulation(name: str | Callable[..., Any]) -> tuple[str, Callable[..., Any]]:
    """Return (name, callable) of a formulation given by name or as a callable; errors as of `entry_point`."""
    if callable(name):
        return getattr(name, "__name__", "formulation"), name
    return name, entry_point(FORMULATIONS, name).load()


def entry_point(group: str, name: str) -> EntryPoint:
    """Return the entry point of a name, not yet loaded.

    Raises:
        LookupFailed: no such name; the message has the nearest one.
    """
    known = registered(group)
    if not isinstance(name, str) or name not in known:
        raise LookupFailed(f"no {_NOUNS[group]} is called {name!r}. {nearest(str(name), known)}")
    return known[name]


def fault_formulation(name: str) -> Callable[..., Any]:
    """Return a programme about a fault by its name; errors as of `entry_point`."""
    return entry_point(FAULTS, name).load()


def render(result: Any, form: str = "text") -> Any:
    """Return a result in a form, such as "text", by the renderer registered as "<class name>.<form>".

    Results are data: they know no table and no figure, and import nothing that draws or prints them.

    Raises:
        LookupFailed: no such renderer; the message has the nearest name.
    """
    return entry_point(RENDERERS, f"{type(result).__name__}.{form}").load()(result)


def named_constraint(text: str) -> Any:
    """Build a constraint from a word such as ``monotone:increasing`` or ``gain:1.0``.

    Raises:
        LookupFailed: no such constraint; the message has the nearest name.
        StructureError: arguments it does not take.
    """
    word, *arguments = text.split(":")
    build = entry_point(CONSTRAINTS, word).load()
    positional: list[Any] = []
    keywords: dict[str, Any] = {}
    for argument in ":".join(arguments).split(",") if arguments else []:
        key, equals, value = argument.partition("=")
        if equals:
            keywords[key.strip()] = _number(value)
        else:
            positional.append(_number(argument))
    try:
        signature = inspect.signature(build)
        for key, value in signature.bind(*positional, **keywords).arguments.items():
            kind = str(signature.parameters[key].annotation)
            if isinstance(value, str) and ("float" in kind or "int" in kind) and "str" not in kind:
                raise StructureError(f"constraint {text!r}: {key} must be a number, not {value!r}")
        return build(*positional, **keywords)
    except TypeError as error:
        raise StructureError(f"constraint {text!r}: {error}; it is used as {word}{inspect.signature(build)}") from None


def check_arguments(name: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Refuse arguments a formulation does not have, and name those it misses.

    Raises:
        StructureError: with the nearest known argument.
    """
    parameters = inspect.signature(function).parameters
    if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        return
    known = [key for key, p in parameters.items() if p.kind is p.KEYWORD_ONLY]
    for key in arguments:
        if key not in known:
            raise StructureError(f"formulation {name!r} takes no argument {key!r}. {nearest(key, known)}")
    missing = [key for key in known if parameters[key].default is inspect.Parameter.empty and key not in arguments]
    if missing:
        raise StructureError(f"formulation {name!r} needs {', '.join(missing)}")


def defaults(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the arguments of a formulation that may be left out, with their values then."""
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY and p.default is not p.empty}


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text.strip()

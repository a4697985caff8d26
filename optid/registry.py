"""Formulations, constraints and renderers by name: entry points, so that a third party's are on equal footing."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from functools import cache
from html import escape
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

from optid.errors import LookupFailed, StructureError, nearest

FORMULATIONS = "optid.formulations"
CONSTRAINTS = "optid.constraints"
FAULTS = "optid.fault_formulations"
RENDERERS = "optid.renderers"
OURS = "formulations"  # the package beside optid
_NOUNS = {FORMULATIONS: "formulation", CONSTRAINTS: "constraint", FAULTS: "programme about faults"}


@cache
def find_entry_points(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name."""
    return {point.name: point for point in entry_points(group=group)}


def formulation(name: str | Callable[..., Any]) -> tuple[str, Callable[..., Any]]:
    """Return (name, callable) of a formulation given by name or as a callable; errors as of `entry_point`."""
    if callable(name):
        return getattr(name, "__name__", "formulation"), name
    return name, _loaded(FORMULATIONS, name)


def entry_point(group: str, name: str) -> EntryPoint:
    """Return the entry point of a name, not yet loaded.

    Raises:
        LookupFailed: no such name; the message has the nearest one.
    """
    known = find_entry_points(group)
    if not isinstance(name, str) or name not in known:
        raise LookupFailed(f"no {_NOUNS[group]} is called {name!r}. {nearest(str(name), known)}")
    return known[name]


def _loaded(group: str, name: str) -> Any:
    """Load an entry point; one of ours that another package of the same name hides is refused with its place."""
    point = entry_point(group, name)
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        package = point.module.partition(".")[0]
        found = find_spec(package)
        places = list(found.submodule_search_locations or [str(found.origin)]) if found else []
        if package != OURS or not places or str(Path(__file__).parents[1] / OURS) in places:
            raise
        raise LookupFailed(f"{name!r} is in the package {OURS!r} of optid, which another one hides: {places[0]}. "
                           "Rename that, or remove its folder from the path of Python.") from error


def fault_formulation(name: str) -> Callable[..., Any]:
    """Return a programme about a fault by its name; errors as of `entry_point`."""
    return _loaded(FAULTS, name)


def render(result: Any, form: str = "text", *arguments: Any, **options: Any) -> Any:
    """Return a result in a form, by the renderer registered as "<class name>.<form>".

    Results are data: they know no table and no figure, and import nothing that draws or prints them. A notebook shows
    the text of a result without an HTML renderer.

    Args:
        result: the result.
        form: "text", "html" (for notebooks), "figure" (matplotlib), or "page" (writes a file).
        arguments: of the renderer, after the result.
        options: of the renderer.

    Raises:
        LookupFailed: the result has no such form; the message lists those that it has.
    """
    kind, known = type(result).__name__, find_entry_points(RENDERERS)
    name = f"{kind}.{form}"
    if form == "html" and name not in known:
        return f"<pre>{escape(render(result))}</pre>"
    if name not in known:
        has = ", ".join(sorted(each.partition(".")[2] for each in known if each.startswith(f"{kind}.")))
        raise LookupFailed(f"{kind} has no form {form!r}; it has {has or 'none'}.")
    return known[name].load()(result, *arguments, **options)


class Rendered:
    """Results that print, draw and report themselves through the registry."""

    def summary(self) -> str:
        """Return the printed result."""
        return render(self)

    def plot(self, *arguments: Any, **options: Any) -> Any:
        """Return a matplotlib figure; the arguments are those of its function in `optid.plots`."""
        return render(self, "figure", *arguments, **options)

    def report(self, path: str | Path, *arguments: Any, **options: Any) -> Path:
        """Write an HTML page that opens offline and return its path."""
        return render(self, "page", path, *arguments, **options)

    def __str__(self) -> str:
        return render(self)

    def __repr__(self) -> str:
        values = {one.name: getattr(self, one.name) for one in fields(cast(Any, self)) if one.repr}
        shown = [f"{name}={value!r}" for name, value in values.items()
                 if isinstance(value, str | int | float) and len(str(value)) < 60]
        return f"{type(self).__name__}({', '.join(shown)})"

    def _repr_html_(self) -> str:
        return render(self, "html")

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(f"{type(self).__name__}(...)" if cycle else str(self))


def named_constraint(text: str) -> Any:
    """Build a constraint from a word such as ``monotone:increasing`` or ``gain:1.0``.

    Raises:
        LookupFailed: no such constraint; the message has the nearest name.
        StructureError: arguments it does not take.
    """
    word, *arguments = text.split(":")
    build = _loaded(CONSTRAINTS, word)
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


def read_constraints(constraints: Any) -> tuple[Any, ...]:
    """Return constraints as a tuple of builders; a text alone, or a callable alone, is one constraint.

    Raises:
        LookupFailed, StructureError: as `named_constraint`.
        StructureError: neither a text, a callable nor a sequence of them.
    """
    if isinstance(constraints, str) or callable(constraints):
        constraints = (constraints,)
    if constraints is None or isinstance(constraints, Mapping) or not isinstance(constraints, Iterable):
        raise StructureError(f"constraints = {constraints!r}: must be a text such as 'monotone:increasing', a function "
                             "of the named variables, or a list of these")
    return tuple(named_constraint(one) if isinstance(one, str) else one for one in constraints)


def check_arguments(name: str, function: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Refuse arguments a formulation does not have, and name those it misses.

    Raises:
        StructureError: with the nearest known argument.
    """
    parameters = _parameters(function)
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
    keywords = (p for p in _parameters(function).values() if p.kind is p.KEYWORD_ONLY)
    return {p.name: p.default for p in keywords if p.default is not p.empty}


def annotations(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotations of the arguments of a formulation but its record and constraints."""
    return {name: p.annotation for name, p in _parameters(function).items()
            if p.kind is p.KEYWORD_ONLY and p.annotation is not p.empty and name != "constraints"}


@cache
def _parameters(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function).parameters


def _number(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return text.strip()

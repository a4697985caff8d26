"""The bases by name: what a user imports, writes on a command line and finds in a model file."""

from collections.abc import Callable
from typing import Any

from optid.basis import Basis
from optid.errors import LookupFailed, StructureError, nearest
from optid.expansions import Linear, Polynomial, Trigonometric, UserFunctions, restore
from optid.splines import BSpline, PiecewiseConstant, Triangular

__all__ = [
    "BSpline",
    "Basis",
    "Linear",
    "PiecewiseConstant",
    "Polynomial",
    "Triangular",
    "Trigonometric",
    "UserFunctions",
    "from_dict",
    "parse",
]

_CLASSES: dict[str, Callable[..., Basis]] = {
    "triangular": Triangular,
    "trigonometric": Trigonometric,
    "polynomial": Polynomial,
    "bspline": BSpline,
    "piecewiseconstant": PiecewiseConstant,
    "linear": Linear,
}
_ALIASES = {"legendre": "polynomial", "hat": "triangular"}
_OPTIONS: dict[str, Callable[[str], Any]] = {"degree": int, "half_range": float, "outside": str}


def parse(text: str) -> Basis:
    """Read a basis as the command line writes it.

    Args:
        text: the class name in lower case and its size, then options: "triangular:10", "legendre:4",
            "bspline:8:degree=2", "trigonometric:5:half_range=1.25:outside=extrapolate", "linear".

    Raises:
        LookupFailed: no basis has this name.
        StructureError: the size or an option cannot be read.
    """
    name, *parts = text.strip().lower().split(":")
    name = _ALIASES.get(name, name)
    if name not in _CLASSES:
        raise LookupFailed(f"No basis {name!r}. {nearest(name, [*_CLASSES, *_ALIASES])}")
    sizes = [part for part in parts if "=" not in part]
    if len(sizes) != (name != "linear"):
        raise StructureError(
            f"Basis {text!r}: write {'linear' if name == 'linear' else name + ':10'}, options as key=value."
        )
    try:
        options = {key: _OPTIONS[key](value) for key, value in (part.split("=", 1) for part in parts if "=" in part)}
        return _CLASSES[name](*map(int, sizes), **options)
    except StructureError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise StructureError(
            f"Basis {text!r} cannot be read ({error}): write {name}:10, then options such as outside=extrapolate."
        ) from error


def from_dict(description: dict[str, Any], functions: dict[str, Any] | None = None) -> Basis:
    """Build the basis that `Basis.to_dict` described.

    Args:
        description: {"type": name, ...}.
        functions: the functions of a UserFunctions basis by name, each a callable or (callable, slope).

    Raises:
        LookupFailed: unknown type.
        StructureError: arguments that do not fit the type, or functions that are not supplied.
    """
    arguments = dict(description)
    name = str(arguments.pop("type", ""))
    if arguments.get("interval") is not None:
        arguments["interval"] = tuple(float(end) for end in arguments["interval"])
    if name == "userfunctions":
        names = [str(word) for word in arguments.pop("names", [])]
        callables, slopes = restore(names, functions or {})
        return UserFunctions(callables, tuple(names), slopes, **arguments)
    if name not in _CLASSES:
        raise LookupFailed(f"No basis {name!r}. {nearest(name, [*_CLASSES, 'userfunctions'])}")
    try:
        return _CLASSES[name](**arguments)
    except TypeError as error:
        raise StructureError(f"Basis {name!r} cannot be built from {sorted(arguments)}: {error}.") from error

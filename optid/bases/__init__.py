"""The bases by name: what a user imports, writes on a command line and finds in a model file."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import short_repr
from optid.bases.basis import Basis
from optid.bases.expansions import Linear, Polynomial, Trigonometric, UserFunctions
from optid.bases.splines import BSpline, PiecewiseConstant, Triangular
from optid.errors import DataError, LookupFailed, OptidError, StructureError, nearest
from optid.lazy import public_names

if TYPE_CHECKING:
    from optid.data.record import Data
    from optid.data.streams import Stream

__all__ = ["BSpline", "Bases", "Basis", "FeedbackBases", "Linear", "PiecewiseConstant", "Polynomial", "Triangular",
           "Trigonometric", "UserFunctions", "feedback_bases", "fitted_bases", "from_dict", "has_products", "parse"]

Bases = Basis | str | Sequence[Basis | str]  # one basis, or its name as for `parse`, for all inputs, or one per input

FeedbackBases = Basis | str | None | Sequence[Basis | str | None]
"""One basis for all outputs, or one per output; None or "none" where nothing is fed back."""

_CLASSES: dict[str, Callable[..., Basis]] = {
    "triangular": Triangular,
    "trigonometric": Trigonometric,
    "polynomial": Polynomial,
    "bspline": BSpline,
    "piecewiseconstant": PiecewiseConstant,
    "linear": Linear,
}
_ALIASES = {"legendre": "polynomial", "hat": "triangular"}


def _interval(text: str) -> tuple[float, float]:
    """Read an interval written as low..high."""
    low, high = map(float, text.split(".."))
    return low, high


_OPTIONS: dict[str, Callable[[str], Any]] = {
    "degree": int, "half_range": float, "outside": str, "interval": _interval,
}


def parse(text: str) -> Basis:
    """Read a basis as the command line writes it: the class name in lower case and its size, then options.

    For instance "triangular:10", "legendre:4", "bspline:8:degree=2", "triangular:8:interval=-1..1", "linear",
    "trigonometric:5:half_range=1.25:outside=extrapolate".

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

    The functions of a UserFunctions basis are given by name, each a callable or (callable, slope).

    Raises:
        LookupFailed: unknown type.
        StructureError: arguments that do not fit the type, or functions that are not supplied.
    """
    arguments = dict(description)
    name = str(arguments.pop("type", ""))
    if arguments.get("interval") is not None:
        arguments["interval"] = tuple(float(end) for end in arguments["interval"])
    if name == "userfunctions":
        names, known = [str(word) for word in arguments.pop("names", [])], functions or {}
        missing = [word for word in names if word not in known]
        if missing:
            raise StructureError(
                f"The model uses functions that a file does not hold: {', '.join(map(repr, missing))}. "
                "Supply them: load(path, functions={" + ", ".join(f"{word!r}: ..." for word in missing) + "})."
            )
        pairs = [known[word] if isinstance(known[word], tuple) else (known[word], None) for word in names]
        values, slopes = zip(*pairs) if pairs else ((), ())
        return UserFunctions(values, tuple(names), None if None in slopes else slopes, **arguments)
    if name not in _CLASSES:
        raise LookupFailed(f"No basis {name!r}. {nearest(name, [*_CLASSES, 'userfunctions'])}")
    try:
        return _CLASSES[name](**arguments)
    except TypeError as error:
        raise StructureError(f"Basis {name!r} cannot be built from {sorted(arguments)}: {error}.") from error


def has_products(basis: Any) -> bool:
    """Whether a basis, or one of several, has more than one function; a word that cannot be read counts as such."""
    several = basis if isinstance(basis, list | tuple) else (basis,)
    try:
        sizes = [(parse(one) if isinstance(one, str) else one).size for one in several if one not in (None, "none")]
    except (OptidError, AttributeError):
        return True
    return max(sizes, default=0) > 1


def fitted_bases(data: "Data | Stream", basis: Bases) -> tuple[Basis, ...]:
    """Return one basis per input; a basis without an interval takes the range of its input.

    Raises:
        StructureError: a wrong number of bases, or an entry that is not a basis.
        DataError: an input that is constant or without any sample.
    """
    return tuple(_one_each(basis, data.inputs, "input", data.ranges()))


def feedback_bases(data: "Data", given: FeedbackBases) -> list[Basis | None]:
    """Return one basis with an interval, or None, per output, as `fitted_bases` does for the inputs."""
    low, high = np.zeros((2, data.l))
    if given is not None:
        y = np.concatenate([e.y for e in data.experiments])
        low, high = np.fmin.reduce(y), np.fmax.reduce(y)
    return _one_each(given, data.outputs, "output", (low, high), "feedback ")


def _one_each(given: Any, channels: Sequence[str], kind: str, ranges: Sequence[Any], feedback: str = "") -> list[Any]:
    """Return one basis per channel on its range (low, high); with `feedback`, the word for messages, also None."""
    several = list(given) if isinstance(given, list | tuple) else [given] * len(channels)
    if len(several) != len(channels):
        raise StructureError(f"{len(several)} {feedback}bases for {len(channels)} {kind}s "
                             f"({', '.join(channels)}): give one each"
                             + (", None for an output that is not fed back" if feedback else ""))
    found: list[Basis | None] = []
    for channel, one, low, high in zip(channels, several, *ranges):
        if feedback and (one is None or isinstance(one, str) and one == "none"):
            found.append(None)
            continue
        family = parse(one) if isinstance(one, str) else one
        if not isinstance(family, Basis):
            raise StructureError(f"the {feedback}basis of {kind} {channel!r} is {short_repr(one)}: give one such as "
                                 "Triangular(10) or its name, 'triangular:10'")
        if low != low:
            raise DataError(f"{kind} {channel!r} has no sample at all; choose another column or drop the {kind}")
        if low == high:
            raise DataError(f"{kind} {channel!r} is constant ({low:g}): nothing can be identified from it; "
                            "excite the input or drop the channel, or begin the record before its step")
        found.append(family.with_interval(float(low), float(high)))
    return found


__dir__ = public_names(__name__)

"""Pickles for another process, with refusals that name what cannot be sent."""

import io
import pickle
import sys
from types import FunctionType
from typing import Any

from optid.errors import StructureError

REMEDY = "define it in a module that can be imported"
MAIN = ("__main__", "__mp_main__")  # another process has another main module


class Unsendable(StructureError):
    """A function or an argument cannot be sent to another process; the message names it and the remedy."""


class Absent:
    """Stands in another process for a function that could not be sent there; using it is an `Unsendable`."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Refuse."""
        raise Unsendable(_refusal(self._name))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise Unsendable(_refusal(self._name))


def pack(content: Any, lenient: bool = False) -> bytes:
    """Return a pickle of functions and data, with importable functions and classes by their names.

    Args:
        content: what to send.
        lenient: send an `Absent` for a function, or an object of a class, that cannot be imported, instead of refusing.

    Raises:
        Unsendable: something cannot be sent.
    """
    file = io.BytesIO()
    try:
        _Pickler(file, lenient).dump(content)
    except Unsendable:
        raise
    except RecursionError:
        raise Unsendable("the data are nested too deeply to be sent to another process") from None
    except Exception as error:  # whatever an object raises when it is pickled
        raise Unsendable(f"the data cannot be sent to another process: {error}") from error
    return file.getvalue()


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, lenient: bool) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._lenient, self._found = lenient, dict[Any, bool]()

    def reducer_override(self, one: Any) -> Any:
        """Replace or refuse what the other process cannot import."""
        origin = one if isinstance(one, FunctionType | type) else type(one)
        if origin not in self._found:
            self._found[origin] = _is_importable(origin)
        if self._found[origin]:
            return NotImplemented
        name = f"{origin.__module__}.{origin.__qualname__}"
        if not self._lenient:
            raise Unsendable(_refusal(name))
        return Absent, (name,)


def _is_importable(origin: Any) -> bool:
    """Whether a function is what its name says; a class only has to have a place in a module."""
    module, path = getattr(origin, "__module__", None), origin.__qualname__
    if module in MAIN or "<locals>" in path:
        return False
    if isinstance(origin, type):
        return True
    found = sys.modules.get(module or "")
    for name in path.split("."):
        found = getattr(found, name, None)
    return found is origin


def _refusal(name: str) -> str:
    return f"{name} cannot be sent to another process: {REMEDY}"

"""Public names that are loaded on first use, so that importing a package stays fast."""

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

POSTPONED = {"scipy.stats": "entropy", "scipy.signal": "fftconvolve"}
"""What CVXPY imports for one function each; both together take as long as the rest of it."""


def on_first_use(package: str, home: Mapping[str, Sequence[str]], modules: Mapping[str, str] | None = None
                 ) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` (PEP 562) of a package of this name.

    home has the modules below the package and their public names, modules the names of public modules and where they
    are below it.
    """
    places = {name: module for module, names in home.items() for name in names}
    public = {} if modules is None else modules

    def load(name: str) -> Any:
        if name in places:
            return getattr(import_module(f"{package}.{places[name]}"), name)
        if name in public:
            return import_module(f"{package}.{public[name]}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: sorted([*places, *public])


def public_names(module: str) -> Callable[[], list[str]]:
    """Return `__dir__` of a module: ``__all__``, or what it defines itself without an underscore."""
    def names() -> list[str]:
        space = vars(sys.modules[module])
        own = [name for name, value in space.items() if getattr(value, "__module__", None) == module]
        return sorted(space.get("__all__", [name for name in own if not name.startswith("_")]))

    return names


def import_cvxpy() -> None:
    """Import CVXPY without the large packages of which it needs one function each (`POSTPONED`).

    No other thread may import these packages meanwhile: it would meet a stand-in.
    """
    stand_ins = {name: _stand_in(name, function) for name, function in POSTPONED.items() if name not in sys.modules}
    sys.modules.update(stand_ins)
    try:
        import_module("cvxpy")
    finally:
        for name in stand_ins:
            del sys.modules[name]


def _stand_in(name: str, function: str) -> ModuleType:
    """Return a module whose one function imports the true one when it is called."""

    def call(*arguments: Any, **keywords: Any) -> Any:
        return getattr(import_module(name), function)(*arguments, **keywords)

    module = ModuleType(name)
    setattr(module, function, call)
    return module

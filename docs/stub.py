"""Write `optid/__init__.pyi`, with which an editor completes public names and the arguments of every formulation.

python docs/stub.py            # writes the file
"""

import inspect
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import optid
from optid.identify.fitting import fit
from optid.registry import FORMULATIONS, find_entry_points

STUB = Path(optid.__file__).with_suffix(".pyi")

HEAD = '''"""Written by docs/stub.py from the signatures of the formulations; do not edit."""

# ruff: noqa
'''


def written(hint: Any, modules: set[str]) -> str:
    """Return a type as text and note the modules that it is from."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is type(None):
        return "None"
    if hint is Any:
        return "Any"
    if origin in (types.UnionType, Union):
        return " | ".join(written(one, modules) for one in arguments)
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, arguments))}]"
    if isinstance(hint, list):
        return "[" + ", ".join(written(one, modules) for one in hint) + "]"
    if hint is ...:
        return "..."
    if origin is not None:
        return f"{written(origin, modules)}[{', '.join(written(one, modules) for one in arguments)}]"
    if hint.__module__ == "builtins":
        return hint.__qualname__
    modules.add(hint.__module__)
    return f"{hint.__module__}.{hint.__qualname__}"


def parameters(function: Callable[..., Any], modules: set[str]) -> dict[str, str]:
    """Return the keyword-only parameters of a function as text, by name."""
    hints = get_type_hints(function)
    found = {}
    for name, one in inspect.signature(function).parameters.items():
        if one.kind is one.KEYWORD_ONLY:
            default = "" if one.default is one.empty else " = ..."
            found[name] = f"{name}: {written(hints.get(name, Any), modules)}{default}"
    return found


def stub() -> str:
    """Return the text of the stub."""
    modules: set[str] = {"collections.abc"}
    common = parameters(fit, modules)
    overloads = []
    record = {hint: written(hint, modules) for hint in (get_type_hints(fit)["data"],)}.popitem()[1]
    for name, point in sorted(find_entry_points(FORMULATIONS).items()):
        if point.module.split(".")[0] != "formulations":  # those of other packages
            continue
        own = parameters(point.load(), modules)
        default = " = ..." if name == inspect.signature(fit).parameters["formulation_name"].default else ""
        words = [*own.values(), *(text for key, text in common.items() if key not in own)]
        lines = ",\n    ".join([f"data: {record}", f'formulation_name: Literal["{name}"]{default}', "*", *words])
        overloads.append(f"@overload\ndef fit(\n    {lines},\n) -> Fit: ...\n")
    lines = ",\n    ".join([f"data: {record}", "formulation_name: str | collections.abc.Callable[..., Any]", "*",
                           *common.values(), "**structure: Any"])
    overloads.append(f"@overload\ndef fit(\n    {lines},\n) -> Fit: ...\n")
    names = [f"from optid.{home} import {one} as {one}" for home, several in optid._HOME.items() for one in several
             if one != "fit"]
    names.append("from optid.identify.search import identify as identify")
    for name, home in optid._MODULES.items():
        parent, _, module = f"optid.{home}".rpartition(".")
        if name != "identify":
            names.append(f"from {parent} import {module} as {name}")
    imports = [f"import {module}" for module in sorted(modules)]
    return "\n".join([HEAD, *imports, "from typing import Any, Literal, overload\n", *names, "\n__version__: str\n",
                      *overloads])


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
    print(STUB)

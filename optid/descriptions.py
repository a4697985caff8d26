"""Signatures and docstrings of registered functions, read from their source without importing it."""

import ast
import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_AS_IN = re.compile(r"[Aa]s in `(\w+)`")
_SHARED = re.compile(r"[Aa]rguments as in\s+`(?:([\w.]+)\.)?(\w+)`")
_TRANSPARENT = {"record_arguments", "steps", "subspace_steps"}  # decorators that keep signature and docstring
_NAMED = re.compile(r"Named variables: ([^.]*)\.")


@dataclass(frozen=True)
class Description:
    """Signature and docstring of a function."""

    signature: inspect.Signature  # defaults as values, expressions and annotations as text
    text: str  # the docstring
    siblings: Mapping[str, str]  # docstrings of the functions of the same module, by name

    @property
    def summary(self) -> str:
        """First paragraph of the docstring, without its markup."""
        text = re.sub(r"`+", "", self.text.split("\n\n")[0].replace("\n", " "))
        return text[7].upper() + text[8:] if text.startswith("Return ") else text

    @property
    def variables(self) -> tuple[str, ...]:
        """Names that constraints may use, from the sentence "Named variables: ..."."""
        found = _NAMED.search(" ".join(self.text.split()))
        return tuple(re.findall(r"``([^`]+)``", found[1])) if found else ()

    @property
    def options(self) -> dict[str, inspect.Parameter]:
        """The keyword-only parameters by name."""
        return {key: p for key, p in self.signature.parameters.items() if p.kind is p.KEYWORD_ONLY}

    def arguments(self) -> dict[str, str]:
        """Return {argument: its first sentence}.

        "As in `other`" is looked up in the module, "Arguments as in `other`", of all of them, also in another one.
        """
        return _arguments(self.text, self.siblings)


def describe(point: EntryPoint) -> Description:
    """Describe the function of an entry point; a module or function that cannot be found raises `ImportError`."""
    try:
        return _in_source(point.module, point.attr) or describe_function(point.load())
    except AttributeError as error:
        raise ImportError(str(error)) from error


def describe_function(function: Callable[..., Any]) -> Description:
    """Describe a function that is loaded."""
    module = vars(inspect.getmodule(function) or object())
    siblings = {name: inspect.getdoc(one) or "" for name, one in module.items() if inspect.isfunction(one)}
    return Description(inspect.signature(function), inspect.getdoc(function) or "", siblings)


def _in_source(module: str, name: str) -> Description | None:
    """Read a function from the source of its module; None where it is not there, or a decorator may change it."""
    functions = _functions(module)
    node = functions.get(name)
    decorators = [] if node is None else [d.func if isinstance(d, ast.Call) else d for d in node.decorator_list]
    if node is None or {ast.unparse(d) for d in decorators} - _TRANSPARENT:
        return None
    given = node.args
    plain = [*given.posonlyargs, *given.args]
    first = [None] * (len(plain) - len(given.defaults))
    kind = inspect.Parameter
    parameters = [*((a, kind.POSITIONAL_OR_KEYWORD, default) for a, default in zip(plain, [*first, *given.defaults])),
                  (given.vararg, kind.VAR_POSITIONAL, None),
                  *((a, kind.KEYWORD_ONLY, default) for a, default in zip(given.kwonlyargs, given.kw_defaults)),
                  (given.kwarg, kind.VAR_KEYWORD, None)]
    signature = inspect.Signature([_parameter(a, *rest) for a, *rest in parameters if a is not None])
    siblings = _docstrings(module)
    return Description(signature, siblings[name], siblings)


def _docstrings(module: str) -> dict[str, str]:
    return {name: ast.get_docstring(found) or "" for name, found in _functions(module).items()}


@cache
def _functions(module: str) -> dict[str, ast.FunctionDef]:
    spec = find_spec(module)
    if spec is None:
        raise ImportError(f"no module is called {module!r}")
    if spec.origin is None or not spec.origin.endswith(".py"):
        return {}
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    return {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}


def _parameter(argument: ast.arg, kind: Any, default: ast.expr | None) -> inspect.Parameter:
    annotation = inspect.Parameter.empty if argument.annotation is None else ast.unparse(argument.annotation)
    value: Any = inspect.Parameter.empty
    if default is not None:
        try:
            value = ast.literal_eval(default)
        except ValueError:  # an expression, such as np.inf
            value = ast.unparse(default)
    return inspect.Parameter(argument.arg, kind, default=value, annotation=annotation)


def _arguments(text: str, siblings: Mapping[str, str]) -> dict[str, str]:
    shared, found = _SHARED.search(text), {}
    if shared:
        others = _docstrings(shared[1]) if shared[1] else siblings
        found = _arguments(others.get(shared[2], ""), others)
    lines = text.splitlines()
    if "Args:" not in lines:
        return found
    entries = "\n".join(lines[lines.index("Args:") + 1 :]).split("\n\n")[0]
    for entry in re.split(r"\n(?=    \S)", "\n" + entries):
        key, colon, said = entry.strip().partition(":")
        if colon and key.isidentifier():
            said = " ".join(said.split())
            reference = _AS_IN.search(said)
            other = siblings.get(reference[1], "") if reference else ""
            if other and other != text:
                said = _arguments(other, siblings).get(key, said)
            found[key] = re.split(r"(?<=[a-z)])[.;] ", said)[0].replace("`", "").rstrip(".")
    return found

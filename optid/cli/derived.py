"""Options that a formulation brings along: one for each of its arguments, from its signature and its docstring."""

import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import typer
from rich.markup import escape

from optid.cli.terminal import Command
from optid.errors import LookupFailed

DEFAULT = "hammerstein_arx.exact"

_AS_IN = re.compile(r"[Aa]s in `(\w+)`")


class FittingCommand(Command):
    """A command that takes the arguments of the formulation named by ``--formulation`` as options."""

    spelled_out = DEFAULT

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse, after the options of the formulation have joined those of the command."""
        self.params = [p for p in self.params if not getattr(p, "derived", False)]
        name = chosen(args)
        if name != self.spelled_out:  # whose arguments all have options of their own: nothing need be loaded
            self.params += derived_options(name, {word for p in self.params for word in p.opts})
        try:
            rest = super().parse_args(ctx, args)
        except Exception as error:
            option = getattr(error, "option_name", None)
            if type(error).__name__ != "NoSuchOption" or not option or not option.startswith("--"):
                raise
            raise typer.BadParameter(unknown(name, option)) from None
        values = {p.name: ctx.params.pop(p.name) for p in self.params if getattr(p, "derived", False) and p.name}
        words = [f"{key}={_json(value)}" for key, value in values.items() if value not in (None, (), [])]
        ctx.params["settings"] = [*words, *(ctx.params.get("settings") or ())] or None
        return rest


def chosen(args: Sequence[str]) -> str:
    """Return the formulation that words of the command line name; the default where they name none."""
    found = DEFAULT
    for word, following in zip(args, [*args[1:], ""]):
        if word in ("--formulation", "-f"):
            found = following
        elif word.startswith("--formulation="):
            found = word.partition("=")[2]
    return found


def derived_options(name: str, taken: set[str]) -> list[Any]:
    """Return one option for every argument of a formulation that the command has no option for.

    Args:
        name: of the formulation; an unknown one has no options, the fit will say so.
        taken: option words of the command.
    """
    try:
        function = _function(name)
    except LookupFailed:
        return []
    about, parameters = described(function), []
    for key, parameter in _arguments(function).items():
        word = option_of(key)
        if word in taken or key == "constraints":
            continue
        flag = isinstance(parameter.default, bool) and parameter.annotation in (bool, "bool")
        hidden = parameter.default in (None, inspect.Parameter.empty, ()) or flag
        shown = "" if hidden else f" [default: {parameter.default}]"
        text = about.get(key, "")
        option = typer.Option(
            f"{word}/--no-{word[2:]}" if flag else word,
            metavar=None if flag else "VALUE...",
            help=escape(f"{text[:1].upper()}{text[1:]}.{shown}"),
            rich_help_panel=f"Arguments of {name}",
            show_default=False,
        )
        kind = Annotated[bool | None if flag else list[str] | None, option]
        parameters.append(inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind))
    return _options(parameters) if parameters else []


def _options(parameters: Sequence[inspect.Parameter]) -> list[Any]:
    """Let typer make options of a signature."""

    def shape(**_: Any) -> None: ...

    shape.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    shape.__annotations__ = {p.name: p.annotation for p in parameters}
    app = typer.Typer(add_completion=False)
    app.command()(shape)
    options = [p for p in typer.main.get_command(app).params if p.name in shape.__annotations__]
    for option in options:
        option.derived = True  # type: ignore[attr-defined]
    return options


def option_of(argument: str) -> str:
    """Return the option word of an argument."""
    return "--" + argument.replace("_", "-")


def unknown(name: str, option: str) -> str:
    """Say that a formulation has no such option, what it has, and which formulations have it."""
    from optid.registry import FORMULATIONS, registered

    key = option.removeprefix("--").partition("=")[0].replace("-", "_")
    having = []
    for other, point in sorted(registered(FORMULATIONS).items()):
        try:
            if key in _arguments(point.load()):
                having.append(other)
        except ImportError:  # a broken plug-in takes nothing away
            continue
    try:
        takes = " ".join(option_of(k) for k in _arguments(_function(name)) if k not in ("data", "constraints"))
    except LookupFailed as error:
        return f"there is no option {option}, and {error}"
    others = f" Formulations that do: {', '.join(having)}." if having else ""
    return f"formulation {name} takes no {option}; its own options are {takes}.{others}"


def described(function: Callable[..., Any]) -> dict[str, str]:
    """Return {argument: its first sentence} from a Google docstring; "as in `other`" is looked up in the module."""
    found: dict[str, str] = {}
    lines = (inspect.getdoc(function) or "").splitlines()
    if "Args:" not in lines:
        return found
    entries = "\n".join(lines[lines.index("Args:") + 1 :]).split("\n\n")[0]
    for entry in re.split(r"\n(?=    \S)", "\n" + entries):
        key, colon, text = entry.strip().partition(":")
        if colon and key.isidentifier():
            text = " ".join(text.split())
            reference = _AS_IN.search(text)
            other = getattr(inspect.getmodule(function), reference[1], None) if reference else None
            if other is not None and other is not function:
                text = described(other).get(key, text)
            found[key] = re.split(r"(?<=[a-z)])[.;] ", text)[0].replace("`", "").rstrip(".")
    return found


def _function(name: str) -> Callable[..., Any]:
    from optid.registry import formulation

    return formulation(name)[1]


def _arguments(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    parameters = inspect.signature(function).parameters
    return {key: p for key, p in parameters.items() if p.kind is inspect.Parameter.KEYWORD_ONLY}


def _json(words: Any) -> str:
    """Write the words of one option as the value of ``--set``: numbers and true as such, several as a list."""
    from optid.cli.arguments import listed, one_or_all, value

    if isinstance(words, bool):
        return json.dumps(words)
    return json.dumps(one_or_all([value(word) for word in listed(words) or []]))

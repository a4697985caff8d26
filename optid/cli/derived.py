"""Options for the arguments of a formulation, made from its signature and docstring."""

import inspect
import json
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from rich.markup import escape

from optid.cli.options import descriptions, option_of
from optid.cli.terminal import Command, exit_code, print_error
from optid.descriptions import describe
from optid.errors import LookupFailed
from optid.registry import FORMULATIONS, entry_point

DEFAULT = "hammerstein_arx.exact"


class FittingCommand(Command):
    """A command that takes the arguments of the formulation named by ``--formulation`` as options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse, after adding the options of the formulation to those of the command."""
        self.params = [p for p in self.params if not getattr(p, "derived", False)]
        name = find_formulation(args)
        try:
            entry_point(FORMULATIONS, name)
        except LookupFailed as error:
            raise _refused(error) from None
        self.params += derived_options(name, {word for p in self.params for word in p.opts})
        if "--help" in args and not any(word.partition("=")[0] in ("--formulation", "-f") for word in args):
            self.params += options_of_others({word for p in self.params for word in p.opts})
        try:
            rest = super().parse_args(ctx, args)
        except Exception as error:
            option = getattr(error, "option_name", None)
            if type(error).__name__ != "NoSuchOption" or not option or not option.startswith("--"):
                raise
            raise _refused(LookupFailed(unknown(name, option))) from None
        ctx.params["formulation"] = name
        values = {p.name: ctx.params.pop(p.name) for p in self.params if getattr(p, "derived", False) and p.name}
        words = [f"{key}={_json(key, value)}" for key, value in values.items() if value not in (None, (), [])]
        ctx.params["settings"] = [*words, *(ctx.params.get("settings") or ())] or None
        return rest


def _refused(error: LookupFailed) -> typer.Exit:
    print_error(error)
    return typer.Exit(exit_code(error))


def find_formulation(args: Sequence[str]) -> str:
    """Return the formulation named on the command line, or that of the example, or the default."""
    found = example = None
    for word, following in zip(args, [*args[1:], ""]):
        key, equals, value = word.partition("=")
        if key in ("--formulation", "-f"):
            found = value if equals else following
        elif key == "--example":
            example = value if equals else following
    if found is None and example is not None:
        from optid.examples import EXAMPLES

        found = EXAMPLES[example]().suggestion.get("formulation_name") if example in EXAMPLES else None
    return DEFAULT if found is None else found


def derived_options(name: str, taken: set[str]) -> list[Any]:
    """Return options for the arguments of a formulation for which the command has none (`taken` are its options)."""
    found = describe(entry_point(FORMULATIONS, name))
    about, parameters = found.arguments(), []
    for key, parameter in found.options.items():
        if option_of(key) in taken or key == "constraints":
            continue
        flag = isinstance(parameter.default, bool) and parameter.annotation in (bool, "bool")
        hidden = parameter.default in (None, inspect.Parameter.empty, ()) or flag
        shown = "" if hidden else f" [default: {parameter.default}]"
        parameters.append(_parameter(key, about.get(key, ""), shown, f"Arguments of {name}", flag))
    return _options(parameters)


def options_of_others(taken: set[str]) -> list[Any]:
    """Return options for the arguments that only other formulations have, for the help text."""
    texts: dict[str, str] = {}
    having: dict[str, list[str]] = {}
    for name, found in descriptions():
        about = found.arguments()
        for key in found.options:
            if key != "constraints" and option_of(key) not in taken:
                texts.setdefault(key, about.get(key, ""))
                having.setdefault(key, []).append(name)
    parameters = []
    for key, text in sorted(texts.items()):
        names = ", ".join(having[key][:2]) + (f" and {len(having[key]) - 2} more" if len(having[key]) > 2 else "")
        parameters.append(_parameter(key, text, f" [{names}]", "Arguments of other formulations"))
    return _options(parameters)


def _parameter(key: str, text: str, more: str, panel: str, flag: bool = False) -> inspect.Parameter:
    word = option_of(key)
    text = text if text.startswith("optid.") else text[:1].upper() + text[1:]
    option = typer.Option(
        f"{word}/--no-{word[2:]}" if flag else word, metavar=None if flag else "VALUE...", show_default=False,
        help=escape(f"{text}.{more}"), rich_help_panel=panel)
    kind: Any = bool | None if flag else list[str] | None
    return inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, option])


def _options(parameters: Sequence[inspect.Parameter]) -> list[Any]:

    def shape(**_: Any) -> None: ...

    shape.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    shape.__annotations__ = {p.name: p.annotation for p in parameters}
    app = typer.Typer(add_completion=False)
    app.command()(shape)
    options = [p for p in typer.main.get_command(app).params if p.name in shape.__annotations__]
    for option in options:
        option.derived = True  # type: ignore[attr-defined]
    return options


def unknown(name: str, option: str) -> str:
    """Return a message: the formulation has no such option; its options, and the formulations that have it."""
    key = option.removeprefix("--").partition("=")[0].replace("-", "_")
    having = [other for other, found in descriptions() if key in found.options]
    takes = " ".join(option_of(k) for k in describe(entry_point(FORMULATIONS, name)).options if k != "constraints")
    others = f" Formulations that do: {', '.join(having)}." if having else ""
    return f"formulation {name} takes no {option}; its own options are {takes}.{others}"


def _json(key: str, words: Any) -> str:
    """Write the words of the option of an argument as the value of ``--set``: JSON, several as a list."""
    from optid.cli.arguments import one_or_all, split_names, value

    if isinstance(words, bool):
        return json.dumps(words)
    whole = [value(word) for word in words]
    if len(whole) == 1 and isinstance(whole[0], list):  # JSON, which may be nested
        return words[0]
    found = split_names(words)
    if not found:
        raise typer.BadParameter(f"{option_of(key)} needs a value")
    return json.dumps(one_or_all([value(word) for word in found]))

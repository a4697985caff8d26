"""The terminal: options with several values, one message per error, warnings, tables and progress."""

import re
import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from threading import Timer
from typing import Any, Self

import typer
from rich import box
from rich.console import Console
from rich.segment import Segment
from rich.table import Table
from rich.text import Text
from typer.core import TyperCommand, TyperGroup

from optid.cli.encoding import readable_output
from optid.errors import DataWarning, InfeasibleError, OptidError, SolverFailed, SolverMissing, UnboundedError

PATIENCE = 2.0  # seconds of silence before progress is shown
FILES = "FILE..."  # metavar of options whose values are files

_FILE = re.compile(r".+\.(csv|tsv|txt|dat|asc|lvm|parquet|mat|npz|npy|xlsx|tdms|mf4|json)", re.IGNORECASE)
_NUMBER = re.compile(r"-[0-9.].*")


class Command(TyperCommand):
    """A command whose repeatable options take several values, and whose errors are one message and an exit code."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse, after `--inputs u1 u2` has become `--inputs u1 --inputs u2`."""
        several = {word: p.metavar == FILES for p in self.params if getattr(p, "multiple", False) for word in p.opts}
        return super().parse_args(ctx, spread(args, several))

    def invoke(self, ctx: Any) -> Any:
        """Run the command; an error becomes one message, with `--debug` a traceback."""
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if ctx.find_root().params.get("debug"):
                raise
            print_error(error)
            raise typer.Exit(exit_code(error)) from None


class CommandGroup(TyperGroup):
    """The commands; `--debug` may come anywhere."""

    def main(self, *args: Any, **settings: Any) -> Any:
        """Run the commands; the output needs no character that its encoding lacks."""
        with readable_output():
            return super().main(*args, **settings)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse, after `--debug` has been moved in front of the command."""
        rest = [word for word in args if word != "--debug"]
        return super().parse_args(ctx, ["--debug"] * (len(rest) < len(args)) + rest)


def spread(args: Sequence[str], several: dict[str, bool]) -> list[str]:
    """Repeat an option before each of its values.

    The values end at the next option, at ``--``, and at a data file, unless the option takes files.

    Args:
        args: words of the command line.
        several: options that take several values, and whether the values are files.

    Raises:
        typer.BadParameter: an option without a value.
    """
    result: list[str] = []
    option, waiting = "", False
    for position, word in enumerate([*args, "--"]):
        if word.startswith("-") and len(word) > 1 and not _NUMBER.fullmatch(word):
            if waiting:
                raise typer.BadParameter(f"{option} needs a value")
            if word == "--":
                return result + list(args[position:])
            name, equals, _ = word.partition("=")
            option = name if name in several else ""
            waiting = bool(option) and not equals
            if not waiting:
                result.append(word)
        elif option and (several[option] or waiting or not _FILE.fullmatch(word)):
            result += [option, word]
            waiting = False
        else:
            result.append(word)
            option = ""
    return result


STOPPED = 130
"""Exit code after Ctrl-C, by convention of shells."""


def exit_code(error: BaseException) -> int:
    """Return 2 for data, structure and names, 3 for no solution, 4 for the solver, 1 for a defect of optid."""
    if isinstance(error, InfeasibleError | UnboundedError):
        return 3
    if isinstance(error, SolverMissing | SolverFailed):
        return 4
    return 2 if isinstance(error, OptidError | OSError) else 1


class SafeConsole(Console):
    """A console that replaces control characters in texts: names and messages come from files."""

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        """Yield the segments with a visible character in place of each control character."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(_CONTROL.sub("\ufffd", segment.text), segment.style)


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters but tab and newline, and those that turn the direction of writing."""


def output() -> Console:
    """Return the console of results."""
    return SafeConsole(highlight=False)


def print_text(text: str | Text) -> None:
    """Print a result as it is: no wrapping, no markup."""
    output().print(Text(text) if isinstance(text, str) else text, soft_wrap=True)


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str | Text]], footer: str = "", *,
                firm: Collection[int] = (0,), right: Collection[int] = (), padding: Any = (0, 1)) -> None:
    """Print a table and a footer; of the column numbers, `firm` are never broken and `right` hold numbers."""
    table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold", pad_edge=False,
                  padding=padding)
    for c, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=c in firm, justify="right" if c in right else "left",
                         min_width=max(map(len, column.split())))
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    output().print(table)
    if footer:
        output().print(Text(footer, "dim"))


def highlight(text: str) -> Text:
    """Return a printed result with its headings and its verdict in colour."""
    result = Text(text)
    result.highlight_regex(r"(?m)^\S.*(?=\n[-=─═]{3})", "bold")
    result.highlight_regex(r"(?m)^[-=─═]{3,}$", "dim")
    result.highlight_regex(r"\boptimal \(proved\)", "bold green")
    result.highlight_regex(r"(?m)^The model on this record: good$|\bPASS$", "bold green")
    result.highlight_regex(r"(?m)^The model on this record: fair$", "bold blue")
    result.highlight_regex(r"(?m)^The model on this record: poor$", "bold yellow")
    result.highlight_regex(r"(?m)^The model on this record: useless$|\bFAIL$", "bold red")
    result.highlight_regex(r"\b(locally optimal|inaccurate|limit) \(not proved\)", "bold yellow")
    return result


def print_error(error: BaseException) -> None:
    """Print one message for an error, on the error stream."""
    text = str(error) or type(error).__name__
    if isinstance(error, OptidError):
        from optid.cli.options import in_options

        text = in_options(text)
    elif isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    if exit_code(error) == 1:
        text = f"{type(error).__name__}: {text}. This is a defect of optid; --debug prints the traceback"
    _tell("error", "bold red", text)


def note(text: str) -> None:
    """Print a warning, on the error stream."""
    _tell("note", "bold yellow", text)


def _tell(word: str, style: str, text: str) -> None:
    console = SafeConsole(stderr=True, highlight=False)
    console.print(Text.assemble((f"{word}: ", style), text), soft_wrap=not console.is_terminal)


@contextmanager
def capture_warnings() -> Iterator[list[str]]:
    """Collect the data warnings of a block, each sentence once; print them if an error ends the block."""
    heard: list[str] = []

    def keep(message: Any, category: type[Warning], *_: Any, **__: Any) -> None:
        if issubclass(category, DataWarning) and str(message) not in heard:
            heard.append(str(message))

    with warnings.catch_warnings(action="ignore"):
        warnings.simplefilter("always", DataWarning)
        warnings.showwarning = keep
        try:
            yield heard
        except Exception:
            for sentence in heard:
                note(sentence)
            raise


class Spinner:
    """Progress on the error stream after `PATIENCE` seconds; nothing where that is no terminal."""

    def __init__(self) -> None:
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        console = SafeConsole(stderr=True)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal)
        self._task = self._progress.add_task("")
        self._timer = Timer(PATIENCE, self._progress.start)
        self._timer.daemon = True

    def step(self, text: str) -> None:
        """Show the current step."""
        self._progress.update(self._task, description=text)

    def __enter__(self) -> Self:
        self._timer.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._timer.cancel()
        self._progress.stop()

"""The frame of a command: checks before it starts, progress and warnings, results and files."""

import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optid.cli.terminal import Waiting, coloured, hearing, note, say
from optid.errors import DataError
from optid.registry import CONSTRAINTS, FORMULATIONS, entry_point, render


def check_names(constraints: Iterable[str] | None, solver: str = "auto", formulation: str | None = None) -> None:
    """Refuse unknown constraints, solvers and formulations before heavy imports (`LookupFailed`, `SolverMissing`)."""
    if formulation is not None:
        entry_point(FORMULATIONS, formulation)
    for word in constraints or ():
        if word != "none":
            entry_point(CONSTRAINTS, word.partition(":")[0])
    if solver != "auto":
        from optid.backends.choice import find

        find(solver)


def reading_for(model: Any, how: Mapping[str, Any]) -> dict[str, Any]:
    """Return the reading options with the channels of a model, and its sampling time where it has a unit.

    A model of a record without a clock counts samples: another record of its plant is read as that one was.
    """
    from optid.cli.arguments import as_modelled

    counts_samples = not model.time_unit and model.dt == 1
    return as_modelled(how, model) | ({"dt": how["dt"]} if counts_samples else {})


def check_folders(*paths: Path | None) -> None:
    """Refuse files that cannot be written (`DataError`) before any work is done."""
    for path in (path for path in paths if path is not None):
        folder = path.absolute().parent
        if not folder.is_dir():
            raise DataError(f"{path} cannot be written: there is no folder {folder}")
        if path.is_dir():
            raise DataError(f"{path} cannot be written: it is a folder; name a file in it")
        if not os.access(path if path.exists() else folder, os.W_OK):
            raise DataError(f"{path} cannot be written: {'it' if path.exists() else f'folder {folder}'} is "
                            "read-only; give a file in another folder")


class Work(Waiting):
    """The progress of a command, and the text that it prints at the end.

    Attributes:
        text: the result.
        heard: warnings for the user, which the result may already contain.
    """

    text = ""
    heard: list[str]

    def draw(self, figure: Callable[[], Any], path: Path | None) -> None:
        """Write a figure of matplotlib if a path is given; `DataError` for an unknown ending."""
        if path is not None:
            self.step("drawing")
            try:
                figure().savefig(path, dpi=150)
            except ValueError as error:
                raise DataError(f"{path}: {error}") from None

    def page(self, result: Any, path: Path | None, *more: Any) -> None:
        """Write the report of a result if a path is given; more arguments are those of its renderer."""
        if path is not None:
            self.step("writing the report")
            render(result, "page", path, *more, command=command_line())


@contextmanager
def working(**written: Path | None) -> Iterator[Work]:
    """Give a command its `Work`; then print its result, the warnings that this does not contain, and the files written.

    The files are given by their content, such as ``report=path``; `DataError` where one cannot be written.
    """
    check_folders(*written.values())
    with hearing() as heard, Work() as work:
        work.heard = heard
        work.step("reading")
        yield work
    text = work.text.replace("pass dt= ", "pass --dt ")  # a finding of the record names the argument of Python
    say(coloured(text))
    said = " ".join(work.text.split())
    for sentence in heard:
        if " ".join(sentence.split()) not in said:
            note(sentence)
    for what, path in written.items():
        if path is not None:
            say(f"{what} written to {path}")


def command_line() -> str:
    """Return the command line of this run, for a report."""
    return shlex.join(["optid", *sys.argv[1:]])

"""What surrounds the work of a command: refusals before it, notes and progress, and what it leaves behind."""

import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optid.cli.terminal import Waiting, coloured, hearing, note, say
from optid.errors import DataError
from optid.registry import CONSTRAINTS, FORMULATIONS, entry_point, render


def check_names(constraints: Iterable[str] | None, solver: str = "auto", formulation: str | None = None) -> None:
    """Refuse names of formulations, constraints and solvers that do not exist, before any heavy import.

    Raises:
        LookupFailed: with the nearest name.
        SolverMissing: a solver that is not installed.
    """
    if formulation is not None:
        entry_point(FORMULATIONS, formulation)
    for word in constraints or ():
        if word != "none":
            entry_point(CONSTRAINTS, word.partition(":")[0])
    if solver != "auto":
        from optid.backends.choice import find

        find(solver)


def check_folders(*paths: Path | None) -> None:
    """Refuse a file that cannot be written, before any work is done.

    Raises:
        DataError: its folder is not there or takes no files, or it is a folder itself.
    """
    for path in (path for path in paths if path is not None):
        folder = path.absolute().parent
        if not folder.is_dir():
            raise DataError(f"{path} cannot be written: there is no folder {folder}")
        if path.is_dir():
            raise DataError(f"{path} cannot be written: it is a folder; name a file in it")
        if not os.access(path if path.exists() else folder, os.W_OK):
            raise DataError(f"{path} cannot be written: {'it' if path.exists() else f'folder {folder}'} is read-only "
                            "here; give a file in another folder")


class Work(Waiting):
    """The work of a command: its progress, and the text that it prints at the end.

    Attributes:
        text: the result.
        heard: sentences for the user that the result may hold already.
    """

    text = ""
    heard: list[str]

    def draw(self, figure: Callable[[], Any], path: Path | None) -> None:
        """Write a figure of matplotlib where one was asked for.

        Raises:
            DataError: an ending that matplotlib does not know.
        """
        if path is not None:
            self.step("drawing")
            try:
                figure().savefig(path, dpi=150)
            except ValueError as error:
                raise DataError(f"{path}: {error}") from None

    def page(self, result: Any, path: Path | None, *more: Any) -> None:
        """Write the page of a result where one was asked for; more arguments are those of its renderer."""
        if path is not None:
            self.step("writing the report")
            render(result, "page", path, *more, command=command_line())


@contextmanager
def working(**written: Path | None) -> Iterator[Work]:
    """Give a command its `Work`; print its result, the notes that this does not carry, and what was written where.

    Args:
        written: files by what they hold, e.g. ``report=path``; None for those that were not asked for.

    Raises:
        DataError: one of the files cannot be written.
    """
    check_folders(*written.values())
    with hearing() as heard, Work() as work:
        work.heard = heard
        work.step("reading")
        yield work
    say(coloured(work.text))
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

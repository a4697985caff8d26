"""The frame of a command: checks before it starts, progress and warnings, results and files."""

import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from optid.cli.terminal import Spinner, capture_warnings, highlight, note, print_text
from optid.errors import DataError, StructureError
from optid.registry import CONSTRAINTS, FORMULATIONS, entry_point, render


def check_names(constraints: Iterable[str] | None, solver: str = "auto", formulation: str | None = None) -> None:
    """Refuse unknown constraints, solvers and formulations before heavy imports (`LookupFailed`, `SolverMissing`)."""
    if formulation is not None:
        entry_point(FORMULATIONS, formulation)
    for word in constraints or ():
        if word != "none":
            entry_point(CONSTRAINTS, word.partition(":")[0])
    named = solver_choice(solver)
    for word in [named] if isinstance(named, str) else named.values():
        if word != "auto":
            from optid.backends.choice import find

            find(word)


def solver_choice(text: str) -> str | dict[str, str]:
    """Read a solver, or "STEP=SOLVER,..." for steps of a formulation; a step twice is a `StructureError`."""
    if "=" not in text:
        return text
    found: dict[str, str] = {}
    for step, _, word in (part.partition("=") for part in text.split(",")):
        if step.strip() in found:
            raise StructureError(f"--solver {text!r} names the step {step.strip()!r} twice")
        found[step.strip()] = word.strip()
    return found


def reading_for(model: Any, how: Mapping[str, Any]) -> dict[str, Any]:
    """Return the reading options with the channels of a model, and its sampling time where it has a unit.

    A model of a record without a clock counts samples: another record of its plant is read as that one was.
    """
    from optid.cli.arguments import options_of_model

    counts_samples = not model.time_unit and model.dt == 1
    return options_of_model(how, model) | ({"dt": how["dt"]} if counts_samples else {})


def check_folders(*paths: Path | None, writable: bool = True) -> None:
    """Refuse files without a folder, and read-only ones if `writable` (`DataError`), before any work is done."""
    for path in (path for path in paths if path is not None):
        folder = path.absolute().parent
        if not folder.is_dir():
            raise DataError(f"{path} cannot be written: there is no folder {folder}")
        if path.is_dir():
            raise DataError(f"{path} cannot be written: it is a folder; name a file in it")
        if writable and not os.access(path if path.exists() else folder, os.W_OK):
            raise DataError(f"{path} cannot be written: {'it' if path.exists() else f'folder {folder}'} is "
                            "read-only; give a file in another folder")


def save_model(model: Any, path: Path, record: Mapping[str, Any] | None = None) -> None:
    """Write a model as JSON, or by the ending .fmu, .st or .c as an FMU, structured text or C."""
    from optid.models.generated_code import KEYWORDS, ST_KEYWORDS, identifiers

    name = identifiers([path.stem], "model", KEYWORDS | ST_KEYWORDS)[0]
    if path.suffix in (".fmu", ".st", ".c"):
        getattr(model, f"to_{path.suffix[1:]}")(path, name)
    else:
        model.save(path, record)


class Work(Spinner):
    """The progress of a command, and what it prints at the end, also where an error ends it.

    Attributes:
        text: the result.
        heard: warnings for the user, which the result may already contain.
        written: files by their content, such as ``{"model": path}``.
    """

    def __init__(self) -> None:
        super().__init__()
        self.text, self.heard, self.written = "", [], {}

    def write(self, what: str, path: Path | None, write: Callable[[Path], Any]) -> None:
        """Write a file by a function if a path is given."""
        if path is not None:
            self.step(f"writing the {what}")
            write(path)
            self.written[what] = path

    def draw(self, figure: Callable[[], Any], path: Path | None) -> None:
        """Write a figure of matplotlib if a path is given; `DataError` for an unknown ending."""
        def save(path: Path) -> None:
            try:
                figure().savefig(path, dpi=150)
            except ValueError as error:
                raise DataError(f"{path}: {error}") from None

        self.write("picture", path, save)

    def page(self, result: Any, path: Path | None, *more: Any, **options: Any) -> None:
        """Write the report of a result if a path is given; more arguments are those of its renderer."""
        self.write("report", path, lambda path: render(result, "page", path, *more, command=command_line(), **options))

    def print(self) -> None:
        """Print the result, the warnings that it does not contain, and the files written."""
        if self.text:
            print_text(highlight(self.text))
        said = " ".join(self.text.split())
        for sentence in self.heard:
            if " ".join(sentence.split()) not in said:
                note(sentence)
        for what, path in self.written.items():
            print_text(f"{what} written to {path}")


@contextmanager
def working(*files: Path | None) -> Iterator[Work]:
    """Give a command its `Work`, and print that at the end; `DataError` where one of the files cannot be written."""
    check_folders(*files)
    work = Work()
    try:
        with capture_warnings() as work.heard, work:
            work.step("reading")
            yield work
    except BaseException:
        work.heard = []  # printed already
        work.print()
        raise
    work.print()


def command_line() -> str:
    """Return the command line of this run, for a report."""
    return shlex.join(["optid", *sys.argv[1:]])

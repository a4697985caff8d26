"""The commands of studies: run, report, export, systems, schema."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.text import Text
from typer.core import TyperGroup

from optid.cli.listings import systems
from optid.cli.options import File, Words, register
from optid.cli.results import check_folders, command_line
from optid.cli.terminal import STOPPED, Command, SafeConsole, print_text

study = typer.Typer(cls=TyperGroup, no_args_is_help=True, rich_markup_mode="rich",
                    help="Compare formulations and solvers on your data: run, report and export a study.")

NOTHING_SOLVED = 4  # exit code of a run in which no cell has an answer, as where one fit fails in its solver


def run(file: File = None, example: bool = False, db: File = None, workers: int | None = None,
        scheduler: str | None = None, accept_changed_data: bool = False, retry: Words = None, export: File = None,
        dry_run: bool = False) -> None:
    """Run a study, or resume an interrupted one.

    Example: optid study run study.toml --db study.sqlite

    Files:
        file (STUDY.toml): The study file.
    Options:
        example: Run a built-in study, which takes half a minute.
        db (FILE): Database of the results. [dim]name of the study file with .sqlite[/]
        workers (--workers -w N): Number of worker processes. [dim]one per core[/]
        scheduler (ADDRESS): Run on a Dask cluster (tcp://host:8786).
        retry (OUTCOME...): Rerun the cells with these outcomes, such as 'time limit'.
        export (FILE): Write the results at the end (.parquet, .csv).
        dry_run: List the cells that would be run, without running them.
    """
    from optid.errors import StudyError
    from optid.studies.execution import running
    from optid.studies.storage import export as exporting
    from optid.studies.study import Study

    if (file is None) != example:
        raise StudyError("give a study file, or --example for a built-in study" + (", not both" if example else ""))
    described = Study.example() if file is None else Study.from_toml(file)
    db = db or Path(f"{file.stem if file is not None else 'example'}.sqlite")
    check_folders(db, export)
    if export is not None:
        exporting.check_target(export)
    if dry_run:
        _plan(described, db, accept_changed_data=accept_changed_data, retry=retry or ())
        return
    with _executor(scheduler) as executor, follow_progress(db, described) as follow:
        running.run(described, db, workers=workers, executor=executor, progress=follow,
                    accept_changed_data=accept_changed_data, retry=retry or ())
    solved = _summary(db, described.name)
    if export is not None:
        count = exporting.export(db, export, described.name)
        print_text(f"{count} rows written to {export}")
    if not solved:
        raise typer.Exit(NOTHING_SOLVED)


@contextmanager
def _executor(scheduler: str | None) -> Iterator[Any]:
    """Give the executor of a Dask cluster; None where none is asked for."""
    if scheduler is None:
        yield None
        return
    from optid.data.clusters import connect_cluster

    with connect_cluster(scheduler) as client:
        yield client.get_executor()


def report(db: Path, page: File = None, title: str | None = None, accuracy: float | None = None, clock: str = "solve"
           ) -> None:
    """Print the verdict of a study and write its report.

    Example: optid study report study.sqlite -o study.html

    Options:
        page (--report -o FILE): Write a self-contained HTML report.
        accuracy: Relative accuracy of the comparison. [dim]that of most cells[/]
        clock (--time WORD): Time compared: solve (cold), fit (whole fit) or warm.
    """
    from optid.studies.storage.store import rows_of_one
    from optid.studies.verdicts.verdict import conclude

    check_folders(page)
    verdict = conclude(rows_of_one(db, title), accuracy=accuracy, time=clock)
    print_text(str(verdict))
    _print_superseded(db, title)
    if page is not None:
        verdict.report(page, command=command_line())
        print_text(f"report written to {page}")


def _print_superseded(db: Path, study: str | None) -> None:
    """Print the number of superseded rows in a database."""
    from optid.studies.storage.store import Store

    if db.suffix == ".parquet":
        return
    with Store(db) as store:
        count = sum(store.count_superseded(study).values())
    if count:
        rows, stay = ("row", "is") if count == 1 else ("rows", "are")
        print_text(Text(f"{count:,} {rows} of former entries, data, settings or versions, or of cells that were run "
                        f"again, {stay} kept in {db} (table superseded) and in no report", "dim"))


def export(db: Path, target: Path, title: str | None = None) -> None:
    """Export the results of one or all studies of a database to a Parquet or CSV file.

    Example: optid study export study.sqlite rows.parquet

    Files:
        target (FILE): A .parquet or .csv file.
    """
    from optid.studies.storage import export as exporting
    from optid.studies.storage.store import read_rows, rows_of_one

    check_folders(target)
    rows = rows_of_one(db, title) if title is not None else read_rows(db)
    count = exporting.export(db, target, title)
    studies = len(set(rows["study"]))
    print_text(f"{count} rows{f' of {studies} studies' if studies > 1 else ''} written to {target}")


def problems(db: Path, out: Path, title: str | None = None) -> None:
    """Export the convex programmes of a study in standard form (NPZ, MPS), with a script that solves them.

    Example: optid study problems study.sqlite --out problems

    Options:
        out (-o FOLDER): Folder for the problems.
    """
    from optid.studies.problem_set import write_problems

    lines = write_problems(db, out, title)
    kinds = Counter(line["kind"] for line in lines)
    listed = ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items())) or "none is convex"
    print_text(f"{len(lines)} problems written to {out} ({listed}); solve_problems.py there solves them without optid")


def schema() -> None:
    """Print the columns of the database as Markdown."""
    from optid.studies.storage.rows import markdown

    typer.echo(markdown(), nl=False)


for function in (run, report, export, problems, systems, schema):
    register(study, function, Command)


@contextmanager
def follow_progress(db: Path | None, described: Any = None) -> Iterator[Any]:
    """Show a progress bar on the error stream and report the cells to run; Ctrl-C keeps the finished rows.

    `db` is the database if the user named one, `described` the study whose superseded rows are reported.
    """
    from rich import progress

    from optid.studies.execution.running import describe_previous_run
    from optid.studies.storage.store import Store

    console = SafeConsole(stderr=True)
    bar = progress.Progress(
        progress.TextColumn("{task.description}"), progress.BarColumn(), progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(), progress.TimeRemainingColumn(), console=console, transient=True,
        disable=not console.is_terminal)
    task = bar.add_task("cells", total=None)
    counts = [0, 0]

    def follow(done: int, total: int, row: dict[str, Any] | None) -> None:
        counts[:] = done, total
        if row is None and db is not None and done:
            left = f"{total - done:,} to run" if done < total else "nothing is left to run"
            print_text(f"{done:,} of {total:,} cells are in {db} already; {left}")
        elif row is None and db is not None:
            print_text(f"{total:,} cells to run")
        if row is None and db is not None and described is not None:
            with Store(db) as store:
                former = describe_previous_run(store, described)
            if former:
                print_text(former)
        bar.update(task, completed=done, total=total, description=_now(row))

    try:
        with bar:
            yield follow
    except KeyboardInterrupt:
        kept = f"{counts[0]:,} of {counts[1]:,} cells are in {db}; the same command goes on from there"
        print_text(f"stopped: {kept}" if db is not None else "stopped")
        raise typer.Exit(STOPPED) from None


def _now(row: dict[str, Any] | None) -> str:
    if row is None:
        return "cells"
    from rich.markup import escape

    from optid.phrases import short

    formulation, solver = (escape(short(row[name], 28)) for name in ("formulation", "solver"))
    return f"[dim]{formulation} · {solver}: {row['status_verified'] or row['outcome']}[/]"


def _plan(described: Any, db: Path, **settings: Any) -> None:
    from optid.studies.execution import running

    every, left, former = running.plan(described, db, **settings)
    print_text(f"{described.name}: {len(described.data)} data, {len(described.formulations)} formulations, "
               f"{len(described.solvers)} solvers; {len(every):,} cells, {len(left):,} of them to run")
    for refusal, count in Counter(cell.refusal for cell in every if cell.refusal).items():
        print_text(f"{count:,} cells cannot be run here: {refusal}")
    if former:
        print_text(former)


def _summary(db: Path, name: str) -> bool:
    """Print the verdict of a study and how to get its page; return whether any cell has an answer."""
    import shlex

    import numpy as np

    from optid.program.solution import Status
    from optid.studies.storage.store import read_rows
    from optid.studies.verdicts.verdict import conclude

    every = read_rows(db)
    rows = {column: values[every["study"] == name] for column, values in every.items()}
    print_text(str(conclude(rows)))
    words = ["optid", "study", "report", str(db), "-o", f"{db.stem}.html"]
    words += ["--study", name] if len(rows["key"]) < len(every["key"]) else []
    print_text(Text(shlex.join(words), "dim"))
    answers = rows["reached"] | np.isin(rows["status_verified"], (str(Status.INFEASIBLE), str(Status.UNBOUNDED)))
    return bool(answers.any())

"""The command `optid identify`: from a record to a structure and a model."""

from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.options import MODEL, RECORD, RESULT, SOLVER, Example, Files, Report, Seed, reads_a_record
from optid.cli.results import command_line, conclude
from optid.cli.startup import check_constraints, check_solver
from optid.cli.terminal import FILES, Waiting, hearing
from optid.lazy import import_cvxpy

BUDGET = 60.0


@reads_a_record
def identify(
    data: Files = None,
    example: Example = None,
    *,
    how: dict[str, Any],
    budget: Annotated[
        float, typer.Option("--budget", metavar="SECONDS", rich_help_panel=MODEL, help="Time of the search.")
    ] = BUDGET,
    horizon: Annotated[
        int | None,
        typer.Option(
            "--horizon",
            metavar="N",
            rich_help_panel=MODEL,
            help="Compare predictions so many samples ahead. [dim]free runs[/]",
        ),
    ] = None,
    classes: Annotated[
        list[str] | None,
        typer.Option(
            "--classes",
            metavar="NAME...",
            rich_help_panel=MODEL,
            help="Classes of models to be tried: linear, 'input functions', feedback, 'latent signals'. [dim]all[/]",
        ),
    ] = None,
    constraint: Annotated[
        list[str] | None,
        typer.Option(
            "--constraint", "-c", metavar="NAME:VALUE...", rich_help_panel=MODEL, help="What every model has to obey."
        ),
    ] = None,
    solver: Annotated[
        str, typer.Option("--solver", "-s", metavar="NAME", rich_help_panel=SOLVER, help="See optid solvers.")
    ] = "auto",
    workers: Annotated[
        int | None,
        typer.Option("--workers", metavar="N", rich_help_panel=SOLVER, help="Processes. [dim]one per processor[/]"),
    ] = None,
    split: Annotated[
        float | None,
        typer.Option(
            "--split", metavar="SHARE", rich_help_panel=RECORD, help="Search on this share, validate on the rest."
        ),
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option("--test", metavar=FILES, rich_help_panel=RECORD, help="Validate on these files.")
    ] = None,
    seed: Seed = 0,
    report: Report = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", "-m", metavar="FILE", rich_help_panel=RESULT, help="Write the model (JSON)."),
    ] = None,
) -> None:
    """Find the structure of a record by cross-validation, and fit it: formulation, delay, orders, functions.

    Example: optid identify data.csv --inputs u --outputs y --dt 0.1 --report report.html
    """
    search(
        data, example, how, seed, split, test, constraint, solver, model, report, budget=budget, horizon=horizon,
        workers=workers, **({"classes": classes} if classes else {}),
    )


def search(
    data: Any, example: str | None, how: dict[str, Any], seed: int, split: float | None, test: list[str] | None,
    constraint: list[str] | None, solver: str, model: Path | None, report: Path | None, **settings: Any,
) -> None:
    """Search, print what was found, and write what was asked for; settings are those of `optid.identify`."""
    check_constraints(constraint)
    check_solver(solver)
    from optid.cli import arguments as words

    words.check_folders(model, report)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        record: Any = words.record(data, how, example, seed)[0]
        import_cvxpy()
        from optid.identify.search import identify as find
        from optid.identify.validation.checks import validate as check

        held_out: Any = words.read_record(test, how) if test else None
        if split is not None and held_out is None:
            record, held_out = words.split_record(record, split)
        found = find(record, constraints=constraint or (), solver=solver, progress=waiting.step, **settings)
        text = str(found)
        if held_out is not None:
            waiting.step("validating")
            text += f"\n\n{held_out.n_samples} samples held out of the search\n{check(found.model, held_out)}"
        if model is not None:
            found.model.save(model)
        if report is not None:
            from optid.show.report import write_search

            waiting.step("writing the report")
            write_search(found, report, held_out, command=command_line())
    conclude(text, heard, model=model, report=report)

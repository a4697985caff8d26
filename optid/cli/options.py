"""Options that several commands share."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

RECORD, MODEL, SOLVER, RESULT = "The record", "The model", "The solver", "The result"

Files = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="DATA...", help="CSV, Parquet, MAT, NPZ or npy files, one experiment each.", show_default=False
    ),
]
Example = Annotated[
    str | None,
    typer.Option(
        "--example", metavar="NAME", rich_help_panel=RECORD, help="A built-in record instead: see optid examples."
    ),
]
Seed = Annotated[int, typer.Option("--seed", rich_help_panel=RECORD, help="Seed of the noise of an example.")]
Inputs = Annotated[
    list[str] | None,
    typer.Option(
        "--inputs",
        "-u",
        metavar="NAME...",
        rich_help_panel=RECORD,
        help="Columns of the inputs. [dim]u, u1, u2, ...[/]",
    ),
]
Outputs = Annotated[
    list[str] | None,
    typer.Option(
        "--outputs",
        "-y",
        metavar="NAME...",
        rich_help_panel=RECORD,
        help="Columns of the outputs. [dim]y, y1, y2, ...[/]",
    ),
]
Dt = Annotated[
    float | None,
    typer.Option("--dt", rich_help_panel=RECORD, help="Sampling time; from the time stamps where there are some."),
]
Time = Annotated[
    str | None,
    typer.Option(
        "--time",
        metavar="NAME",
        rich_help_panel=RECORD,
        help="Column of time stamps; 'none' ignores them. [dim]t, time[/]",
    ),
]
Runs = Annotated[
    str | None,
    typer.Option(
        "--experiment", metavar="NAME", rich_help_panel=RECORD, help="Column that names the experiment of each row."
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        "--columns", metavar="NAME...", rich_help_panel=RECORD, help="Names of the columns of a file without a header."
    ),
]
Delimiter = Annotated[str, typer.Option("--delimiter", rich_help_panel=RECORD, help="Between the cells of a CSV file.")]
Decimal = Annotated[str, typer.Option("--decimal", rich_help_panel=RECORD, help="Decimal mark of a CSV file.")]
Report = Annotated[
    Path | None,
    typer.Option("--report", "-o", metavar="FILE", rich_help_panel=RESULT, help="Write a self-contained HTML report."),
]
Picture = Annotated[
    Path | None,
    typer.Option("--picture", "-p", metavar="FILE", rich_help_panel=RESULT, help="Write the picture (PNG, PDF)."),
]
FeedbackBasis = Annotated[
    list[str] | None,
    typer.Option(
        "--feedback-basis",
        metavar="NAME:SIZE...",
        rich_help_panel=MODEL,
        help="Basis of the functions of the outputs that are fed back, one or one per output.",
    ),
]

Load = Annotated[
    list[str] | None,
    typer.Option(
        "--load",
        "--process",
        metavar="NAME=E1,E2,...",
        rich_help_panel=MODEL,
        help="Direction of a process fault: one number per state, or what it does to outputs, as leak=y1:-1.",
    ),
]
Disturbance = Annotated[
    list[str] | None,
    typer.Option(
        "--disturbance",
        metavar="NAME",
        rich_help_panel=MODEL,
        help="An input, an output or a --process direction that may do anything without being a fault.",
    ),
]
StateJump = Annotated[
    bool, typer.Option("--state-jump/--no-state-jump", rich_help_panel=MODEL, help="May the state jump?")
]

READING: dict[str, tuple[Any, Any]] = {
    "inputs": (Inputs, None),
    "outputs": (Outputs, None),
    "dt": (Dt, None),
    "time": (Time, None),
    "experiment": (Runs, None),
    "columns": (Columns, None),
    "delimiter": (Delimiter, ","),
    "decimal": (Decimal, "."),
}
"""How the files of a record are read: the type of each option and its default."""


def reads_a_record(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `READING` in place of its keyword-only parameter `how`, which gets them all.

    `optid.cli.arguments.record` turns them into a record.
    """
    keyword = inspect.Parameter.KEYWORD_ONLY
    options = [inspect.Parameter(key, keyword, default=d, annotation=kind) for key, (kind, d) in READING.items()]
    parameters = []
    for parameter in inspect.signature(command).parameters.values():
        parameters += options if parameter.name == "how" else [parameter]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        command(how={key: given.pop(key) for key in READING}, **given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run

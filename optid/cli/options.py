"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

RECORD, MODEL, SOLVER, RESULT = "The record", "The model", "The solver", "The result"

Files = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="DATA...", help="CSV, Parquet, MAT, NPZ or npy files, one experiment each.", show_default=False
    ),
]
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

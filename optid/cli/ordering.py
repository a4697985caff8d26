"""The command `optid order`: how many states and lags a record asks for, and why."""

from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.options import MODEL, RECORD, RESULT, Columns, Decimal, Delimiter, Dt, Files, Inputs, Outputs, Runs, Time
from optid.cli.terminal import Waiting, coloured, hearing, note, say


def order(
    data: Files = None,
    example: Annotated[
        str | None,
        typer.Option(
            "--example", metavar="NAME", rich_help_panel=RECORD, help="A built-in record instead: see optid examples."
        ),
    ] = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    dt: Dt = None,
    time: Time = None,
    experiment: Runs = None,
    columns: Columns = None,
    delimiter: Delimiter = ",",
    decimal: Decimal = ".",
    basis: Annotated[
        list[str] | None,
        typer.Option(
            "--basis",
            "-b",
            metavar="NAME:SIZE...",
            rich_help_panel=MODEL,
            help="Basis of the nonlinearity, one or one per input, e.g. polynomial:4. [dim]linear[/]",
        ),
    ] = None,
    feedback_basis: Annotated[
        list[str] | None,
        typer.Option(
            "--feedback-basis",
            metavar="NAME:SIZE...",
            rich_help_panel=MODEL,
            help="Basis of the functions of the outputs that are fed back, one or one per output.",
        ),
    ] = None,
    block_rows: Annotated[
        int | None,
        typer.Option(
            "--block-rows", rich_help_panel=MODEL, help="Future block rows, above the order. [dim]10, or fewer[/]"
        ),
    ] = None,
    nx: Annotated[
        int | None, typer.Option("--nx", rich_help_panel=MODEL, help="Largest number of states of interest.")
    ] = None,
    na: Annotated[int, typer.Option("--na", rich_help_panel=MODEL, help="Most output lags compared.")] = 8,
    nb: Annotated[int, typer.Option("--nb", rich_help_panel=MODEL, help="Most input lags compared.")] = 6,
    nk: Annotated[int, typer.Option("--nk", rich_help_panel=MODEL, help="Largest delay compared.")] = 8,
    holdout: Annotated[
        float, typer.Option("--holdout", metavar="SHARE", rich_help_panel=MODEL, help="Share that is held out.")
    ] = 0.3,
    level: Annotated[
        float | None,
        typer.Option(
            "--level", rich_help_panel=MODEL, help="Probability of rejecting the true order. [dim]at most 0.01[/]"
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", rich_help_panel=RECORD, help="Seed of the noise of an example.")] = 0,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", "-p", metavar="FILE", rich_help_panel=RESULT, help="Write the picture (PNG, PDF)."),
    ] = None,
) -> None:
    """Find the order of a record: singular values, thresholds, criteria, a recommendation with its reasons.

    Example: optid order data.csv --inputs u1 u2 --outputs y1 y2 --picture order.png
    """
    from optid.cli import arguments as words
    from optid.errors import DataError
    from optid.examples import example as built_in
    from optid.model_order import order as study

    words.check_folders(picture)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        if example is not None and data:
            raise DataError("give data files or --example, not both")
        how = {"inputs": inputs, "outputs": outputs, "dt": dt, "time": time, "experiment": experiment,
               "columns": columns, "delimiter": delimiter, "decimal": decimal}
        record: Any = words.read_record(data, how) if example is None else built_in(example, seed=seed).data
        waiting.step("comparing orders")
        found = study(
            record,
            basis=words.one_or_all(words.listed(basis)),
            feedback_basis=words.one_or_all(words.listed(feedback_basis)),
            block_rows=block_rows,
            nx=nx,
            na=na,
            nb=nb,
            nk=nk,
            holdout=holdout,
            level=level,
        )
        if picture is not None:
            waiting.step("drawing")
            try:
                found.picture().savefig(picture, dpi=150)
            except ValueError as error:  # an ending that matplotlib does not know
                raise DataError(f"{picture}: {error}") from None
    text = str(found)
    say(coloured(text))
    said = " ".join(text.split())
    for sentence in heard:
        if " ".join(sentence.split()) not in said:
            note(sentence)
    if picture is not None:
        say(f"picture written to {picture}")

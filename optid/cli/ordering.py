"""The command `optid order`: how many states and lags a record asks for, and why."""

from typing import Annotated, Any

import typer

from optid.cli.options import MODEL, Example, FeedbackBasis, Files, Picture, Seed, reads_a_record
from optid.cli.results import conclude, save_picture
from optid.cli.terminal import Waiting, hearing


@reads_a_record
def order(
    data: Files = None,
    example: Example = None,
    *,
    how: dict[str, Any],
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
    feedback_basis: FeedbackBasis = None,
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
    seed: Seed = 0,
    picture: Picture = None,
) -> None:
    """Find the order of a record: singular values, thresholds, criteria, a recommendation with its reasons.

    Example: optid order data.csv --inputs u1 u2 --outputs y1 y2 --picture order.png
    """
    from optid.cli import arguments as words
    from optid.identify.order import order as study

    words.check_folders(picture)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        record: Any = words.record(data, how, example, seed)[0]
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
            save_picture(found.plot(), picture)
    conclude(str(found), heard, picture=picture)

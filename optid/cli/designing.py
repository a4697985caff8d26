"""The command `optid design`: an excitation for the plant of a record, with what it promises."""

from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.options import MODEL, RECORD, RESULT, Example, FeedbackBasis, reads_a_record
from optid.cli.results import conclude
from optid.cli.terminal import FILES, Waiting, hearing

EXCITATION = "The excitation"


@reads_a_record
def design(
    like: Annotated[
        list[str] | None,
        typer.Option("--like", metavar=FILES, rich_help_panel=RECORD, help="Record of the plant, one file or several."),
    ] = None,
    example: Example = None,
    *,
    how: dict[str, Any],
    kind: Annotated[
        str,
        typer.Option(
            "--kind", "-k", metavar="NAME", rich_help_panel=EXCITATION, help="multisine, chirp, noise or levels."
        ),
    ] = "multisine",
    samples: Annotated[
        int | None,
        typer.Option("--samples", "-n", rich_help_panel=EXCITATION, help="Samples; as many as the record has."),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option("--levels", rich_help_panel=EXCITATION, help="Equally spaced values each input may take."),
    ] = None,
    band: Annotated[
        list[float] | None,
        typer.Option(
            "--band",
            metavar="LOW HIGH",
            rich_help_panel=EXCITATION,
            help="Lowest and highest frequency; from the measured response.",
        ),
    ] = None,
    amplitude: Annotated[
        list[float] | None,
        typer.Option(
            "--amplitude",
            metavar="LOW HIGH...",
            rich_help_panel=EXCITATION,
            help="Range of all inputs, or one pair per input; the range of the record.",
        ),
    ] = None,
    shaped: Annotated[
        bool,
        typer.Option(
            "--shaped", rich_help_panel=EXCITATION, help="Weight the spectrum by the inverse of the measured gain."
        ),
    ] = False,
    hold: Annotated[
        int, typer.Option("--hold", rich_help_panel=EXCITATION, help="Samples for which levels are held.")
    ] = 5,
    periods: Annotated[int, typer.Option("--periods", rich_help_panel=EXCITATION, help="Periods of a multisine.")] = 1,
    candidates: Annotated[
        int, typer.Option("--candidates", rich_help_panel=EXCITATION, help="Realisations to choose the best from.")
    ] = 8,
    seed: Annotated[int, typer.Option("--seed", rich_help_panel=EXCITATION, help="Seed of the first of them.")] = 0,
    basis: Annotated[
        list[str] | None,
        typer.Option(
            "--basis",
            "-b",
            metavar="NAME:SIZE...",
            rich_help_panel=MODEL,
            help="Basis of the nonlinearity to be identified, one or one per input. [dim]polynomial:4[/]",
        ),
    ] = None,
    feedback_basis: FeedbackBasis = None,
    rows: Annotated[
        int, typer.Option("--rows", rich_help_panel=MODEL, help="Lags of every function: block rows, or nb.")
    ] = 10,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", rich_help_panel=RESULT, help="Write time and inputs to a CSV file."
        ),
    ] = None,
) -> None:
    """Design an excitation for the plant of a record, with a promise about the expanded regressor.

    Example: optid design --like data.csv --inputs u --outputs y --kind multisine --levels 12 -o excitation.csv
    """
    from optid.cli import arguments as words
    from optid.errors import StructureError
    from optid.identify.design import design as designed

    for name, value in (("--band", band), ("--amplitude", amplitude)):
        if value is not None and (len(value) % 2 or (name == "--band" and len(value) != 2)):
            raise StructureError(f"{name} {' '.join(f'{v:g}' for v in value)}: give two numbers, low and high.")
    words.check_folders(output)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        record: Any = words.record(like, how, example, seed, asked="--like FILE")[0]
        waiting.step(f"designing a {kind}")
        pairs = None if amplitude is None else list(zip(amplitude[::2], amplitude[1::2]))
        found = designed(
            record, kind, n=samples, levels=levels, band=None if band is None else (band[0], band[1]),
            amplitude=words.one_or_all(pairs), shaped=shaped, hold=hold, periods=periods, candidates=candidates,
            seed=seed, rows=rows, basis=words.one_or_all(words.listed(basis)) or "polynomial:4",
            feedback_basis=words.one_or_all(words.listed(feedback_basis)),
        )
        if output is not None:
            found.save(output)
    conclude(str(found), heard, excitation=output)

"""The commands `optid design` (excitation signals) and `optid order` (order selection)."""

from typing import Any

from optid.cli.options import File, Paths, Words
from optid.cli.results import working


def design(like: Words = None, example: str | None = None, *, how: dict[str, Any], kind: str = "multisine",
           samples: int | None = None, levels: int | None = None, band: list[float] | None = None,
           amplitude: list[float] | None = None, shaped: bool = False, hold: int = 5, periods: int = 1,
           candidates: int = 8, seed: int = 0, basis: Words = None, feedback_basis: Words = None, rows: int = 10,
           output: File = None) -> None:
    """Design an excitation signal with a guaranteed condition number of the expanded regressor.

    Example: optid design --like data.csv --inputs u --outputs y --kind multisine --levels 12 -o excitation.csv

    The record:
        like (FILE...): Record of the plant, one or several files.
    The excitation:
        kind (-k NAME): Kind of signal: multisine, chirp, noise or levels.
        samples (-n): Number of samples. [dim]that of the record[/]
        levels: Number of equally spaced values of each input.
        band (LOW HIGH): Lowest and highest frequency. [dim]from the measured response[/]
        amplitude (LOW HIGH...): Range of all inputs, or one pair per input. [dim]that of the record[/]
        shaped: Weight the spectrum by the inverse of the measured gain.
        hold: Samples for which a level is held.
        periods: Number of periods of a multisine.
        candidates: Number of realisations, of which the best is chosen.
        seed: Seed of the first realisation.
    The model:
        basis (-b NAME:SIZE...): Basis of the nonlinearity, one for all inputs or one per input. [dim]polynomial:4[/]
        rows: Number of lags of the expanded regressor: block rows, or nb.
    The result:
        output (-o FILE): Write time and inputs (CSV).
    """
    from optid.cli import arguments as words
    from optid.errors import StructureError

    for name, value in (("--band", band), ("--amplitude", amplitude)):
        if value is not None and (len(value) % 2 or (name == "--band" and len(value) != 2)):
            raise StructureError(f"{name} {' '.join(f'{v:g}' for v in value)}: give two numbers, low and high.")
    with working(output) as work:
        record: Any = words.record(like, how, example, seed, asked="--like FILE")[0]
        work.step(f"designing a {kind}")
        from optid.identify.design import design as designed

        pairs = None if amplitude is None else list(zip(amplitude[::2], amplitude[1::2]))
        found = designed(
            record, kind, n=samples, levels=levels, band=None if band is None else (band[0], band[1]),
            amplitude=words.one_or_all(pairs), shaped=shaped, hold=hold, periods=periods, candidates=candidates,
            seed=seed, rows=rows, basis=words.one_or_all(words.split_names(basis)) or "polynomial:4",
            feedback_basis=words.one_or_all(words.split_names(feedback_basis)))
        work.write("excitation", output, found.save)
        work.text = str(found)


def order(data: Paths = None, example: str | None = None, *, how: dict[str, Any], basis: Words = None,
          feedback_basis: Words = None, block_rows: int | None = None, nx: int | None = None, na: int = 8, nb: int = 6,
          nk: int = 8, holdout: float = 0.3, level: float | None = None, seed: int = 0, picture: File = None) -> None:
    """Select the model order from a record by singular values, information criteria and hold-out.

    Example: optid order data.csv --inputs u1 u2 --outputs y1 y2 --picture order.png

    The model:
        basis (-b NAME:SIZE...): Basis of the nonlinearity, one for all inputs or one per input, such as polynomial:4.
            [dim]linear[/]
        block_rows: Future block rows; must exceed the order. [dim]10, or fewer[/]
        nx: Largest number of states.
        na: Largest number of output lags.
        nb: Largest number of input lags.
        nk: Largest delay.
        holdout (SHARE): Share of the record held out.
        level: Probability of rejecting the true order. [dim]at most 0.01[/]
    """
    with working(picture) as work:
        from optid.cli import arguments as words

        record: Any = words.record(data, how, example, seed)[0]
        work.step("comparing orders")
        from optid.identify.order import order as study

        found = study(record, basis=words.one_or_all(words.split_names(basis)),
                      feedback_basis=words.one_or_all(words.split_names(feedback_basis)), block_rows=block_rows, nx=nx,
                      na=na, nb=nb, nk=nk, holdout=holdout, level=level)
        work.text = str(found)
        work.draw(found.plot, picture)

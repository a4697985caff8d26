"""The command `optid look`: a record before any fit."""

from typing import Any

from optid.cli.options import File, Paths
from optid.cli.results import working


def look(data: Paths = None, example: str | None = None, *, how: dict[str, Any], seed: int = 0, report: File = None,
         picture: File = None, csv: File = None) -> None:
    """Show a record before any fit: its clock, its channels, what reading it found, and what it can tell.

    Example: optid look data.csv --inputs u --outputs y --report record.html

    The result:
        csv (FILE): Write the record as it was read (CSV).
    """
    with working(report, picture, csv) as work:
        from optid.cli import arguments as words
        from optid.identify.informativity import informativity

        record: Any = words.record(data, how, example, seed)[0]
        work.text = f"{record}\n\n{informativity(record)}"
        work.write("record", csv, record.to_csv)
        work.draw(record.plot, picture)
        work.page(record, report)

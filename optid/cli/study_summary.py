"""Printed summaries of the rows of a study: outcomes, reasons, models and superseded rows."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.text import Text

from optid.cli.terminal import print_table, print_text
from optid.studies.storage.rows import DONE, REFUSED

LISTED = 12  # reasons that are printed; the page has them all


def print_outcomes(title: str, rows: Mapping[str, Any]) -> None:
    """Print a table of the outcomes of the cells by solver; rows are {column: (rows,) array}."""
    table = []
    for solver in sorted(set(rows["solver"])):
        mine = {key: values[rows["solver"] == solver] for key, values in rows.items()}
        others = Counter(word for word in _failures(mine) if word and word != REFUSED)
        table.append((Text(solver, "bold"), *(f"{count:,}" if count else "-" for count in (
            len(mine["key"]), int(mine["reached"].sum()), int(mine["proved"].sum()), int(mine["false_claim"].sum()),
            int((mine["outcome"] == REFUSED).sum()))),
            ", ".join(f"{word} {count:,}" for word, count in others.most_common()) or "-"))
    print_table(title, ("solver", "cells", "accuracy reached", "proved", "false claims", "refused", "other outcomes"),
                table, right=range(1, 6))


def _failures(rows: Mapping[str, Any]) -> list[str]:
    """The outcome of every row, or the status of one that ended, in one word; empty for a success."""
    return ["" if reached else status if outcome == DONE else outcome
            for outcome, status, reached in zip(rows["outcome"], rows["status_verified"], rows["reached"])]


def print_reasons(rows: Mapping[str, Any]) -> None:
    """Print the reasons why cells missed their accuracy, each once with its solvers and count; refusals come last.

    Sentences that differ only in numbers count as one.
    """
    from optid.studies.verdicts.choice import listed
    from optid.studies.verdicts.verdict import without_numbers

    groups: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for word, solver, reason in zip(_failures(rows), rows["solver"], rows["reason"]):
        if word and reason:
            reason = " ".join(reason.split())
            groups.setdefault((word, without_numbers(reason)), []).append((solver, reason))
    ordered = sorted(groups.items(), key=lambda item: (item[0][0] == REFUSED, -len(item[1]), item[0]))
    for (word, shape), found in ordered[:LISTED]:
        reasons = {reason for _, reason in found}
        names = listed(sorted({solver for solver, _ in found}), most=20)
        print_text(Text(f"{names}: {word} {len(found):,}: {reasons.pop() if len(reasons) == 1 else shape}", "dim"))
    if len(ordered) > LISTED:
        print_text(Text(f"and {len(ordered) - LISTED} more reasons, listed in the report and the database", "dim"))


def print_models(verdict: Any) -> None:
    """Print the figures of the formulations where a study compares these with a single solver."""
    if len(verdict.overall.standings) != 1 or len(verdict.quality.formulations) < 2:
        return
    from optid.studies.page import quality_table

    found = quality_table(verdict.quality)
    print_table(found.title, found.head, found.rows, firm=(), right=range(2, len(found.head)), padding=(0, 1, 0, 0))


def print_former(db: Path, study: str | None = None) -> None:
    """Print the number of superseded rows in a database."""
    from optid.studies.storage.store import Store

    if db.suffix == ".parquet":
        return
    with Store(db) as store:
        count = sum(store.superseded(study).values())
    if count:
        rows, stay = ("row", "is") if count == 1 else ("rows", "are")
        print_text(Text(f"{count:,} {rows} of former entries, data, settings or versions, or of cells that were run "
                        f"again, {stay} kept in {db} (table superseded) and in no report", "dim"))

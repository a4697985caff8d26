"""The search for a structure as text: the best of every class, why one of them, and the model."""

from typing import TYPE_CHECKING

import numpy as np

from optid.show.printing import describe, set_table, wrapped
from optid.show.wording import Table, seconds

if TYPE_CHECKING:
    from optid.identify.search import Identification
    from optid.identify.search.trial import Trial


def describe_search(found: "Identification") -> str:
    """Return the search and the fit it ended with as text, at most 80 columns wide."""
    return "\n".join([*search_lines(found), "", describe(found.fit, found.verdict)])


def search_lines(found: "Identification") -> list[str]:
    """Return the table of the best structures by class, and the reasons of the choice, line by line."""
    lines = set_table(search_table(found))
    lines += [line for reason in found.reasons for line in wrapped(f"- {reason}")]
    chosen = found.chosen.candidate
    lines += ["", *wrapped(f"Chosen: --formulation {chosen.formulation} {chosen.words}", "    ")]
    if found.stopped:
        lines += wrapped(f"Note: the search was ended by {found.stopped}; more time may find a better structure")
    return lines


def search_table(found: "Identification") -> Table:
    """Return the best structure of every class, and the one behind it."""
    rows = []
    for kind in found.best:
        several = sorted((t for t in found.trials if t.candidate.kind == kind and np.isfinite(t.score)),
                         key=lambda t: t.score, reverse=True)
        best = found.best[kind]
        others = [t for t in several if t is not best][:1]
        rows += [_row(kind, best, best is found.chosen), *(_row("  runner-up", t, False) for t in others)]
    what = "free run" if found.horizon is None else f"{found.horizon} samples ahead"
    spent = sum(t.seconds for t in found.trials)
    return Table(f"Search over {len(found.trials)} structures ({what}, {found.blocks} blocks left out, "
                 f"{seconds(spent)} of computing)", ("structure", "fit %", "worst block", "parameters"), rows)


def _row(word: str, trial: "Trial", chosen: bool) -> tuple[str, ...]:
    structure = f"{trial.candidate.formulation} {trial.candidate.words}"
    return (f"{'* ' * chosen}{word}: {structure}", f"{trial.score:.1f}", f"{trial.by_block.min():.1f}",
            str(trial.parameters))

"""The search for a structure as text: the best of every class, why one of them, and the model."""

from typing import TYPE_CHECKING

from optid.show.checks import search_table
from optid.show.printing import describe
from optid.show.terminal import set_table, wrapped

if TYPE_CHECKING:
    from optid.identify.search import Identification


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

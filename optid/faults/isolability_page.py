"""Self-contained HTML page of a study of isolability."""

from pathlib import Path

import numpy as np

from optid.faults.isolability import Isolability
from optid.faults.page import write_page
from optid.phrases import plural
from optid.show.wording import Table, number


def write(found: Isolability, path: str | Path, *, command: str = "") -> Path:
    """Write the smallest detectable and isolable size of every fault as a self-contained HTML page.

    Args:
        found: the study.
        path: of the page.
        command: the command line behind it.

    Raises:
        OSError: the file cannot be written.
    """
    never = [label for label, size in zip(found.labels, found.isolable) if not np.isfinite(size)]
    count = len(found.labels) - len(never)
    rows = []
    for i, (label, rival) in enumerate(zip(found.labels, found.rivals)):
        sine = number(found.sines[i, found.labels.index(rival)], 3) if rival else "-"
        rows.append((label + " *" * bool(found.bounded[i]), _size(found.detectable[i]), _size(found.isolable[i]),
                     rival or "-", sine))
    sizes = Table("Sizes", ("fault", "detectable", "isolable", "hardest to isolate from", "sine"), rows,
                  "Sizes are in the unit of the channel, or the share of a loss. Sine: of the smallest angle between "
                  "the whitened signatures; near 0 the two faults look alike."
                  + " *: the signature decays, so that a longer window does not help." * bool(found.bounded.any()))
    matrix = Table("Isolability matrix", ("fault of the row", *found.labels), [
        (label, *map(_size, line)) for label, line in zip(found.labels, found.matrix)],
        "Smallest size at which the fault of a row is isolated from that of a column; on the diagonal: detected.")
    where = "unknown onset" if found.onset == "unknown" else f"onset at sample {found.onset}"
    notes = [f"Not isolable from each other: {', '.join(group)}." for group in found.ambiguity_groups]
    notes += [f"Affects no output: {label}, {why}." for label, why in found.excluded.items()]
    notes += [f"Not judged without data: {label}." for label in found.skipped]
    return write_page(
        path, "Isolability", (f"window of {plural(found.window, 'sample')}", where,
                              f"false alarm {found.false_alarm:g}"),
        headings=("Sizes", "Matrix and probabilities", "Evidence"), draw=found.plot,
        caption="The isolability matrix, and the probabilities of detection and isolation by deflection.",
        cards=[("candidates", str(len(found.labels))), ("isolable at some size", str(count)),
               ("simulated windows per fault", f"{found.draws:,}")],
        tables=[sizes, matrix], tone="fair" if never or notes else "good",
        word=f"{count} of {plural(len(found.labels), 'candidate')} are isolable" if count != 1 else
        f"1 of {plural(len(found.labels), 'candidate')} is isolable",
        sentences=[f"A fault of the isolable size is detected and preferred to every other candidate with probability "
                   f"{found.prob:g}."], notes=notes,
        call=command or "optid.faults.dictionary(model).isolability()", text=str(found))


def _size(value: float) -> str:
    return number(value, 3) if np.isfinite(value) else "never"

"""A study of isolability as a page: the isolability matrix, and the probabilities by deflection."""

from pathlib import Path

import numpy as np

from optid.faults.isolability_study import GRID, Isolability
from optid.phrases import plural, short
from optid.show import charts, page
from optid.show.documents import reproduce
from optid.show.sections import Axis, Banner, Chart, Charts, Document, Notes, Section, Series
from optid.show.wording import Table, number


def write(found: Isolability, path: str | Path, *, command: str = "") -> Path:
    """Write the page of a study, with the command line behind it."""
    return page.write(isolability_document(found, command=command), path)


def describe(found: Isolability) -> str:
    """Print sizes, rivals and angles, the isolability matrix and remarks, in 80 columns."""
    where = "unknown" if found.onset == "unknown" else f"known, {found.onset}"
    lines = [
        f"window {found.window} samples, onset {where}, false alarm {found.false_alarm:g},",
        f"probability {found.prob:g} ({found.draws} simulated windows per fault)",
        "",
        f"     {'fault':<23}{'detectable':>10}{'isolable':>9}  {'hardest to isolate from':<23}{'sine':>6}"]
    for i, label in enumerate(found.labels):
        rival = found.rivals[i]
        sine = f"{found.sines[i, found.labels.index(rival)]:6.3f}" if rival else ""
        lines.append(
            f"{i + 1:>3}  {short(label, 22):<23}{_size(found.detectable[i]):>10}{_size(found.isolable[i]):>9}"
            f"  {short(rival, 22):<23}{sine:>6}" + " *" * bool(found.bounded[i]))
    lines += ["", "smallest size at which the fault of a row is isolated from that of a column"]
    wide = 7
    fits = (80 - 5) // wide
    for first in range(0, len(found.labels), fits):
        columns = range(first, min(first + fits, len(found.labels)))
        lines.append("     " + "".join(f"{j + 1:>{wide}}" for j in columns))
        lines += [
            f"{i + 1:>3}  " + "".join(f"{_size(found.matrix[i, j]):>{wide}}" for j in columns)
            for i in range(len(found.labels))]
    notes = ["on the diagonal: smallest detectable size"]
    if found.bounded.any():
        notes.append("* transient: the signature decays, a longer window does not help")
    notes += [f"not isolable from each other: {', '.join(group)}" for group in found.ambiguity_groups]
    notes += [f"excluded: {label}, {why}" for label, why in found.excluded.items()]
    notes += [f"not judged without data: {label}" for label in found.skipped]
    return "\n".join(lines + notes).replace(" \n", "\n")


def isolability_document(found: Isolability, *, command: str = "") -> Document:
    """Return the document of the smallest detectable and isolable size of every fault."""
    count = int(np.isfinite(found.isolable).sum())
    where = "unknown onset" if found.onset == "unknown" else f"onset at sample {found.onset}"
    notes = [f"Not isolable from each other: {', '.join(group)}." for group in found.ambiguity_groups]
    notes += [f"Affects no output: {label}, {why}." for label, why in found.excluded.items()]
    notes += [f"Not judged without data: {label}." for label in found.skipped]
    total = plural(len(found.labels), "candidate")
    banner = Banner(
        "fair" if notes or count < len(found.labels) else "good",
        f"{count} of {total} {'is' if count == 1 else 'are'} isolable",
        f"A fault of the isolable size is detected and preferred to every other candidate with probability "
        f"{found.prob:g}.",
        (("candidates", str(len(found.labels))), ("isolable at some size", str(count)),
         ("simulated windows per fault", f"{found.draws:,}")))
    lead = " · ".join([f"window of {plural(found.window, 'sample')}", where, f"false alarm {found.false_alarm:g}"])
    return Document("Isolability", lead, [
        Section("verdict", "Result", [banner, *([Notes(notes)] if notes else [])]),
        Section("sizes", "Sizes", [_sizes(found)]),
        Section("matrix", "Isolability matrix", [_matrix(found)]),
        Section("figures", "Probabilities", [Charts([isolation_chart(found)])]),
        Section("reproduce", "Reproduce", lambda: reproduce(
            command or "optid.faults.isolability(dictionary(model))", str(found)))])


def _sizes(found: Isolability) -> Table:
    rows = []
    for i, (label, rival) in enumerate(zip(found.labels, found.rivals)):
        sine = number(found.sines[i, found.labels.index(rival)], 3) if rival else "-"
        rows.append((label + " *" * bool(found.bounded[i]), _size(found.detectable[i]), _size(found.isolable[i]),
                     rival or "-", sine))
    return Table("", ("fault", "detectable", "isolable", "hardest to isolate from", "sine"), rows,
                 "Sizes are in the unit of the channel, or the share of a loss. Sine: of the smallest angle between "
                 "the whitened signatures; near 0 the two faults look alike."
                 + " *: the signature decays, so that a longer window does not help." * bool(found.bounded.any()))


def _matrix(found: Isolability) -> Table:
    return Table("", ("fault of the row", *found.labels), [
        (label, *map(_size, line)) for label, line in zip(found.labels, found.matrix)],
        "Smallest size at which the fault of a row is isolated from that of a column; on the diagonal: detected.")


def _size(value: float) -> str:
    return number(value, 3) if np.isfinite(value) else "never"


def isolation_chart(found: Isolability) -> Chart:
    """Return the probabilities of isolation of every fault, by its deflection, and the mean one of detection."""
    series = [Series(label, GRID[1:], chance[1:], colour=colour)
              for label, chance, colour in zip(found.labels, found.isolated, charts.COLOURS * len(found.labels))]
    series.append(Series("detection (mean)", GRID[1:], found.detected.mean(axis=0)[1:], colour="muted", dash="4 2"))
    needed = (found.isolable * found.unit)[np.isfinite(found.isolable)]
    high = min(2.5 * float(needed.max(initial=10.0)), float(GRID[-1]))
    return Chart("Probability of isolation", "By the deflection: the norm of the whitened signature.",
                 Axis("deflection", log=True, low=1.0, high=high), Axis("probability", low=0.0, high=1.0), series)

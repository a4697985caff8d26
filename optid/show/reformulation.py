"""A reformulation as a page: actuators before and after the fault, attainable outputs, sensors."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from optid.errors import OptidError
from optid.faults.repair.allocation import allocate
from optid.faults.repair.reformulation import MemberModel, Reformulation
from optid.phrases import short
from optid.show import page
from optid.show.documents import reproduce
from optid.show.sections import Axis, Banner, Chart, Charts, Code, Document, Facts, Heading, Notes, Section, Series
from optid.show.terminal import wrap_lines
from optid.show.wording import Table, number

TONES = {"healthy": "good", "refitted": "good", "as diagnosed": "fair", "not repaired": "fair", "ambiguous": "bad"}

HEADS = {
    "healthy": "healthy: the plant is as it was",
    "refitted": "one explanation; the model is refitted",
    "as diagnosed": "one explanation; the model is that of the diagnosis",
    "not repaired": "one explanation; its refit is not offered, and the model stays the healthy one",
    "ambiguous": "several explanations; the model stays the healthy one until one is left",
}
"""The statuses in words."""

COLOURS = ("c1", "c2", "c0")
"""Colours of the explanations that are drawn."""


def write(found: Reformulation, path: str | Path, *, record: str = "", command: str = "") -> Path:
    """Write a reformulation as a self-contained HTML page, with the name of the record and the command line behind it.

    Raises:
        OSError: the file cannot be written.
    """
    return page.write(reformulation_document(found, record=record, command=command), path)


def describe(found: Reformulation) -> str:
    """Return a reformulation as text of 80 columns."""
    told = (found.schedule, found.if_ambiguous, *((found.observer, found.allocation) if found.members else ()))
    heads = [f"{one.label} (probability {one.damage.posterior:.3g})" for one in found.members]
    text = "\n".join([HEADS[found.status], *heads, *(str(one) for one in told if one is not None)])
    known = {line.strip() for line in text.splitlines()}
    return wrap_lines(text.splitlines() + [f"note: {note}" for note in found.notes if note.strip() not in known])


def reformulation_document(found: Reformulation, *, record: str = "", command: str = "") -> Document:
    """Return the document of a reformulation; arguments as of `write`."""
    notes, tables = list(dict.fromkeys(found.notes)), _tables(found)
    banner = Banner(TONES[found.status], HEADS[found.status], " ".join(_sentences(found)), tuple(_cards(found)))
    members = [part for member in found.members for part in (Heading(member.label), Code(str(member)))]
    return Document(f"Reformulation: {found.status}", " · ".join(filter(None, (record, found.healthy.title))), [
        Section("verdict", "Result", [banner, *([Notes(notes)] if notes else [])]),
        *([Section("tables", "The damaged system", tables)] if tables else []),
        Section("figures", "Before and after", lambda: [Charts(reformulation_charts(found))]),
        *([Section("evidence", "Explanations", members)] if members else []),
        Section("reproduce", "Reproduce", lambda: reproduce(
            command or "optid.faults.reformulate(model, diagnosis, data)", str(found)))])


def _sentences(found: Reformulation) -> list[str]:
    labels = explanation_names(found.members)
    if found.if_ambiguous is not None:
        advice = found.if_ambiguous
        return [f"Fault: {labels}.", f"Advice: {advice.action}; {advice.reason}."]
    lines = [f"Fault: {labels}."] if labels else ["The plant is unchanged."]
    if found.schedule is not None:
        lines.append(
            f"The model was refitted from {found.schedule.samples} samples after the fault: {found.schedule.stage} "
            f"({found.schedule.reason}).")
    if found.observer.lost:
        lines.append(f"{', '.join(found.observer.lost)}: not used; the filter on the other sensors estimates them.")
    return lines


def _cards(found: Reformulation) -> Facts:
    cards = []
    if found.schedule is not None:
        cards.append(("samples after the fault", str(found.schedule.samples)))
        cards += [(f"rms error of {name} at most", number(value, 3)) for name, value in found.error_bound.items()
                  if np.isfinite(value)]
    cards += [(f"predicted RMSE of {name}", number(found.observer.rmse[name], 3)) for name in found.observer.lost]
    if found.allocation is not None:
        cards.append(("actuators that move", ", ".join(found.allocation.moving) or "none"))
        cards.append(("route of the allocation", found.allocation.route))
    return cards


def _tables(found: Reformulation) -> list[Table]:
    tables = []
    for one in () if found.schedule is None else found.schedule.values:
        rows = [
            (number(u, 4), number(old, 4), number(new, 4), number(std, 2), "prior only" if unseen else "")
            for u, old, new, std, unseen in zip(one.nodes, one.healthy, one.values, one.std, one.prior_only)]
        note = (
            f"Inputs after the fault from {one.seen[0]:.4g} to {one.seen[1]:.4g}; smallest eigenvalue of the "
            f"information on the values with samples {one.excitation:.3g}. Standard errors: without constraints.")
        tables.append(Table(f"Effect of {one.name}", ("input", "before", "now", "standard error", ""), rows, note))
    seen = found.observer
    if not seen.lost:
        return tables
    rows = [(name, "not used" if name in seen.lost else "used", number(value, 3), number(seen.noise[name], 3),
             number(seen.open_loop[name], 3)) for name, value in seen.rmse.items()]
    tables.append(Table(
        "Outputs", ("output", "sensor", "predicted RMSE", "noise of the sensor", "RMSE of a simulation"), rows,
        "Of the outputs without their noise, from the Riccati equation of the filter on the used sensors."))
    return tables


def reformulation_charts(found: Reformulation) -> list[Chart]:
    """Return the effect of every actuator before and now, and with two outputs the attainable ones."""
    shown = [_actuator(found, c) for c in range(found.healthy.m)]
    return [*shown, *_attainable(found)] if found.healthy.l == 2 else shown


def _explanations(found: Reformulation) -> list[tuple[MemberModel, str, str]]:
    """Return the explanations that are drawn, with their colours and names."""
    one = len(found.members) == 1
    return [(member, colour, "now" if one else short(member.label, 20))
            for member, colour in zip(found.members, COLOURS)]


def _actuator(found: Reformulation, c: int) -> Chart:
    """Return the nonlinearities of an input before and now, with twice the standard errors of a refit."""
    columns, healthy = [i for i, of in enumerate(found.healthy.input_of) if of == c], found.healthy.nonlinearities
    low, high = healthy[columns[0]].basis.interval or (-1.0, 1.0)
    if found.allocation is not None:
        low, high = float(found.allocation.low[c]), float(found.allocation.high[c])
    u, series = np.linspace(low, high, 301), []
    for i in columns:
        values = np.asarray(healthy[i](u))
        series.append(Series("before", u, values, colour="muted", dash="4 2"))
        for member, colour, name in _explanations(found):
            if i not in member.damage.columns:
                continue
            curves = () if member.schedule is None else member.schedule.values
            one = next((curve for curve in curves if curve.column == i), None)
            if one is None:
                now = member.damage.gains[i] * values + member.damage.constants[i]
                series.append(Series(name, u, now, colour=colour))
                continue
            seen = ~one.prior_only
            series += [Series("", one.nodes, one.values + 2 * one.std, "area", colour, one.values - 2 * one.std,
                              aside=True),
                       Series(name, one.nodes, one.values, colour=colour),
                       Series("", one.nodes[seen], one.values[seen], "dots", colour)]
    return Chart(f"Actuator {found.healthy.inputs[c]}", "Its effect before and after the fault, with twice the "
                 "standard error; no dot where no sample lies.", Axis("input"), Axis("effect"), series)


def _attainable(found: Reformulation) -> list[Chart]:
    """Return the attainable steady outputs, before and now; none where a plant is not linear in f(u)."""
    sets = [(member.allocation, colour, name, "") for member, colour, name in _explanations(found)]
    if found.allocation is not None:
        with suppress(OptidError):
            before = allocate(found.healthy, low=found.allocation.low, high=found.allocation.high, route="qp")
            sets.insert(0, (before, "muted", "before", "4 2"))
    series = []
    for allocation, colour, name, dash in sets:
        if allocation is not None and allocation.linear:
            corners = allocation.corners()
            around = np.vstack([corners, corners[:1]])
            kind = "line-only" if len(corners) > 1 else "dots"
            series.append(Series(name, around[:, 0], around[:, 1], kind, colour, dash=dash))
    return [Chart("Attainable outputs", "Steady outputs within the bounds of the inputs.",
                  Axis(found.healthy.outputs[0]), Axis(found.healthy.outputs[1]), series)] if series else []


def explanation_names(members: Sequence[MemberModel]) -> str:
    """Return the labels of explanations, joined."""
    return " or ".join(member.label for member in members)

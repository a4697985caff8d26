"""A reformulation as one HTML page that carries its figure with it."""

from pathlib import Path

import numpy as np

from optid.faults.page import write_page
from optid.faults.repair.reformulation import HEADS, Reformulation
from optid.show.wording import Table, number

TONES = {"healthy": "good", "refitted": "good", "as diagnosed": "fair", "ambiguous": "bad"}


def write(found: Reformulation, path: str | Path, *, record: str = "", command: str = "") -> Path:
    """Write a reformulation as a self-contained HTML page, with the name of the record and the command line behind it.

    Raises:
        OSError: the file cannot be written.
    """
    caption = (
        "Effect of every actuator before and after the fault, with twice its standard error (open dots: no sample lies "
        "there); attainable steady outputs; predicted errors of the outputs without their noise."
    )
    return write_page(
        path, f"Reformulation: {found.status}", (record, found.healthy.title),
        headings=("The damaged system", "Before and after", "Explanations"), draw=found.plot, caption=caption,
        cards=_cards(found), tables=_tables(found), texts=[(member.label, str(member)) for member in found.members],
        tone=TONES[found.status], word=HEADS[found.status], sentences=_sentences(found),
        notes=list(dict.fromkeys(found.notes)), call=command or "optid.faults.reformulate(model, diagnosis, data)",
        text=str(found),
    )


def _sentences(found: Reformulation) -> list[str]:
    labels = " or ".join(member.label for member in found.members)
    if found.if_ambiguous is not None:
        advice = found.if_ambiguous
        return [f"Fault: {labels}.", f"Advice: {advice.action}; {advice.reason}."]
    lines = [f"Fault: {labels}."] if labels else ["The plant is unchanged."]
    if found.schedule is not None:
        lines.append(
            f"The model was refitted from {found.schedule.samples} samples after the fault: {found.schedule.stage} "
            f"({found.schedule.reason})."
        )
    if found.observer.lost:
        lines.append(f"{', '.join(found.observer.lost)}: not used; the filter on the other sensors estimates them.")
    return lines


def _cards(found: Reformulation) -> list[tuple[str, str]]:
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
            for u, old, new, std, unseen in zip(one.nodes, one.healthy, one.values, one.std, one.prior_only)
        ]
        note = (
            f"Inputs after the fault from {one.seen[0]:.4g} to {one.seen[1]:.4g}; smallest eigenvalue of the "
            f"information on the values with samples {one.excitation:.3g}. Standard errors: without constraints."
        )
        tables.append(Table(f"Effect of {one.name}", ("input", "before", "now", "standard error", ""), rows, note))
    seen = found.observer
    if not seen.lost:
        return tables
    rows = [(name, "not used" if name in seen.lost else "used", number(value, 3), number(seen.noise[name], 3),
             number(seen.open_loop[name], 3)) for name, value in seen.rmse.items()]
    tables.append(Table(
        "Outputs", ("output", "sensor", "predicted RMSE", "noise of the sensor", "RMSE of a simulation"), rows,
        "Of the outputs without their noise, from the Riccati equation of the filter on the used sensors.",
    ))
    return tables

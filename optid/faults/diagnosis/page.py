"""Self-contained HTML page of a diagnosis."""

from pathlib import Path

from optid.data.description import first_findings
from optid.faults.diagnosis import words
from optid.faults.diagnosis.answers import Diagnosis
from optid.faults.page import write_page
from optid.show.wording import Table, number

TONES = {"healthy": "good", "faulty": "bad"}
"""Colour of a verdict; the others are neutral."""


def write(found: Diagnosis, path: str | Path, *, record: str = "", command: str = "") -> Path:
    """Write a diagnosis as a self-contained HTML page, with the name of the record and the command line behind it.

    Raises:
        StructureError: a diagnosis read from a file: the record is not in it.
        OSError: the file cannot be written.
    """
    percent, best = f"{100 * found.coverage:g} %", found.best
    p_value = "p-value of health", words.probability_words(found.p_value)
    cards: list[tuple[str, str]] = [p_value]
    rows: list[tuple[str, ...]] = []
    caption = "Whitened innovations of every output"
    facts = [("Method", found.method), ("False alarms", f"{found.false_alarm:g} of healthy records"), p_value]
    if best is not None:
        caption += ", the fit of the best answer, and its onset with the interval"
        cards += [
            ("probability of the best answer", f"{best.posterior:.3f}"),
            (f"answers in the set of {percent}", str(len(found.candidates))),
            ("deflection", number(best.faults[0].deflection, 3)),
        ]
    caption += "; the energy that every candidate explains, by its onset, beyond its threshold"
    caption += "; the probability of every answer in the set." if len(found.candidates) > 1 else "."
    if found.certificate.kind != "none":
        facts.append(("Proof", words.certificate_words(found).removeprefix("proof: ")))
    if found.remaining is not None:
        cards.append(("p-value of the residual", words.probability_words(found.remaining.p_value)))
        facts.append(("Left unexplained", words.remaining_words(found).removeprefix("left unexplained: ")))
    for place, answer in enumerate(found.candidates, start=1):
        for i, fault in enumerate(answer.faults):
            first, *more = words.size_words(fault)
            rows.append((
                f"{place}. {fault.label}" if i == 0 else f"and {fault.label}",
                f"{answer.posterior:.3f}" if i == 0 else "", words.onset_words(fault).removeprefix("onset "),
                number(fault.deflection, 3), first,
            ))
            rows += [("", "", "", "", magnitude) for magnitude in more]
    table = Table(
        "Answers", ("fault", "probability", "onset", "deflection", "magnitude"), rows,
        f"The smallest set with {percent} of the probability. Intervals have a coverage of {percent}, the "
        "search for the onset included.",
    )
    return write_page(
        path, f"Diagnosis: {found.verdict}", (record, found.model, words.window_words(found)),
        headings=("Answers", "Innovations and statistics", "Evidence"), draw=found.plot, caption=caption,
        cards=cards, tables=[table] * bool(found.candidates), facts=facts,
        tone=TONES.get(found.verdict, "fair"), word=words.headline(found),
        findings=first_findings(found.findings), sentences=words.explained(found, notes=False),
        notes=[*[found.status] * bool(found.status), *(f"{a}: {why}" for a, why in found.untestable.items())],
        call=command or "optid.faults.diagnose(model, data)", text=str(found),
    )

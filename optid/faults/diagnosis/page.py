"""Self-contained HTML page of a diagnosis."""

from pathlib import Path

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
    best = ", the fit of the best answer, and its onset with the interval" if found.best is not None else ""
    several = "; the probability of every answer in the set" if len(found.candidates) > 1 else ""
    caption = (
        f"Whitened innovations of every output{best}; the energy that every candidate explains, by its onset, beyond "
        f"its threshold{several}."
    )
    return write_page(
        path, f"Diagnosis: {found.verdict}", (record, found.model, f"{found.window} samples"),
        headings=("Answers", "Innovations and statistics", "Evidence"), draw=found.plot, caption=caption,
        cards=_cards(found), tables=[_answers(found)] * bool(found.candidates), facts=_evidence(found),
        tone=TONES.get(found.verdict, "fair"), word=words.headline(found),
        sentences=words.explained(found, notes=False),
        notes=[*[found.status] * bool(found.status), *(f"{a}: {why}" for a, why in found.untestable.items())],
        call=command or "optid.faults.diagnose(model, data)", text=str(found),
    )


def _cards(found: Diagnosis) -> list[tuple[str, str]]:
    cards = [("p-value of health", words.probability_words(found.p_value))]
    if found.best is not None:
        fault = found.best.faults[0]
        cards += [
            ("probability of the best answer", f"{found.best.posterior:.3f}"),
            (f"answers in the set of {100 * found.coverage:g} %", str(len(found.candidates))),
            ("deflection", number(fault.deflection, 3)),
        ]
    if found.remaining is not None:
        cards.append(("p-value of the residual", words.probability_words(found.remaining.p_value)))
    return cards


def _answers(found: Diagnosis) -> Table:
    rows = []
    for place, answer in enumerate(found.candidates, start=1):
        for i, fault in enumerate(answer.faults):
            first, *more = words.size_words(fault)
            rows.append((
                f"{place}. {fault.label}" if i == 0 else f"and {fault.label}",
                f"{answer.posterior:.3f}" if i == 0 else "", words.onset_words(fault).removeprefix("onset "),
                number(fault.deflection, 3), first,
            ))
            rows += [("", "", "", "", magnitude) for magnitude in more]
    note = (
        f"The smallest set with {100 * found.coverage:g} % of the probability. Intervals in brackets have a "
        f"coverage of {100 * found.coverage:g} %, the search for the onset included."
    )
    return Table("Answers", ("fault", "probability", "onset", "deflection", "magnitude"), rows, note)


def _evidence(found: Diagnosis) -> list[tuple[str, str]]:
    facts = [
        ("Method", found.method),
        ("False alarms", f"{found.false_alarm:g} of healthy records"),
        ("p-value of health", words.probability_words(found.p_value)),
    ]
    if found.certificate.kind != "none":
        facts.append(("Proof", words.certificate_words(found).removeprefix("proof: ")))
    if found.remaining is not None:
        facts.append(("Left unexplained", words.remaining_words(found).removeprefix("left unexplained: ")))
    return facts


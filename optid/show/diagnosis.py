"""A diagnosis as a page: its answers, the innovations, and the energy explained by the onset."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import StructureError
from optid.faults.diagnosis.answers import Diagnosis, SearchEvidence
from optid.show import charts, page
from optid.show import diagnosis_words as words
from optid.show.documents import record_findings, reproduce
from optid.show.sections import Axis, Banner, Chart, Charts, Document, Facts, Notes, Section, Series
from optid.show.wording import Table, number, time_title

TONES = {"healthy": "good", "faulty": "bad"}
"""Colour of a verdict; the others are neutral."""

MOST = 8
"""Candidates whose energy is drawn: those that explain most."""


def write(found: Diagnosis, path: str | Path, *, record: str = "", command: str = "") -> Path:
    """Write a diagnosis as a self-contained HTML page, with the name of the record and the command line behind it.

    Raises:
        StructureError: a diagnosis read from a file: the record is not in it.
        OSError: the file cannot be written.
    """
    return page.write(diagnosis_document(found, record=record, command=command), path)


def diagnosis_document(found: Diagnosis, *, record: str = "", command: str = "") -> Document:
    """Return the document of a diagnosis; arguments and errors as of `write`."""
    drawn = diagnosis_charts(found)
    notes = [*[found.status] * bool(found.status), *(f"{a}: {why}" for a, why in found.untestable.items())]
    banner = Banner(TONES.get(found.verdict, "fair"), words.headline(found),
                    " ".join(words.diagnosis_sentences(found, notes=False)), tuple(_cards(found)))
    lead = " · ".join(part for part in (record, found.model, words.window_words(found)) if part)
    return Document(f"Diagnosis: {found.verdict}", lead, [
        *record_findings(found.findings),
        Section("verdict", "Result", [banner, *([Notes(notes)] if notes else [])]),
        *([Section("tables", "Answers", [answer_table(found)])] if found.candidates else []),
        Section("figures", "Innovations and statistics", [Charts(drawn, wide=True)]),
        Section("evidence", "Evidence", [_facts(found)]),
        Section("reproduce", "Reproduce", lambda: reproduce(
            command or "optid.faults.diagnose(model, data)", str(found)))])


def _p_value(found: Diagnosis) -> tuple[str, str]:
    return "p-value of health", words.probability_words(found.p_value)


def _cards(found: Diagnosis) -> Facts:
    cards = [_p_value(found)]
    if found.best is not None:
        cards += [
            ("probability of the best answer", f"{found.best.posterior:.3f}"),
            (f"answers in the set of {100 * found.coverage:g} %", str(len(found.candidates))),
            ("deflection", number(found.best.faults[0].deflection, 3))]
    if found.remaining is not None:
        cards.append(("p-value of the residual", words.probability_words(found.remaining.p_value)))
    return cards


def _facts(found: Diagnosis) -> Facts:
    facts = [("Method", found.method), ("False alarms", f"{found.false_alarm:g} of healthy records"), _p_value(found)]
    if found.certificate.basis != "none":
        facts.append(("Proof", words.certificate_words(found).removeprefix("proof: ")))
    if found.remaining is not None:
        facts.append(("Left unexplained", words.remaining_words(found).removeprefix("left unexplained: ")))
    return facts


def answer_table(found: Diagnosis) -> Table:
    """Return the set of answers: their faults, probabilities, onsets and magnitudes."""
    rows: list[tuple[str, ...]] = []
    for place, answer in enumerate(found.candidates, start=1):
        for i, fault in enumerate(answer.faults):
            first, *more = words.size_words(fault) or ["-"]
            rows.append((
                f"{place}. {fault.label}" if i == 0 else f"and {fault.label}",
                f"{answer.posterior:.3f}" if i == 0 else "", words.onset_words(fault).removeprefix("onset "),
                number(fault.deflection, 3), first))
            rows += [("", "", "", "", magnitude) for magnitude in more]
    percent = f"{100 * found.coverage:g} %"
    return Table("", ("fault", "probability", "onset", "deflection", "magnitude"), rows,
                 f"The smallest set with {percent} of the probability. Intervals have a coverage of {percent}, the "
                 "search for the onset included.")


def diagnosis_charts(found: Diagnosis, x: Axis | None = None, first: int = 0) -> list[Chart]:
    """Return the whitened innovations of every output, and the energies that faults explain, by their onset.

    Args:
        found: the diagnosis.
        x: the axis of time of the record; by default that of the diagnosis.
        first: sample of the record at which the diagnosed window begins.

    Raises:
        StructureError: a diagnosis read from a file: the record is not in it.
    """
    seen, time = found.evidence, found.timeline
    if seen is None:
        raise StructureError("The record is not in a saved diagnosis: draw it where it was diagnosed, or run it again.")
    x = x or Axis("time" if time.dated else time_title(time.unit), unit=time.unit, dates=time.dated, start=time.start,
                  step=time.dt)
    start, step = x.start or 0.0, x.step or 1.0

    def at(samples: Any) -> np.ndarray:
        return start + step * (first + np.asarray(samples, dtype=float))

    shown = [_innovations(found, seen, o, x, at) for o in range(seen.r.shape[1])]
    return [*shown, _energies(seen, x, at)] if seen.labels else shown


def _innovations(found: Diagnosis, seen: SearchEvidence, o: int, x: Axis, at: Callable[[Any], np.ndarray]) -> Chart:
    """Return the whitened innovations of an output, the fit of the best answer, and its onset with the interval."""
    name, k = (found.outputs or [f"y{i + 1}" for i in range(seen.r.shape[1])])[o], at(np.arange(len(seen.r)))
    r = np.where(seen.present[:, o], seen.r[:, o], np.nan)
    low, high = float(np.nanmin(r, initial=-3.0)), float(np.nanmax(r, initial=3.0))
    series = []
    for fault in found.best.faults if found.best is not None else ():
        early, late = fault.onset_interval
        series.append(Series("onset" if not series else "", at([early - 0.5, late + 0.5]), [high, high], "area",
                             colour="c2", lows=[low, low], aside=True))
    series.append(Series("innovation", k, r, colour="muted", width=1.0))
    if seen.fitted[:, o].any():
        series.append(Series("best answer", k, seen.fitted[:, o], colour="c1", width=2.0))
    return Chart(f"Whitened innovations of {name}", "Mostly between -2 and 2 when healthy.", x,
                 Axis("standard deviations"), series, "fault", height=220)


def _energies(seen: SearchEvidence, x: Axis, at: Callable[[Any], np.ndarray]) -> Chart:
    """Return the energies that the candidates explain beyond the thresholds, by their onset."""
    peaks = np.nanmax(np.where(np.isnan(seen.gains), -np.inf, seen.gains), axis=1)
    order = [int(i) for i in np.argsort(-peaks)[:MOST] if np.isfinite(peaks[i])]
    series = [Series(seen.labels[i], at(np.arange(len(seen.r))), seen.gains[i], colour=colour, width=1.8)
              for i, colour in zip(order, charts.COLOURS)]
    title = "onset (sample)" if x.title == "sample" else x.title.replace("time", "onset")
    axis = Axis(title, unit=x.unit, dates=x.dates, start=x.start, step=x.step)
    return Chart("Likelihood of each fault by its onset", "Energy that a fault explains beyond the alarm threshold; "
                 "rarely above zero without a fault.", axis, Axis("energy beyond the threshold"), series, "fault",
                 height=320)

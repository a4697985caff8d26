"""The page of a study: one HTML file that opens offline, with its figures, its tables and every run."""

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from optid import __version__
from optid.phrases import plural, short
from optid.show.page import embedded, scripts, template, versions
from optid.show.wording import Table, number, seconds
from optid.studies.payload import page_payload
from optid.studies.storage.rows import OUTCOMES
from optid.studies.verdicts.advice import choice_of_solver, evidence
from optid.studies.verdicts.choice import CANNOT_TELL
from optid.studies.verdicts.model_advice import model_evidence
from optid.studies.verdicts.outcomes import MEANINGS, SOLVED, TIMES, states_of_rows
from optid.studies.verdicts.quality import FIGURES, DataSet, Quality
from optid.studies.verdicts.statement import FAIR, GOOD, counting
from optid.studies.verdicts.verdict import StudyVerdict, conclude

SCRIPTS = ("plot.js", "grid.js", "study.js")
TIME_WORDS = {"solve": "compile and solve, cold", "fit": "the whole fit", "warm": "the second, warm solve"}
FOLDED = 8  # formulations above which their list is folded away
LISTED = 40  # false claims, and rows of the models, on the page; the database has them all
FEW_REASONS = 12  # kinds of failure that are shown without being asked for
REASON = 400  # characters of a reason, which is broken into lines


def write_page(rows_or_db: Any, path: str | Path, *, title: str = "", command: str = "",
               study: str | None = None, accuracy: float | None = None, time: str = "solve") -> Path:
    """Write the page of a study: verdict, tables, figures and all runs in one file that makes no request.

    Rows, study, accuracy and time are those of `conclude`, whose errors are raised; a `StudyVerdict` is taken as it is.
    The title is by default that of the study; the command is for the section that says how to reproduce the page.

    Returns:
        The path; the file is replaced when it exists.

    Raises:
        OSError: the file cannot be written.
    """
    if not isinstance(rows_or_db, StudyVerdict):
        rows_or_db = conclude(rows_or_db, study=study, accuracy=accuracy, time=time)
    path = Path(path)
    path.write_text(render(rows_or_db, title=title, command=command), encoding="utf-8", errors="replace")
    return path


def render(verdict: StudyVerdict, *, title: str = "", command: str = "") -> str:
    """Return the page that `write_page` writes."""
    head, style = verdict.headline, files("optid") / "show" / "templates" / "study.css"
    studies = [name for name in dict.fromkeys(verdict.table["study"]) if name]
    content = {
        "version": __version__,
        "title": title or " · ".join(short(name) for name in studies[:3]) or "Study",
        "lead": _lead(verdict),
        "tone": head.tone,
        "word": head.word,
        "sentence": head.text,
        "cards": _cards(verdict),
        "picks": _picks(verdict) if len(verdict.sections) > 1 else None,
        "folded": len(verdict.sections) > FOLDED,
        "statements": verdict.statements,
        "claims": _claims(verdict),
        "quality": quality_table(verdict.quality) if verdict.quality.records else None,
        "few_reasons": 0 < len(verdict.failures) <= FEW_REASONS,
        "formulations": [section.name for section in verdict.sections],
        "requested": f"{verdict.found.accuracy:.0e}",
        "tolerance": f"{verdict.found.tolerance:.0e}",
        "clock": f"{' + '.join(TIMES[verdict.found.measure])}: {TIME_WORDS[verdict.found.measure]}",
        "states": [*OUTCOMES.items(), *MEANINGS.items()],
        "call": command or "optid study report STUDY.sqlite -o study.html",
        "versions": [*versions(), *_machines(verdict)],
        "text": str(verdict),
        "style": Markup(style.read_text(encoding="utf-8")),
        **scripts(*SCRIPTS),
        "payload": embedded(page_payload(verdict)),
        "single": len(verdict.overall.standings) < 2,
        "measure": verdict.quality.measure.replace("_", " "),
        "sections": [("verdict", "Verdict"), ("solvers", "Solvers"), ("figures", "Figures"), ("failures", "Failures"),
                     ("agreement", "Agreement"), ("models", "Models"), ("runs", "Runs"), ("method", "Method")],
    }
    return template("study.html.j2").render(content)


def _lead(verdict: StudyVerdict) -> str:
    runs, found = len(verdict.table["solver"]), verdict.found
    parts = [(runs, "run"), (len(found.data), "problem"), (len(found.solvers), "solver"),
             (len(verdict.sections), "formulation"), (len(set(zip(found.study, found.data))), "data set")]
    counts = [plural(count, noun) for count, noun in parts]
    return " · ".join([*counts, f"accuracy {found.accuracy:.0e}: {counting(found.accuracy)}"])


def _cards(verdict: StudyVerdict) -> list[dict[str, str]]:
    section, table = verdict.overall, verdict.table
    runs, solved = (sum(getattr(s, name) for s in section.standings) for name in ("problems", "solved"))
    by_anyone = int(section.found.solved.any(axis=1).sum()) if len(section.found.data) else 0
    proved = int((table["proved"] & (states_of_rows(table, verdict.found) == SOLVED)).sum())
    cards = {
        "problems solved by any solver": f"{by_anyone:,} of {len(section.found.data):,}",
        f"of {runs:,} attempts reached the accuracy": f"{100 * solved / runs:.1f} %" if runs else "none",
        "runs proved globally optimal": f"{proved:,}",
        "false claims": f"{sum(claim.count for claim in verdict.false_claims):,}",
    }
    return [{"value": value, "label": label} for label, value in cards.items()]


def _picks(verdict: StudyVerdict) -> list[dict[str, Any]]:
    """Return one line per formulation: the recommended solver, or of a single solver the quality of the models."""
    lines, quality = [], verdict.quality
    for section in verdict.sections:
        said, first = choice_of_solver(section), section.choice.first
        lead = section.standing(first) if first else None
        if len(verdict.overall.standings) < 2:
            mean = quality.figures[quality.measure][section.name]
            shown = f"{100 * mean:.3g} %" if quality.errors else f"{mean:.2f} %"
            word = shown if np.isfinite(mean) else "-"
            tone = GOOD if section.name in quality.choice.leaders else FAIR
            why = model_evidence(quality, section.name)
        else:
            so_far = first and section.choice.kind == CANNOT_TELL
            word, tone, why = f"{first}, so far" if so_far else said.word, said.tone, evidence(section)
        lines.append({
            "name": section.name, "tone": tone, "word": word, "evidence": why,
            "solved": f"{lead.solved:,} of {len(section.found.data):,}" if lead else "-",
            "time": seconds(lead.time) if lead else "-",
        })
    return lines


def _claims(verdict: StudyVerdict) -> Table | None:
    claims = verdict.false_claims
    rows = [(short(c.solver), short(c.formulation), f"{c.count:,}", short(c.claimed) or "-",
             short(c.reason, REASON) or "verified otherwise") for c in claims[:LISTED]]
    note = f"The {LISTED} most frequent kinds of {len(claims)}." if len(claims) > LISTED else ""
    head = ("solver", "formulation", "runs", "claimed", "but")
    return Table("False claims", head, rows, note) if claims else None


def quality_table(quality: Quality) -> Table:
    """Return the mean figures of the models of every formulation, and those on each data set where these are few."""
    head = ("solved", "simulation fit", "one-step fit", "parameter error", "error of f")
    apart = len(quality.sets) > 1 and (len(quality.sets) + 1) * len(quality.formulations) <= LISTED
    rows = []
    for name in quality.formulations:
        whole = f"all {len(quality.sets)}" if len(quality.sets) > 1 else short("".join(s.name for s in quality.sets))
        rows.append((short(name), whole, *_models(quality, name)))
        if apart:
            rows += [(short(name), short(one.name), *_models(one, name)) for one in quality.sets]
    note = ("Means over the records that the formulation solved, and of those over the data sets, of the model with "
            "the best verified objective; fits on samples the fit did not see. Means over different records do not "
            "compare: the verdict pairs them.")
    return Table("Models", ("formulation", "data set", *head), rows, note)


def _models(quality: Quality | DataSet, name: str) -> tuple[str, ...]:
    figures = [quality.figures[c][name] for c in FIGURES]
    fits = [f"{number(v, 4)} %" if np.isfinite(v) else "-" for v in figures[:2]]
    errors = [f"{100 * v:.3g} %" if np.isfinite(v) else "truth unknown" for v in figures[2:]]
    return (f"{quality.solved[name]:,} of {quality.records:,}", *fits, *errors)


def _machines(verdict: StudyVerdict) -> list[tuple[str, str]]:
    names = [name for name in dict.fromkeys(verdict.table["machine"]) if name]
    shown = [short(name) for name in names[:5]] + ([f"{len(names) - 5} more"] if len(names) > 5 else [])
    runs = sorted(str(v)[:16].replace("T", " ") for v in verdict.table["started"] if v and v != "NaT")
    spans = [("Runs", f"{runs[0]} to {runs[-1]} UTC")] if runs else []
    return [("Machine" if len(names) == 1 else "Machines", "; ".join(shown)), *spans] if names else spans

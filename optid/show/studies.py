"""The document of the verdict of a study: headline, tables of accuracy and time, performance profiles, failures."""

from pathlib import Path
from typing import Any

import numpy as np

from optid.phrases import plural, seconds, short
from optid.show import page, terminal
from optid.show.charts import COLOURS
from optid.show.sections import Axis, Banner, Chart, Charts, Code, Document, Fold, Notes, Section, Series
from optid.show.wording import Table, number
from optid.studies.storage.rows import OUTCOMES, REFUSED
from optid.studies.verdicts.averages import Paired
from optid.studies.verdicts.headline import evidence, solver_statement
from optid.studies.verdicts.models import FIGURES, DataSet, Quality
from optid.studies.verdicts.outcomes import MEANINGS, TIMES
from optid.studies.verdicts.standings import Standing, StandingsSection
from optid.studies.verdicts.statement import counting
from optid.studies.verdicts.verdict import StudyVerdict

LISTED = 40  # false claims, and rows of the models; the database has them all
REASON = 300  # characters of a reason
REASONS = 12  # kinds of failure that are shown
TIME_WORDS = {"solve": "compile and solve, cold", "fit": "the whole fit", "warm": "the second, warm solve"}

COUNTED = (
    ("Solved", "the run was completed, our own residuals are within the tolerance of the compared accuracy, and no "
     "other solver verified a lower objective. Of several repetitions every one must count."),
    ("Problem", "one record with one formulation: what every solver was given alike."),
    ("First", "a solver is no candidate if it solved fewer problems than the most reliable one, by more than 1 % of "
     "them and beyond chance. The first is the candidate that no other candidate beats in time on common problems. "
     "Others tie with it if the 95 % interval of the ratio of their times contains 1 or the difference is below 10 %. "
     "With fewer than 6 common problems, or an interval wider than a factor of 2, the comparison cannot tell."),
    ("Models", "compare by their fit on unseen samples, record by record, each formulation with the model of its best "
     "verified objective. Of two to five data sets each is judged by its own records; from six on each counts once."),
    ("Profile", "share of the problems solved within a factor of the fastest time (Dolan and Moré, 2002)."),
)
"""How the verdict counts."""


def study_document(verdict: StudyVerdict, *, title: str = "", command: str = "") -> Document:
    """Return the document of a verdict; the title is by default that of the study."""
    studies = [short(name) for name in dict.fromkeys(verdict.table["study"]) if name]
    head, found = verdict.headline, verdict.found
    solved = sum(s.solved for s in verdict.overall.standings)
    cards = (("runs", f"{len(verdict.table['solver']):,}"), ("solved", f"{solved:,}"),
             ("false claims", f"{sum(claim.count for claim in verdict.false_claims):,}"))
    several = len(verdict.sections) > 1 and any(len(section.standings) > 1 for section in verdict.sections)
    reasons = verdict.failures or verdict.false_claims
    sections = [
        Section("verdict", "", [Banner({"fair": "plain"}.get(head.tone, head.tone), head.word, head.text, cards),
                                *([Notes([f"{one.word}: {one.text}" for one in verdict.statements])]
                                  if verdict.statements else [])]),
        Section("solvers", "Solvers", lambda: [solver_table(verdict.overall)]),
        Section("formulations", "Formulations", lambda: _formulations(verdict)),
        Section("figures", "Performance profiles", lambda: [Charts([profile_chart(section) for section in (
            verdict.overall, *(verdict.sections if several else ()))])], page_only=True),
        Section("models", "Models", lambda: [model_table(verdict.models)]),
        Section("failures", "Failures", lambda: _failures(verdict)),
        Section("method", "Method", lambda: [
            [*COUNTED, ("Time", f"{' + '.join(TIMES[found.measure])}: {TIME_WORDS[found.measure]}; median of the "
                        "repetitions. Averages are geometric means shifted by 10 ms."),
             ("Accuracy", f"{found.accuracy:.0e}; {counting(found.accuracy)}")],
            Fold("Words for how a run ended", [[*OUTCOMES.items(), *MEANINGS.items()]])], page_only=True),
        Section("reproduce", "Reproduce", lambda: [
            Code(command or "optid study report STUDY.sqlite -o study.html"),
            [*page.versions(), *_machines(verdict)]], page_only=True)]
    left_out = {"formulations": not several, "figures": not verdict.overall.standings, "failures": not reasons,
                "solvers": not verdict.overall.standings, "models": not any(verdict.models.solved.values())}
    lead = " · ".join([plural(len(found.data), "problem"), plural(len(found.solvers), "solver"),
                       plural(len(verdict.sections), "formulation")])
    return Document(title or " · ".join(studies[:3]) or "Study", lead,
                    [section for section in sections if not left_out.get(section.id)])


def describe_study(verdict: StudyVerdict) -> str:
    """Return a verdict as text."""
    return terminal.text(study_document(verdict))


def write_study(verdict: StudyVerdict, path: str | Path, *, title: str = "", command: str = "") -> Path:
    """Write the page of a verdict; see `StudyVerdict.report`."""
    return page.write(study_document(verdict, title=title, command=command), path)


def solver_table(section: StandingsSection) -> Table:
    """Return accuracy and time of every solver on the problems of a section, the first choice at the top."""
    first, choice = section.choice.first, section.choice

    def ratio(one: Standing) -> str:
        pair = choice.against.get(one.solver)
        return "1" if one.solver == first else _interval(pair) if pair else "-"

    rows = [(short(one.solver, 40), f"{one.solved:,} of {one.problems:,}", number(one.residual, 2), seconds(one.time),
             ratio(one), f"{one.proved:,}", f"{one.refused:,}", f"{one.false_claims:,}") for one in section.standings]
    note = (f"Ratios of times are paired by problem, with their 95 % interval. False: claims of success. Accuracy "
            f"{section.found.accuracy:.0e}.")
    note += f" Not run: {', '.join(section.idle)}." if section.idle else ""
    head = ("solver", "solved", "residual", "time", f"time / {short(first, 16)}" if first else "time ratio", "proved",
            "refused", "false")
    return Table(section.name, head, rows, note)


def _interval(pair: Paired) -> str:
    """Write a paired comparison for a cell of a table: "1.5 (1.2 to 1.9)"."""
    value, low, high = pair.texts
    return f"{value} ({low} to {high})" if pair.n > 1 else "-"


def _formulations(verdict: StudyVerdict) -> list[Any]:
    """Return the choice of a solver for every formulation that has one, and on the page the table of each."""
    rows = [(short(one.name, 40), solver_statement(one).word,
             f"{one.standing(one.choice.first).solved:,} of {len(one.found.data):,}")
            for one in verdict.sections if one.choice.decided]
    rest = len(verdict.sections) - len(rows)
    note = f"For {plural(rest, 'formulation')} the comparison cannot tell." if rest else ""
    folds = [Fold(one.name, [solver_table(one), Notes([evidence(one)])]) for one in verdict.sections if one.standings]
    return [Table("", ("formulation", "verdict", "solved"), rows, note) if rows else Notes([note]), *folds]


def profile_chart(section: StandingsSection) -> Chart:
    """Return the performance profile of every solver of a section: a step function."""
    series, most = [], max((factors.max(initial=1.0) for factors, _ in section.profiles.values()), default=1.0)
    for k, (name, (factors, shares)) in enumerate(section.profiles.items()):
        xs = np.repeat([1.0, *factors, 1.1 * most], 2)[1:]
        ys = np.repeat([0.0, *shares], 2)
        series.append(Series(name, xs[: ys.size], ys[: xs.size], "line-only", COLOURS[k % len(COLOURS)],
                             dash="" if k < len(COLOURS) else "6 3", width=2.0))
    caption = "Share of the problems solved within a factor of the fastest time."
    return Chart(section.name or "All problems", caption, Axis("time / fastest time", log=True), Axis(
        "share of problems", low=0.0, high=1.0), series)


def model_table(models: Quality) -> Table:
    """Return the mean figures of the models of every formulation, and those on each data set where these are few."""
    apart = 1 < len(models.sets) and (len(models.sets) + 1) * len(models.formulations) <= LISTED
    rows = []
    for name in models.formulations:
        rows.append((short(name, 40), *_figures(models, name)))
        rows += [(f"  on {short(one.name, 30)}", *_figures(one, name)) for one in models.sets if apart]
    behind = "ratio of parameter errors" if models.errors else "points of simulation fit"
    note = ("Means in % over the records that a formulation solved, of fits on samples that it did not see and of "
            f"errors against a known truth. Behind: {behind}, paired by {models.unit}, with the 95 % interval.")
    return Table("", ("formulation", "solved", "simul.", "1-step", "params", "f", "behind"), rows, note)


def _figures(some: DataSet, name: str) -> tuple[str, ...]:
    values = [some.figures[column][name] * scale for column, scale in zip(FIGURES, (1, 1, 100, 100))]
    pair = some.choice.against.get(name)
    behind = "0" if name == some.choice.first else _interval(pair) if pair is not None else "-"
    return (f"{some.solved[name]:,} of {some.records:,}", *(number(v, 4 if k < 2 else 3) for k, v in enumerate(values)),
            behind)


def _failures(verdict: StudyVerdict) -> list[Any]:
    """Return the claims that were false, and why runs did not reach the accuracy; refusals come last."""
    claims = [(short(c.solver, 40), short(c.formulation, 40), f"{c.count:,}", short(c.claimed) or "-",
               short(c.reason, REASON) or "verified otherwise") for c in verdict.false_claims[:LISTED]]
    head = ("solver", "formulation", "runs", "claimed", "but")
    said, refused = [], []
    for one in verdict.failures:
        is_aside = one.state == REFUSED and one.solver not in verdict.overall.idle
        (refused if is_aside else said).append(f"{one.solver}: {one.state} {one.count:,}: {short(one.reason, REASON)}")
    more = [f"and {len(said) - REASONS} more reasons, which the database has"] if len(said) > REASONS else []
    parts = [(claims, Table("Claims that were false", head, claims)), (said, Notes([*said[:REASONS], *more])),
             (refused, Fold("Refused", [Notes(refused)]))]
    return [part for any_there, part in parts if any_there]


def _machines(verdict: StudyVerdict) -> list[tuple[str, str]]:
    names = [short(name) for name in dict.fromkeys(verdict.table["machine"]) if name]
    runs = sorted(str(v)[:16].replace("T", " ") for v in verdict.table["started"] if v and v != "NaT")
    found = [("Machines", "; ".join(names[:5]))] if names else []
    return [*found, ("Runs", f"{runs[0]} to {runs[-1]} UTC")] if runs else found

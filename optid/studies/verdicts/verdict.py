"""The verdict of a study: problems solved, times at equal verified accuracy, and undecided questions."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.phrases import plural
from optid.registry import render
from optid.studies.storage.rows import ERROR, REFUSED, columns
from optid.studies.storage.store import rows_of_one
from optid.studies.verdicts.headline import headline, model_statement
from optid.studies.verdicts.models import Quality, compare_formulations
from optid.studies.verdicts.outcomes import (
    CONTRADICTED,
    NOT_RUN,
    OTHER_ACCURACY,
    SOLVED,
    UNTIMED,
    VALUE,
    Results,
    Table,
    states_of_rows,
    tabulate,
)
from optid.studies.verdicts.standings import StandingsSection, compare_solvers
from optid.studies.verdicts.statement import BAD, FAIR, Statement, group, join_names

NUMBER = re.compile(r"(?<![A-Za-z_])[-+]?\d[\d.,]*(?:e[-+]?\d+)?")
"""Left out of reasons, so that sentences of one kind count together."""


@dataclass(frozen=True)
class FalseClaim:
    """Claims of one solver that were false, of one kind."""

    solver: str
    formulation: str
    count: int  # runs
    claimed: str  # status reported by the solver
    reason: str  # why it is false, of one of them


@dataclass(frozen=True)
class Failure:
    """Runs of one solver that did not reach the accuracy, of one kind and reason."""

    solver: str
    state: str  # outcome or status
    reason: str  # the sentence, its numbers left out where they differ
    count: int  # problems


@dataclass(frozen=True)
class StudyVerdict:
    """The verdict of a study."""

    table: Table  # the rows, one array per column
    found: Results  # problems and solvers, the accuracy and the measure of time
    overall: StandingsSection  # comparison on all problems
    sections: tuple[StandingsSection, ...]  # comparison on the problems of each formulation, in alphabetical order
    models: Quality  # the formulations by their models
    false_claims: tuple[FalseClaim, ...]  # most frequent first
    failures: tuple[Failure, ...]  # most frequent first, refusals at the end
    headline: Statement  # the verdict in one line
    statements: tuple[Statement, ...]  # the other comparison, warnings and open questions

    @property
    def recommended(self) -> tuple[str, ...]:
        """Solvers that come first or tie for it on all problems; empty if none is recommended."""
        return self.overall.recommended

    def __str__(self) -> str:
        """The verdict as text, with its tables."""
        return render(self)

    def report(self, path: str | Path, *, title: str = "", command: str = "") -> Path:
        """Write the verdict with its tables and figures as one HTML file that opens offline.

        Args:
            path: the file, replaced when it exists.
            title: by default that of the study.
            command: the command line behind the verdict, for the section that says how to reproduce it.

        Returns:
            The path.

        Raises:
            OSError: the file cannot be written.
        """
        return render(self, "page", path, title=title, command=command)


def conclude(rows: Any, *, study: str | None = None, accuracy: float | None = None, time: str = "solve"
             ) -> StudyVerdict:
    """Draw the conclusions from the rows of a study.

    Args:
        rows: a mapping of columns, a frame (pandas, polars), dict rows, or the path of a database.
        study: its title, for a database that holds several.
        accuracy: relative accuracy to compare at; unless given, the one most runs asked for.
        time: "solve" (compile and solve, cold), "fit" (the whole fit) or "warm" (the second solve).

    Returns:
        The verdict. A solver counts only where our residuals verified the accuracy; undecided questions are stated.

    Raises:
        DataError: these are no rows of a study, an unknown measure of time, or an accuracy that is none.
        StudyError: the database holds several studies, and none is named.
        DatabaseError: the database cannot be read.
    """
    if accuracy is not None and not 0 < accuracy < 1:
        raise DataError(f"accuracy is a number between 0 and 1; {accuracy:g} is not")
    table = columns(rows_of_one(rows, study) if isinstance(rows, str | Path) else rows)
    found = tabulate(table, accuracy, time)
    overall = compare_solvers(found)
    sections = tuple(compare_solvers(found.where(found.formulation == f), f) for f in sorted(set(found.formulation)))
    models = compare_formulations(found, table)
    head = headline(overall, sections, models)
    about_models = model_statement(models)
    said = [] if about_models in (None, head) else [about_models]
    return StudyVerdict(table, found, overall, sections, models, _false_claims(table, found), _failures(found),
                        head, (*said, *_warnings(overall, found, table)))


def _warnings(overall: StandingsSection, found: Results, table: Table) -> Iterator[Statement]:
    keys, error = found.data_set, found.state == ERROR
    failed = [key for key in sorted(set(keys)) if found.ran[keys == key].any()
              and (error | ~found.ran)[keys == key].all()]
    if failed:  # such as a file that cannot be read
        why = found.reason[(keys == failed[0])[:, None] & error][0]
        names = join_names([key.partition(chr(0))[2] for key in failed])
        text = f"Every run on {names} ended with an error: {why[:200]}"
        yield Statement(BAD, "Data that failed", text.rstrip(".") + ".")
    if (wrong := _refuted(found, table)).any():
        p = int(np.flatnonzero(wrong)[0])
        yield Statement(BAD, "A proof is contradicted", f"On {plural(int(wrong.sum()), 'problem')} a proved lower "
                        f"bound lies above an objective that another run verified, first on {found.data[p]}, "
                        f"{found.formulation[p]}. One of the two is wrong: please report it.")
    if (other := states_of_rows(table, found) == OTHER_ACCURACY).any():
        asked = ", ".join(f"{value:.0e}" for value in np.unique(table["accuracy"][other]))
        yield Statement(FAIR, "Several accuracies", f"{plural(int(other.sum()), 'run')} asked for {asked}: they do not "
                        f"count beside those that suit {found.accuracy:.0e}; --accuracy compares at another one.")
    if k := overall.infeasible:
        have = "has" if k == 1 else "have"
        yield Statement(FAIR, "Infeasible problems", f"{plural(k, 'problem')} {have} no solution according to every "
                        "solver that came to an answer. This counts neither for nor against them.")


def _refuted(found: Results, table: Table) -> np.ndarray:
    """Return where a proved lower bound lies above a verified objective of another run, (P,): a proof is wrong."""
    if not found.row.size:
        return np.zeros(0, dtype=bool)
    there, bound = np.isfinite(found.objective), table["bound"][found.row]
    proved = there & table["proved"][found.row] & np.isfinite(bound)
    least = np.max(np.where(proved, bound, -np.inf), axis=1)
    best = np.min(np.where(there, found.objective, np.inf), axis=1)
    with np.errstate(invalid="ignore"):
        return np.isfinite(least) & np.isfinite(best) & ((least - best) / found.size > max(VALUE, found.tolerance))


def _false_claims(table: Table, found: Results) -> tuple[FalseClaim, ...]:
    lies = [(int(i), str(table["reason"][i])) for i in np.flatnonzero(table["false_claim"])]
    for p, s in zip(*np.nonzero(found.state == CONTRADICTED)):
        winner = found.solvers[int(np.flatnonzero(found.solved[p])[0])]
        lies.append((int(found.row[p, s]), f"{winner} has a verified point"))
    groups = group(((table["solver"][i], table["formulation"][i], table["status_claimed"][i]), reason)
                         for i, reason in lies)
    claims = [FalseClaim(key[0], key[1], len(reasons), key[2], min(reasons)) for key, reasons in groups.items()]
    return tuple(sorted(claims, key=lambda c: (-c.count, c.solver, c.formulation, c.claimed)))


def _failures(found: Results) -> tuple[Failure, ...]:
    failed = zip(*np.nonzero(~np.isin(found.state, (SOLVED, NOT_RUN, UNTIMED))))
    said = [(found.solvers[s], str(found.state[p, s]), str(found.reason[p, s])) for p, s in failed]
    groups = group(((solver, state, NUMBER.sub("…", reason)), reason) for solver, state, reason in said)
    failures = [Failure(solver, state, reasons[0] if len(set(reasons)) == 1 else shape, len(reasons))
                for (solver, state, shape), reasons in groups.items()]
    return tuple(sorted(failures, key=lambda f: (f.state == REFUSED, -f.count, f.solver, f.state, f.reason)))


"""The verdict of a study: who solves what, how fast, at equal verified accuracy, and what the data cannot tell."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.studies.storage.rows import ERROR, REFUSED
from optid.studies.verdicts.advice import carries_over, choice_of_solver, headline, no_solution
from optid.studies.verdicts.agreement import Agreement, agreement_matrix
from optid.studies.verdicts.choice import listed
from optid.studies.verdicts.model_advice import UNDECIDED, choice_of_formulation
from optid.studies.verdicts.outcomes import (
    CONTRADICTED,
    OTHER_ACCURACY,
    SOLVED,
    VALUE,
    Results,
    applicable,
    states_of_rows,
    tabulate,
    usual_accuracy,
)
from optid.studies.verdicts.quality import Quality, compare_formulations
from optid.studies.verdicts.standings import Section, compare_solvers
from optid.studies.verdicts.statement import Statement, plural
from optid.studies.verdicts.table import columns


@dataclass(frozen=True)
class FalseClaim:
    """Claims of one solver that were false, of one kind.

    Attributes:
        solver, formulation: labels.
        count: runs.
        claimed: what the solver said.
        reason: why it is false, of one of them.
    """

    solver: str
    formulation: str
    count: int
    claimed: str
    reason: str


@dataclass(frozen=True)
class Failure:
    """Runs of one solver that did not reach the accuracy, of one kind and reason.

    Attributes:
        solver: label.
        state: outcome or status.
        reason: the sentence, its numbers left out where they differ.
        count: problems.
    """

    solver: str
    state: str
    reason: str
    count: int


@dataclass(frozen=True)
class Verdict:
    """What a study says.

    Attributes:
        table: the rows, one array per column.
        found: problems and solvers.
        accuracy: relative accuracy that was compared at.
        time: measure of time: "solve", "fit" or "warm".
        overall: comparison on all problems.
        sections: comparison on the problems of each formulation, in alphabetical order.
        quality: the formulations by their models.
        agreement: of the solvers.
        false_claims: most frequent first.
        failures: most frequent first, refusals at the end.
        headline: the verdict in one line.
        statements: further recommendations, warnings, and what cannot be told.
    """

    table: Mapping[str, np.ndarray]
    found: Results
    accuracy: float
    time: str
    overall: Section
    sections: tuple[Section, ...]
    quality: Quality
    agreement: Agreement
    false_claims: tuple[FalseClaim, ...]
    failures: tuple[Failure, ...]
    headline: Statement
    statements: tuple[Statement, ...]

    @property
    def recommended(self) -> tuple[str, ...]:
        """Solvers that come first or tie for it on all problems; empty where nobody can be recommended."""
        return self.overall.recommended

    def __str__(self) -> str:
        """The verdict as text."""
        return "\n".join(f"{s.word}: {s.text}" for s in (self.headline, *self.statements))


def conclude(rows: Any, *, study: str | None = None, accuracy: float | None = None, time: str = "solve",
             level: float = 0.05) -> Verdict:
    """Draw the conclusions from the rows of a study.

    Args:
        rows: a mapping of columns, a frame, dict rows, or the path of a database.
        study: its title, for a database that holds several.
        accuracy: relative accuracy to compare at; unless given, the one most runs asked for.
        time: "solve" (compile and solve, cold), "fit" (the whole fit) or "warm" (the second solve).
        level: significance level of the test over data sets.

    Returns:
        The verdict. A solver counts only where our residuals verified the accuracy; what the data cannot tell is said.

    Raises:
        DataError: these are no rows of a study, an unknown measure of time, or an accuracy that is none.
        StudyError: the database holds several studies, and none is named.
        DatabaseError: the database cannot be read.
    """
    if accuracy is not None and not 0 < accuracy < 1:
        raise DataError(f"accuracy is a number between 0 and 1; {accuracy:g} is not")
    if isinstance(rows, str | Path):
        from optid.studies.storage.store import rows_of_one

        rows = rows_of_one(rows, study)
    table = columns(rows)
    at = usual_accuracy(table) if accuracy is None else accuracy
    found = tabulate(table, at, time)
    overall = compare_solvers(found, "", level)
    formulations = sorted(set(found.formulation))
    sections = tuple(compare_solvers(found.where(found.formulation == f), f, level) for f in formulations)
    quality = compare_formulations(found, table, level)
    head = headline(overall, list(sections), quality)
    return Verdict(
        table, found, at, time, overall, sections, quality, agreement_matrix(found, table), _false_claims(table, found),
        _failures(found), head, tuple(_statements(overall, sections, quality, found, table, head)),
    )  # fmt: skip


def _statements(overall: Section, sections: tuple[Section, ...], quality: Quality, found: Results,
                table: Mapping[str, np.ndarray], head: Statement) -> list[Statement]:  # fmt: skip
    if not len(found.data):
        return []
    models, solvers = choice_of_formulation(quality), choice_of_solver(overall)
    if head == models:
        decided = not head.word.startswith(UNDECIDED)
        said = [solvers, carries_over(quality.ranking, "formulation") if decided else None]
    else:
        said = [models]
        if found.solved.any() and len(overall.standings) > 1 and (len(sections) == 1 or head == solvers):
            said.append(carries_over(overall.ranking))
    said += [_failed_data(found), _never(overall), _refuted(found, table), _no_truth(quality)]
    said.append(_other_accuracies(found, table))
    if overall.infeasible:
        said.append(Statement("fair", "Infeasible problems", no_solution(overall), "solver"))
    return [statement for statement in said if statement is not None]


def _failed_data(found: Results) -> Statement | None:
    """Name the data sets on which every run ended with an error, such as a file that cannot be read."""
    keys = np.array([f"{study}\0{data}" for study, data in zip(found.study, found.data)], dtype=object)
    tried, error = applicable(found), found.state == ERROR
    failed = [key for key in sorted(set(keys)) if (there := tried[keys == key]).any()
              and (error[keys == key] | ~there).all()]  # fmt: skip
    if not failed:
        return None
    why = found.reason[(keys == failed[0])[:, None] & error][0]
    text = f"Every run on {listed([key.partition(chr(0))[2] for key in failed])} ended with an error: {why[:200]}"
    return Statement("bad", "Data that failed", text.rstrip(".") + ".", "data sets")


def _never(overall: Section) -> Statement | None:
    never = [s.solver for s in overall.standings if not s.solved]
    if not never or len(never) == len(overall.standings):
        return None
    tried = "; ".join(f"{s.solver}: {plural(s.problems, 'problem')}, "
                      + ", ".join(f"{word} {count:,}" for word, count in s.failures.items())
                      for s in overall.standings if not s.solved)  # fmt: skip
    return Statement("bad", "Never reached the accuracy", f"{tried}.", "solver")


def _no_truth(quality: Quality) -> Statement | None:
    if quality.truth or not any(quality.solved.values()):
        return None
    text = "Errors of parameters and nonlinearity cannot be told: the truth is not known for any record."
    return Statement("fair", "Truth unknown", text, "formulation")


def _other_accuracies(found: Results, table: Mapping[str, np.ndarray]) -> Statement | None:
    """Say how many runs asked for another accuracy."""
    other = states_of_rows(table, found) == OTHER_ACCURACY
    if not other.any():
        return None
    asked = ", ".join(f"{value:.0e}" for value in np.unique(table["accuracy"][other]))
    text = (f"{plural(int(other.sum()), 'run')} asked for {asked}: they do not count beside those that suit "
            f"{found.accuracy:.0e}; --accuracy compares at another one.")  # fmt: skip
    return Statement("fair", "Several accuracies", text, "solver")


def _refuted(found: Results, table: Mapping[str, np.ndarray]) -> Statement | None:
    """Warn where a proved lower bound lies above an objective that another run verified: then a proof is wrong."""
    if not found.row.size:
        return None
    rows = np.where(np.isfinite(found.objective), found.row, -1)
    proved = (rows >= 0) & table["proved"][rows] & np.isfinite(table["bound"][rows])
    bounds = np.max(np.where(proved, table["bound"][rows], -np.inf), axis=1)
    best = np.min(np.where(np.isfinite(found.objective), found.objective, np.inf), axis=1)
    with np.errstate(invalid="ignore"):
        wrong = np.isfinite(bounds) & np.isfinite(best) & ((bounds - best) / found.size > max(VALUE, found.tolerance))
    if not wrong.any():
        return None
    p = int(np.flatnonzero(wrong)[0])
    text = f"On {plural(int(wrong.sum()), 'problem')} a proved lower bound lies above an objective that another run "
    text += "verified, "
    text += f"first on {found.data[p]}, {found.formulation[p]}. One of the two is wrong: please report it."
    return Statement("bad", "A proof is contradicted", text, "claims")


def _false_claims(table: Mapping[str, np.ndarray], found: Results) -> tuple[FalseClaim, ...]:
    groups: dict[tuple[str, ...], list[str]] = {}
    for i in np.flatnonzero(table["false_claim"]):
        key = tuple(str(table[c][i]) for c in ("solver", "formulation", "status_claimed"))
        groups.setdefault(key, []).append(table["reason"][i])
    for p, s in zip(*np.nonzero(found.state == CONTRADICTED)):
        key = (found.solvers[s], str(found.formulation[p]), str(table["status_claimed"][found.row[p, s]]))
        winner = found.solvers[int(np.flatnonzero(found.solved[p])[0])]
        groups.setdefault(key, []).append(f"{winner} has a verified point")
    claims = [FalseClaim(key[0], key[1], len(reasons), key[2], min(reasons)) for key, reasons in groups.items()]
    return tuple(sorted(claims, key=lambda c: (-c.count, c.solver, c.formulation, c.claimed)))


def _failures(found: Results) -> tuple[Failure, ...]:
    groups: dict[tuple[str, str, str], list[str]] = {}
    failed = (applicable(found) | (found.state == REFUSED)) & (found.state != SOLVED)
    for p, s in zip(*np.nonzero(failed)):
        reason = str(found.reason[p, s])
        groups.setdefault((found.solvers[s], str(found.state[p, s]), without_numbers(reason)), []).append(reason)
    failures = [
        Failure(solver, state, reasons[0] if len(set(reasons)) == 1 else shape, len(reasons))
        for (solver, state, shape), reasons in groups.items()
    ]
    return tuple(sorted(failures, key=lambda f: (f.state == REFUSED, -f.count, f.solver, f.state, f.reason)))


def without_numbers(reason: str) -> str:
    """Return a sentence without its numbers, so that sentences of one kind count together."""
    return re.sub(r"(?<![A-Za-z_])[-+]?\d[\d.,]*(?:e[-+]?\d+)?", "…", reason)

"""Comparison of solvers on one record and one formulation, with a recommendation."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.phrases import seconds
from optid.studies.storage.rows import ERROR, REFUSED, columns
from optid.studies.verdicts.averages import MINOR
from optid.studies.verdicts.outcomes import FALSE_CLAIM, SOLVED, WORSE_MINIMUM, seconds_of, tabulate
from optid.studies.verdicts.statement import BAD, FAIR, GOOD, Statement, counting, group, join_names
from optid.studies.verdicts.verdict import StudyVerdict, conclude


@dataclass(frozen=True)
class Line:
    """One solver."""

    solver: str
    state: str  # "solved", or the reason
    status: str  # after our own residuals have judged the claim; the outcome where nothing was judged
    proved: bool  # globally optimal
    above: float  # objective above the best verified one, relative; NaN without a point
    residual: float  # worst verified residual; NaN without a point
    cold: float  # seconds of the first solve, compilation included, median over the repetitions
    warm: float  # seconds of the second solve, from the first one's solution
    one_step: float  # one-step fit in % on the hold-out samples
    simulation: float  # simulation fit in % there
    reason: str  # one sentence where the state needs one


@dataclass(frozen=True)
class SolverComparison:
    """All solvers on one record."""

    lines: tuple[Line, ...]  # those that were run, the recommended order first
    refused: dict[str, str]  # {solver: why it was not run}
    accuracy: float  # requested, relative

    @property
    def reasons(self) -> dict[str, list[str]]:
        """Solvers that did not solve it, by reason."""
        return group((line.reason, line.solver) for line in self.lines if line.state != SOLVED and line.reason)

    @property
    def common_error(self) -> str | None:
        """The error of every solver, such as a record without excitation; None if one was run."""
        if self.lines and len(self.reasons) == 1 and all(line.state == ERROR for line in self.lines):
            (reason,) = self.reasons
            return reason.partition(": ")[2] or reason
        return None

    @property
    def headline(self) -> Statement:
        """Which solver to use on this record, with the evidence."""
        solved = [line for line in self.lines if line.state == SOLVED]
        at = f"the accuracy of {self.accuracy:.0e}"
        if not self.lines:
            return Statement(FAIR, "No solver takes this formulation", "choose others (optid solvers).")
        if not solved:
            states = group((line.state, line.solver) for line in self.lines)
            why = "; ".join(f"{state}: {join_names(names)}" for state, names in states.items())
            return Statement(BAD, f"No solver reached {at}", f"{counting(self.accuracy)}; {why}.")
        first, *others = solved
        close = [line for line in others if line.cold <= (1 + MINOR) * first.cold and line.proved == first.proved]
        rest = [line for line in others if line not in close]
        names = [line.solver for line in (first, *close)]
        text = f"{'they' if close else 'it'} reached {at} ({counting(self.accuracy)}) in {seconds(first.cold)}"
        text += f", equal within {MINOR:.0%}" if close else ""
        text += f", {'' if first.proved else 'not '}proved globally optimal"
        failed = [line.solver for line in self.lines if line.state != SOLVED]
        if rest:
            text += f"; next is {rest[0].solver} with {seconds(rest[0].cold)}"
            text += " (without a proof)" if first.proved and not rest[0].proved else ""
        elif not others:
            text += f"; {join_names(failed)} did not" if failed else "; there is no other to compare it with"
        either = " or ".join(names) if len(names) < 4 else f"any of {join_names(names)}"
        return Statement(GOOD, f"Use {either}", f"{text}.")

    @property
    def recommendation(self) -> str:
        """One sentence: which solver, with the evidence."""
        return f"{self.headline.word}: {self.headline.text}"


def compare(rows: Sequence[dict[str, Any]]) -> SolverComparison:
    """Set the rows of a study with one record, one formulation and one accuracy side by side.

    Raises:
        DataError: there are no rows, or these are none of a study.
    """
    if not rows:
        raise DataError("there are no rows to compare: the study has no run")
    table = columns(rows)
    found = tabulate(table)
    best = np.min(found.objective[0][found.solved[0]], initial=np.inf)
    excess = (table["objective"] - (best if np.isfinite(best) else np.nan)) / found.size[0]
    cold = seconds_of(table, "solve")
    lines, refused = [], {}
    for solver, state, row, residual in zip(found.solvers, found.state[0], found.row[0], found.residual[0]):
        shown = {name: values[row] for name, values in table.items()}
        if state == REFUSED:
            refused[solver] = str(shown["reason"])
            continue
        mine = (table["solver"] == solver) & (table["outcome"] == shown["outcome"])
        lines.append(Line(
            solver, str(state), str(shown["status_verified"] or shown["outcome"]), bool(shown["proved"]),
            float(excess[row]), float(residual), _median(cold[mine]), _median(table["warm_s"][mine]),
            float(shown["one_step_fit"]), float(shown["simulation_fit"]), str(shown["reason"])))
    return SolverComparison(tuple(sorted(lines, key=_order)), refused, float(table["accuracy"][0]))


def verdict_on_one_record(rows: Sequence[dict[str, Any]]) -> StudyVerdict:
    """Return the verdict on the rows of `compare`, with the headline of the comparison; it raises the same."""
    head = compare(rows).headline
    caveat = Statement(FAIR, "Other records: cannot tell", "This is one record. A study of at least 6 problems (optid "
                       "study run) shows which solver to prefer on others.")
    head = replace(head, text=head.text[:1].upper() + head.text[1:])  # its own sentence on the page
    return replace(conclude(rows), headline=head, statements=(caveat,))


def _order(line: Line) -> tuple[Any, ...]:
    rank = {SOLVED: 0, WORSE_MINIMUM: 1, FALSE_CLAIM: 3}.get(line.state, 2)
    return rank, not line.proved, np.nan_to_num(line.cold, nan=np.inf), line.solver


def _median(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else float("nan")

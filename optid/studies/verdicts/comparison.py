"""Solvers side by side on one record and one formulation: a line for each, and one sentence that says which to use."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.show.wording import seconds
from optid.studies.storage.rows import ERROR, REFUSED
from optid.studies.verdicts.choice import listed
from optid.studies.verdicts.outcomes import FALSE_CLAIM, SOLVED, WORSE_MINIMUM, tabulate
from optid.studies.verdicts.standings import MINOR
from optid.studies.verdicts.statement import BAD, FAIR, GOOD, Statement, counting
from optid.studies.verdicts.table import columns
from optid.studies.verdicts.verdict import Verdict, conclude


@dataclass(frozen=True)
class Line:
    """One solver.

    Attributes:
        solver: its label.
        state: "solved", or the word for why not.
        status: status after our own residuals have judged the claim; the outcome where nothing was judged.
        proved: whether the answer is proved globally optimal.
        above: objective above the best verified one, relative; NaN without a point.
        residual: worst verified residual; NaN without a point.
        cold: seconds of the first solve, compilation included, median over the repetitions.
        warm: seconds of the second solve, from the first one's solution.
        one_step: one-step fit in % on the hold-out samples.
        simulation: simulation fit in % there.
        reason: one sentence where the state needs one.
    """

    solver: str
    state: str
    status: str
    proved: bool
    above: float
    residual: float
    cold: float
    warm: float
    one_step: float
    simulation: float
    reason: str


@dataclass(frozen=True)
class Comparison:
    """All solvers on one record.

    Attributes:
        lines: those that were run, the recommended order first.
        refused: {solver: why it was not run}.
        accuracy: requested relative accuracy.
    """

    lines: tuple[Line, ...]
    refused: dict[str, str]
    accuracy: float

    @property
    def reasons(self) -> dict[str, list[str]]:
        """Solvers that did not solve it by the sentence that says why."""
        found: dict[str, list[str]] = {}
        for line in self.lines:
            if line.state != SOLVED and line.reason:
                found.setdefault(line.reason, []).append(line.solver)
        return found

    @property
    def common_error(self) -> str | None:
        """What kept every solver from being run, such as a record without excitation; None where one was run."""
        if self.lines and len(self.reasons) == 1 and all(line.state == ERROR for line in self.lines):
            return next(iter(self.reasons)).partition(": ")[2] or next(iter(self.reasons))
        return None

    @property
    def headline(self) -> Statement:
        """Which solver to use on this record, with the evidence."""
        solved = [line for line in self.lines if line.state == SOLVED]
        if not solved and not self.lines:
            return Statement(FAIR, "No solver takes this formulation", "choose others (optid solvers).", "solver")
        if not solved:
            word = f"No solver reached the accuracy of {self.accuracy:.0e}"
            return Statement(BAD, word, f"{counting(self.accuracy)}; {self._why_not()}.", "solver")
        first, *others = solved
        proof = f", {'' if first.proved else 'not '}proved globally optimal"
        close = [line for line in others if line.cold <= (1 + MINOR) * first.cold and line.proved == first.proved]
        names = [line.solver for line in (first, *close)]
        text = f"{'they' if close else 'it'} reached the accuracy of {self.accuracy:.0e} ({counting(self.accuracy)}) "
        text += f"in {seconds(first.cold)}"
        text += f", equal within {MINOR:.0%}{proof}" if close else proof
        rest = [line for line in others if line not in close]
        if rest:
            text += f"; next is {rest[0].solver} with {seconds(rest[0].cold)}"
            text += " (without a proof)" if first.proved and not rest[0].proved else ""
        elif not others:
            failed = [line.solver for line in self.lines if line is not first]
            text += f"; {listed(failed)} did not" if failed else "; there is no other to compare it with"
        return Statement(GOOD, f"Use {_either(names)}", f"{text}.", "solver")

    @property
    def recommendation(self) -> str:
        """One sentence: which solver, with the evidence."""
        return f"{self.headline.word}: {self.headline.text}"

    def _why_not(self) -> str:
        counts: dict[str, list[str]] = {}
        for line in self.lines:
            counts.setdefault(line.state, []).append(line.solver)
        return "; ".join(f"{state}: {listed(names)}" for state, names in counts.items())


def compare(rows: Sequence[dict[str, Any]]) -> Comparison:
    """Set the rows of one record and one formulation side by side.

    Args:
        rows: of a study with one record, one formulation and one accuracy.

    Raises:
        DataError: there are no rows, or these are none of a study.
    """
    if not rows:
        raise DataError("there are no rows to compare: the study has no run")
    table = columns(rows)
    found = tabulate(table)
    accuracy = float(table["accuracy"][0])
    best = np.min(found.objective[0][found.solved[0]], initial=np.inf)
    lines, refused = [], {}
    for s, solver in enumerate(found.solvers):
        row = int(found.row[0, s])
        if found.state[0, s] == REFUSED:
            refused[solver] = str(table["reason"][row])
            continue
        mine = (table["solver"] == solver) & (table["outcome"] == table["outcome"][row])
        cold = np.nan_to_num(table["compile_s"][mine]) + table["solve_s"][mine]
        above = (table["objective"][row] - best) / found.size[0] if np.isfinite(best) else np.nan
        lines.append(Line(
            solver, str(found.state[0, s]), str(table["status_verified"][row] or table["outcome"][row]),
            bool(table["proved"][row]), float(above), float(found.residual[0, s]), _median(cold),
            _median(table["warm_s"][mine]), float(table["one_step_fit"][row]), float(table["simulation_fit"][row]),
            str(table["reason"][row])))
    return Comparison(tuple(sorted(lines, key=_order)), refused, accuracy)


def verdict_on_one_record(rows: Sequence[dict[str, Any]]) -> Verdict:
    """Return the verdict of a study of one record and one formulation, headed by what the comparison says.

    Args:
        rows: of a study with one record, one formulation and one accuracy.

    Raises:
        DataError: there are no rows, or these are none of a study.
    """
    found, verdict = compare(rows), conclude(rows)
    caveat = Statement(FAIR, "Other records: cannot tell", "This is one record. Which solver to prefer on others is "
                       "told by a study of at least 6 problems (optid study run).", "data sets")  # fmt: skip
    said = [statement for statement in verdict.statements if statement.about != "data sets"]
    text = found.headline.text
    head = replace(found.headline, text=text[:1].upper() + text[1:])  # a sentence of its own on the page
    return replace(verdict, headline=head, statements=(caveat, *said))


def _order(line: Line) -> tuple[Any, ...]:
    states = (SOLVED, WORSE_MINIMUM)
    rank = states.index(line.state) if line.state in states else len(states) + (line.state == FALSE_CLAIM)
    return rank, not line.proved, np.nan_to_num(line.cold, nan=np.inf), line.solver


def _median(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else float("nan")


def _either(names: Sequence[str]) -> str:
    return " or ".join(names) if len(names) < 4 else f"any of {listed(list(names))}"

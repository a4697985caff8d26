"""The standing of every solver on a set of problems, all of a study or those of one formulation."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.studies.storage.rows import REFUSED
from optid.studies.verdicts.averages import performance_profiles, shifted_geometric_mean
from optid.studies.verdicts.choice import Choice, choose
from optid.studies.verdicts.outcomes import INFEASIBLE, Results, agreed_infeasible


@dataclass(frozen=True)
class Standing:
    """One solver on a set of problems."""

    solver: str
    problems: int  # it was run on
    solved: int  # where it reached the verified accuracy at the best verified objective
    refused: int  # problems it does not take
    false_claims: int  # problems on which a claim of it was false
    time: float  # shifted geometric mean of the seconds on what it solved; others may have solved other problems
    proved: int  # problems on which what it solved is proved globally optimal
    residual: float  # median verified residual on what it solved
    failures: dict[str, int]  # {why not solved: problems}, most frequent first


@dataclass(frozen=True)
class StandingsSection:
    """The comparison of solvers on one set of problems."""

    name: str  # label of the formulation, or "" for all problems
    found: Results  # its problems and solvers, without problems that are infeasible by agreement
    infeasible: int  # number of those
    standings: tuple[Standing, ...]  # of the solvers that were run, best first
    idle: tuple[str, ...]  # solvers that were run on none of these problems
    choice: Choice  # the best solver
    profiles: dict[str, tuple[np.ndarray, np.ndarray]]  # performance profiles, as of `performance_profiles`

    @property
    def recommended(self) -> tuple[str, ...]:
        """The first and those that tie; empty where undecided, or where it fails more often than not."""
        lead = self.standing(self.choice.first) if self.choice.decided else None
        return self.choice.leaders if lead is not None and 2 * lead.solved >= lead.problems else ()

    def standing(self, solver: str) -> Standing:
        """Return the standing of one solver."""
        return next(s for s in self.standings if s.solver == solver)


def compare_solvers(found: Results, name: str = "") -> StandingsSection:
    """Compare the solvers on the problems of a table; the name is that of the section."""
    gone: np.ndarray = agreed_infeasible(found)
    run: np.ndarray = np.any(found.ran, axis=0)
    idle = tuple(s for s, there in zip(found.solvers, run) if not there)
    found = found.where(solvers=run)
    kept = found.where(~gone)
    choice = choose(kept.time, kept.solvers)
    counted = found.ran & ~((found.state == INFEASIBLE) & gone[:, None])  # a crash on an infeasible problem counts

    def order(standing: Standing) -> tuple[Any, ...]:
        """First choice, candidates by their time against it, then by what was solved."""
        pair, candidate = choice.against.get(standing.solver), standing.solver in choice.candidates
        return (standing.solver != choice.first, not candidate,
                (pair.value if pair else 1.0) if candidate else -standing.solved, standing.solver)

    standings = [_standing(found, s, counted[:, s]) for s in range(len(found.solvers))]
    return StandingsSection(name, kept, int(gone.sum()), tuple(sorted(standings, key=order)), idle, choice,
                            dict(zip(kept.solvers, performance_profiles(kept.time))))


def _standing(found: Results, s: int, ran: np.ndarray) -> Standing:
    """Return the standing of solver number s; `ran` are the problems that count for or against it, (P,)."""
    state, solved = found.state[:, s], found.solved[:, s]
    words, counts = np.unique(state[ran & ~solved].astype(str), return_counts=True)
    residual = found.residual[solved, s]
    residual = residual[np.isfinite(residual)]
    return Standing(
        solver=found.solvers[s], problems=int(ran.sum()), solved=int(solved.sum()),
        refused=int((state == REFUSED).sum()), false_claims=int(found.false[:, s].sum()),
        time=shifted_geometric_mean(found.time[solved, s]), proved=int(found.proved[:, s].sum()),
        residual=float(np.median(residual)) if residual.size else float("nan"),
        failures={str(words[i]): int(counts[i]) for i in np.argsort(-counts, kind="stable")})

"""The standing of every solver on a set of problems: all of a study, or those of one formulation."""

from dataclasses import dataclass

import numpy as np

from optid.studies.storage.rows import REFUSED
from optid.studies.verdicts.averages import (
    Growth,
    PerformanceProfile,
    performance_profiles,
    shifted_geometric_mean,
    time_growth,
    time_ratios,
)
from optid.studies.verdicts.choice import Choice, choose
from optid.studies.verdicts.outcomes import INFEASIBLE, Results, agreed_infeasible
from optid.studies.verdicts.ranks import SolverRanking, rank


@dataclass(frozen=True)
class Standing:
    """One solver on a set of problems."""

    solver: str
    problems: int  # it was run on
    solved: int  # where it reached the verified accuracy at the best verified objective
    refused: int  # problems it does not take
    false_claims: int  # problems on which a claim of it was false
    fastest: int  # problems on which no solver was faster
    time: float  # shifted geometric mean of the seconds on what it solved; others may have solved other problems
    fit: float  # the same of the whole fit; building, judging and proving take their time, too
    proved: int  # problems on which what it solved is proved globally optimal
    penalised: float  # the time with every failure counted as the time limit; inf where a limit is not known
    residual: float  # median verified residual on what it solved
    growth: Growth  # of its time with the record length
    failures: dict[str, int]  # {why not solved: problems}, most frequent first

    @property
    def share(self) -> float:
        """Solved share of the problems it was run on; ``nan`` where it was never run."""
        return self.solved / self.problems if self.problems else float("nan")


@dataclass(frozen=True)
class StandingsSection:
    """The comparison on one set of problems."""

    name: str  # label of the formulation, or "" for all problems
    found: Results  # its problems and solvers, without problems that are infeasible by agreement
    infeasible: int  # number of those
    deniers: tuple[int, int]  # solvers that claim it for some of them, and solvers that were run on some
    standings: tuple[Standing, ...]  # of the solvers that were run, best first
    idle: tuple[str, ...]  # solvers that were run on none of these problems
    choice: Choice  # the best solver
    ranking: SolverRanking  # over data sets
    profiles: dict[str, PerformanceProfile]  # performance profiles

    @property
    def recommended(self) -> tuple[str, ...]:
        """The first and those that tie; empty where undecided, or where it fails more often than not."""
        good = self.choice.decided and self.standing(self.choice.first).share >= 0.5
        return self.choice.leaders if good else ()

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
    says = (found.state == INFEASIBLE) & gone[:, None]
    counted = found.ran & ~says  # a crash on an infeasible problem is a failure

    def order(standing: Standing) -> tuple:
        """First choice, candidates by their time against it, then by what was solved."""
        ratio = choice.against[standing.solver].value if standing.solver in choice.against else 1.0
        candidate = standing.solver in choice.candidates
        return (standing.solver != choice.first, not candidate, ratio if candidate else -standing.solved,
                standing.penalised if np.isfinite(standing.penalised) else np.inf, standing.solver)

    tried = kept.ran & kept.solved.any(axis=0)  # a solver without a solved problem is last without a test
    return StandingsSection(
        name, kept, int(gone.sum()), (int(says.any(axis=0).sum()), int(found.ran[gone].any(axis=0).sum())),
        tuple(sorted(_standings(found, counted), key=order)), idle, choice,
        rank(kept.time, tried, kept.solvers, kept.data_set),
        dict(zip(kept.solvers, performance_profiles(kept.time))))


def _standings(found: Results, counted: np.ndarray) -> list[Standing]:
    """Return the standings in the order of the solvers; `counted` are the entries that count for or against, (P, S)."""
    times, fastest = found.time, time_ratios(found.time) == 1.0
    slowest = np.nanmax(times, axis=1, initial=0.0) if times.size else 0.0
    limits = np.where(np.isfinite(found.limit), np.fmax(found.limit, slowest), np.inf)
    made = []
    for s, solver in enumerate(found.solvers):
        state, ran, solved, mine = found.state[:, s], counted[:, s], found.solved[:, s], times[:, s]
        words, counts = np.unique(state[ran & ~solved].astype(str), return_counts=True)
        known = found.residual[solved, s]
        known = known[np.isfinite(known)]
        made.append(Standing(
            solver=solver, problems=int(ran.sum()), solved=int(solved.sum()), refused=int((state == REFUSED).sum()),
            false_claims=int(found.false[:, s].sum()), fastest=int(fastest[:, s].sum()),
            time=shifted_geometric_mean(mine[solved]), fit=shifted_geometric_mean(found.fit[solved, s]),
            proved=int(found.proved[:, s].sum()), penalised=shifted_geometric_mean(np.where(solved, mine, limits)[ran]),
            residual=float(np.median(known)) if known.size else float("nan"),
            growth=time_growth(mine, found.n, found.group),
            failures={str(words[i]): int(counts[i]) for i in np.argsort(-counts, kind="stable")}))
    return made

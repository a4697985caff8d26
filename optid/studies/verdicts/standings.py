"""How every solver stands on a set of problems: all of a study, or those of one formulation."""

from dataclasses import dataclass

import numpy as np

from optid.studies.storage.rows import REFUSED
from optid.studies.verdicts.averages import Paired, paired_ratio, shifted_geometric_mean
from optid.studies.verdicts.choice import FIRST, TIE, Choice, choose
from optid.studies.verdicts.growth import Growth, time_growth
from optid.studies.verdicts.outcomes import INFEASIBLE, Results, agreed_infeasible, applicable
from optid.studies.verdicts.profiles import Profile, performance_profiles, time_ratios
from optid.studies.verdicts.ranks import Ranking, rank_over_data_sets, ranks_of_problems, scores_by_data_set

MINOR = 0.1  # times closer than 10 % are equal for all practical purposes


@dataclass(frozen=True)
class Standing:
    """One solver on a set of problems.

    Attributes:
        solver: its label.
        problems: problems it was run on.
        solved: those where it reached the verified accuracy at the best verified objective.
        refused: problems it does not take.
        false_claims: problems on which a claim of it was false.
        fastest: problems on which nobody was faster.
        time: shifted geometric mean of the seconds on what it solved; not comparable where others solved other
            problems.
        fit: the same of the whole fit; building, judging and proving take their time, too.
        proved: problems on which what it solved is proved globally optimal.
        penalised: the same as the time, with every failure counted as the time limit; ``inf`` where a limit is not
            known.
        against: its time against the first choice on the problems both solved; None for the first choice itself and
            where there is none.
        residual: median verified residual on what it solved.
        growth: of its time with the record length.
        failures: {why not solved: problems}, most frequent first.
    """

    solver: str
    problems: int
    solved: int
    refused: int
    false_claims: int
    fastest: int
    time: float
    fit: float
    proved: int
    penalised: float
    against: Paired | None
    residual: float
    growth: Growth
    failures: dict[str, int]

    @property
    def share(self) -> float:
        """Solved share of the problems it was run on; ``nan`` where it was never run."""
        return self.solved / self.problems if self.problems else float("nan")


@dataclass(frozen=True)
class Section:
    """The comparison on one set of problems.

    Attributes:
        name: label of the formulation, or "" for all problems.
        found: its problems and solvers; problems without a solution, by common consent, are taken out.
        infeasible: how many were taken out.
        deniers: solvers that say of some of them that they have no solution, and solvers that were run on some.
        standings: one per solver that was run, best first.
        idle: solvers that were run on none of these problems.
        choice: who comes first.
        ranking: over data sets.
        profiles: {solver: performance profile}.
    """

    name: str
    found: Results
    infeasible: int
    deniers: tuple[int, int]
    standings: tuple[Standing, ...]
    idle: tuple[str, ...]
    choice: Choice
    ranking: Ranking
    profiles: dict[str, Profile]

    @property
    def recommended(self) -> tuple[str, ...]:
        """Who comes first or ties for it; empty where that cannot be told, or where it fails more often than not."""
        choice = self.choice
        if choice.kind not in (FIRST, TIE) or self.standing(choice.first).share < 0.5:
            return ()
        return (choice.first, *choice.tied)

    def standing(self, solver: str) -> Standing:
        """Return the standing of one solver."""
        return next(s for s in self.standings if s.solver == solver)


def compare_solvers(found: Results, name: str = "", level: float = 0.05) -> Section:
    """Compare the solvers on the problems of a table.

    Args:
        found: problems and solvers.
        name: label of the section.
        level: significance level of the test over data sets.
    """
    gone: np.ndarray = agreed_infeasible(found)
    run: np.ndarray = np.any(applicable(found), axis=0)
    idle = tuple(s for s, there in zip(found.solvers, run) if not there)
    found = found.where(np.ones(len(gone), dtype=bool), run)
    kept = found.where(~gone)
    choice = choose(kept.time, kept.solvers, MINOR, paired_ratio, none=1.0)
    says = (found.state == INFEASIBLE) & gone[:, None]
    counted = applicable(found) & ~says  # who crashed on a problem without a solution has failed on it all the same
    standings = _standings(found, counted, choice)
    profiles = dict(zip(kept.solvers, performance_profiles(kept.time)))
    standings.sort(key=lambda s: _order(s, choice))
    deniers = (int(says.any(axis=0).sum()), int(applicable(found)[gone].any(axis=0).sum()))
    ranking = _ranking(kept, level)
    return Section(name, kept, int(gone.sum()), deniers, tuple(standings), idle, choice, ranking, profiles)


def _order(standing: Standing, choice: Choice) -> tuple:
    """First choice, candidates by their time against it, then by what was solved."""
    ratio = standing.against.value if standing.against is not None else 1.0
    candidate = standing.solver in choice.candidates
    return (standing.solver != choice.first, not candidate, ratio if candidate else -standing.solved,
            standing.penalised if np.isfinite(standing.penalised) else np.inf, standing.solver)  # fmt: skip


def _standings(found: Results, counted: np.ndarray, choice: Choice) -> list[Standing]:
    """Standings in the order of the solvers.

    Args:
        found: problems and solvers.
        counted: the entries that count for or against the solver, (P, S).
        choice: who comes first.
    """
    times, fastest = found.time, time_ratios(found.time) == 1.0
    slowest = np.nanmax(times, axis=1, initial=0.0) if times.size else 0.0
    limits = np.where(np.isfinite(found.limit), np.fmax(found.limit, slowest), np.inf)
    labels = zip(found.formulation, found.study, found.data, found.noise)
    groups = np.array(["\0".join((*words, f"{noise:.12g}")) for *words, noise in labels], dtype=object)
    made = []
    for s, solver in enumerate(found.solvers):
        state, ran, solved = found.state[:, s], counted[:, s], found.solved[:, s]
        words, counts = np.unique(state[ran & ~solved].astype(str), return_counts=True)
        known = found.residual[solved, s]
        known = known[np.isfinite(known)]
        against = None
        if choice.first and solver != choice.first:
            against = paired_ratio(times[:, s], times[:, found.solvers.index(choice.first)])
        made.append(Standing(
            solver,
            int(ran.sum()),
            int(solved.sum()),
            int((state == REFUSED).sum()),
            int(found.false[:, s].sum()),
            int(fastest[:, s].sum()),
            shifted_geometric_mean(times[solved, s]),
            shifted_geometric_mean(found.fit[solved, s]),
            int(found.proved[:, s].sum()),
            shifted_geometric_mean(np.where(solved, times[:, s], limits)[ran]),
            against,
            float(np.median(known)) if known.size else float("nan"),
            time_growth(times[:, s], found.n, groups),
            {str(words[i]): int(counts[i]) for i in np.argsort(-counts, kind="stable")},
        ))  # fmt: skip
    return made


def _ranking(found: Results, level: float) -> Ranking:
    """Rank the solvers that ran on every data set; a failure or a refusal on a problem ranks last there."""
    data = np.array([f"{s}\0{d}" for s, d in zip(found.study, found.data)], dtype=object)
    ran = applicable(found)
    labels = list(dict.fromkeys(data))
    everywhere = np.array([all(ran[data == d, s].any() for d in labels) for s in range(len(found.solvers))], dtype=bool)
    useful = everywhere & found.solved.any(axis=0)  # who never solved anything is last without a test
    names = tuple(n for n, keep in zip(found.solvers, useful) if keep)
    out = tuple(n for n, keep in zip(found.solvers, useful) if not keep)
    if not len(data):
        return rank_over_data_sets(np.zeros((0, len(names))), names, out, level)
    return rank_over_data_sets(scores_by_data_set(ranks_of_problems(found.time[:, useful]), data), names, out, level)

"""The choice of the best: reliability before speed, with ties and undecided comparisons."""

from dataclasses import dataclass, field
from itertools import permutations

import numpy as np

from optid.studies.verdicts.averages import LEVEL, MINIMUM_PAIRS, Paired, paired_mean, sign_test
from optid.studies.verdicts.statement import join_names, there_are

FIRST, TIE, CANNOT_TELL, ONLY_ONE, NOBODY = "first", "tie", "cannot tell", "only one", "nobody"
DEPENDS = "depends"
RELIABLE = 0.01  # share of the problems by which the number solved may stay behind the most reliable


@dataclass(frozen=True)
class Choice:
    """The outcome of a comparison.

    Its kind is "first" (one is ahead), "tie" (those named are close), "cannot tell" (too few data, or a contradictory
    order), "only one" (nothing to compare), "nobody" (no problem solved) or "depends" (each is behind on a data set).
    """

    kind: str
    first: str = ""  # the best; of a tie the one that solved most, then the one with the best mean
    tied: tuple[str, ...] = ()  # the others not significantly behind it
    candidates: tuple[str, ...] = ()  # as reliable as the best, up to slack and chance
    against: dict[str, Paired] = field(default_factory=dict)  # each against the first, where both solved
    solved: dict[str, int] = field(default_factory=dict)  # problems solved
    missing: str = ""  # the missing data

    @property
    def leaders(self) -> tuple[str, ...]:
        """The best and those that are not significantly behind it."""
        return (self.first, *self.tied)

    @property
    def decided(self) -> bool:
        """Whether one is ahead or several are equal."""
        return self.kind in (FIRST, TIE)


def choose(costs: np.ndarray, names: tuple[str, ...], ratio: bool = True, slack: float = RELIABLE,
           noun: str = "problem", groups: np.ndarray | None = None) -> Choice:
    """Choose the least costly of the most reliable.

    Args:
        costs: (P, S), lower is better, ``nan`` where the problem was not solved.
        names: the S names.
        ratio: whether costs compare by their ratios, else by their differences.
        slack: share of the problems by which the number solved may be below that of the most reliable.
        noun: name of the unit of the comparison.
        groups: (P,) labels, if every group counts as one.

    Returns:
        The choice. The candidates are those whose number solved is not below that of the most reliable by more than the
        slack and beyond chance (exact one-sided sign test on the problems that one of the two solved, at `LEVEL`). Two
        candidates differ where they solved `MINIMUM_PAIRS` problems in common, the interval of their comparison
        excludes equality and the difference has practical meaning; they tie where that interval is narrow, and are
        undecided where it is not. No other candidate is ahead of the first.
    """
    known = np.isfinite(costs)
    counts = known.sum(axis=0)
    solved, units = dict(zip(names, counts.tolist())), len(costs) if groups is None else len(set(groups))
    if not counts.any():
        return Choice(NOBODY, solved=solved, missing="needs a solver that reaches the accuracy")

    def compare(one: np.ndarray, other: np.ndarray) -> Paired:
        return paired_mean(one, other, ratio, groups)

    allowed = int(slack * len(costs))
    best = known[:, [int(np.argmax(counts))]]
    lost, won = (best & ~known).sum(axis=0), (known & ~best).sum(axis=0)
    reliable = [int(s) for s in np.flatnonzero(counts)
                if lost[s] - won[s] <= allowed or sign_test(int(lost[s]), int(won[s])) >= LEVEL]
    candidates = tuple(names[s] for s in reliable)
    beaten = {one for one, other in permutations(reliable, 2) if compare(costs[:, one], costs[:, other]).behind}
    unbeaten = [s for s in reliable if s not in beaten]
    leaders = [s for s in unbeaten if counts[s] >= max(counts[unbeaten]) - allowed]
    common = known[:, leaders].all(axis=1)
    if not leaders or not common.any():
        circle = "has no order: pairwise comparisons are cyclic, "
        circle += f"each of {join_names(candidates)} is beaten by another one"
        missing = f"needs a {noun} that {join_names([names[s] for s in leaders])} all solve" if leaders else circle
        return Choice(CANNOT_TELL, "", (), candidates, {}, solved, missing)
    lead = min(leaders, key=lambda s: compare(np.where(common, costs[:, s], np.nan), np.ones(len(costs))).value)
    against = {names[s]: compare(costs[:, s], costs[:, lead]) for s in np.flatnonzero(counts) if s != lead}
    tied = tuple(name for name in candidates if name in against and not against[name].behind)
    kind, missing = (TIE if tied else FIRST), ""
    if len(names) == 1:
        kind = ONLY_ONE
    elif units < MINIMUM_PAIRS:
        kind, missing = CANNOT_TELL, f"needs at least {MINIMUM_PAIRS} {noun}s; {there_are(units)}"
    elif few := [name for name in tied if not against[name].enough]:
        kind = CANNOT_TELL
        missing = (f"needs at least {MINIMUM_PAIRS} {noun}s that both {names[lead]} and {few[0]} solve; "
                   f"{there_are(against[few[0]].n)}")
    elif vague := [name for name in tied if against[name].vague]:
        kind, pair = CANNOT_TELL, against[vague[0]]
        missing = (f"needs more than {pair.n} {noun}s to tell {names[lead]} and {vague[0]} apart: the interval of "
                   f"their comparison, {pair.low:.3g} to {pair.high:.3g}, is too wide")
    return Choice(kind, names[lead], tied, candidates, against, solved, missing)

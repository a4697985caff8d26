"""Who comes first: reliability before speed, and a tie is called a tie."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import binom

from optid.studies.verdicts.averages import MINIMUM_PAIRS, Paired

FIRST, TIE, CANNOT_TELL, ONLY_ONE, NOBODY = "first", "tie", "cannot tell", "only one", "nobody"
DEPENDS = "depends"
VAGUE = 10.0  # with 10 % of practical meaning, a tie is known to within a factor of 2
RELIABLE = 0.01  # share of the problems by which the number solved may stay behind the most reliable
LEVEL = 0.05  # of the test whether it stays behind by more than chance


@dataclass(frozen=True)
class Choice:
    """The outcome of a comparison.

    Attributes:
        kind: "first" (one is ahead), "tie" (those named are known to be close), "cannot tell" (too few data, or an
            order that depends on the problems; `missing` says which), "only one" (nothing to compare with), "nobody"
            (not one problem solved), "depends" (everybody is behind on one of the data sets).
        first: who is ahead, of a tie the one that solved most, then the one with the best mean; "" where there is
            nobody.
        tied: the others that cannot be told apart from it.
        candidates: who solved as many problems as the most reliable, up to the slack and chance.
        against: {name: it against the first, on the problems that both solved}.
        solved: {name: problems solved}.
        problems: their number.
        missing: what is missing to tell.
    """

    kind: str
    first: str = ""
    tied: tuple[str, ...] = ()
    candidates: tuple[str, ...] = ()
    against: dict[str, Paired] = field(default_factory=dict)
    solved: dict[str, int] = field(default_factory=dict)
    problems: int = 0
    missing: str = ""


def choose(costs: np.ndarray, names: tuple[str, ...], minor: float,
           compare: Callable[[np.ndarray, np.ndarray], Paired], none: float = 0.0, slack: float = RELIABLE,
           noun: str = "problem", units: int | None = None) -> Choice:
    """Choose the least costly of the most reliable.

    Args:
        costs: (P, S), lower is better, ``nan`` where the problem was not solved.
        names: the S names.
        minor: a mean comparison closer to ``none`` than this is of no practical meaning.
        compare: one column of costs against another, such as `paired_ratio`.
        none: the comparison of equals (1 for ratios, 0 for differences).
        noun: what the comparison counts as one is called.
        units: how many of those there are, where that is not a row of the costs but a group of them.
        slack: share of the problems by which the number solved may stay behind the most reliable.

    Returns:
        The choice. Somebody is no candidate where the number solved is behind that of the most reliable by more than
        the slack and beyond chance (exact one-sided sign test on the problems that one of the two solved, at `LEVEL`).
        Two candidates are told apart where they solved `MINIMUM_PAIRS` problems in common, the interval of their
        comparison excludes equality and the difference is of practical meaning; they tie where that interval is narrow,
        and cannot be told where it is not. The first is one that no other candidate is ahead of.
    """  # fmt: skip
    known = np.isfinite(costs)
    counts = known.sum(axis=0)
    solved, problems = {name: int(c) for name, c in zip(names, counts)}, len(costs)
    units = problems if units is None else units
    if not counts.any():
        return Choice(NOBODY, solved=solved, problems=problems, missing="needs a solver that reaches the accuracy")
    allowed = int(slack * problems)
    reliable = _reliable(known, allowed)
    candidates = tuple(names[s] for s in reliable)
    beaten = _beaten(costs, reliable, minor, compare, none)
    unbeaten = [s for s in reliable if s not in beaten]
    if not unbeaten:
        missing = f"goes in a circle: each of {listed(candidates)} is behind another one on the {noun}s that both solve"
        return Choice(CANNOT_TELL, "", (), candidates, {}, solved, problems, missing)
    leaders = [s for s in unbeaten if counts[s] >= max(counts[unbeaten]) - allowed]
    common = known[:, leaders].all(axis=1)
    if not common.any():
        missing = f"needs a {noun} that {listed([names[s] for s in leaders])} all solve"
        return Choice(CANNOT_TELL, "", (), candidates, {}, solved, problems, missing)
    lead = min(leaders, key=lambda s: _mean(np.where(common, costs[:, s], np.nan), compare))
    against = {names[s]: compare(costs[:, s], costs[:, lead]) for s in np.flatnonzero(counts) if s != lead}
    tied = tuple(name for name in candidates if name in against and not _apart(against[name], minor, none))
    kind, missing = (TIE if tied else FIRST), ""
    if len(names) == 1:
        kind = ONLY_ONE
    elif units < MINIMUM_PAIRS:
        kind = CANNOT_TELL
        missing = f"needs at least {MINIMUM_PAIRS} {noun}s; there {'is' if units == 1 else 'are'} {units}"
    elif any(not against[name].enough for name in tied):
        kind = CANNOT_TELL
        few = next(name for name in tied if not against[name].enough)
        missing = (f"needs at least {MINIMUM_PAIRS} {noun}s that both {names[lead]} and {few} solve; "
                   f"there {'is' if against[few].n == 1 else 'are'} {against[few].n}")  # fmt: skip
    elif vague := [name for name in tied if _vague(against[name], minor, none)]:
        kind, pair = CANNOT_TELL, against[vague[0]]
        missing = (f"needs more than {pair.n} {noun}s to tell {names[lead]} and {vague[0]} apart: the interval of "
                   f"their comparison, {pair.low:.3g} to {pair.high:.3g}, is too wide")  # fmt: skip
    return Choice(kind, names[lead], tied, candidates, against, solved, problems, missing)


def _reliable(known: np.ndarray, allowed: int) -> list[int]:
    """Who solved something, and no fewer than the most reliable by more than what is allowed and chance explains."""
    counts = known.sum(axis=0)
    best = known[:, int(np.argmax(counts))]

    def behind(one: np.ndarray) -> bool:
        lost, won = int((best & ~one).sum()), int((one & ~best).sum())
        return lost - won > allowed and float(binom.sf(lost - 1, lost + won, 0.5)) < LEVEL

    return [int(s) for s in np.flatnonzero(counts) if not behind(known[:, s])]


def _beaten(costs: np.ndarray, reliable: list[int], minor: float,
            compare: Callable[[np.ndarray, np.ndarray], Paired], none: float) -> set[int]:  # fmt: skip
    """Who is behind another one, for sure and by more than a trifle."""
    beaten = set()
    for k, one in enumerate(reliable):
        for other in reliable[k + 1 :]:
            pair = compare(costs[:, one], costs[:, other])
            if _apart(pair, minor, none):
                beaten.add(one)
            elif _ahead(pair, minor, none):
                beaten.add(other)
    return beaten


def _mean(column: np.ndarray, compare: Callable[[np.ndarray, np.ndarray], Paired]) -> float:
    """The column against ones: a mean in the scale of the comparison."""
    return compare(column, np.ones_like(column)).value


def _apart(pair: Paired, minor: float, none: float) -> bool:
    """Whether the other one is worse, for sure and by more than a trifle."""
    threshold = none * (1 + minor) if none else minor
    return pair.enough and pair.low > none and pair.value > threshold


def _ahead(pair: Paired, minor: float, none: float) -> bool:
    """Whether the other one is better, for sure and by more than a trifle."""
    threshold = none / (1 + minor) if none else -minor
    return pair.enough and pair.high < none and pair.value < threshold


def _vague(pair: Paired, minor: float, none: float) -> bool:
    """Whether the interval holds differences `VAGUE` times those of practical meaning: that is ignorance, not a tie."""
    low, high = (1 / (1 + VAGUE * minor), 1 + VAGUE * minor) if none else (-VAGUE * minor, VAGUE * minor)
    return pair.low < low or pair.high > high


def listed(names: tuple[str, ...] | list[str], most: int = 4) -> str:
    """Write names as "a, b and c", in quotes where a name has a comma; of many the first ones and how many more."""
    if any("," in name or " and " in name for name in names):
        names = [f"\u201c{name}\u201d" for name in names]
    if len(names) > most:
        return ", ".join(names[: most - 1]) + f" and {len(names) - most + 1} more"
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))

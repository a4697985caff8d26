"""How the time grows with the length of the record: the slope between the logarithms, with its interval."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

MINIMUM_LENGTHS = 3  # two lengths give a slope but nothing to judge it by
MINIMUM_SPREAD = 4.0  # between the longest and the shortest record


@dataclass(frozen=True)
class Growth:
    """Time proportional to N to the power of the slope.

    Attributes:
        slope: the exponent; ``nan`` where it cannot be told.
        low, high: its 95 % interval.
        lengths: record lengths, ascending, of data with two or more.
        times: geometric mean time at each of them, (lengths,).
        missing: what is missing to tell; "" where it can be told.
    """

    slope: float
    low: float
    high: float
    lengths: np.ndarray
    times: np.ndarray
    missing: str = ""


def time_growth(times: np.ndarray, n: np.ndarray, groups: np.ndarray) -> Growth:
    """Fit ``log t = c_group + slope log N`` by least squares.

    Seeds of one group and length are averaged first: their number must not narrow the interval, because what is
    uncertain is whether a power law holds, not the mean time. At least one group must have `MINIMUM_LENGTHS` lengths
    and `MINIMUM_SPREAD` between them: a power law over short spans at different lengths is none over the whole.

    Args:
        times: (P,) seconds, ``nan`` where not solved.
        n: (P,) record lengths.
        groups: (P,) whatever else makes a problem slow: formulation, data set, noise. Only groups with two lengths
            count.
    """
    usable = np.isfinite(times) & np.isfinite(n) & (n > 0) & (times > 0)
    cells: dict[tuple, list[float]] = {}
    for group, length, seconds in zip(groups[usable], n[usable], times[usable]):
        cells.setdefault((group, float(length)), []).append(float(np.log(seconds)))
    of_group: dict[object, list[float]] = {}
    for group, length in cells:
        of_group.setdefault(group, []).append(length)
    cells = {key: logs for key, logs in cells.items() if len(of_group[key[0]]) > 1}
    lengths = np.unique([length for _, length in cells])
    means = [np.concatenate([logs for (_, at), logs in cells.items() if at == length]) for length in lengths]
    shown = np.exp(np.array([np.mean(logs) for logs in means])) if len(lengths) else np.zeros(0)
    if not any(len(own) >= MINIMUM_LENGTHS and max(own) >= MINIMUM_SPREAD * min(own) for own in of_group.values()):
        most = max((len(own) for own in of_group.values()), default=0)
        needs = (f"needs at least {MINIMUM_LENGTHS} record lengths, the longest {MINIMUM_SPREAD:g} times the shortest, "
                 f"solved on the same data; there {'is' if most == 1 else 'are'} at most {most}")  # fmt: skip
        return Growth(float("nan"), float("nan"), float("nan"), lengths, shown, needs)
    names = {group: g for g, group in enumerate(dict.fromkeys(group for group, _ in cells))}
    group = np.array([names[g] for g, _ in cells])
    x = np.log([length for _, length in cells])
    y = np.array([np.mean(logs) for logs in cells.values()])
    x, y = _centred(x, group), _centred(y, group)
    slope = float(x @ y / (x @ x))
    freedom = len(x) - len(names) - 1  # one at least: a group has three lengths
    error = np.sqrt(np.sum((y - slope * x) ** 2) / freedom / (x @ x))
    half = float(student.ppf(0.975, freedom) * error)
    return Growth(slope, slope - half, slope + half, lengths, shown)


def _centred(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    means = np.bincount(group, values) / np.bincount(group)
    return values - means[group]

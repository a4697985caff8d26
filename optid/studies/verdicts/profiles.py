"""Performance profiles: the share of the problems solved within a factor of the fastest solver.

E. D. Dolan, J. J. Moré: Benchmarking optimization software with performance profiles. Mathematical Programming 91
(2002) 201-213. With more than two solvers a profile compares each with the fastest, not with each other (N. Gould,
J. Scott, ACM Transactions on Mathematical Software 43 (2016) 15).
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Profile:
    """The profile of one solver: a step function of the factor, continuous from the right.

    Attributes:
        factors: where it steps, ascending, the first at least 1.
        shares: its value from there on, in (0, 1].
    """

    factors: np.ndarray
    shares: np.ndarray

    def __call__(self, factor: float) -> float:
        """Return the share of the problems solved within this factor of the fastest."""
        at = int(np.searchsorted(self.factors, factor, side="right"))
        return float(self.shares[at - 1]) if at else 0.0


def time_ratios(times: np.ndarray) -> np.ndarray:
    """Return every time relative to the fastest on its problem.

    Args:
        times: (P, S) in any unit, ``nan`` where the problem was not solved.

    Returns:
        (P, S), 1 for the fastest, ``inf`` where not solved.
    """
    reached = np.where(np.isfinite(times), times, np.inf)
    fastest = np.min(reached, axis=1, initial=np.inf, keepdims=True)
    return np.where(np.isfinite(reached), reached / np.where(np.isfinite(fastest), fastest, 1.0), np.inf)


def performance_profiles(times: np.ndarray) -> list[Profile]:
    """Return one profile per solver.

    Args:
        times: (P, S), ``nan`` where the problem was not solved. Problems that nobody solved stay in the denominator.
    """
    ratios = time_ratios(times)
    profiles = []
    for s in range(ratios.shape[1]):
        factors, counts = np.unique(ratios[np.isfinite(ratios[:, s]), s], return_counts=True)
        profiles.append(Profile(factors, np.cumsum(counts) / max(len(ratios), 1)))
    return profiles

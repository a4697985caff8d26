"""Severity of an actuator fault: shares lost between 0 and 1, stop positions within the range, at every onset (F5).

The contribution of a broken actuator is v = (1 - gamma) f(u) + c. The share gamma lies between 0 and 1, and the
constant c of a stuck actuator in the image of f. Both enter the innovations linearly, so that the best ones at a given
onset solve a least-squares problem with bounds; all onsets are tried.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.errors import StructureError
from optid.faults.search.scanning import Scan
from optid.faults.signatures import Candidate


@dataclass(frozen=True, eq=False)
class Bounded:
    """The best magnitudes of a candidate within their bounds at every onset; `bounded` makes it.

    Attributes:
        label: the candidate.
        statistic: (N,) energy that they explain, NaN where the candidate is not tested. Below that of the scan where a
            bound is active.
        sizes: (N, d) magnitudes within the bounds.
        low: (d,) bounds; -inf where there is none.
        high: (d,) bounds; inf where there is none.
        multipliers: (N, d) derivative of half the energy along each magnitude: zero between the bounds, negative at the
            lower one, positive at the upper one (the certificate of each onset).
    """

    label: str
    statistic: Array
    sizes: Array
    low: Array
    high: Array
    multipliers: Array

    @property
    def peak(self) -> int:
        """The onset at which they explain most."""
        return int(np.nanargmax(self.statistic))


@dataclass(frozen=True)
class Severity:
    """Share lost of an actuator; `severity` makes it.

    Attributes:
        label: the candidate.
        onset: the most likely one.
        share: lost, 0 to 1.
        share_interval: of the share, all onsets profiled, cut to 0 to 1.
        stop: constants added, one for each function of the input; empty for a loss.
        coverage: nominal, of the interval.
        hard_over: whether a complete loss is within the interval and no loss at all is not.
        energy: explained between the bounds.
    """

    label: str
    onset: int
    share: float
    share_interval: tuple[float, float]
    stop: tuple[float, ...]
    coverage: float
    hard_over: bool
    energy: float

    def __str__(self) -> str:
        """State the share lost with its interval and whether the loss may be complete."""
        low, high = self.share_interval
        stop = f", adds {', '.join(f'{c:.4g}' for c in self.stop)} instead" if self.stop else ""
        verdict = "hard-over: a complete loss is possible" if self.hard_over else \
            "not a complete loss" if high < 1 else "not distinguishable from no loss"
        return (
            f"{self.label} from sample {self.onset}\n{100 * self.share:.1f} % lost [{100 * low:.1f}, {100 * high:.1f}] "
            f"({100 * self.coverage:g} %){stop}\n{verdict}"
        )


def bounded(scan: Scan, candidate: Candidate | str, *, reach: ArrayLike | None = None) -> Bounded:
    """Return the best magnitudes between their bounds at every onset.

    Args:
        scan: the search; made with the inputs u.
        candidate: a loss or a stuck actuator.
        reach: (lowest, highest) input of the actuator; by default the interval on which f is known, and no bound where
            f has none.

    Raises:
        StructureError: another kind of fault, one that is tested nowhere (no input, or one that does not move), a
            reach that is not an interval.
    """
    from scipy.optimize import lsq_linear

    c = scan.index(candidate)
    low, high = _bounds(scan.dictionary.model, scan.dictionary.candidates[c], reach)
    tested = ~np.isnan(scan.statistic[c])
    if not tested.any():
        raise StructureError(
            f"{scan.labels[c]} is not tested in this window: "
            + ("pass the inputs, scan(..., u)." if scan.u is None else "untestable, the input does not excite it.")
        )
    roots, correlations = scan.sweep.roots_of(c), scan.correlations[:, scan.sweep.columns(c)]
    sizes = np.einsum("kqi,kqj,kj->ki", roots, roots, correlations)  # without bounds
    designs = np.swapaxes(np.linalg.pinv(roots), 1, 2)
    free = high > low  # f may be constant over the reach
    for k in np.flatnonzero(tested & np.any((sizes < low) | (sizes > high), axis=1)):
        sizes[k, ~free] = low[~free]
        left = roots[k] @ correlations[k] - designs[k][:, ~free] @ low[~free]
        sizes[k, free] = lsq_linear(designs[k][:, free], left, (low[free], high[free]), "bvls", tol=1e-14).x
    multipliers = correlations - np.einsum("kqi,kqj,kj->ki", designs, designs, sizes)
    values = np.sum(sizes * (correlations + multipliers), axis=1)
    values[~tested], sizes[~tested] = np.nan, np.nan
    return Bounded(scan.labels[c], values, sizes, low, high, multipliers)


def _bounds(model: Any, c: Candidate, reach: ArrayLike | None) -> tuple[Array, Array]:
    """Lower and upper bounds of the magnitudes of a loss or of a stuck actuator."""
    if not c.columns:
        raise StructureError(f"{c.label}: only a loss and a stuck actuator have a share lost.")
    ends = [(0.0, 1.0)]
    for column in c.columns if c.kind == "stuck" else ():
        function = model.nonlinearities[column]
        within = function.basis.interval if reach is None else tuple(np.asarray(reach, dtype=float).ravel())
        if within is None:
            ends.append((-np.inf, np.inf))
            continue
        if len(within) != 2 or not np.all(np.isfinite(within)) or not within[0] < within[1]:
            raise StructureError(f"reach={reach!r}: it must be the lowest and the highest input.")
        image = function(np.linspace(within[0], within[1], 513))
        ends.append((float(np.min(image)), float(np.max(image))))
    low, high = np.array(ends).T
    return low, high


def severity(
    scan: Scan, candidate: Candidate | str, *, coverage: float = 0.95, reach: ArrayLike | None = None
) -> Severity:
    """Return the share lost, with an interval that accounts for the search for the onset.

    The interval holds the shares at which twice the logarithm of the likelihood, profiled over the onset and over the
    constants added, is within the quantile of chi square of its maximum. `coverage` is its nominal probability; the
    other arguments and the errors are those of `bounded`.
    """
    from scipy.special import chdtri

    check_probability(coverage, "coverage")
    best, free = bounded(scan, candidate, reach=reach), scan.statistic[scan.index(candidate)]
    onset, width = best.peak, float(chdtri(1, 1 - coverage))
    low, high = best.sizes[onset, 0], best.sizes[onset, 0]
    for k in np.flatnonzero(free > np.nanmax(free) - width):
        nu, covariance = scan.estimate(candidate, int(k))
        reach_k = np.sqrt(covariance[0, 0] * (width - (np.nanmax(free) - free[k])))
        low, high = min(low, nu[0] - reach_k), max(high, nu[0] + reach_k)
    interval = float(np.clip(low, 0, 1)), float(np.clip(high, 0, 1))
    return Severity(
        best.label, onset, float(best.sizes[onset, 0]), interval, tuple(float(v) for v in best.sizes[onset, 1:]),
        coverage, bool(interval[1] >= 1 and interval[0] > 0), float(best.statistic[onset]),
    )

"""How much of an actuator is lost: shares between none and all, stops within its reach, at every onset (F5).

What a broken actuator contributes is v = (1 - gamma) f(u) + c. A share gamma lies between 0 and 1, and the constant
c of a stuck one in the image of f, since the actuator stands somewhere. Both enter the innovations linearly, so that
the best ones at a given onset are a quadratic programme with a box, solved exactly, and all onsets are tried.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_probability
from optid.errors import StructureError
from optid.faults.search.scanning import Scan
from optid.faults.signatures import Candidate

FACES = 6
"""Magnitudes for which all faces of the box are tried."""

ROUNDING = 1e-10
"""Share of a product that is rounding."""


class Bounds(NamedTuple):
    """What the magnitudes of a fault can be.

    Attributes:
        low: (d,).
        high: (d,).
    """

    low: Array
    high: Array


@dataclass(frozen=True, eq=False)
class Bounded:
    """The best possible magnitudes of a candidate at every onset; `bounded` makes it.

    Attributes:
        label: the candidate.
        statistic: (N,) energy that they explain, NaN where the candidate is not tested. Below that of the scan where a
            bound holds them.
        sizes: (N, d) magnitudes within the bounds.
        bounds: what they can be.
        multipliers: (N, d) derivative of half the energy along each magnitude: zero between the bounds, negative at the
            lower one, positive at the upper one (the certificate of each onset).
    """

    label: str
    statistic: Array
    sizes: Array
    bounds: Bounds
    multipliers: Array

    @property
    def peak(self) -> int:
        """The onset at which they explain most."""
        return int(np.nanargmax(self.statistic))


@dataclass(frozen=True)
class Severity:
    """How much is lost; `severity` makes it.

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
        """Say how much."""
        low, high = self.share_interval
        stop = f", adds {', '.join(f'{c:.4g}' for c in self.stop)} instead" if self.stop else ""
        verdict = "hard-over: a complete loss is possible" if self.hard_over else \
            "not a complete loss" if high < 1 else "not told from no loss at all"
        return (
            f"{self.label} from sample {self.onset}\n{100 * self.share:.1f} % lost [{100 * low:.1f}, {100 * high:.1f}] "
            f"({100 * self.coverage:g} %){stop}\n{verdict}"
        )


def bounds_of(scan: Scan, candidate: Candidate | str, reach: ArrayLike | None = None) -> Bounds:
    """Return what the magnitudes of a loss or of a stuck actuator can be.

    Args:
        scan: the search.
        candidate: a loss or a stuck actuator.
        reach: (lowest, highest) input of the actuator; by default the interval on which f is known, and no bound where
            f has none.

    Raises:
        StructureError: another kind of fault, a reach that is not one.
    """
    c = scan.dictionary.candidates[scan.index(candidate)]
    if not c.columns:
        raise StructureError(f"{c.label}: only a loss and a stuck actuator have a share lost.")
    low, high = [0.0], [1.0]
    for column in c.columns if c.kind == "stuck" else ():
        function = scan.dictionary.model.nonlinearities[column]
        ends = function.basis.interval if reach is None else tuple(np.asarray(reach, dtype=float).ravel())
        if ends is None:
            low.append(-np.inf)
            high.append(np.inf)
            continue
        if len(ends) != 2 or not np.all(np.isfinite(ends)) or not ends[0] < ends[1]:
            raise StructureError(f"reach={reach!r}: the lowest and the highest input are needed.")
        image = function(np.linspace(*ends, 513))
        low.append(float(np.min(image)))
        high.append(float(np.max(image)))
    return Bounds(np.array(low), np.array(high))


def bounded(scan: Scan, candidate: Candidate | str, *, reach: ArrayLike | None = None) -> Bounded:
    """Return the best magnitudes between their bounds at every onset.

    Args:
        scan: the search; made with the inputs u.
        candidate: a loss or a stuck actuator.
        reach: (lowest, highest) input of the actuator, see `bounds_of`.

    Raises:
        StructureError: another kind of fault, one that is tested nowhere (no input, or one that does not move), more
            than six functions of an input.
    """
    from optid.faults.search.box_kernels import boxed

    c = scan.index(candidate)
    limits, d = bounds_of(scan, candidate, reach), int(scan.sweep.blocks.sizes[c])
    tested = ~np.isnan(scan.statistic[c])
    if not tested.any():
        raise StructureError(
            f"{scan.labels[c]} is not tested in this window: "
            + ("pass the inputs, scan(..., u)." if scan.u is None else "untestable, the input does not excite it.")
        )
    if d > FACES:
        raise StructureError(f"{scan.labels[c]}: {d} magnitudes; bounds are kept for {FACES} at most.")
    products = products_of(scan, c)
    correlations = np.ascontiguousarray(scan.correlations[:, scan.sweep.columns(c)])
    sizes, values = np.empty((len(products), d)), np.empty(len(products))
    boxed(products, correlations, limits.low, limits.high, ROUNDING, sizes, values)
    values[~tested], sizes[~tested] = np.nan, np.nan
    return Bounded(
        scan.labels[c], values, sizes, limits, correlations - np.einsum("kij,kj->ki", products, sizes)
    )


def severity(
    scan: Scan, candidate: Candidate | str, *, coverage: float = 0.95, reach: ArrayLike | None = None
) -> Severity:
    """Return the share lost, with an interval that counts the search of the onset.

    The interval holds the shares at which twice the logarithm of the likelihood, profiled over the onset and over the
    constants added, is within the quantile of chi square of its maximum.

    Args:
        scan: the search; made with the inputs u.
        candidate: a loss or a stuck actuator.
        coverage: nominal probability of the interval.
        reach: (lowest, highest) input of the actuator, see `bounds_of`.

    Raises:
        StructureError: as `bounded`, or a coverage outside (0, 1).
    """
    from scipy.special import chdtri

    check_probability(coverage, "coverage")
    best, c = bounded(scan, candidate, reach=reach), scan.index(candidate)
    onset, width = best.peak, float(chdtri(1, 1 - coverage))
    low, high = best.sizes[onset, 0], best.sizes[onset, 0]
    free = scan.statistic[c]
    for k in np.flatnonzero(free > np.nanmax(free) - width):
        nu, covariance = scan.estimate(scan.dictionary.candidates[c], int(k))
        reach_k = np.sqrt(covariance[0, 0] * (width - (np.nanmax(free) - free[k])))
        low, high = min(low, nu[0] - reach_k), max(high, nu[0] + reach_k)
    interval = float(np.clip(low, 0, 1)), float(np.clip(high, 0, 1))
    return Severity(
        best.label, onset, float(best.sizes[onset, 0]), interval, tuple(float(v) for v in best.sizes[onset, 1:]),
        coverage, bool(interval[1] >= 1 and interval[0] > 0), float(best.statistic[onset]),
    )


def products_of(scan: Scan, c: int) -> Array:
    """Return the products (N, d, d) of the signatures of a candidate, without directions that are not seen."""
    d, place = int(scan.sweep.blocks.sizes[c]), int(scan.sweep.blocks.places[c])
    roots = scan.sweep.roots[:, place : place + d * d].reshape(-1, d, d)
    squares = np.sum(roots**2, axis=2)  # rows are orthogonal: axes over the roots of the eigenvalues
    weights = np.where(squares > 0, 1 / np.where(squares > 0, squares, 1.0) ** 2, 0.0)
    return np.ascontiguousarray(np.einsum("kq,kqi,kqj->kij", weights, roots, roots))

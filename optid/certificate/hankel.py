"""A lower bound on the simulation error of every state-space model of a given order, from the record alone.

For the simulator with measured feedback, without correction of the state (P2), any model of order n gives
``H(yhat) = Gamma X + T H(phi)`` with ``phi = [eta(u); zeta(y)]``: projected off the rows of H(phi) and the constant,
the block Hankel matrix of its outputs has rank n at most, whatever A, B, C, D, E, offsets and initial states. A sample
stands in at most alpha of its columns. Hence (Eckart and Young on the projected outputs)

    ‖y - yhat‖² >= (1/alpha) sum_{i>n} sigma_i²( H(y) Pi_perp )        for every number alpha of block rows.

It holds for that simulator alone. Predictors that use y through an observer gain (one-step and innovation forms) reach
errors below it, and a free run feeds its own outputs back, for which phi is not known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.errors import OptidError, RankError, StructureError
from optid.program.solution import Bound
from optid.statistics.expansion import Expansion
from optid.statistics.hankel import Expand, hankel_statistics

WORK = 2e9  # operations of the statistics beyond which a bound is not worth its time
ROUNDING = {"qr": 1e-13, "gram": 1e-15}  # of the projected energy, the second per squared condition number


@dataclass(frozen=True, eq=False)
class HankelBounds:
    """Lower bounds for several numbers of block rows and all orders."""

    block_rows: tuple[int, ...]  # the alphas that were tried
    # (len(block_rows), orders) squared error in squared units of the weighted outputs, by order from zero; zero where
    # alpha is too small to say anything about an order
    values: Array
    energy: float  # squared norm of the weighted outputs over the samples in complete windows, the yardstick

    def value(self, n: int) -> tuple[float, int]:
        """Return the largest bound for order n and its number of block rows; refuse other orders (`StructureError`)."""
        if not 0 <= n < self.values.shape[1]:
            raise StructureError(f"bounds exist for the orders 0 to {self.values.shape[1] - 1}; got {n!r}")
        best = int(np.argmax(self.values[:, n]))
        return float(self.values[best, n]), self.block_rows[best]

    def bound(self, n: int, error: float) -> Bound:
        """Return the certificate of a fit of order n with a squared simulation error; refuse one below the bound."""
        value, rows = self.value(n)
        if error < value * (1 - 1e-9) - 1e-12 * self.energy:
            raise StructureError(f"an error of {error:.6g} lies below the bound {value:.6g} for order {n}: it was not "
                                 "measured by the simulator with measured feedback on this record and these functions")
        reason = f"no model of order {n} with these functions simulates with a squared error below {value:.4g}"
        if n and self.value(n - 1)[0] > error >= value:
            reason += f"; order {n - 1} cannot reach what order {n} reached"
        return Bound(value, False, f"Hankel matrix, {rows} block rows", reason, multipliers=self)


class SignalPlaces(NamedTuple):
    """Positions among the signals."""

    inputs: Sequence[int]  # of the functions of the inputs
    outputs: Sequence[int]
    feedback: Sequence[int] = ()  # of the functions of the outputs that are fed back


def hankel_bounds(records: Sequence[Array], expand: Expand | None, places: SignalPlaces, *, block_rows: Sequence[int],
                  largest: int = 10, weights: Array | None = None) -> HankelBounds:
    """Bound the simulation error of every model of order 0 to ``largest``.

    Windows that touch a missing sample are left out, which keeps the bound valid for the remaining samples.

    Args:
        records: one array (N, c) of raw channels per experiment, NaN = missing.
        expand: raw channels -> signals, as in `optid.statistics.hankel.hankel_statistics`; None for the channels.
        places: of the signals; a linear function of the outputs among those that are fed back makes the bound zero.
        block_rows: the alphas to try.
        largest: largest order of interest.
        weights: (l,) by which the outputs are multiplied in the error.

    Raises:
        StructureError: a number of block rows below two.
        RankError: the record is too short for any of them.
    """
    tried = tuple(sorted({int(a) for a in block_rows}))
    if not tried or tried[0] < 2:
        raise StructureError(f"the bound needs at least two block rows; got {block_rows!r}")
    inputs, outputs, feedback = places
    scales = np.ones(len(outputs)) if weights is None else np.asarray(weights, dtype=float)
    values, energy = np.zeros((len(tried), largest + 1)), -1.0
    centre: Any = "mean"
    for position, alpha in enumerate(tried):
        statistics = hankel_statistics(records, alpha, expand, centre=centre)
        centre = statistics.centre
        known = np.concatenate([[0], statistics.at(inputs), statistics.at(feedback, range(alpha - 1))]).astype(int)
        order = np.concatenate([known, statistics.at(outputs)])
        if statistics.windows <= known.size:
            continue
        triangle = statistics.triangle(order)[:, known.size :] * np.tile(scales, alpha)
        whole = float(np.sum(triangle**2)) / alpha
        left = np.linalg.svd(triangle[known.size :], compute_uv=False) ** 2
        slack = ROUNDING[statistics.method] * (statistics.condition**2 if statistics.method == "gram" else 1.0)
        tails = np.concatenate([np.cumsum(left[::-1])[::-1], np.zeros(largest + 1)])[: largest + 1] / alpha
        values[position] = np.maximum(tails - slack * max(statistics.windows, 1) ** 0.5 * whole, 0.0)
        energy = max(energy, whole)
    if energy < 0:
        raise RankError(f"the record has too few complete windows for a bound with {tried[0]} block rows of "
                        f"{len(inputs) + len(outputs) + len(feedback)} signals; use a longer record or fewer functions")
    return HankelBounds(tried, values, energy)


def simulation_bound(records: Sequence[Array], expansion: Expansion, n: int, weights: Array, error: float,
                     block_rows: int, said: str) -> Bound:
    """Return the bound that holds for every model of the order with these functions, or none with the reason.

    Args:
        records: raw channels [u | y] per experiment.
        expansion: the signals.
        n: order of the model.
        weights: (l,) by which every output was multiplied in the error.
        error: its value, a squared error of the simulator with measured feedback.
        block_rows: of the fit; the bound is the best of one, two and four times as many.
        said: what else there is to say about optimality.
    """
    x = replace(expansion, simulated=False)
    count, signals = sum(len(record) for record in records), x.p + x.q + x.l
    longest = max(len(record) for record in records)
    tried = [a for a in (block_rows, 2 * block_rows, 4 * block_rows)
             if a > 1 and 2 * a * signals < longest and count * (a * signals) ** 2 <= WORK]
    if not tried:
        return Bound.none(said)
    try:
        found = hankel_bounds(records, x, SignalPlaces(x.eta, x.y, x.zeta), block_rows=tried, largest=n,
                              weights=weights).bound(n, error)
    except OptidError as reason:
        return Bound.none(f"{said}; no Hankel bound: {reason}")
    return replace(found, reason=f"{said}; {found.reason}")

"""The Hankel bound on the objective of a state-space fit, where that objective is a simulation error."""

from collections.abc import Sequence

from optid.arrays import Array
from optid.certificate.hankel import hankel_bounds
from optid.errors import OptidError
from optid.program.solution import Bound
from optid.statistics.expansion import Expansion

WORK = 2e9  # operations of the statistics beyond which a bound is not worth its time


def simulation_bound(records: Sequence[Array], expansion: Expansion, n: int, weights: Array, error: float,
                     block_rows: int, said: str, applies: bool = True) -> Bound:
    """Return the bound that holds for every model of the order with these functions, or none with the reason.

    Args:
        records: raw channels [u | y] per experiment.
        expansion: the signals.
        n: order of the model.
        weights: (l,) by which every output was multiplied in the error.
        error: its value, a squared error of the simulator with measured feedback.
        block_rows: of the fit; the bound is the best of one, two and four times as many.
        said: what else there is to say about optimality.
        applies: whether no observer gain corrects the state and no instruments stand for the feedback; for anything
            else the bound does not hold and is not given.
    """
    if not applies:
        return Bound.none(f"{said}; its objective is no simulation error, which the Hankel bound is about")
    x = expansion.with_simulated(False)
    count, signals = sum(len(record) for record in records), x.p + x.q + x.l
    longest = max(len(record) for record in records)
    tried = [a for a in (block_rows, 2 * block_rows, 4 * block_rows)
             if a > 1 and 2 * a * signals < longest and count * (a * signals) ** 2 <= WORK]
    if not tried:
        return Bound.none(said)
    try:
        bounds = hankel_bounds(records, x, inputs=x.eta, feedback=x.zeta, outputs=x.y, largest=n, block_rows=tried,
                               weights=weights)
        found = bounds.bound(n, error, "measured feedback")
    except OptidError as reason:
        return Bound.none(f"{said}; no Hankel bound: {reason}")
    return Bound(found.value, False, found.method, f"{said}; {found.reason}", multipliers=bounds)

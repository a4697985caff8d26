"""A fit of a transfer function: the search for the best optimum, and its confirmation under the constraints."""

from collections.abc import Callable
from dataclasses import replace

from optid.arrays import LARGEST_INTEGER, Array, check_integer
from optid.core.problem import Problem
from optid.identify.arguments import enough_rows
from optid.identify.prediction_error.search import entry, search, starts_of
from optid.identify.prediction_error.tangent_descent import refine
from optid.identify.prediction_error.transfer_errors import TransferErrors
from optid.solving.solve import Procedure


def fit_transfer(errors: TransferErrors, starts: int, seed: int, pose: Callable[[Array], Problem]) -> Procedure:
    """Search for the best optimum in a gauge that is always reached, and continue from there in that of the errors.

    Args:
        errors: the criterion.
        starts: number of starts.
        seed: of the random ones.
        pose: states the problem of the fit from the optimum, whose values have usual sizes.

    Raises:
        StructureError: numbers that are none.
        RankError: too few samples for the unknowns.
    """
    check_integer(starts, "starts")
    check_integer(seed, "seed", 0, LARGEST_INTEGER)
    free = errors if errors.gauge == "none" else replace(errors, gauge="norm")
    best, others, figures = search(free, lambda part: starts_of(part, starts, seed))
    enough_rows(best.at.rows, errors.errors, errors.unknowns.size, "lags")
    problem = pose(errors.normalise(best.x))
    return (yield from refine(problem, best, figures, entry(problem, free, [best, *others])))

"""What special methods, proofs, prices and intervals may use of a programme beyond its statement in CVXPY."""

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np

from optid.arrays import Array

ZERO = 1e-9  # a variable without a start that is smaller than this has no size of its own to measure by


class Structure:
    """The numbers behind a programme, with the names of the variables they belong to.

    A back end lists the structures it accepts by type (`optid.backends.BackEnd.structures`), so that a new structure
    needs its class and a back end, and no change here.

    Attributes:
        word: its name in messages and in the list of solvers.
        constrained: whether its methods accept constraints of the user.
    """

    word: ClassVar[str]
    constrained: ClassVar[bool] = False

    @property
    def about(self) -> str:
        """What the programme is and how large, for the reason of a choice."""
        return self.word

    def measure(self, program: Any) -> tuple[float, float] | None:
        """Return objective and relative stationarity at the assigned point of a programme without user constraints.

        None where the numbers tell no more than the CVXPY expressions do.
        """
        return None


class Compressed(Protocol):
    """A record reduced to least squares in z, at a size that does not grow with its length.

    Attributes:
        problem: the numbers of ``‖root z - target‖² + remainder``: root (k, n), target (k,), remainder.
        statistics: the rows behind it: ``root``, the triangular factor of [regressor | outputs]; ``rows`` used and
            ``candidates`` in the record; ``condition`` of the factor and the ``method`` that made it.
        energy: (l,) sum of squares of every output about its mean, in units of the objective.
    """

    @property
    def problem(self) -> Any: ...  # noqa: D102
    @property
    def statistics(self) -> Any: ...  # noqa: D102
    @property
    def energy(self) -> Array: ...  # noqa: D102

    def lifted(self, values: Mapping[str, Array]) -> Array:
        """Return z (n,) of named values."""
        ...

    def regression(self, values: Mapping[str, Array]) -> Array:
        """Return the coefficients (n_columns, l) of the columns of the factor."""
        ...

    def one_step_fit(self, values: Mapping[str, Array]) -> Array:
        """Return the one-step fit (l,) in %."""
        ...


def relative_gradient(gradient: Array, terms: Array, yardstick: float, size: float) -> float:
    """Return the largest component relative to its terms plus the objective's size per size of the variable."""
    floor = yardstick / size + terms
    return float(np.max(gradient / np.where(floor > 0, floor, 1.0), initial=0.0))


def variable_size(value: Array, usual: float | None) -> float:
    """Return the largest entry of a value or of its start; one where there is no start and nothing but rounding."""
    size = float(np.max(np.abs(value), initial=0.0))
    if usual is not None:
        return max(size, usual)
    return size if size > ZERO else 1.0

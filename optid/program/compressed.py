"""What prices, fits and intervals ask of the compressed data behind a programme."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from optid.arrays import Array


class Compressed(Protocol):
    """A record reduced to least squares in z, at a size that does not grow with its length.

    Attributes:
        problem: the numbers of ``‖root z - target‖² + remainder``: root (k, n), target (k,), remainder.
        statistics: the rows behind it: ``root``, the triangular factor of [regressor | outputs]; ``rows`` used and
            ``candidates`` in the record; ``condition`` of the factor and the ``method`` that made it.
        columns: (n_columns, l) positions in z of the coefficients of the columns of the factor.
        energy: (l,) sum of squares of every output about its mean, in units of the objective.
    """

    @property
    def problem(self) -> Any: ...  # noqa: D102
    @property
    def statistics(self) -> Any: ...  # noqa: D102
    @property
    def columns(self) -> Any: ...  # noqa: D102
    @property
    def energy(self) -> Array: ...  # noqa: D102

    def lifted(self, values: Mapping[str, np.ndarray]) -> Array:
        """Return z (n,) of named values."""
        ...

    def one_step_fit(self, values: Mapping[str, np.ndarray]) -> Array:
        """Return the one-step fit (l,) in %."""
        ...

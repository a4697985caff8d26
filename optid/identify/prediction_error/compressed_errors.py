"""The compressed errors of a model near its optimum, and the scatter of its estimate.

Directions without effect on the errors of a state-space model, changes of the states and of the scale between mu and b,
have weight in the factor and no part in the scatter: intervals hold for quantities that do not depend on them.
Simulation errors are coloured where noise enters before the output; their long autoregression gives the sandwich form
of the covariance (Ljung, System Identification, 1999, chapter 9).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.data.channels import Transform
from optid.errors import StructureError
from optid.identify.noise import regression_lags
from optid.identify.prediction_error.descent import Criterion
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.tangent_fit import Places
from optid.program.compressed import Spread, degrees_of_freedom, white_spread
from optid.program.program import Program
from optid.program.units import energy_unit
from optid.statistics.coloured import long_autoregression, response_of, scattered
from optid.statistics.hankel import complete_runs
from optid.statistics.linearised import Linearised

LEAST = 8  # order of the noise, at least, for which the autoregression has lags
NO_EFFECT = 1e-9  # size of an effect on the errors, relative to the largest, that is rounding


class LeastSquares(NamedTuple):
    """``‖root z - target‖² + remainder``."""

    root: Array
    target: Array
    remainder: float


class ErrorRows(NamedTuple):
    """The triangular factor ``root`` (n + 1, n + 1) of [sensitivities | errors], and the rows it came from."""

    root: Array
    rows: int
    candidates: int
    condition: float
    method: str
    constants: int = 0


@dataclass(eq=False)
class CompressedErrors:
    """The compressed errors near an iterate, for uncertainty, prices and figures."""

    criterion: Criterion  # the errors
    at: Linearised  # these near the iterate
    reference: Array  # (n,) variables of the iterate, flattened: z

    @cached_property
    def places(self) -> Places:
        """Positions of the variables in z."""
        return Places.of(self.criterion)

    @property
    def energy(self) -> Array:
        """Sum of squares of the output about its mean, (1,)."""
        return np.array([self.criterion.energy_of_record])

    @property
    def problem(self) -> LeastSquares:
        """The sum of squares in z."""
        root, errors = self.at.whole
        return LeastSquares(root, root @ self.reference - errors, self.at.remainder)

    @property
    def statistics(self) -> ErrorRows:
        """The same as a factor of rows."""
        size, (matrix, errors) = len(self.reference), self.at.whole
        root = np.zeros((size + 1, size + 1))
        root[:size, :size], root[:size, size] = matrix, matrix @ self.reference - errors
        root[size, size] = np.sqrt(self.at.remainder)
        candidates = sum(e.y.size for e in self.criterion.data.experiments)
        return ErrorRows(root, self.at.rows, candidates, self.condition, self.at.method)

    @property
    def condition(self) -> float:
        """Condition number of the scaled sensitivities."""
        return self.at.condition

    @property
    def columns(self) -> NDArray[np.intp]:
        """Positions (n, 1) in z of the coefficients of the columns."""
        return np.arange(len(self.reference))[:, None]

    def lifted(self, values: Mapping[str, Array]) -> Array:
        """Return z."""
        return self.places.pack(values)

    def one_step_fit(self, values: Mapping[str, Array]) -> Array | None:
        """Return the fit in % on the record: one step ahead an output-error model predicts what it simulates."""
        value = self.at.after(self.lifted(values) - self.reference)
        return 100.0 * (1.0 - np.sqrt(value / np.maximum(self.energy, 1e-300)))

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under white errors."""
        return white_spread(self, z, moves)


@dataclass(eq=False)
class CompressedStates(CompressedErrors):
    """The compressed errors of a state-space model; see `CompressedErrors`."""

    criterion: StateErrors
    outward: Transform  # from the units of the programme's models to those of the record
    fixed: bool = False  # whether the programme fixes by rows what changes no output

    def settle(self, program: Program) -> None:
        """Linearise the errors again, at the values of the variables of the programme."""
        self.reference = self.places.pack(program.values())
        self.at = self.criterion.linearise(self.reference)

    @property
    def _scaled(self) -> tuple[Array, Array, Array]:
        """Column sizes, singular values and right vectors of the factor, its columns scaled to one."""
        matrix = self.at.whole[0]
        sizes = np.linalg.norm(matrix, axis=0)
        sizes = np.where(sizes > 0, sizes, 1.0)
        return sizes, *np.linalg.svd(matrix / sizes)[1:]

    @property
    def free(self) -> Array:
        """Directions (k, n) without effect on the outputs, as rows of weight: two per latent signal, z to a z + b."""
        if not self.criterion.unknowns.latent:
            return np.zeros((0, len(self.reference)))
        sizes, values, vectors = self._scaled
        count = min(int(np.sum(values < NO_EFFECT * values[0])), 2 * len(self.criterion.unknowns.latent))
        return vectors[len(values) - count :] * sizes

    @property
    def condition(self) -> float:
        """Condition number of the scaled sensitivities in the directions that are not free."""
        if not self.criterion.unknowns.latent:
            return self.at.condition
        values = self._scaled[1][: len(self.reference) - len(self.free)]
        return float(values[0] / max(values[-1], 1e-300))

    @property
    def problem(self) -> LeastSquares:
        """The sum of squares in z, with the directions that are free."""
        (matrix, errors), free = self.at.whole, self.free
        root, errors = np.vstack([matrix, free]), np.append(errors, np.zeros(len(free)))
        return LeastSquares(root, root @ self.reference - errors, self.at.remainder)

    def one_step_fit(self, values: object) -> None:
        """Return nothing: the errors are those of the criterion."""

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under the noise that the errors at the iterate show."""
        criterion, x = self.criterion, self.reference
        unknowns, outputs = criterion.unknowns, criterion.unknowns.l
        known = moves.shape[1] - (0 if self.fixed else len(criterion.gauge_rows(x)) + len(self.free))
        dof = degrees_of_freedom(self.statistics.rows / outputs, known / outputs)
        errors = criterion.residuals(x)
        complete = np.vstack([e[~np.isnan(e).any(axis=1)] for e in errors])
        noise = complete.T @ complete / len(complete)
        response, root = self._noise_filter(errors, noise)
        meat = np.zeros((unknowns.size, unknowns.size))
        for i in range(unknowns.experiments):
            states = unknowns.shared + i * unknowns.memory + np.arange(unknowns.memory)
            columns = np.r_[states, np.arange(unknowns.shared)]
            meat[np.ix_(columns, columns)] += scattered(criterion.blocks(x)(i), response, root)
        covariance = moves.T @ meat @ moves
        taken = 1 + float(np.trace(covariance)) / self.at.value  # what the fit has taken out of the errors
        return Spread(taken * covariance, taken * energy_unit(self.outward) * noise, dof)

    def _noise_filter(self, errors: list[Array], noise: Array) -> tuple[Array, Array]:
        """Response of the weighted errors to white ones, and a triangular root of the covariance of these."""
        weigh = np.linalg.cholesky(self.criterion.weight).T
        outputs = len(noise)
        white = np.eye(outputs)[None], np.linalg.cholesky(weigh @ noise @ weigh.T + 1e-300 * np.eye(outputs)).T
        if self.criterion.unknowns.innovations:
            return white
        try:
            lags = regression_lags([len(run) for e in errors for run in complete_runs(e, 1)],
                                   max(self.criterion.unknowns.n, LEAST), outputs)
        except StructureError:  # too few to tell a colour
            return white
        autoregression, root = long_autoregression([e @ weigh.T for e in errors], lags)
        rows = sum(len(e) for e in errors)
        return response_of(autoregression), root * np.sqrt(rows / max(rows - lags * outputs, 1))

"""The compressed errors of a model near its optimum, and the scatter of its estimate.

Directions without effect on the errors of a state-space model, changes of the states and of the scale between mu and b,
have weight in the factor and no part in the scatter: intervals hold for quantities that do not depend on them.
Errors are coloured where noise enters before the output, or a noise model is too simple; their long autoregression
gives the sandwich form of the covariance (Ljung, System Identification, 1999, chapter 9).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.core.terms import Values
from optid.data.channels import Transform
from optid.identify.prediction_error.criterion import Criterion
from optid.identify.prediction_error.error_noise import ErrorNoise
from optid.program.compressed import Spread, degrees_of_freedom, white_spread
from optid.program.units import energy_unit
from optid.statistics.coloured import score_covariance
from optid.statistics.linearised import Linearised

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
    def outward(self) -> Transform | None:
        """What leads from the units of the models of the criterion to those of the record; None where they are one."""
        return None

    @property
    def columns(self) -> NDArray[np.intp]:
        """Positions (n, 1) in z of the coefficients of the columns."""
        return np.arange(len(self.reference))[:, None]

    def lift(self, values: Mapping[str, Array]) -> Array:
        """Return z."""
        return self.criterion.variables.pack(values)

    def one_step_fit(self, values: Mapping[str, Array]) -> Array | None:
        """Return the fit in % on the record: one step ahead an output-error model predicts what it simulates."""
        value = self.at.after(self.lift(values) - self.reference)
        return 100.0 * (1.0 - np.sqrt(value / np.maximum(self.energy, 1e-300)))

    @property
    def scale(self) -> float:
        """What one unit of the covariance of the errors is in units of the objective."""
        return 1.0

    def surplus(self) -> int:
        """Return the number of directions of a tangent space that change no output."""
        return 0

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under the noise that the errors show at z; where it is white, the factor tells it."""
        noise = self._noise(z, moves)
        return self._sandwich(noise, moves) if noise.words else white_spread(self.statistics, self.columns, z, moves)

    def _noise(self, z: Array, moves: Array) -> ErrorNoise:
        self._dof(moves)  # too few rows are refused first
        rows = self.criterion.rows(self.reference)
        return ErrorNoise([self._errors(rows(i), i, z) for i in range(self.criterion.unknowns.experiments)])

    def _dof(self, moves: Array) -> float:
        outputs = len(self.criterion.weight)
        return degrees_of_freedom(self.statistics.rows / outputs, (moves.shape[1] - self.surplus()) / outputs)

    def _sandwich(self, noise: ErrorNoise, moves: Array) -> Spread:
        """Return the scatter under any noise.

        The scores J(k)' e(k) of errors e = H(q) w, of sensitivities J, have the covariance sum_k G(k)' R G(k), with
        G(k) = sum_i H_i' J(k+i) and R the covariance of w in the experiment of k. The information is the identity, so
        that this is the covariance of the estimate.
        """
        unknowns, rows = self.criterion.unknowns, self.criterion.rows(self.reference)
        meat = np.zeros((unknowns.size, unknowns.size))
        for i, root in enumerate(noise.roots):
            places = self._of(i)
            meat[np.ix_(places, places)] += score_covariance(rows(i), noise.response, root)
        covariance = moves.T @ meat @ moves
        taken = 1 + float(np.trace(covariance)) / max(self.at.value, 1e-300)  # what the fit has taken out of the errors
        back = np.linalg.inv(np.linalg.cholesky(self.criterion.weight).T)
        return Spread(taken * covariance, taken * self.scale * back @ noise.covariance @ back.T, self._dof(moves),
                      words=noise.words)

    def _of(self, experiment: int) -> NDArray[np.intp]:
        """Places in z of the columns of the rows of an experiment: its initial state, and what all share."""
        unknowns = self.criterion.unknowns
        states = unknowns.shared + experiment * unknowns.memory + np.arange(unknowns.memory)
        return np.r_[states, np.arange(unknowns.shared)]

    def _errors(self, rows: Iterable[tuple[Array, int]], experiment: int, z: Array) -> Array:
        """Return the weighted errors (N, l) of an experiment at z by the rows at the iterate, NaN where one misses."""
        step, found = np.append((z - self.reference)[self._of(experiment)], 1.0), []
        for block, _ in rows:
            found.append(np.where(block.any(axis=1), block @ step, np.nan))
        return np.concatenate(found).reshape(-1, len(self.criterion.weight))


@dataclass(eq=False)
class CompressedStates(CompressedErrors):
    """The compressed errors of a state-space model; see `CompressedErrors`."""

    criterion: Any  # `optid.identify.prediction_error.state_errors.StateErrors`
    fixed: bool = False  # whether the programme fixes by rows what changes no output

    @property
    def outward(self) -> Transform | None:
        """What leads from the units of the models of the criterion to those of the record."""
        return self.criterion.units

    def settle(self, values: Values) -> None:
        """Linearise the errors again, at values of the unknowns."""
        self.reference = self.criterion.variables.pack(values)
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

    @property
    def scale(self) -> float:
        """What one unit of the covariance of the errors is in units of the objective."""
        return energy_unit(self.criterion.units)

    def spread(self, z: Array, moves: Array) -> Spread:
        """Return the scatter under the noise that the errors show at z: the factor holds directions of no effect."""
        return self._sandwich(self._noise(z, moves), moves)

    def surplus(self) -> int:
        """Return the number of directions that change no output, which a programme does not fix by rows."""
        return 0 if self.fixed else len(self.criterion.gauge_rows(self.reference)) + len(self.free)

"""Errors of a state-space model and their sensitivities, compressed chunk by chunk.

A stretch is run by the simulator of the criterion; the derivatives of the state are carried along that run
(`optid.models.state_kernels`), and what leaves a chunk is a factor of [sensitivities | errors].
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataError
from optid.models import state_simulation as simulation
from optid.models.state_signals import Stretch
from optid.models.state_space import StateSpace
from optid.statistics.linearised import Linearised, Method, linearised
from optid.statistics.state_unknowns import SIMULATORS, StatePoint, StateUnknowns

if TYPE_CHECKING:
    from optid.data.record import Data

HUGE = 1e250  # sum of squared sensitivities beyond which a run counts as one that leaves its range
NUMBERS = 500_000  # entries of the sensitivities formed at a time


@dataclass(frozen=True, eq=False)
class StatePredictor:
    """The simulator of a criterion on a record, whose errors are model less record.

    Where an output is missing its error is left out, nothing is corrected by it, and the model's own output is fed
    back.
    """

    data: "Data"  # the record; every input present
    unknowns: StateUnknowns  # their order
    model: Callable[[StatePoint], Any]  # (point) -> `StateSpace`; the matrix that carries its state must be stable
    # (l, l) positive definite: the errors count as e^T weight e; where outputs are missing, with the inverse of the
    # block of its inverse
    weight: Array
    limits: Any = None  # range that the outputs of every experiment must not leave, from `allowed_range`; None for none

    def compress(self, x: Array, gauge: Array | None = None, method: Method = "auto") -> Linearised:
        """Run over all experiments from the unknowns x and compress the errors with their sensitivities.

        Args:
            x: the unknowns.
            gauge: (rows, shared) directions that change no output; they get weight in the factor, not in the errors.
            method: see `optid.statistics.linearised.Method`.

        Returns:
            The errors near x; of infinite value where a run leaves the range allowed.
        """
        n, p, experiments = self.unknowns.n, self.unknowns.shared, self.unknowns.experiments
        try:
            return linearised(self.blocks(x), experiments, n, p, gauge, method)
        except (FloatingPointError, DataError):
            nothing = (np.eye(n), np.zeros((n, p)), np.zeros(n))
            return Linearised(np.eye(p), np.zeros(p), (nothing,) * experiments, np.inf, 0, 1.0, "gram")

    def blocks(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return what yields the weighted rows [x0 | shared | error] of an experiment, and their number, by its index.

        A missing output has a row of zeros.
        """
        unknowns, point = self.unknowns, self.unknowns.unpack(x)
        model, covariance = self.model(point), np.linalg.inv(self.weight)
        chunk = max(32, NUMBERS // ((unknowns.n + unknowns.shared + 1) * unknowns.l))

        def rows(index: int) -> Iterator[tuple[Array, int]]:
            for block in _runs(self._job(model, index), unknowns, point, index, chunk):
                count = int(np.count_nonzero(~np.isnan(block[:, :, -1])))
                block = _weighted(block, covariance)
                if not np.vdot(block, block) < HUGE:
                    raise FloatingPointError
                yield block.reshape(-1, block.shape[2]), count

        return rows

    def residuals(self, x: Array) -> list[Array]:
        """Return the errors (N, l) of every experiment, NaN where the output is missing.

        Raises:
            DataError: a run that leaves the range allowed.
        """
        point = self.unknowns.unpack(x)
        model = self.model(point)
        return [simulation.run(self._job(model, i), point.x0[i]) - e.y for i, e in enumerate(self.data.experiments)]

    def squares(self, x: Array) -> float:
        """Return the weighted sum of squared errors; infinite where a run leaves the range allowed."""
        try:
            found = self.residuals(x)
        except DataError:
            return np.inf
        total = sum(float(np.sum(_weighted(e[:, :, None], np.linalg.inv(self.weight)) ** 2)) for e in found)
        return total if np.isfinite(total) else np.inf

    def _job(self, model: StateSpace, index: int) -> simulation.Run:
        e = self.data.experiments[index]
        return simulation.prepared(model, SIMULATORS[self.unknowns.criterion], e.u, e.y,
                                   self.limits and self.limits[index], "")


def _weighted(block: Array, covariance: Array) -> Array:
    """Weigh rows (T, l, q), the last column the errors, in place where that is possible; zero where one is missing."""
    missing = np.isnan(block[:, :, -1])
    if missing.any():
        block[missing] = 0.0
        for pattern in np.unique(missing, axis=0):
            rows = (missing == pattern).all(axis=1)
            block[rows] = _root(covariance, pattern) @ block[rows]
        return block
    root = _root(covariance, missing[0])
    if np.any(root - np.diag(np.diag(root))):
        return root @ block
    block *= np.diag(root)[:, None]
    return block


def _root(covariance: Array, missing: Any) -> Array:
    """Return the square root R of the weight of the outputs present, with e^T R^T R e the weighted square."""
    here, root = np.flatnonzero(~missing), np.zeros((missing.size, missing.size))
    if here.size:
        root[np.ix_(here, here)] = np.linalg.cholesky(np.linalg.inv(covariance[np.ix_(here, here)])).T
    return root


def _runs(job: simulation.Run, unknowns: StateUnknowns, point: StatePoint, index: int, chunk: int) -> Iterator[Array]:
    """Yield the sensitivities and the errors in the last column, (T, l, n + shared + 1), chunk by chunk."""
    from optid.models.state_kernels import sensitivities

    n, l, parts = unknowns.n, unknowns.l, job.model.parts  # noqa: E741
    direct, state, turn = unknowns.direct(point), point.x0[index].copy(), np.eye(n, n + unknowns.shared)
    for first in range(0, len(job.u), chunk):
        samples = slice(first, min(first + chunk, len(job.u)))
        eta = [basis.values(job.u[samples, c]) for c, basis in enumerate(unknowns.expansion.inputs)]
        f = np.column_stack([part @ mu for part, mu in zip(eta, point.mus)])
        stretch, count = simulation.stretch_of(job, samples, f), len(f)
        states, outputs, block = np.empty((count, n)), np.empty((count, l)), np.empty((count, l, turn.shape[1] + 1))
        simulation.march(job, first, stretch, state, outputs, states)
        run = simulation.signals(job, stretch, states, outputs)
        values = _values(unknowns, point, stretch, states, outputs, run.slopes, job.u[samples], f, eta)
        sensitivities(parts, direct, run._replace(values=values), turn, block)
        block[:, :, -1] = outputs - job.y[samples]
        yield block


def _values(unknowns: StateUnknowns, point: StatePoint, stretch: Stretch, states: Array, outputs: Array,
            slopes: Array, u: Array, f: Array, eta: Sequence[Array]) -> Array:
    """Return the signals of a run (T, s) that multiply unknowns, in the order of `StateUnknowns.signals`."""
    missing, one = np.isnan(stretch.y), np.ones((len(u), 1))
    fed, argument = np.where(missing, outputs, stretch.y), np.hstack([states, u, one])
    zeta = [family.values(fed) for family in unknowns.expansion.feedback]
    z = (stretch.z + states @ point.Cz.T).T
    phi = [latent.basis.values(signal) @ latent.vectors for latent, signal in zip(unknowns.latent, z)]
    g, w = ([part @ one for part, one in zip(parts, of)] for parts, of in ((zeta, point.nus), (phi, point.cs)))
    innovations = np.where(missing, 0.0, stretch.y - outputs)
    return np.column_stack([states, innovations, f, *g, *w, one, *eta, *zeta, *phi,
                            *(slope[:, None] * argument for slope in slopes.T)])

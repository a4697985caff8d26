"""The noise that errors show: its colour, and its level in every experiment, with which an estimate scatters."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optid.arrays import Array
from optid.identify.validation.correlations import autocorrelation
from optid.statistics.coloured import autoregression, response_of
from optid.statistics.experiments import OF_EXPERIMENTS, UNEQUAL, equal_levels

LONGEST, SHARE = 40, 20  # lags of an autoregression at most; errors of an output for every one
LAGS = 25  # at which errors are compared with their past
DEPENDENT = 0.01  # p value below which errors are coloured


@dataclass(frozen=True, eq=False)
class ErrorNoise:
    """Errors (N, l) per experiment, NaN = missing, as white noise through a filter; their covariance is regular."""

    errors: Sequence[Array]

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the errors (l, l)."""
        complete = np.vstack([e[~np.isnan(e).any(axis=1)] for e in self.errors])
        covariance = complete.T @ complete / max(len(complete), 1)
        return covariance + 1e-300 * np.eye(len(covariance))

    @cached_property
    def coloured(self) -> bool:
        """Whether the errors of an output depend on the past."""
        present = min(int(np.sum(~np.isnan(e))) for e in np.vstack(self.errors).T)
        outputs, lags = range(len(self.covariance)), min(LAGS, present // 4)
        if lags < 1:
            return False
        columns = [[e[:, o] for e in self.errors] for o in outputs]
        tests = [autocorrelation(columns[o], "", lags, past=columns[other] if o != other else None)
                 for o in outputs for other in outputs]
        return min(test.p_value for test in tests) * len(tests) < DEPENDENT

    @cached_property
    def _filter(self) -> tuple[Array, Array]:
        """Autoregression (lags, l, l), and a triangular root (l, l) of the covariance of what it leaves."""
        outputs, rows = len(self.covariance), sum(len(e) for e in self.errors)
        most = min(LONGEST, rows // (SHARE * outputs)) if self.coloured else 0
        found, covariance = autoregression(self.errors, most)
        if not len(found):
            covariance = self.covariance
        return found, np.linalg.cholesky(covariance).T * np.sqrt(rows / max(rows - len(found) * outputs, 1))

    @property
    def response(self) -> Array:
        """Response (M + 1, l, l) of the errors to white ones."""
        found = self._filter[0]
        return response_of(found) if len(found) else np.eye(len(self.covariance))[None]

    @cached_property
    def roots(self) -> list[Array]:
        """Triangular roots (l, l) of the covariance of the white errors, one per experiment."""
        return [size * self._filter[1] for size in self._sizes]

    @property
    def words(self) -> tuple[str, ...]:
        """What the errors are found to be that white ones of one level are not."""
        uneven = bool(np.any(self._sizes != 1.0))
        return ("coloured",) * bool(len(self._filter[0])) + (OF_EXPERIMENTS,) * uneven

    @cached_property
    def _sizes(self) -> Array:
        """Level of every experiment over the mean; ones where no difference is beyond chance (Bartlett's test)."""
        autoregression, root = self._filter
        squares = []
        for e in self.errors:
            white = e.copy()
            for lag, a in enumerate(autoregression, start=1):
                white[lag:] -= e[:-lag] @ a.T
                white[:lag] = np.nan
            white = np.linalg.solve(root.T, white[~np.isnan(white).any(axis=1)].T)
            squares.append(np.sum(white**2, axis=0))
        counts, means = np.array([len(s) for s in squares]), np.array([s.mean() if s.size else 0.0 for s in squares])
        # heavy tails scatter the squares more
        scatter = np.mean([max(np.var(s) / m**2, 1e-3) for s, m in zip(squares, means) if m > 0] or [2.0])
        equal = equal_levels(counts, means, float(scatter)) > UNEQUAL
        return np.ones(len(squares)) if equal else np.sqrt(means * counts.sum() / float(counts @ means))

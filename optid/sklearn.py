"""An estimator for scikit-learn: pipelines, grid search, and cross-validation by blocks of time."""

from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import OptidError
from optid.identify.fitting import Fit, fit

try:
    from sklearn.base import BaseEstimator, RegressorMixin
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as error:
    raise OptidError("optid.sklearn needs scikit-learn: pip install 'optid[sklearn]'") from error

LONGEST = 10_000  # samples that the free run may take to come to rest at the first input


class HammersteinRegressor(RegressorMixin, BaseEstimator):
    """A dynamic model as a regressor: rows are samples in the order of time, `predict` is the free run.

    The rows have to follow one another without a gap: use `sklearn.model_selection.TimeSeriesSplit`, or `KFold` without
    shuffling, whose training parts are two records joined where the test part was taken out (`groups` of `fit` tells
    them apart). A prediction starts from rest at its first input.

    Args:
        formulation: name of a formulation.
        na: as in the formulation, such as the number of past outputs; None leaves it out.
        nb: number of past inputs; None leaves it out.
        nk: delay; None leaves it out.
        basis: basis of the nonlinearity; None leaves it out.
        dt: sampling time.
        constraints: as in `optid.fit`.
        solver: as in `optid.fit`.
        options: further arguments of the formulation.
    """

    def __init__(self, formulation: str = "hammerstein_arx.exact", *, na: int | None = 1, nb: int | None = 1,
                 nk: int | None = 0, basis: Any = "polynomial:3", dt: float = 1.0, constraints: Sequence[Any] = (),
                 solver: str = "auto", options: Mapping[str, Any] | None = None) -> None:
        self.formulation = formulation
        self.na = na
        self.nb = nb
        self.nk = nk
        self.basis = basis
        self.dt = dt
        self.constraints = constraints
        self.solver = solver
        self.options = options

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def fit(self, X: Any, y: Any, groups: Any = None) -> Self:  # noqa: N803 - the name of scikit-learn
        """Fit a model.

        Args:
            X: (N, m) inputs.
            y: (N,) or (N, l) outputs.
            groups: (N,) labels of experiments; rows of one experiment follow one another. One experiment by default.

        Raises:
            ValueError: as scikit-learn's checks, or the record cannot determine the model (`DataError`).
        """
        u, y = validate_data(self, X, y, multi_output=True, y_numeric=True, ensure_min_samples=2, dtype=float)
        self.flat_ = np.ndim(y) == 1
        outputs = np.asarray(y, dtype=float).reshape(len(u), -1)
        cuts = [] if groups is None else np.flatnonzero(np.asarray(groups)[1:] != np.asarray(groups)[:-1]) + 1
        data = Data(np.split(u, cuts), np.split(outputs, cuts), self.dt)
        given = {"na": self.na, "nb": self.nb, "nk": self.nk, "basis": self.basis}
        structure = {name: value for name, value in given.items() if value is not None} | dict(self.options or {})
        self.fit_: Fit = fit(data, self.formulation, solver=self.solver, constraints=tuple(self.constraints),
                             prove=False, **structure)
        self.model_ = self.fit_.model
        return self

    def predict(self, X: Any) -> Array:  # noqa: N803
        """Return the outputs (N,) or (N, l) of the free run over inputs (N, m), from rest at the first of them."""
        check_is_fitted(self)
        u = validate_data(self, X, reset=False, dtype=float)
        settling = self._settling()
        outputs = self.model_.simulate(np.vstack([np.repeat(u[:1], settling, axis=0), u]))[settling:]
        return outputs[:, 0] if self.flat_ else outputs

    def _settling(self) -> int:
        """Samples after which what was before has fallen below rounding."""
        radius = self.model_.radius
        if radius >= 1:
            return 0
        return int(min(LONGEST, self.model_.memory + np.ceil(36 / max(-np.log(max(radius, 1e-12)), 1e-12))))

"""A static nonlinearity: a basis, its coefficients and, where the data determine it, an offset."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, finite
from optid.bases import Basis, Linear
from optid.bases import from_dict as basis_from_dict
from optid.errors import StructureError

CHUNK = 65536  # samples evaluated at a time, so that no table of samples x functions is formed


@dataclass(frozen=True, eq=False)
class Nonlinearity:
    """f(u) = eta(u)^T mu + offset.

    Attributes:
        basis: a basis with its interval.
        mu: (P,) coefficients.
        offset: the constant of f; None, which counts as zero, where it is part of the constant of the model.

    Raises:
        StructureError: mu does not have one finite coefficient per basis function.
    """

    basis: Basis
    mu: Array
    offset: float | None = None

    def __post_init__(self) -> None:
        mu = finite(self.mu, "mu")
        if mu.shape != (self.basis.size,):
            raise StructureError(
                f"mu has shape {mu.shape}; a {type(self.basis).__name__} of this size needs ({self.basis.size},).")
        object.__setattr__(self, "mu", mu)

    def __call__(self, u: ArrayLike) -> Any:
        """Evaluate f at u, any shape; NaN where u is NaN. A sample that the basis refuses raises a `DataError`."""
        u = np.asarray(u, dtype=float)
        flat, table = u.ravel(), self.basis.contrast @ self.mu
        f = np.empty(flat.size)
        for start in range(0, flat.size, CHUNK):
            part = flat[start : start + CHUNK]
            first, weights = self.basis.local(part)
            sums = np.full(part.size, self.offset or 0.0)
            for i, weight in enumerate(weights.T):
                sums += weight * table[first + i]
            sums[np.isnan(part)] = np.nan
            f[start : start + CHUNK] = sums
        return float(f[0]) if u.ndim == 0 else f.reshape(u.shape)

    @property
    def is_linear(self) -> bool:
        """Whether f is a straight line through the origin."""
        return isinstance(self.basis, Linear)

    @property
    def unit_slope(self) -> float:
        """The factor that turns a linear f into f(u) = u; one for every other."""
        return 1 / float(self.mu[0]) if self.is_linear and self.mu[0] != 0 else 1.0

    def times(self, factor: float) -> "Nonlinearity":
        """Return factor times f, the offset as it is."""
        return replace(self, mu=factor * self.mu)

    def in_units(self, scale: float, offset: float) -> tuple["Nonlinearity", float]:
        """Express f in the units v = scale u + offset: f(u) = g(v) + c; return g and c.

        A basis of UserFunctions keeps its units and is refused (`StructureError`).
        """
        basis, matrix, constant = self.basis.in_units(scale, offset)
        return Nonlinearity(basis, matrix @ self.mu), float(constant @ self.mu)

    def to_dict(self) -> dict[str, Any]:
        """Describe basis and coefficients in JSON types; the constant belongs to the model."""
        return {"basis": self.basis.to_dict(), "mu": self.mu.tolist()}

    @classmethod
    def from_dict(cls, content: dict[str, Any], functions: dict[str, Any] | None = None) -> "Nonlinearity":
        """Build what `to_dict` described; `functions` are those of a basis of UserFunctions, by name."""
        return cls(basis_from_dict(content["basis"], functions), np.array(content["mu"], dtype=float))

    def slope(self, u: ArrayLike) -> Any:
        """Evaluate f'(u), any shape; to the right at kinks, zero where f is clamped."""
        u = np.asarray(u, dtype=float)
        slopes = self.basis.slopes(u.ravel()) @ self.mu
        return float(slopes[0]) if u.ndim == 0 else slopes.reshape(u.shape)

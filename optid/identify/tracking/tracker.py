"""PAST and OPAST: a subspace that follows a stream of vectors.

Sources: B. Yang, Projection approximation subspace tracking, IEEE Trans. Signal Processing 43 (1995); K. Abed-Meraim,
A. Chkeif and Y. Hua, Fast orthonormal PAST algorithm, IEEE Signal Processing Letters 7 (2000).
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, check_integer, one_of
from optid.errors import DataError, StructureError
from optid.identify.recursive.state import SavedState, as_block, forgetting_factor
from optid.identify.tracking.subspaces import as_basis, orthonormal, principal_angles

METHODS = ("past", "opast")
MISSING = ("fill", "skip", "refuse")
RENEWED = 1024  # samples after which an orthonormal W is orthonormalised again, against rounding


class SubspaceTracker(SavedState):
    """The dominant r-dimensional subspace of a stream of zero-mean vectors; `update` changes it.

    A sample with missing entries is used through its least-squares coordinates on the rows of W that are present; where
    these do not determine the coordinates, it is skipped and counted.

    Attributes:
        W: (n, r) the basis of the recursion.
        root: (r, r) triangular factor of the weighted sum of y y^T, y = W^T x.
        sums: (2,) weighted count of samples and weighted sum of residual energy.
        counts: (3,) samples seen, used, skipped.
    """

    kind, arrays = "tracker", ("W", "root", "sums", "counts")
    settings = ("n", "r", "method", "forgetting", "missing", "names")

    def __init__(
        self, n: int, r: int, *, method: Literal["past", "opast"] = "opast", forgetting: float = 0.995,
        start: ArrayLike | None = None, information: float = 1.0, missing: Literal["fill", "skip", "refuse"] = "fill",
        names: Sequence[str] | None = None,
    ) -> None:
        """Begin a run.

        Args:
            n: dimension of the vectors.
            r: of the subspace, below n.
            method: "past", nearly orthonormal, or "opast", orthonormal at every sample.
            forgetting: factor on earlier samples, in (0, 1]; remembers about 1 / (1 - forgetting) samples.
            start: (n, r) a first guess, orthonormalised; the first r coordinates when not given.
            information: weight of the guess, in energy of y: the inverse of P(0) in the textbook form.
            missing: "fill" as above, "skip" leaves incomplete samples out, "refuse" raises by name.
            names: one name per coordinate; x1, x2, ... when not given.

        Raises:
            StructureError: arguments out of range.
            RankError: a guess with dependent columns.
        """
        self.n = check_integer(n, "n", 2)
        self.r = check_integer(r, "r", high=self.n - 1)
        one_of("method", method, METHODS)
        one_of("missing", missing, MISSING)
        if not (np.isfinite(information) and information > 0):
            raise StructureError(f"information={information!r}: must be a positive number.")
        self.method, self.forgetting, self.missing = method, forgetting_factor(forgetting), missing
        self.names = tuple(names) if names is not None else tuple(f"x{i + 1}" for i in range(self.n))
        if len(self.names) != self.n:
            raise StructureError(f"{len(self.names)} names for {self.n} coordinates.")
        guess = np.eye(self.n)[:, : self.r] if start is None else orthonormal(start, "start", self.n)
        if guess.shape[1] != self.r:
            raise StructureError(f"start has {guess.shape[1]} columns for a subspace of dimension {self.r}.")
        self.W = np.ascontiguousarray(guess)
        self.root = np.sqrt(information) * np.eye(self.r)
        self.sums, self.counts = np.zeros(2), np.zeros(3, dtype=np.int64)

    def update(self, x: ArrayLike) -> Array:
        """Process a block (N, n) or one sample (n,); return the distance (N,) of every sample from the subspace before.

        It is NaN where the sample was not used. Another shape, an infinite entry, or a missing one with
        missing="refuse", is a `DataError`.
        """
        from optid.identify.tracking.kernel import track  # compiled code is loaded with the first sample

        block = as_block(x, self.names, "x", int(self.counts[0]))
        lost = np.isnan(block)
        if self.missing == "refuse" and lost.any():
            k, i = (int(v[0]) for v in np.nonzero(lost))
            raise DataError(f"{self.names[i]} is missing at sample {int(self.counts[0]) + k}: use missing='fill' or "
                            "'skip'.")
        if self.missing == "skip":
            block = np.where(lost.any(axis=1, keepdims=True), np.nan, block)
        residuals, start, orthogonal = np.empty(len(block)), 0, self.method == "opast"
        while start < len(block):
            part = slice(start, start + RENEWED - int(self.counts[0]) % RENEWED)
            residuals[part] = track(self.W, self.root, self.sums, self.counts, np.ascontiguousarray(block[part]),
                                    self.forgetting, orthogonal)
            if orthogonal and self.counts[0] % RENEWED == 0:
                columns, triangle = np.linalg.qr(self.W)
                self.W[:] = columns * np.sign(np.diag(triangle))
            start = part.stop
        return residuals

    @property
    def basis(self) -> Array:
        """Orthonormal basis (n, r) of the tracked subspace."""
        return orthonormal(self.W, "W")

    @property
    def projector(self) -> Array:
        """Orthogonal projector (n, n) on the tracked subspace."""
        return self.basis @ self.basis.T

    @property
    def energies(self) -> Array:
        """Weighted mean energies along the principal axes inside the subspace, descending, (r,); NaN at the start."""
        if self.sums[0] == 0:
            return np.full(self.r, np.nan)
        return np.linalg.svd(self.root, compute_uv=False) ** 2 / self.sums[0]

    @property
    def floor(self) -> float:
        """Weighted mean energy per dimension outside the subspace, the size of the noise; NaN at the start."""
        return float(self.sums[1] / self.sums[0] / (self.n - self.r)) if self.sums[0] else float("nan")

    @property
    def rank(self) -> int:
        """Number of signal directions, at most r, by description length (Wax and Kailath 1985).

        The n - r eigenvalues that are not tracked count as equal to `floor`, which makes the criterion generous.
        """
        memory, values = float(self.sums[0]), np.concatenate([self.energies, np.full(self.n - self.r, self.floor)])
        if not memory or not values[0] > 0:
            return 0
        values = np.maximum(values, 1e-15 * values[0])
        rests = [values[k:] for k in range(self.r + 1)]
        return int(np.argmin([memory * rest.size * (np.log(rest.mean()) - np.log(rest).mean())
                              + 0.5 * k * (2 * self.n - k) * np.log(max(memory, 2.0)) for k, rest in enumerate(rests)]))

    def angles(self, nominal: ArrayLike) -> Array:
        """Return the principal angles to a nominal subspace (n, s), ascending, in radians."""
        return principal_angles(self.W, as_basis(nominal, self.n, "nominal"))

    def __str__(self) -> str:
        seen, used, passed = self.counts.tolist()
        head = f"{self.method.upper()}, {self.r} of {self.n} dimensions, forgetting {self.forgetting:g}"
        named = head.replace(" dimensions", f" dimensions ({', '.join(self.names)})")
        lost = f", {passed} skipped" if passed else ""
        energies = " ".join(f"{v:.4g}" for v in self.energies[:8])
        return (f"{named if len(named) <= 80 else head}\n{seen} samples, {used} used{lost}\n"
                f"energies {energies}; noise {self.floor:.4g}; directions with signal {self.rank}")

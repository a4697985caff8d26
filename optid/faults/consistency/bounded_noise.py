"""Can a healthy plant with bounded noise have made a window at all? The window, the bounds, and proofs to check (F9).

    x(k + 1) = A x(k) + known(k) + w(k),   y(k) = C x(k) + known(k) + v(k),   |w_i| <= t w̄_i,  |v_j| <= t v̄_j

A parity vector p (N, l) is orthogonal to what any state at the start leaves in the outputs. With e the readings less a
simulation from the state zero, sum p e is a sum of the noises alone, with the weights p for v and q for w, where
q(k - 1) = A' q(k) + C' p(k) backwards from q = 0. So t is at least |sum p e| / (sum |p| v̄ + sum |q| w̄): if this
exceeds one, no healthy plant within the bounds has made the window. Anyone can compute these sums.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults.whitening import Predictor
from optid.models.experiments import in_units_of

if TYPE_CHECKING:
    from optid.models import HammersteinSS

SIGMAS = 3.0
"""Bounds of the noise in standard deviations, where none are given."""

CERTAIN = 1e-9
"""Relative size below which the product of a parity vector with what it must not see is rounding."""


@dataclass(frozen=True, eq=False)
class BoundedWindow:
    """A window of a plant whose noise is bounded; `bounded_window` makes it.

    Attributes:
        A: (n, n) of the model.
        C: (l, n) of the model.
        drive: (N, n) what is known of x(k + 1) - A x(k).
        e: (N, l) readings less what is known of y(k) - C x(k) and less a simulation of the states from zero; zero
            where a reading is missing.
        present: (N, l) whether a reading is there.
        steps: (N,) whether the step from k is known; where a reading that is fed back is missing it is not.
        process: (n,) bounds of w.
        output: (l,) bounds of v.
        u: (N, m) inputs.
    """

    A: Array
    C: Array
    drive: Array
    e: Array
    present: np.ndarray
    steps: np.ndarray
    process: Array
    output: Array
    u: Array

    @property
    def count(self) -> int:
        """Samples N."""
        return len(self.e)

    def state_weights(self, p: Array) -> Array:
        """Return q (N, n), the weights of w(k), for p (N, l); or (N, n, c) for (N, l, c)."""
        q = np.zeros((self.count, self.A.shape[0], *p.shape[2:]))
        for k in range(self.count - 1, 0, -1):
            q[k - 1] = self.A.T @ q[k] + self.C.T @ p[k]
            if not self.steps[k - 1]:
                q[k - 1] = 0.0  # nothing is known of this step: the state after it is another start
        return q

    def unseen(self, into_state: Array | None = None, into_output: Array | None = None) -> Array:
        """Return what p must be orthogonal to, (N l, c): free starts, and additions to the state and the output.

        Args:
            into_state: (N, n, d) additions to x(k), of unknown sizes.
            into_output: (N, l, d) additions to y(k).
        """
        n, l = self.A.shape[0], len(self.C)  # noqa: E741
        starts = [0, *(np.flatnonzero(~self.steps[:-1]) + 1).tolist()]
        free = np.zeros((self.count, n, len(starts) * n))
        for number, k in enumerate(starts):
            free[k, :, number * n : (number + 1) * n] = np.eye(n)
        state, output = free, np.zeros((self.count, l, free.shape[2]))
        if into_state is not None and into_output is not None:
            state, output = np.concatenate([state, into_state], 2), np.concatenate([output, into_output], 2)
        still = np.zeros((n, l))
        seen = Predictor(self.A, self.C, still, still, np.eye(l), np.eye(l)).respond(state, output)
        return np.where(self.present[:, :, None], seen, 0.0).reshape(self.e.size, -1)


@dataclass(frozen=True, eq=False)
class ParityProof:
    """A proof that the noise must exceed its bounds by a factor, to be checked by adding up.

    Attributes:
        weights: (N, l) parity vector p, zero where a reading is missing.
        state_weights: (N, n) q.
        residual: sum p e.
        limit: sum |p| v̄ + sum |q| w̄: what |sum p e| is at most with noise within its bounds.
        rounding: what rounding can have added to the residual.
    """

    weights: Array
    state_weights: Array = field(repr=False)
    residual: float
    limit: float
    rounding: float

    @property
    def factor(self) -> float:
        """The least factor t by which the bounds must be widened."""
        return max(abs(self.residual) - self.rounding, 0.0) / max(self.limit, 1e-300)

    @property
    def proved(self) -> bool:
        """Whether the window is impossible within the bounds."""
        return self.factor > 1.0

    def __str__(self) -> str:
        """Say what adds up to what."""
        total, most = abs(self.residual), self.limit
        return f"parity sum {total:.5g}, within the bounds at most {most:.5g}: factor {self.factor:.4f}"


@dataclass(frozen=True, eq=False)
class Membership:
    """What set membership says of a window.

    Attributes:
        factor: t, the least factor of the bounds at which a healthy plant is possible; NaN where the solver failed.
        proof: the parity vector of the healthy plant, which certifies the factor from below.
        candidates: {label: factor}: at most one where the candidate is possible, that of the onset found; above one
            where it is excluded, the least one proved; NaN where the solver failed.
        onsets: {label: onset at which the candidate is possible}; None where it is excluded, or where any course was
            allowed.
        proofs: {label: {(first, last): the parity vector that excludes all onsets between}}; together they cover all
            onsets of a candidate that is excluded.
        untested: {label: why}.
        window: the window.
        status: status of the solver where it failed for the healthy plant, "" otherwise.
    """

    factor: float
    proof: ParityProof | None
    candidates: Mapping[str, float]
    onsets: Mapping[str, int | None]
    proofs: Mapping[str, Mapping[tuple[int, int], ParityProof]] = field(repr=False)
    untested: Mapping[str, str]
    window: BoundedWindow = field(repr=False)
    status: str = ""

    @property
    def impossible(self) -> bool:
        """Whether it is proved that the plant is not healthy."""
        return self.proof is not None and self.proof.proved

    @property
    def consistent(self) -> tuple[str, ...]:
        """Candidates that are not excluded, the least factor first."""
        left = [c for c, t in self.candidates.items() if not t > 1.0]  # a solver that failed excludes nothing
        return tuple(sorted(left, key=lambda c: np.nan_to_num(self.candidates[c], nan=np.inf)))

    @property
    def parity_vector(self) -> Array | None:
        """The parity vector (N, l) of the healthy plant; None where the solver failed."""
        return None if self.proof is None else self.proof.weights

    def __str__(self) -> str:
        """Print the factors and the proof."""
        verdict = "a healthy plant is impossible" if self.impossible else "a healthy plant is possible"
        lines = [f"bounds of the noise times {self.factor:.3f}: {verdict}"]
        lines += [f"  {self.proof}"[:80]] if self.proof is not None else [f"  no proof: {self.status}"[:80]]
        for label, t in self.candidates.items():
            onset = self.onsets.get(label)
            where = "" if onset is None else f" from sample {onset}"
            verdict = "not solved" if np.isnan(t) else "excluded" if t > 1 else f"possible{where}"
            lines.append(f"  {label[:40]:<42}{t:>8.3f}  {verdict}")
        return "\n".join([*lines, *(f"  not tested: {label}, {why}"[:80] for label, why in self.untested.items())])


def bounded_window(model: "HammersteinSS", data: Data, bounds: Any = SIGMAS) -> BoundedWindow:
    """Return a window with the bounds of its noise.

    Args:
        model: with noise covariances where the bounds are multiples of standard deviations.
        data: one experiment; missing outputs are left out.
        bounds: a number of standard deviations of the noise of the model, or {"process": (n,), "output": (l,)} in the
            units of the states and of the outputs; zero in a state says that no noise enters there.

    Raises:
        DataError: several experiments, a missing input.
        StructureError: no noise covariances, bounds of another shape or negative.
    """
    raw = in_units_of(model, data)
    if raw.n_experiments != 1:
        raise DataError(f"{raw.n_experiments} experiments: set membership takes one at a time.")
    part = raw.experiments[0]
    if not np.isfinite(part.u).all():
        k, c = np.argwhere(~np.isfinite(part.u))[0]
        raise DataError(f"Input {model.inputs[c]!r} is missing at sample {k}: set membership needs every input.")
    process, output = _bounds(model, bounds)
    present = np.asarray(~np.isnan(part.y))
    f, y = model.expanded(part.u), np.where(present, part.y, 0.0)
    drive = f @ model.B.T + model.offset_x + y @ model.L.T
    fed_back = np.any(model.L != 0, axis=0)
    for i, (function, o) in enumerate(zip(model.feedback, model.output_of)):
        drive += np.outer(function(y[:, o]), model.E[:, i])
        fed_back[o] = True
    steps = np.asarray(present[:, fed_back].all(axis=1))
    e, x = np.zeros_like(y), np.zeros(model.nx)
    direct = f @ model.D.T + model.offset_y
    for k in range(len(y)):
        e[k] = np.where(present[k], y[k] - model.C @ x - direct[k], 0.0)
        x = model.A @ x + drive[k] if steps[k] else np.zeros(model.nx)
    if not np.isfinite(e).all():
        raise StructureError("The simulation of the model leaves the range of numbers: use a shorter window.")
    return BoundedWindow(model.A, model.C, drive, e, present, steps, process, output, np.asarray(part.u))


def parity_proof(window: BoundedWindow, p: Array, unseen: Array) -> ParityProof:
    """Return the proof that a vector near a solver's multipliers gives; none of the solver's digits is trusted.

    Args:
        window: the window.
        p: (N, l) near a parity vector.
        unseen: (N l, c) what it must be orthogonal to, from `BoundedWindow.unseen`.
    """
    flat = np.where(window.present, np.nan_to_num(p), 0.0).ravel()
    sizes = np.linalg.norm(unseen, axis=0)
    kept = sizes > 0
    left, values, _ = np.linalg.svd(unseen[:, kept] / sizes[kept], full_matrices=False)
    basis = left[:, values > CERTAIN * max(float(values.max(initial=0.0)), 1e-300)]
    for _ in range(2):  # twice is enough to lose only rounding
        flat = flat - basis @ (basis.T @ flat)
    p = flat.reshape(window.e.shape)
    q = window.state_weights(p)
    residual = float(flat @ window.e.ravel())
    limit = float(np.sum(np.abs(p) @ window.output) + np.sum(np.abs(q[:-1]) @ window.process))
    # a start as large as the readings would leave this much through what is left of the products
    large = 1e3 * float(np.abs(window.e).max(initial=0.0))
    rounding = large * float(np.abs(unseen[:, kept].T @ flat / sizes[kept]).sum()) + 1e-12 * float(
        np.abs(flat) @ np.abs(window.e.ravel()))
    if not limit > 0:
        return ParityProof(p, q, 0.0, 1.0, 0.0)
    return ParityProof(p, q, residual, limit, rounding)


def _bounds(model: "HammersteinSS", bounds: Any) -> tuple[Array, Array]:
    if isinstance(bounds, Mapping):
        if set(bounds) != {"process", "output"}:
            raise StructureError(f"bounds has {', '.join(map(repr, bounds))}; 'process' and 'output' are needed.")
        found = tuple(np.asarray(bounds[word], dtype=float) for word in ("process", "output"))
    else:
        number: Any = bounds
        if not (np.ndim(number) == 0 and np.isfinite(number) and number > 0):
            raise StructureError(
                f"bounds={bounds!r}; a positive number of standard deviations, or {{'process': (n,), 'output': (l,)}}.")
        if model.noise is None:
            raise StructureError("The model has no noise covariances: give bounds={'process': (n,), 'output': (l,)}.")
        found = tuple(float(number) * np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (model.noise.Q, model.noise.R))
    for word, value, size in zip(("process", "output"), found, (model.nx, model.l)):
        if value.shape != (size,):
            raise StructureError(f"bounds[{word!r}] has shape {value.shape}; ({size},) is needed.")
        if not (np.isfinite(value).all() and np.all(value >= 0)):
            raise StructureError(f"bounds[{word!r}] has a value that is negative or not finite.")
    if not np.any(found[0]) and not np.any(found[1]):
        raise StructureError("bounds: all are zero, so that any deviation at all is impossible.")
    return found[0], found[1]

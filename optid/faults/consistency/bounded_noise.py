"""Set membership: a window, the bounds of its noise, and proofs that no healthy plant within them produced it (F9).

    x(k + 1) = A x(k) + known(k) + w(k),   y(k) = C x(k) + known(k) + v(k),   |w_i| <= t w̄_i,  |v_j| <= t v̄_j

A parity vector p (N, l) is orthogonal to the response of the outputs to any initial state. With e the readings less a
simulation from the state zero, sum p e is a sum of the noises alone, with the weights p for v and q for w, where
q(k - 1) = A' q(k) + C' p(k) backwards from q = 0. So t is at least |sum p e| / (sum |p| v̄ + sum |q| w̄): above one, no
healthy plant within the bounds has produced the window.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults.whitening import Predictor
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of

SIGMAS = 3.0
"""Default bounds of the noise, in standard deviations."""

CERTAIN = 1e-9
"""Relative singular value below which a direction that a parity vector must be orthogonal to is rounding."""


@dataclass(frozen=True, eq=False)
class BoundedWindow:
    """A window of a plant whose noise is bounded; `bounded_window` makes it."""

    A: Array  # (n, n) of the model
    C: Array  # (l, n) of the model
    e: Array  # (N, l) readings less a simulation from the state zero; zero where a reading is missing
    present: np.ndarray  # (N, l) whether a reading is there
    steps: np.ndarray  # (N,) whether the step from k is known; not where a reading that is fed back is missing
    process: Array  # (n,) bounds of w
    output: Array  # (l,) bounds of v
    u: Array  # (N, m) inputs

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
                q[k - 1] = 0.0  # the step is unknown: the state after it is another free start
        return q

    def unseen(self, into_state: Array | None = None, into_output: Array | None = None) -> Array:
        """Return what p must be orthogonal to, (N l, c): responses to free starts and to additions of unknown sizes.

        The additions are (N, n, d) to x(k) and (N, l, d) to y(k).
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
    """A proof that the noise exceeds its bounds by a factor, to be checked by adding up."""

    weights: Array  # (N, l) parity vector p, zero where a reading is missing
    state_weights: Array = field(repr=False)  # (N, n) q
    residual: float  # sum p e
    limit: float  # sum |p| v̄ + sum |q| w̄, the largest |sum p e| with noise within its bounds
    rounding: float  # bound of the rounding of the residual

    @property
    def factor(self) -> float:
        """The smallest factor t of the bounds."""
        return max(abs(self.residual) - self.rounding, 0.0) / max(self.limit, 1e-300)

    @property
    def proved(self) -> bool:
        """Whether the window is impossible within the bounds."""
        return self.factor > 1.0

    def __str__(self) -> str:
        total, most = abs(self.residual), self.limit
        return f"parity sum {total:.5g}, within the bounds at most {most:.5g}: factor {self.factor:.4f}"


@dataclass(frozen=True, eq=False)
class Membership:
    """Result of set membership for a window.

    Attributes:
        factor: t, the smallest factor of the bounds at which a healthy plant is possible; NaN where the solver failed.
        proof: the parity vector of the healthy plant, which certifies the factor from below.
        candidates: {label: factor}: at most one where the candidate is possible, at the onset found; above one where it
            is excluded, the smallest one proved; NaN where the solver failed.
        onsets: {label: onset at which the candidate is possible}; None where it is excluded, or for any course.
        proofs: {label: {(first, last): the parity vector that excludes the onsets between}}; they cover all onsets of
            an excluded candidate.
        untested: {label: reason}.
        window: the window.
        status: of the solver where it failed for the healthy plant, "" otherwise.
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
        """Whether a healthy plant is proved impossible."""
        return self.proof is not None and self.proof.proved

    @property
    def consistent(self) -> tuple[str, ...]:
        """Candidates that are not excluded, the smallest factor first."""
        left = [c for c, t in self.candidates.items() if not t > 1.0]  # a solver that failed excludes nothing
        return tuple(sorted(left, key=lambda c: np.nan_to_num(self.candidates[c], nan=np.inf)))

    @property
    def parity_vector(self) -> Array | None:
        """The parity vector (N, l) of the healthy plant; None where the solver failed."""
        return None if self.proof is None else self.proof.weights

    def __str__(self) -> str:
        verdict = "a healthy plant is impossible" if self.impossible else "a healthy plant is possible"
        lines = [f"bounds of the noise times {self.factor:.3f}: {verdict}"]
        lines += [f"  {self.proof}"[:80]] if self.proof is not None else [f"  no proof: {self.status}"[:80]]
        for label, t in self.candidates.items():
            onset = self.onsets.get(label)
            where = "" if onset is None else f" from sample {onset}"
            verdict = "not solved" if np.isnan(t) else "excluded" if t > 1 else f"possible{where}"
            lines.append(f"  {label[:40]:<42}{t:>8.3f}  {verdict}")
        return "\n".join([*lines, *(f"  not tested: {label}, {why}"[:80] for label, why in self.untested.items())])


def bounded_window(model: HammersteinSS, data: Data, bounds: Any = SIGMAS) -> BoundedWindow:
    """Return a window with the bounds of its noise.

    Args:
        model: with noise covariances where the bounds are multiples of standard deviations.
        data: one experiment; missing outputs are left out.
        bounds: a number of standard deviations of the noise of the model, or {"process": (n,), "output": (l,)} in the
            units of the states and of the outputs; zero for a state without noise.

    Raises:
        DataError: several experiments, a missing input.
        StructureError: no noise covariances, bounds of another shape or negative.
    """
    parts = in_units_of(model, data).experiments
    if len(parts) != 1:
        raise DataError(f"{len(parts)} experiments: set membership takes one at a time.")
    part = parts[0]
    if not np.isfinite(part.u).all():
        k, c = np.argwhere(~np.isfinite(part.u))[0]
        raise DataError(f"Input {model.inputs[c]!r} is missing at sample {k}: set membership requires every input.")
    process, output = _bounds(model, bounds)
    present = np.asarray(~np.isnan(part.y))
    f, y = model.expand_inputs(part.u), np.where(present, part.y, 0.0)
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
        raise StructureError("The simulation of the model overflows: use a shorter window.")
    return BoundedWindow(model.A, model.C, e, present, steps, process, output, np.asarray(part.u))


def parity_proof(window: BoundedWindow, p: Array, unseen: Array) -> ParityProof:
    """Return the proof from p (N, l), the multipliers of a solver, made orthogonal to the columns of `unseen` (N l, c).

    No digit of the solver is trusted; the columns are those of `BoundedWindow.unseen`.
    """
    from scipy.linalg import orth

    flat = np.where(window.present, np.nan_to_num(p), 0.0).ravel()
    sizes = np.linalg.norm(unseen, axis=0)
    kept = sizes > 0
    basis = orth(unseen[:, kept] / sizes[kept], rcond=CERTAIN)
    for _ in range(2):  # twice is enough to lose only rounding
        flat = flat - basis @ (basis.T @ flat)
    p = flat.reshape(window.e.shape)
    q = window.state_weights(p)
    residual = float(flat @ window.e.ravel())
    limit = float(np.sum(np.abs(p) @ window.output) + np.sum(np.abs(q[:-1]) @ window.process))
    # what a start as large as the readings adds through the products that rounding has left
    large = 1e3 * float(np.abs(window.e).max(initial=0.0))
    rounding = large * float(np.abs(unseen[:, kept].T @ flat / sizes[kept]).sum()) + 1e-12 * float(
        np.abs(flat) @ np.abs(window.e.ravel()))
    if not limit > 0:
        return ParityProof(p, q, 0.0, 1.0, 0.0)
    return ParityProof(p, q, residual, limit, rounding)


def _bounds(model: HammersteinSS, bounds: Any) -> tuple[Array, Array]:
    if isinstance(bounds, Mapping):
        if set(bounds) != {"process", "output"}:
            raise StructureError(f"bounds has {', '.join(map(repr, bounds))}; give 'process' and 'output'.")
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
            raise StructureError(f"bounds[{word!r}] has shape {value.shape}; it must be ({size},).")
        if not (np.isfinite(value).all() and np.all(value >= 0)):
            raise StructureError(f"bounds[{word!r}] has a value that is negative or not finite.")
    if not np.any(found[0]) and not np.any(found[1]):
        raise StructureError("bounds: all are zero, so that no deviation is possible.")
    return found[0], found[1]

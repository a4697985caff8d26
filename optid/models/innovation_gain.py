"""The gain of an innovation form from what the known signals leave of the outputs: ``r = C x + e, x+ = A x + K e``.

The determinant of the covariance of the innovations is minimised over K, with the initial state of every experiment
eliminated (maximum likelihood of Gaussian noise). Near an optimum with known information, such as that of a part of a
long record, a step costs two runs through the record: forth for the innovations and back for the slope of the
likelihood (Fisher scoring).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np

from optid.arrays import Array, compact
from optid.errors import DataError, StructureError
from optid.models.feedback_tables import tabulate
from optid.models.kalman import kalman_gain
from optid.models.roots import spectral_radius
from optid.models.state_signals import Direct, Parts, Signals, Stretch

STEPS = 50  # steps at most
# damping at least, relative to the diagonal of the information, where a step gained much less than predicted
FIRM = 0.01
ARRIVED = 2e-5  # negligible gain of the log-likelihood; half a unit is one standard error of a parameter
NUMBERS = 200_000  # entries of the sensitivities formed at a time
TINY = np.finfo(float).tiny
NO_FUNCTIONS = tabulate(())


class OneStepPredictor(NamedTuple):
    """A gain, and the innovations of a record under it from the initial states that fit best."""

    gain: Array  # (n, l)
    radius: float  # spectral radius of A - K C
    parts: Parts
    starts: list[Array] | None  # initial states (n,) found in units of the residuals; None: in other units
    errors: Sequence[Array]  # innovations (N, l) of every experiment
    covariance: Array  # (l, l) of the innovations
    log_determinant: float  # of the covariance, -inf where its determinant is not positive


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Likelihood of the gain of a model (A, C), the initial state of every experiment eliminated."""

    A: Array  # (n, n)
    C: Array  # (l, n)
    rest: Sequence[Array]  # (N, l) what the known signals leave of the outputs, one per experiment; NaN = missing

    @cached_property
    def root(self) -> Array:
        """Diagonal matrix (l, l) that divides every output by the size of its residuals."""
        return _whitening(np.diag(np.maximum(np.diag(covariance_of(self.rest)), TINY)))

    def at(self, gain: Array, before: OneStepPredictor | None = None) -> OneStepPredictor:
        """Return the predictor of a gain (n, l); innovations beyond the range of numbers are a `DataError`.

        After a step from a predictor an unstable gain is replaced by the stable one of the same spectrum, and the unit
        of the squared innovations is the covariance of that predictor, not the size of the residuals.
        """
        radius = spectral_radius(self.A - gain @ self.C)
        if before is not None and radius >= 1:
            gain = _stable(self.A, self.C, gain, before.covariance)
            radius = spectral_radius(self.A - gain @ self.C)
        parts = _parts(self.A, self.C, gain)
        starts = _initial(parts, radius, self.rest, self.root if before is None else _whitening(before.covariance))
        errors = [r - _run(parts, r, x0.copy(), np.empty((0, x0.size))) for r, x0 in zip(self.rest, starts)]
        same, covariance = before is None or len(self.C) == 1, covariance_of(errors)  # the unit of one output cancels
        sign, value = np.linalg.slogdet(covariance)
        return OneStepPredictor(gain, radius, parts, starts if same else None, errors, covariance,
                                float(value) if sign > 0 else -np.inf)

    def equations(self, found: OneStepPredictor) -> tuple[Array, Array]:
        """Return the normal equations of a step in the gain (row by row), states eliminated, errors whitened."""
        n, size, root = found.gain.shape[0], found.gain.size, _whitening(found.covariance)
        total = np.zeros((size + 1, size + 1))
        starts = found.starts or _initial(found.parts, found.radius, self.rest, self.root)
        for r, x0 in zip(self.rest, starts):
            moments = _moments(found.parts, r, x0, root, size)
            total += moments[n:, n:] - moments[n:, :n] @ _solved(moments[:n, :n], moments[:n, n:])
        return total[:-1, :-1], -total[:-1, -1]


def refine_gain(likelihood: Likelihood, found: OneStepPredictor, part: Likelihood | None = None,
                arrived: float = ARRIVED
            ) -> OneStepPredictor:
    """Return the predictor whose gain minimises the determinant of the covariance of its innovations.

    The search (Levenberg-Marquardt) starts from ``found``, near an optimum where a ``part`` of the record is given,
    whose mean information serves at every step. It ends where the gain of the log-likelihood still to be expected is
    below ``arrived``.
    """
    damping, before = 1e-4, 0.0
    half = sum(np.count_nonzero(~np.isnan(r)) for r in likelihood.rest) / (2 * len(likelihood.C))
    if part is not None:
        normal, _ = part.equations(part.at(found.gain))
        normal *= sum(map(len, likelihood.rest)) / sum(map(len, part.rest))
    for _ in range(STEPS):
        if part is None:
            normal, right = likelihood.equations(found)
        else:
            right = _slope(likelihood.A, likelihood.C, found.gain, found.errors)
        promised, gained = np.inf, 0.0
        while not gained > 0 and promised > arrived:
            step = _solved(normal + damping * np.diag(np.diag(normal)), right)
            promised = 0.5 * float(right @ step)
            try:
                trial = likelihood.at(found.gain + step.reshape(found.gain.shape), found)
                gained = half * (found.log_determinant - trial.log_determinant)
            except DataError:  # stable, but not before its run has left the range of numbers
                gained = -np.inf
            if gained > 0.75 * promised:
                damping *= 0.1
            elif not gained > 0.25 * promised:
                damping = max(10 * damping, FIRM)
        if not gained > 0:
            break
        found = trial
        rate = promised / before if before and damping < FIRM else 1.0  # undamped steps shrink at a rate, or faster
        if promised * rate < arrived:
            break
        before = promised
    return found


def covariance_of(signals: Sequence[Array]) -> Array:
    """Mean of s(k) s(k)' over the samples that are present, pair by pair of outputs, (l, l), positive semidefinite.

    Means over different samples may contradict each other where outputs are nearly collinear. There the products are
    divided by the geometric mean of the counts of the two outputs, which keeps the variances and is semidefinite.
    """
    sums, pairs = _products(signals)
    found = sums / np.maximum(pairs, 1.0)
    if len(found) == 1:
        return found
    found = (found + found.T) / 2
    values = np.linalg.eigvalsh(found)
    if values[0] < -1e-12 * abs(values[-1]):
        own = np.sqrt(np.maximum(np.diag(pairs), 1.0))
        found = (sums + sums.T) / 2 / np.outer(own, own)
    return found


def _products(signals: Sequence[Array]) -> tuple[Array, Array]:
    """Sum of s(k) s(k)' over the samples at which both outputs are present, and the number of them, (l, l) each."""
    count = signals[0].shape[1]
    sums, pairs = np.zeros((count, count)), np.zeros((count, count))
    for s in signals:
        products, present = s.T @ s, np.full((count, count), float(len(s)))
        if np.isnan(products).any():
            here = ~np.isnan(s)
            filled, here = np.where(here, s, 0.0), here.astype(float)
            products, present = filled.T @ filled, here.T @ here
        sums += products
        pairs += present
    return sums, pairs


def _stable(A: Array, C: Array, gain: Array, covariance: Array) -> Array:
    """Return the gain of the same spectrum that makes A - K C stable."""
    try:
        level = covariance + 1e-12 * np.trace(covariance) * np.eye(len(C))
        return np.array(kalman_gain(A, C, gain @ level @ gain.T, level, gain @ level).K)
    except (StructureError, ValueError):  # zeros on the unit circle
        return np.zeros_like(gain)


def _parts(A: Array, C: Array, gain: Array) -> Parts:
    """A model x+ = A x + K e, y = C x + e as the compiled recursions read it."""
    return _without_functions(*gain.shape)._replace(A=compact(A), C=compact(C), K=compact(gain))


@cache
def _without_functions(n: int, l: int) -> Parts:  # noqa: E741
    """Parts of n states and l outputs that are all zero."""
    shapes = (n, n), (n, 0), (l, n), (l, 0), (n, 0), (n, l), (n, l), (n, 0), (l, 0), (0, n)
    return Parts._make([*map(np.zeros, shapes), np.zeros(0, dtype=np.int64), NO_FUNCTIONS])


def _run(parts: Parts, y: Array, x: Array, states: Array) -> Array:
    """Outputs (T, l) while y (T, l) are measured from a state x, which moves on; infinite once they leave all numbers.

    The states (T, n) before every sample are written, unless (0, n) is given.
    """
    from optid.models.state_kernels import march

    (count, l), n = y.shape, x.size  # noqa: E741
    idle, outputs = np.zeros((count, 0)), np.empty((count, l))
    stretch = Stretch(np.zeros((count, n)), np.zeros((count, l)), idle, compact(y), idle,
                      np.full(l, -np.inf), np.full(l, np.inf))
    outputs[march(parts, stretch, x, outputs, states)[1] :] = np.inf
    return outputs


def _initial(parts: Parts, radius: float, rest: Sequence[Array], root: Array) -> list[Array]:
    """Initial states (n,) that minimise the squared innovations times a root (l, l), which are affine in them.

    The spectral radius of A - K C tells after how many samples they are forgotten.
    """
    n, settled = len(parts.A), None
    if radius < 1:
        settled = n + 10 + int(np.log(1e-10) / np.log(max(radius, 0.1)))
    with np.errstate(over="ignore", invalid="ignore"):
        found = [_moments(parts, r[:settled], np.zeros(n), root, 0) for r in rest]
    if not np.all(np.isfinite(found)):
        raise DataError("the innovations of this gain leave the range of numbers")
    return [-_solved(moments[:n, :n], moments[:n, n]) for moments in found]


def _whitening(covariance: Array) -> Array:
    """Matrix (l, l) that turns innovations of a covariance into white ones."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors / np.sqrt(np.maximum(values, 1e-14 * values[-1]))).T


def _slope(A: Array, C: Array, gain: Array, errors: Sequence[Array]) -> Array:
    """Slope (n l,) of the log-likelihood by the gain (row by row) at its innovations.

    The adjoint runs back in time; where an innovation is missing K corrected nothing, and A takes the place of A - K C.
    """
    sums, pairs = _products(errors)
    root = _whitening(sums / np.maximum(pairs, 1.0))
    weight = root.T @ root * np.mean(np.diag(pairs)) / np.maximum(pairs, 1.0)
    adjoint = _parts((A - gain @ C).T, gain.T, np.zeros_like(gain))._replace(L=compact(C.T))
    slope = np.zeros_like(gain)
    for e in errors:
        backwards, states = np.ascontiguousarray(e[::-1]), np.empty((len(e), len(A)))
        missing = np.isnan(backwards)
        present = np.where(missing, 0.0, backwards)
        _run(adjoint, np.where(missing, np.nan, present @ weight), np.zeros(len(A)), states)
        slope += states.T @ present
    return slope.ravel()


def _moments(parts: Parts, r: Array, x0: Array, root: Array, size: int) -> Array:
    """Gram matrix of [d e / d x0 | d e / d K | e], e predicted less measured outputs times a root (l, l).

    K counts row by row, or, with size 0 in place of n l, not at all.
    """
    from optid.models.state_kernels import sensitivities

    (n, l), x, turn = parts.K.shape, x0.copy(), np.eye(parts.K.shape[0], parts.K.shape[0] + size)  # noqa: E741
    direct = _entries_of_gain(n, l, size)
    total, length = np.zeros((n + size + 1, n + size + 1)), max(64, NUMBERS // ((n + size + 1) * l))
    for first in range(0, len(r), length):
        y = r[first : first + length]
        missing, states, block = np.isnan(y), np.empty((len(y), n)), np.empty((len(y), l, n + size + 1))
        error, returned = _run(parts, y, x, states) - y, np.empty((len(y), n, l))
        returned[:] = -parts.K
        if missing.any():
            error[missing], returned.swapaxes(1, 2)[missing] = 0.0, 0.0
        sensitivities(parts, direct, Signals(returned, np.zeros((len(y), 0)), -error), turn, block)
        block[:, :, -1] = error
        if missing.any():
            block[missing] = 0.0
        rows = (root @ block).reshape(-1, n + size + 1)
        total += rows.T @ rows
    return total


@cache
def _entries_of_gain(n: int, l: int, size: int) -> Direct:  # noqa: E741
    """Where the entries of K act on the states, counted from n on; of none with size 0."""
    columns = np.arange(n, n + size).reshape(-1, l)
    return Direct.of(states=[(np.arange(len(columns))[:, None], columns, np.arange(l), 1.0)])


def _solved(matrix: Array, right: Array) -> Array:
    """Solve a symmetric system; directions without information stay at zero."""
    from scipy.linalg.lapack import dgelss  # pyright: ignore[reportAttributeAccessIssue]

    if not matrix.size:
        return np.zeros(right.shape)
    scale = np.sqrt(np.maximum(matrix.diagonal(), TINY))
    _, found, *_, info = dgelss(matrix / np.outer(scale, scale), (right.T / scale).T, cond=1e-12)
    if info or not np.all(np.isfinite(found)):
        raise np.linalg.LinAlgError("the singular values did not converge")
    return (found.T / scale).T

"""The filter of the monitor: the steady predictor, and a Kalman filter while more than the noise is uncertain.

Isolated faults are carried as unknown constants beside the state (B. Friedland, IEEE Trans. Automatic Control 14, 1969;
A. S. Willsky, H. L. Jones, IEEE Trans. Automatic Control 21, 1976). One filter of state and constants covers them, an
unknown initial state, missing readings, and unknown inputs. With e the innovations of the steady predictor, the plant
is x+ = A x + ... + K e, y = C x + ... + e: once its state is known it stays known, and the filter is the steady
predictor.

An unknown state has no prior: its covariance is P + k N N', k without limit, and the readings determine the
combinations N of states by least squares before anything is concluded from them (the exact initialisation of P. de
Jong, Annals of Statistics 19, 1991). The result depends neither on the coordinates of the state nor on where the plant
starts. The effect of an unknown input differs from that of the last known one, with a wide prior.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from optid.arrays import Array, compact
from optid.faults.kernels import add_product, predict
from optid.faults.kinds import DRIFT, JUMP
from optid.faults.monitor.columns import SPARE, Columns, Matrices, Window
from optid.faults.whitening import Predictor
from optid.models import HammersteinSS

SEEN = 1e-7
"""Share of the response to an unknown that determines it: a response of one standard deviation that is ignored has
1e7 standard deviations behind it, and one that is used makes the covariance 1e14 at most."""

WIDE = 1e10
"""Prior energy of an unknown input in all innovations: with none, a fault of its actuator would have no size at all."""

DOUBLINGS = 24  # doublings of the horizon over which the response to the state is taken
CERTAIN = 1e-12  # energy in one innovation below which the state is known


@dataclass(eq=False)
class Direction:
    """A carried constant."""

    owner: int  # number of its candidate
    column: int  # of the candidates
    growth: float  # increase of its course per sample
    grown: float  # its course at the next sample
    power: float = 0.0  # mean energy of one unit in one innovation
    age: int = 0  # samples since it is carried
    deviation: Any = 0.0  # (n,) effect of one unit on the state of the steady predictor


class RunningFilter:
    """State of the plant and carried constants, before the next sample.

    Attributes:
        model, steady, columns: the healthy plant, its predictor, and the columns of the candidates.
        x: (n + q,) expected state and constants; the additions of carried faults at the next sample are in it.
        P: (n + q, n + q) covariance.
        N: (n, d) combinations of states that are unknown, beside P.
        directions: (q,) the constants.
        held: (D,) magnitudes that are no longer estimated.
        held_variance: (D,) of these.
        before: (r,) functions of the inputs of the sample before.
        certain: whether the steady predictor is exact.
        strength: largest energy of a state of unit size in one innovation.
        response: (n, n) whose product with a state has the norm of its effect on all later innovations.
    """

    KEPT = "x", "P", "N", "held", "held_variance", "before"

    def __init__(self, model: HammersteinSS, steady: Predictor, columns: Columns) -> None:
        """Start from a known state of zero."""
        self.model, self.steady, self.columns = model, steady, columns
        self.x, self.P = np.zeros(model.nx), np.zeros((model.nx, model.nx))
        self.held, self.held_variance = np.zeros(len(columns.course)), np.zeros(len(columns.course))
        self.before = np.zeros(model.B.shape[1])
        self.directions: list[Direction] = []
        self.certain = True
        self.strength = float(np.max(np.sum((steady.root @ steady.C) ** 2, axis=0), initial=1e-300))
        self.response, self.N = _response(steady), np.zeros((model.nx, 0))

    def lose(self) -> None:
        """Make the state of the next sample unknown."""
        n = self.model.nx
        self.P[:n], self.P[:, :n] = 0.0, 0.0
        sizes = np.maximum(np.linalg.norm(self.response, axis=0), 1e-300)
        _, seen, axes = np.linalg.svd(self.response / sizes)
        there = seen > 1e-12 * max(float(seen.max(initial=0.0)), 1e-300)
        self.N = (axes[there] / seen[there, None] / sizes).T  # of unit response each
        self.certain = False

    def additions(self, f: Array) -> tuple[Array, Array]:
        """Return the additions of held faults to the next state (T, n) and to the output (T, l)."""
        into_state, into_output = (np.zeros((len(f), size)) for size in (self.model.nx, self.model.l))
        for j in np.flatnonzero(self.held):
            number = self.columns.driven[j]
            if number >= 0:
                used = np.ascontiguousarray(f - self.columns.rest[number])
                add_product(self.held[j] * self.columns.losses[number][0], used, into_state)
                add_product(self.held[j] * self.columns.losses[number][1], used, into_output)
            else:
                into_state += self.held[j] * self.columns.into_state[j]
                into_output += self.held[j] * self.columns.into_output[j]
        return into_state, into_output

    def run(self, f: Array, fed: Array, y: Array) -> tuple[Array, Array]:
        """Return states (T + 1, n) and whitened innovations (T, l) of complete samples; the filter is unchanged.

        f (T, r) are functions of the inputs, fed (T, s) of the outputs, y (T, l) the readings.
        """
        model, steady = self.model, self.steady
        drive, direct = np.tile(model.offset_x, (len(y), 1)), np.tile(model.offset_y, (len(y), 1))
        for matrix, signal, target in ((model.B, f, drive), (model.E, fed, drive), (model.L, y, drive),
                                       (model.D, f, direct)):
            if matrix.any():
                add_product(np.ascontiguousarray(matrix), signal, target)
        if self.held.any():
            for target, added in zip((drive, direct), self.additions(f)):
                target += added
        A, C, K, root = map(compact, (model.A, model.C, steady.K, steady.root))
        return predict(A, C, K, root, drive, y - direct, self.x)

    def step(self, f: Array, fed: Any, y: Array, unsure: np.ndarray) -> tuple[Array, Matrices]:
        """Process one sample; return the whitened innovation (l,) and the matrices of the search.

        f (r,) are functions of the inputs, unknown where they are `unsure`, fed returns those (s,) of the outputs, and
        y (l,) are the readings, NaN where missing.
        """
        model, steady, n, q = self.model, self.steady, self.model.nx, len(self.directions)
        there, lost = np.flatnonzero(~np.isnan(y)), np.where(np.isnan(y), model.L, 0.0)
        _, shift = self.columns.units(self.before, f)
        later, _ = self.columns.units(f, f)
        H, J = np.zeros((model.l, q)), np.zeros((n, q))
        for p, one in enumerate(self.directions):
            H[:, p] = shift[one.column] * one.grown
            one.grown += one.growth
            J[:, p] = later[one.column] * one.grown
        held_state, held_output = (part[0] for part in self.additions(f[None]))
        C = np.hstack([model.C, H])
        predicted = C @ self.x + model.D @ f + model.offset_y + held_output
        A = np.zeros((n + q, n + q))
        A[:n, :n], A[:n, n:], A[n:, n:] = model.A, J, np.eye(q)
        gain, root, r = np.zeros((n + q, model.l)), np.zeros((model.l, model.l)), np.zeros(model.l)
        noise = np.vstack([steady.K + lost, np.zeros((q, model.l))])
        drift = A.copy()
        drift[:n] += lost @ C
        used = np.where(np.isnan(y), predicted, y)
        x = A @ self.x
        x[:n] += model.B @ f + model.offset_x + model.L @ used + held_state
        if model.E.size:
            x[:n] += model.E @ fed(used)
        wide = np.flatnonzero(unsure)
        into, onto = np.vstack([model.B[:, wide], np.zeros((q, len(wide)))]), model.D[:, wide]
        sizes = np.sum((steady.root @ onto) ** 2, axis=0) + np.sum((self.response @ into[:n]) ** 2, axis=0)
        spread = np.where(sizes > 0, WIDE / np.maximum(sizes, 1e-300), 0.0)
        free, seen, covariance = drift[:n, :n] @ self.N, C[there], steady.covariance[:, there]
        if there.size:
            direct = onto[there]
            S = seen @ self.P @ seen.T + covariance[there] + (direct * spread) @ direct.T
            cross = drift @ self.P @ seen.T + noise @ covariance + (into * spread) @ direct.T
            lower = np.linalg.cholesky((S + S.T) / 2)
            inverse = solve_triangular(lower, np.eye(there.size), lower=True)
            if free.size:  # readings that determine unknowns are no innovations
                left, size, right = np.linalg.svd(inverse @ model.C[there] @ self.N)
                known = int(np.sum(size > SEEN))
                unknowns = right[:known].T @ (left[:, :known].T @ inverse / size[:known, None])
                gain[:n, there], free = free @ unknowns, free @ right[known:].T
                inverse = _lower_triangular(left[:, known:].T @ inverse)
            gain[:, there] += cross @ inverse.T @ inverse
            root[np.ix_(there, there)] = inverse
            innovation = y[there] - predicted[there]
            r[there] = inverse @ innovation
            x += gain[:, there] @ innovation
        if free.size:
            size, right = np.linalg.svd(self.response @ free)[1:]
            free = free @ right[: int(np.sum(size > SEEN))].T
        forget, left, blind = drift - gain @ C, noise - gain, into - gain @ onto
        self.P = forget @ self.P @ forget.T + left @ steady.covariance @ left.T + (blind * spread) @ blind.T
        self.P, self.N = (self.P + self.P.T) / 2, free
        for p, one in enumerate(self.directions):
            raw = H[:, p] + (model.C @ one.deviation if one.age else 0.0)
            response = steady.root @ raw
            one.deviation = J[:, p] - steady.K @ raw + (steady.A @ one.deviation if one.age else 0.0)
            one.age += 1
            one.power += (float(response @ response) - one.power) / min(one.age, 100)
        self.x, self.before = x, f
        self.certain = not q and not free.size and self.strength * float(np.trace(self.P)) < CERTAIN
        if self.certain:
            self.P = np.zeros((n, n))
        missing = gain.copy()
        missing[:n] -= lost
        return r, (A, C, missing, root)

    def carry(self, number: int, window: Window) -> float:
        """Correct the state by the estimate of a candidate and carry it; return the remaining energy of a jump."""
        sizes, covariance, whole = window.estimate(number)
        n, q, own, grown = self.model.nx, len(self.directions), self.columns.of(number), int(window.peak[number])
        kind, moved = self.columns.course[own.start], whole[: n + q]
        drifting, jump, course = kind == DRIFT, kind == JUMP, grown + 1.0 if kind == DRIFT else 1.0
        energy = self.strength * float(np.sum((moved[:n] @ sizes) ** 2)) if jump else np.inf
        if not jump:
            later, _ = self.columns.units(self.before, self.before)
            moved[:n] += course * later[own].T  # at the next sample
        self.x = self.x + moved @ sizes
        self.P = self.P + moved @ covariance @ moved.T
        self.certain = False
        if not jump:
            self._append([Direction(number, j, float(drifting), course) for j in range(own.start, own.stop)], sizes,
                         covariance, moved)
        if drifting:  # an error of the onset leaves a constant
            self.P[n + q :, n + q :] *= 4.0
            guess = np.diag(np.diag(covariance)) * (2.0 * grown) ** 2
            constant = np.vstack([self._constant(own, grown), np.zeros((q + len(sizes), len(sizes)))])
            self.P = self.P + constant @ guess @ constant.T
            self._append([Direction(number, j, 0.0, 1.0) for j in range(own.start, own.stop)], np.zeros(len(sizes)),
                         guess, constant)
        return energy

    def _append(self, directions: list[Direction], sizes: Array, covariance: Array, moved: Array) -> None:
        """Carry d more constants: expected sizes, covariance (d, d), effect (n + q, d) on the state and the others."""
        cross = moved @ covariance
        self.P = np.block([[self.P, cross], [cross.T, covariance]])
        self.x = np.concatenate([self.x, sizes])
        self.directions += directions

    def _constant(self, own: slice, count: int) -> Array:
        """Effect of constants in the place of columns on the state after some samples of the steady predictor."""
        steady, jolt, shift = self.steady, self.columns.into_state[own].T, self.columns.into_output[own].T
        moved = jolt
        for _ in range(count):
            moved = steady.F @ moved - steady.K @ shift + jolt
        return moved

    def forget(self, p: int, window: Window | None) -> None:
        """Stop estimating a constant; its estimate is held."""
        n, one = self.model.nx, self.directions.pop(p)
        self.held[one.column] += self.x[n + p] * one.grown
        self.held_variance[one.column] += self.P[n + p, n + p] * one.grown**2
        self.x, self.P = np.delete(self.x, n + p), np.delete(np.delete(self.P, n + p, 0), n + p, 1)
        if window is not None:
            window.drop(n + p)

    def release(self, rows: list[int], own: slice, window: Window) -> None:
        """Stop compensating columns, estimated in some rows of the constants or held."""
        for p in reversed(rows):
            self.forget(p, window)
        later, _ = self.columns.units(self.before, self.before)
        self.x[: self.model.nx] -= self.held[own] @ later[own]
        self.held[own] = self.held_variance[own] = 0.0

    def rows_of(self, owner: int) -> list[int]:
        """Return the constants of a candidate."""
        return [p for p, one in enumerate(self.directions) if one.owner == owner]

    def estimate(self, owner: int) -> tuple[Array, Array]:
        """Return the magnitudes (d,) of a carried candidate and their covariance."""
        rows, own = self.rows_of(owner), self.columns.of(owner)
        at = [self.model.nx + p for p in rows]
        whole = np.zeros((own.stop - own.start, len(rows)))  # a part may be carried twice, after a repair
        whole[[self.directions[p].column - own.start for p in rows], range(len(rows))] = 1.0
        return self.held[own] + whole @ self.x[at], whole @ self.P[np.ix_(at, at)] @ whole.T

    def magnitudes(self) -> tuple[Array, Array]:
        """Return the magnitudes (D,) that are compensated, held or estimated, and their variances."""
        size, variance = self.held.copy(), self.held_variance.copy()
        for at, one in enumerate(self.directions, self.model.nx):
            if self.columns.course[one.column] != DRIFT or one.growth > 0:
                size[one.column] += self.x[at]
                variance[one.column] += self.P[at, at]
        return size, variance

    def fades_after(self, energy: float, faded: float) -> int:
        """Return the samples after which a transient has the energy `faded`."""
        if energy <= faded:
            return 1
        radius = float(np.max(np.abs(np.linalg.eigvals(self.steady.F)), initial=0.0))
        return 1 + int(np.ceil(np.log(faded / energy) / np.log(min(max(radius, 1e-6), 1 - 1e-6)) / 2))

    def room(self, count: int) -> None:
        """Hold the oldest constants until there is room for so many new ones."""
        most = SPARE + 2 * int(self.columns.size.max()) - count
        while len(self.directions) > most:
            self.forget(0, None)


def _response(steady: Predictor) -> Array:
    """Return R (n, n): the norm of R x is that of the whitened innovations that a state x adds, over a long horizon."""
    n = len(steady.A)
    R, step = _triangular(np.vstack([steady.root @ steady.C, np.zeros((n, n))])), steady.F
    for _ in range(DOUBLINGS):
        R, step = _triangular(np.vstack([R, R @ step])), step @ step
    return R


def _triangular(M: Array) -> Array:
    """Return R, upper triangular, with R'R = M'M."""
    return np.asarray(np.linalg.qr(M, mode="r"))


def _lower_triangular(E: Array) -> Array:
    """Return a square R, lower triangular, with R'R = E'E; its first rows are zero where E has fewer rows."""
    R = np.zeros((E.shape[1], E.shape[1]))
    T = _triangular(E[:, ::-1])
    R[len(R) - len(T) :] = T[::-1, ::-1]
    return R

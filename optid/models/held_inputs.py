"""Linear state equations between samples: exact for inputs that are held, at any instants, behind any dead time.

A dead time only moves the instants at which a held drive changes. Between two changes the course is
exp(t [A B; 0 0]) of the state and the drive; the matrix logarithm takes such a step back to the equations.
"""

import warnings
from typing import Any

import numpy as np
from scipy.linalg import expm, logm, matrix_balance

from optid.arrays import Array
from optid.errors import StructureError

SAME = 1e-9  # share of the shortest sampling interval within which two instants are one
AMBIGUOUS = 1e-6  # angle from the negative real axis, in radians, within which a logarithm has no certain branch
INVERSE = 1e-9  # relative error up to which exp(log(step)) counts as the step


def held_step(A: Array, B: Array, interval: float | Array) -> tuple[Array, Array]:
    """Return Phi (.., n, n) and Gamma (.., n, r): x(t + interval) = Phi x(t) + Gamma w while w is held."""
    block, scale = _balanced(A, B)
    n = len(A)
    steps = expm(np.asarray(interval, dtype=float)[..., None, None] * block) * scale[:, None] / scale
    return steps[..., :n, :n], steps[..., :n, n:]


def _balanced(A: Array, B: Array) -> tuple[Array, Array]:
    """Return [A B; 0 0] in units in which exponentials keep their digits, and the sizes of states and drives."""
    n, r = B.shape
    block, scale = np.zeros((n + r, n + r)), np.ones(n + r)
    if n:
        block[:n, :n], (scale[:n], _) = matrix_balance(A, permute=False, separate=True)
    block[:n, n:] = B / scale[:n, None]
    size, own = np.abs(block[:n, n:]).max(axis=0, initial=0.0), np.abs(block[:n, :n]).max(initial=0.0)
    scale[n:] = np.where(size > 0, (own or 1.0) / np.where(size > 0, size, 1.0), 1.0)
    block[:n, n:] *= scale[n:]
    return block, scale


def held_equations(Phi: Array, Gamma: Array, interval: float) -> tuple[Array, Array]:
    """Return A and B of x' = A x + B w, of which Phi (n, n) and Gamma (n, r) are a step; the inverse of `held_step`.

    Raises:
        StructureError: no such equations exist or they are not unique: a pole at 0, a negative real pole; or the
            logarithm cannot be computed.
    """
    n, r = Gamma.shape
    if n == 0:
        return np.zeros((0, 0)), np.zeros((0, r))
    poles: Any = np.linalg.eigvals(Phi).astype(complex)
    for pole in poles:
        if pole.imag == 0 and pole.real < 0:
            raise StructureError(
                f"The negative real pole {pole.real:.4g} has no continuous counterpart: no held input makes a "
                "plant alternate from sample to sample. It describes noise, or a faster oscillation than half the "
                "sampling rate: lower the order, or sample faster.")
        if np.pi - abs(np.angle(pole)) <= AMBIGUOUS:
            raise StructureError(
                f"The poles {pole.real:.4g} +- {abs(pole.imag):.2g}i lie at half the sampling rate, where the "
                "logarithm changes its branch: their frequency is not determined. Sample faster.")
    block = np.vstack([np.hstack([Phi, Gamma]), np.eye(r, n + r, k=n)])
    size = np.abs(Gamma).max(axis=0)
    block[:n, n:] /= np.where(size > 0, size, 1.0)
    balanced, (scale, _) = matrix_balance(block, permute=False, separate=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # its accuracy is judged below
        log: Any = logm(balanced)
    back = expm(log)
    error = np.abs(back - balanced).max() + np.abs(log.imag).max()
    if not error <= INVERSE * np.abs(balanced).max():
        raise StructureError(
            f"The matrix logarithm of the sampled equations is not accurate (relative error {error:.1e}): poles nearly "
            "coincide, or one is almost 0. Lower the order.")
    equations = (log.real * scale[:, None] / scale)[:n] / interval
    return equations[:, :n], equations[:, n:] * np.where(size > 0, size, 1.0)


def split_delays(delays: Array, dt: float) -> tuple[Array, Array]:
    """Split delays (r,) into numbers of whole sampling times and rests in [0, dt), exact where they are multiples."""
    whole = np.floor(delays / dt + SAME)
    rest = delays - whole * dt
    return whole.astype(int), np.where(rest > SAME * dt, rest, 0.0)


def run_held(system: tuple[Array, Array, Array, Array], delays: Array, instants: Array, w: Array, before: Array,
             x0: Array) -> Array:
    """Run x' = A x + B w, y = C x + D w over samples w (N, r), held from ascending instants (N,) on; return y (N, l).

    A drive takes its samples later by its entry of delays (r,), and has its value `before` (r,) until then; x0 (n,) is
    the state at the first instant.
    """
    from optid.models.process_kernel import run, thin_out  # numba

    A, B, C, D = system
    block, scale = _balanced(A, B)
    n, y = len(A), np.zeros((len(instants), len(C)))
    same = SAME * float(np.min(np.diff(instants), initial=1.0))
    for j, delay in enumerate(delays):
        changes = instants + delay
        near = np.clip(np.searchsorted(instants, changes - same), 0, len(instants) - 1)
        changes = np.where(np.abs(instants[near] - changes) <= same, instants[near], changes)
        late = int(changes[0] > instants[0])
        changes, held = thin_out(np.append(instants[:late], changes), np.append(before[j : j + late], w[:, j])[:, None],
                                 False)
        F, start = np.zeros((n + 2, n + 2)), np.zeros((n + 2, 1))
        F[0, 1], F[2:, 0], F[2:, 2:] = 1.0, block[:n, n + j], block[:n, :n]
        if j == 0:
            start[2:, 0] = x0 / scale[:n]
        read = np.column_stack([D[:, j] * scale[n + j], np.zeros(len(C)), C * scale[:n]])
        y += run(F, read, instants, changes, held / scale[n + j], (False, True), start)[:, :, 0]
    return y

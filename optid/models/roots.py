"""Poles and zeros: roots of 1 + c_1 q^-1 + .. and eigenvalues; their sizes, their order and words, and moved ones."""

from typing import Any

import numpy as np

from optid.arrays import Array

DEFINITE = 1e-9  # share of the identity in a modal weight
AT_ONE = 1e-8  # distance from 1 within which a pole integrates: descents end 1e-9 before it
AT_ZERO = 1e-6  # modulus of a pole up to which it is a delay of a sample rather than a decay
RANK = 1e-10  # singular values below this share of the largest entry of a system count as zero


def roots_of(coefficients: Array) -> Any:
    """Roots of 1 + c_1 q^-1 + .., complex."""
    return np.roots(np.concatenate([[1.0], coefficients])).astype(complex)


def radius(coefficients: Array) -> float:
    """Largest modulus of the roots of 1 + c_1 q^-1 + ..; zero without coefficients."""
    return float(np.max(np.abs(roots_of(coefficients)))) if len(coefficients) else 0.0


def spectral_radius(matrix: Array) -> float:
    """Largest modulus of the eigenvalues of a matrix; zero without rows."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def poles_of(model: Any) -> Array:
    """Return the poles of the plant, largest first, linear feedback of the output included."""
    if model.structure != "ss" or not np.any(model.L):
        return np.asarray(model.poles)
    found = np.linalg.eigvals(model.A + model.L @ model.C).astype(complex)
    return found[np.argsort(-np.abs(found), kind="stable")]


def modal_weight(matrix: Array) -> Array:
    """Return ``P = T T*`` (n, n) of the eigenvectors T of A, which stays definite where T is singular.

    T takes A to a normal matrix, so ``L kron P + M kron (A P) + M' kron (A P)' >= 0`` holds, up to rounding, for every
    region {L + z M + conj(z) M' >= 0} that contains the eigenvalues of A.
    """
    vectors = np.linalg.eig(matrix)[1]
    return np.real(vectors @ vectors.conj().T) + DEFINITE * np.eye(len(matrix))


def largest_first(roots: Any) -> Any:
    """Order roots by their moduli, the largest first; of a pair the one with negative imaginary part first."""
    return roots[np.lexsort((roots.imag, -np.abs(roots)))]


def in_words(roots: Any) -> str:
    """Write roots to four digits."""
    return ", ".join(f"{r.real:.4g}" if abs(r.imag) < 1e-12 else f"{r:.4g}" for r in list(roots))


def without_integrator(coefficients: Array) -> Array:
    """Return the coefficients of A(q) / (1 - q^-1), for 1 + a_1 q^-1 + .. with A(1) = 0."""
    return np.cumsum(np.concatenate([[1.0], coefficients]))[1:-1]


def with_integrator(coefficients: Array) -> Array:
    """Return the coefficients with the root nearest to 1 moved there; of a complex pair the other one stays real."""
    roots = roots_of(coefficients)
    nearest = int(np.argmin(np.abs(roots - 1)))
    others = np.delete(roots, nearest)
    if roots[nearest].imag:
        partner = int(np.argmin(np.abs(others - np.conj(roots[nearest]))))
        others[partner] = others[partner].real
    quotient = np.concatenate([[1.0], with_roots(others, len(others))])
    return np.convolve(quotient, [1.0, -1.0])[1:]


def with_roots(roots: Any, size: int) -> Array:
    """Return the coefficients (size,) of the polynomial 1 + c_1 q^-1 + .. with these roots, and others at zero."""
    found = np.zeros(size)
    found[: len(roots)] = np.real(np.atleast_1d(np.poly(roots)))[1:]
    return found


def pull_roots(coefficients: Array, limit: float) -> Array:
    """Return the coefficients with every root outside the circle of radius ``limit`` pulled back onto it."""
    roots = roots_of(coefficients)
    return with_roots(roots * (limit / np.maximum(np.abs(roots), max(limit, 1e-300))), len(coefficients))


def contain_roots(coefficients: Array, limit: float = np.inf) -> Array:
    """Return the coefficients with roots outside the unit circle reflected, and none outside a radius ``limit``.

    Where the limit moves none, the spectrum of C e keeps its shape (spectral factorisation).
    """
    roots = roots_of(coefficients)
    roots = roots / np.maximum(np.abs(roots), 1.0) ** 2
    return with_roots(roots * np.minimum(limit / np.maximum(np.abs(roots), 1e-300), 1.0), len(coefficients))


def invariant_zeros(A: Array, B: Array, C: Array, D: Array) -> Any:
    """Return the zeros (k,), complex, largest first: the values at which [A - zI, B; C, D] loses rank.

    The part of the system at infinity is removed by rank decisions (Emami-Naeini and Van Dooren, Automatica 18, 1982),
    so that inputs and outputs may differ in number. Modes that an input cannot reach, or no output shows, are zeros.
    """
    size = max((float(np.abs(matrix).max(initial=0.0)) for matrix in (A, B, C, D)), default=0.0)
    if not B.shape[1] or not len(C) or size == 0:
        return np.zeros(0, dtype=complex)
    A, B, C, D = _without_surplus_outputs(A, B, C, D, RANK * size)
    A, C, B, D = (matrix.T for matrix in _without_surplus_outputs(A.T, C.T, B.T, D.T, RANK * size))
    found = np.linalg.eigvals(A - B @ np.linalg.solve(D, C)) if len(D) else np.linalg.eigvals(A)
    return largest_first(found.astype(complex))


def _without_surplus_outputs(A: Array, B: Array, C: Array, D: Array, tolerance: float
                             ) -> tuple[Array, Array, Array, Array]:
    """Return a system with the same zeros whose D has full row rank: an output without D holds its states at zero."""
    while True:
        left, values, _ = np.linalg.svd(D)
        rank = int(np.sum(values > tolerance))
        D, C = left.T @ D, left.T @ C
        D, C, free = D[:rank], C[:rank], C[rank:]
        turn, values, _ = np.linalg.svd(free.T)
        held = int(np.sum(values > tolerance))
        if held == 0:
            return A, B, C, D
        A, B, C = turn.T @ A @ turn, turn.T @ B, C @ turn
        C, D = np.vstack([C[:, held:], A[:held, held:]]), np.vstack([D, B[:held]])
        A, B = A[held:, held:], B[held:]

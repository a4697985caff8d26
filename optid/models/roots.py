"""Poles and zeros: roots of 1 + c_1 q^-1 + .. and eigenvalues; their sizes, their order and words, and moved ones."""

from typing import Any

import numpy as np

from optid.arrays import Array

DEFINITE = 1e-9  # share of the identity in a modal weight


def roots_of(coefficients: Array) -> Any:
    """Roots of 1 + c_1 q^-1 + .., complex."""
    return np.roots(np.concatenate([[1.0], coefficients])).astype(complex)


def radius(coefficients: Array) -> float:
    """Largest modulus of the roots of 1 + c_1 q^-1 + ..; zero without coefficients."""
    return float(np.max(np.abs(roots_of(coefficients)))) if len(coefficients) else 0.0


def spectral_radius(matrix: Array) -> float:
    """Largest modulus of the eigenvalues of a matrix; zero without rows."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


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


def pulled(coefficients: Array, limit: float) -> Array:
    """Return the coefficients with every root outside the circle of radius ``limit`` pulled back onto it."""
    roots = roots_of(coefficients)
    return with_roots(roots * (limit / np.maximum(np.abs(roots), max(limit, 1e-300))), len(coefficients))


def contained(coefficients: Array, limit: float = np.inf) -> Array:
    """Return the coefficients with roots outside the unit circle reflected, and none outside a radius ``limit``.

    Where the limit moves none, the spectrum of C e keeps its shape (spectral factorisation).
    """
    roots = roots_of(coefficients)
    roots = roots / np.maximum(np.abs(roots), 1.0) ** 2
    return with_roots(roots * np.minimum(limit / np.maximum(np.abs(roots), 1e-300), 1.0), len(coefficients))

"""The static curves of an input of a state-space model, as a leaf that constraints may speak about."""

from functools import partial

import numpy as np

from optid.arrays import Array, kron
from optid.core.leaves import Quantity
from optid.core.terms import Values


def static_curve(mu: str, b: str, name: str) -> Quantity:
    """Return the coefficients ``mu (C (I - A)^-1 B + D)ᵀ`` (P, l) of the static curves of an input under a name.

    ``b`` is the name of [B; D] of the input; where ``mu`` is no unknown the input acts linearly, and P is one.
    """
    return Quantity(name, partial(_value, mu, b), partial(_slope, mu, b))


def _value(mu: str, b: str, x: Values) -> Array:
    return np.outer(x.get(mu, np.ones(1)), _gains(b, x)[0])


def _slope(mu: str, b: str, x: Values) -> dict[str, Array]:
    gain, seen, rest = _gains(b, x)
    curve, size = np.reshape(x.get(mu, np.ones(1)), (-1, 1)), len(gain)
    direct = np.eye(size) if np.size(x[b]) > len(rest) else np.zeros((size, 0))
    by = {"A": kron(rest[None], seen), "C": kron(rest[None], np.eye(size)), b: np.hstack([seen, direct])}
    found = {name: kron(part, curve) for name, part in by.items()}
    return {**found, mu: kron(gain[:, None], np.eye(len(curve)))} if mu in x else found


def _gains(b: str, x: Values) -> tuple[Array, Array, Array]:
    """Return ``C (I - A)^-1 B + D`` (l,), ``C (I - A)^-1`` (l, n) and ``(I - A)^-1 B`` (n,)."""
    n = len(x["A"])
    to_state = np.linalg.pinv(np.eye(n) - x["A"], rcond=1e-13)  # at a pole at 1 there is no static curve
    seen, rest = x["C"] @ to_state, to_state @ x[b][:n]
    return seen @ x[b][:n] + (x[b][n:] if np.size(x[b]) > n else 0.0), seen, rest

"""Directions of a latent signal z that are worth a trial: signals, factors of responses, and random ones."""

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
from scipy.linalg import eigvals

from optid.arrays import Array
from optid.identify.prediction_error.state_errors import StateErrors
from optid.statistics.state_unknowns import Latent, StatePoint

CANDIDATES = 32  # directions that are ranked, at least
MARGIN = 1.15  # interval of a basis, as a multiple of the range of z at the start
# states of a model up to which its factors are tried; modulus from which a zero is one at infinity; radius at which
# responses are compared
LARGEST, FAR, OFF = 8, 1e3, 1.05


def directions(errors: StateErrors, point: StatePoint, latent: Latent, rng: np.random.Generator) -> Iterator[Array]:
    """Yield rows [Cz, Dz, constant] with z in [-1, 1]: states, inputs, outputs, factors of responses, random ones."""
    n, m = errors.unknowns.n, errors.unknowns.expansion.m
    states = np.vstack(errors.run_states(point))
    signals = np.hstack([states, np.vstack([e.u for e in errors.data.experiments])])
    moving = np.concatenate([np.ones(n), np.full(m, float(latent.moved))])
    spread = signals.std(axis=0)
    weight = moving / np.where(spread > 0, spread, 1.0)
    known = [*np.eye(n + m)[moving > 0], *np.hstack([point.C, np.zeros((len(point.C), m))]),
             *factors(point, moving, 2 * CANDIDATES, rng)]
    for number in range(max(CANDIDATES, len(known))):
        v = known[number] if number < len(known) else weight * rng.normal(size=n + m)
        z = signals @ v
        low, high = float(z.min()), float(z.max())
        if high - low > 1e-9 * np.abs(signals).max() * np.abs(v).max():
            factor = 2 / (MARGIN * (high - low))
            yield np.concatenate([factor * v, [-factor * (low + high) / 2]])


def factors(point: StatePoint, moving: Array, most: int, rng: np.random.Generator) -> Iterator[Array]:
    """Yield rows [Cz, Dz] of the factors of the transfer functions of a single input; of more than `most`, some.

    A static function between two linear systems has one as its argument: some of the poles, and some of the zeros.
    """
    n, m = len(point.A), point.b.shape[1]
    if m > 1 or n > LARGEST:
        return
    w = OFF * np.exp(1j * np.linspace(0.0, np.pi, 50 * (n + 1)))
    response: Any = np.array([np.append(np.linalg.solve(one * np.eye(n) - point.A, point.b[:, 0]), 1.0) for one in w])
    response *= moving
    poles = _conjugates(np.linalg.eigvals(point.A))
    for c, d in zip(point.C, point.d[:, 0]):
        pencil = np.block([[point.A, point.b], [c[None], np.array([[d]])]])
        zeros: Any = eigvals(pencil, np.diag(np.append(np.ones(n), 0.0)))
        zeros = _conjugates(zeros[np.abs(zeros) < FAR])
        excess = n - sum(map(len, zeros))
        pairs = [(p, z) for p, z in product(_subsets(poles), _subsets(zeros))
                 if len(p) and 0 <= len(p) - len(z) <= excess]
        for i in rng.permutation(len(pairs))[:most] if len(pairs) > most else range(len(pairs)):
            p, z = pairs[i]
            wanted: Any = np.prod(w[:, None] - z, axis=1) / np.prod(w[:, None] - p, axis=1)
            rows = np.vstack([response.real, response.imag])
            yield np.linalg.lstsq(rows, np.concatenate([wanted.real, wanted.imag]))[0]


def _conjugates(roots: Any) -> list[Any]:
    """Group roots: real ones alone, complex ones with their conjugates."""
    return [np.array([one, np.conj(one)]) if one.imag else np.array([one]) for one in roots if one.imag >= 0]


def _subsets(groups: Sequence[Any]) -> list[Any]:
    return [np.concatenate([np.zeros(0), *chosen]) for count in range(len(groups) + 1)
            for chosen in combinations(groups, count)]

"""Models with known parameters that several tests share."""

import numpy as np

from optid.bases import BSpline, Linear, PiecewiseConstant, Polynomial, Triangular, Trigonometric
from optid.data.record import Data
from optid.models import HammersteinTF, Nonlinearity

BASES = [Triangular(7),
         Trigonometric(3),
         Polynomial(4),
         BSpline(5),
         BSpline(4, degree=2),
         PiecewiseConstant(6),
         Linear(),
         Triangular(5, outside="extrapolate"),
         BSpline(5, outside="extrapolate")]


def nonlinearity(basis, seed=0, interval=(-0.7, 1.3)):
    basis = basis.with_interval(*interval)
    return Nonlinearity(basis, np.random.default_rng(seed).normal(size=basis.size))


def siso(basis=None, nk=0, offset=0.3, **changes):
    """The second-order example with poles 0.75 +- 0.37i."""
    arguments = {"a": [-1.5, 0.7],
                 "b": ([16 / 15, 0.8],),
                 "nonlinearities": (nonlinearity(basis or Triangular(7)),),
                 "nk": (nk,),
                 "offset": offset,
                 "dt": 0.1}
    return HammersteinTF(**(arguments | changes))


def mimo():
    """Two outputs that drive each other, three inputs of different orders and delays."""
    a = [[[-0.9, 0.1], [0.2, -0.5]], [[0.3, 0.0], [-0.1, 0.1]]]
    b = ([[1.0, 0.5], [0.4, -0.2]], [[0.0, 1.0]], [[0.3, 0.1], [0.2, 0.2], [-0.1, 0.4]])
    functions = tuple(
        nonlinearity(basis, seed) for seed, basis in enumerate([Triangular(6), Polynomial(3), BSpline(4)]))
    return HammersteinTF(a, b, functions, (0, 2, 1), [0.2, -0.4], dt=0.5, input_units=("A", "", "m"))


def inputs(model, count=200, seed=1):
    return np.random.default_rng(seed).uniform(-0.7, 1.3, (count, model.m))


def distance(found, true):
    """Largest difference of the coefficients of two transfer functions."""
    parts = [found.a - true.a, found.offset - true.offset, *(found.theta(c) - true.theta(c) for c in range(true.m))]
    return max(float(np.max(np.abs(part), initial=0.0)) for part in parts)


def by_hand(model, u, y_past=None, w_past=None, noise=None):
    """Run the difference equation sample by sample with zeros, or the given past, before the record."""
    count, n = len(u), 10
    a = model.a.reshape(model.na, model.l, model.l)
    y = np.zeros((n + count, model.l))
    f = np.zeros((n + count, model.m))
    if y_past is not None:
        y[:n], f[:n] = y_past, w_past
    f[n:] = np.column_stack([g(u[:, c]) for c, g in enumerate(model.nonlinearities)])
    for k in range(n, n + count):
        y[k] = model.offset + (0 if noise is None else noise[k - n])
        for i in range(model.na):
            y[k] -= a[i] @ y[k - 1 - i]
        for c in range(model.m):
            for j, row in enumerate(model.b[c].reshape(-1, model.l)):
                y[k] += row * f[k - model.nk[c] - j, c]
    return y[n:]


def record(model, count=400, seed=1, noise=0.1):
    """A record of a model with white equation errors."""
    u = inputs(model, count, seed)
    e = noise * np.random.default_rng(seed + 100).normal(size=(count, model.l))
    return Data(u, by_hand(model, u, noise=e), dt=model.dt, name="rig")

"""State-space models with known parameters, and their equations run by hand."""

import numpy as np
from systems import nonlinearity

from optid.bases import BSpline, Linear, PiecewiseConstant, Polynomial, Triangular, Trigonometric, UserFunctions
from optid.models import HammersteinSS, NoiseCovariances

USER = UserFunctions((np.sin, np.tanh), interval=(-3.0, 3.0))


def linear(seed=0, n=3, m=2, outputs=2, radius=0.8, **changes):
    """A random linear model in innovation form."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    arguments = {
        "A": A, "B": rng.normal(size=(n, m)), "C": rng.normal(size=(outputs, n)), "D": rng.normal(size=(outputs, m)),
        "K": 0.1 * rng.normal(size=(n, outputs)), "offset_x": rng.normal(size=n), "offset_y": rng.normal(size=outputs),
        "dt": 0.5}
    return HammersteinSS(**(arguments | changes))


def with_feedback(basis=None, seed=0, **changes):
    """Three states, two inputs (the second with two functions), two outputs fed back by the given basis."""
    rng = np.random.default_rng(seed)
    bases = [Triangular(6), Polynomial(3), Linear()]
    functions = tuple(nonlinearity(b, s) for s, b in enumerate(bases))
    fed = tuple(nonlinearity(basis or Polynomial(3), 5 + s, (-2.0, 2.0)) for s in range(2))
    root = rng.normal(size=(5, 5))
    noise = root @ root.T
    arguments = {
        "A": [[0.7, 0.35, 0.0], [-0.35, 0.7, 0.1], [0.0, 0.0, 0.5]], "B": 0.3 * rng.normal(size=(3, 3)),
        "C": [[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]], "D": 0.1 * rng.normal(size=(2, 3)), "nonlinearities": functions,
        "input_of": (0, 1, 1), "E": 0.1 * rng.normal(size=(3, 2)), "feedback": fed, "output_of": (1, 0),
        "L": 0.05 * rng.normal(size=(3, 2)), "K": 0.2 * rng.normal(size=(3, 2)), "offset_x": [0.1, -0.2, 0.05],
        "offset_y": [0.2, -0.1], "noise": NoiseCovariances(noise[:3, :3], noise[3:, 3:], noise[:3, 3:], np.eye(2)),
        "dt": 0.5, "input_units": ("A", ""), "outputs": ("p", "q")}
    return HammersteinSS(**(arguments | changes))


FEEDBACK_BASES = [
    Polynomial(3), Polynomial(4, outside="extrapolate"), Triangular(5), Triangular(4, outside="extrapolate"),
    BSpline(5), BSpline(4, degree=2, outside="extrapolate"),
    BSpline(4, outside="linear"), Polynomial(3, outside="linear"), PiecewiseConstant(6), Trigonometric(2), Linear(),
    USER]


def by_hand(model, u, x0, y=None, gain=None, noise=None):
    """Run the equations sample by sample; y holds what is measured (NaN = not), gain corrects the state with it."""
    x, outputs = np.array(x0, dtype=float), np.zeros((len(u), model.l))
    for k in range(len(u)):
        f = np.array([g(u[k, c]) for g, c in zip(model.nonlinearities, model.input_of)])
        h = np.array([g(z) for g, z in zip(model.latent, model.Cz @ x + model.Dz @ u[k] + model.offset_z)])
        yk = model.C @ x + model.D @ f + model.Fz @ h + model.offset_y + (0 if noise is None else noise[k])
        outputs[k] = yk
        seen = yk if y is None else np.where(np.isnan(y[k]), yk, y[k])
        g = np.array([h(seen[o]) for h, o in zip(model.feedback, model.output_of)])
        x = model.A @ x + model.B @ f + model.L @ seen + model.Ez @ h + model.offset_x + (model.E @ g if g.size else 0)
        if gain is not None:
            x = x + gain @ (seen - yk)
        if noise is not None:
            x = x + model.K @ noise[k]
    return outputs


def inputs(model, count=120, seed=1):
    return np.random.default_rng(seed).uniform(-0.7, 1.3, (count, model.m))


def two_outputs(count=20_000, seed=1):
    """Noise of two outputs by an autoregression: its coefficients, the root of the covariance, noise, white noise."""
    lags = np.array([[[0.5, 0.2], [0.0, 0.3]], [[-0.3, 0.0], [0.1, 0.2]]])
    root = np.linalg.cholesky([[1.0, 0.3], [0.3, 2.0]]).T
    e, w = np.zeros((count, 2)), np.random.default_rng(seed).normal(size=(count, 2)) @ root
    for k in range(2, count):
        e[k] = lags[0] @ e[k - 1] + lags[1] @ e[k - 2] + w[k]
    return lags, root, e, w

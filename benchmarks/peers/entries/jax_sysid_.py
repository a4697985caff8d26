"""jax-sysid: the predictor as a state function with u and y as inputs, Adam and then L-BFGS-B as in its examples."""

import jax.numpy as jnp
import numpy as np
from jax_sysid.models import Model

PACKAGES = ["jax-sysid==1.1.0"]
CANNOT = {}


def train(state, output, nx, guess, U, Y, **bounds):
    model = Model(nx, Y.shape[1], U.shape[1], state_fcn=state, output_fcn=output)
    model.init(params=guess, x0=np.zeros(nx))
    model.loss(rho_x0=0.0, rho_th=0.0)
    adam = 500 if len(Y) < 10_000 else 0  # as many would take minutes on a long record, and L-BFGS-B needs none there
    model.optimization(adam_epochs=adam, adam_eta=0.01, lbfgs_epochs=1000, iprint=-1, **bounds)
    model.fit(Y, U)
    return [np.asarray(p) for p in model.params]


def arx_predictor(curve, linear):
    """x+ = [-a1 y + x2 + b1 f; -a2 y + b2 f]; where y is missing (flag u[2]) it is replaced by the prediction."""

    def state(x, u, params):
        a, b = linear(params)
        f, y = curve(u[0], params), jnp.where(u[2] > 0, u[1], x[0] + params[-1][0])
        y = y - params[-1][0]
        return jnp.array([-a[0] * y + x[1] + b[0] * f, -a[1] * y + b[1] * f])

    return state


def output(x, u, params):
    return jnp.array([x[0] + params[-1][0]])


def masked(Yhat, Y):
    return jnp.sum(jnp.where(jnp.isnan(Y), 0.0, Yhat - jnp.nan_to_num(Y)) ** 2)


def inputs(u, y):
    return np.column_stack([u[:, 0], np.nan_to_num(y[:, 0]), np.isfinite(y[:, 0])])


def arx_model(a, b, f, d):
    def drive(u):
        v = f(u[:, 0])
        return np.concatenate([[0, 0], b[0] * v[1:-1] + b[1] * v[:-2]]) + d * (1 + a.sum())

    return {"a": a, "drive": drive}


def cubic(v, params):
    return v + params[2][0] * v**2 + params[2][1] * v**3


def hammerstein(r):
    guess = [np.array([-0.5, 0.06]), np.array([0.5, 0.5]), np.zeros(2), np.zeros(1)]
    a, b, c, d = train(arx_predictor(cubic, lambda p: p[:2]), output, 2, guess, inputs(r["u"], r["y"]), r["y"])
    return arx_model(a, b, lambda v: cubic(v, (a, b, c)), d)


def missing(r):
    guess = [np.array([-0.5, 0.06]), np.array([0.5, 0.5]), np.zeros(2), np.zeros(1)]
    model = Model(2, 1, 3, state_fcn=arx_predictor(cubic, lambda p: p[:2]), output_fcn=output)
    model.init(params=guess, x0=np.zeros(2))
    model.loss(output_loss=lambda Yhat, Y: masked(Yhat, Y) / Y.shape[0], rho_x0=0.0, rho_th=0.0)
    model.optimization(adam_epochs=500, adam_eta=0.01, lbfgs_epochs=1000, iprint=-1)
    model.fit(r["y"], inputs(r["u"], r["y"]))
    a, b, c, d = (np.asarray(p) for p in model.params)
    return arx_model(a, b, lambda v: cubic(v, (a, b, c)), d)


def constrained(r):
    """Increments of f bounded below by zero; the middle one is the cell, so B(1) = A(1) makes the gain one."""
    nodes, cell = r["nodes"], r["nodes"][1] - r["nodes"][0]
    half = (len(nodes) - 2) // 2

    def values(steps):
        steps = jnp.concatenate([steps[:half], jnp.array([cell]), steps[half:]])
        return jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)]) - cell * (half + 0.5)

    def linear(params):
        a = params[0]
        return a, jnp.array([params[1][0], 1 + a[0] + a[1] - params[1][0]])

    state = arx_predictor(lambda v, params: jnp.interp(v, nodes, values(params[2])), linear)
    guess = [np.array([-0.5, 0.06]), np.array([0.3]), np.full(2 * half, cell), np.zeros(1)]
    free = [np.full(len(g), 1e3) for g in guess]
    low = [-free[0], -free[1], np.zeros(2 * half), -free[3]]
    params = train(state, output, 2, guess, inputs(r["u"], r["y"]), r["y"], params_min=low, params_max=free)
    a, b = (np.asarray(p) for p in linear(params))
    return arx_model(a, b, lambda v: np.interp(v, nodes, np.asarray(values(params[2]))), params[3])


def state_space(r):
    """x+ = A x + B u + K (y - C x), from a stable guess as `LinearModel` takes it."""
    nx, m, p = r["nx"], r["u"].shape[1], r["y"].shape[1]

    def state(x, v, params):
        A, B, C, K = params
        return A @ x + B @ v[:m] + K @ (v[m:] - C @ x)

    rng = np.random.default_rng(0)
    guess = [0.5 * np.eye(nx), 0.1 * rng.standard_normal((nx, m)), 0.1 * rng.standard_normal((p, nx)),
             np.zeros((nx, p))]
    A, B, C, K = train(state, lambda x, v, params: params[2] @ x, nx, guess, np.hstack([r["u"], r["y"]]), r["y"])
    return {"A": A, "B": B, "C": C, "D": np.zeros((p, m)), "K": K}

"""Hand-written CVXPY: alternating convex problems where mu b' is a product, least squares on the compressed rows."""

from functools import partial

import cvxpy as cp
import numpy as np

PACKAGES = ["cvxpy==1.9.3"]
CANNOT = {}


def compressed(r, functions):
    """Rows y = -a1 y1 - a2 y2 + sum_j f(u(k-j))' theta_j + d without missing samples, reduced to their triangle."""
    y, F = r["y"][:, 0], functions(r["u"][:, 0])
    first = max(r["na"], r["nk"] + r["nb"] - 1)
    past = [-y[first - i : len(y) - i] for i in range(1, r["na"] + 1)]
    lags = [F[first - j : len(y) - j] for j in range(r["nk"], r["nk"] + r["nb"])]
    rows = np.column_stack([*past, *lags, np.ones(len(y) - first), y[first:]])
    return np.linalg.qr(rows[np.isfinite(rows).all(axis=1)], mode="r")


def solved(R, na, theta, rules=lambda a: []):
    """Minimise over a, d and the unknowns in theta (functions x lags, affine)."""
    a, d = cp.Variable(na), cp.Variable(1)
    x = cp.hstack([a, cp.vec(theta, order="F"), d])
    problem = cp.Problem(cp.Minimize(cp.sum_squares(R[:, :-1] @ x - R[:, -1])), rules(a))
    problem.solve(solver=cp.CLARABEL)
    return a.value, d.value[0], problem.value


def alternated(R, r, size, rules=lambda mu, b, a: [], rounds=50):
    """The full matrix first, its leading pair as the start, then mu and b in turns."""
    theta = cp.Variable((size, r["nb"]))
    solved(R, r["na"], theta)
    left, values, right = np.linalg.svd(theta.value)
    mu0, b0, best = left[:, 0] * values[0] * right[0, 0], right[0] / right[0, 0], np.inf
    for _ in range(rounds):
        mu = cp.Variable(size)
        solved(R, r["na"], cp.outer(mu, b0), partial(rules, mu, b0))
        mu0, b = mu.value, cp.Variable(r["nb"])
        a, d, value = solved(R, r["na"], cp.outer(mu0, b), partial(rules, mu0, b))
        b0, done, best = b.value, abs(best - value) <= 1e-10 * value, value
        if done:
            break
    return a, mu0, b0, d


def model(r, a, mu, b, d, functions):
    def drive(u):
        v = functions(u[:, 0]) @ mu
        x = np.convolve(v, np.concatenate([np.zeros(r["nk"]), b]))[: len(u)]
        return x + d

    return {"a": a, "drive": drive}


def hammerstein(r):
    def functions(u):
        return np.column_stack([u**p for p in range(1, r["degree"] + 1)])

    return model(r, *alternated(compressed(r, functions), r, r["degree"]), functions)


missing = hammerstein


def constrained(r):
    nodes, middle = r["nodes"], len(r["nodes"]) // 2 - 1
    cell = nodes[1] - nodes[0]

    def functions(u):
        """Steps of a piecewise linear curve: f(u) = sum of slopes times the part of each cell below u."""
        return np.clip((u[:, None] - nodes[:-1]) / cell, 0, 1)

    def rules(mu, b, a):
        rise = mu if isinstance(mu, cp.Variable) else cp.Constant(mu)
        return [rise >= 0, rise[middle] * cp.sum(b) == cell * (1 + cp.sum(a))]

    return model(r, *alternated(compressed(r, functions), r, len(nodes) - 1, rules), functions)


def state_space(r, lags=10):
    """Not convex in the states: a long vector ARX model, states from the SVD of what it predicts, then regressions."""
    u, y, n = r["u"], r["y"], r["nx"]
    w, p = np.hstack([u, y]), y.shape[1]
    past = np.column_stack([w[lags - j : len(w) - j] for j in range(1, lags + 1)])
    size = past.shape[1]
    R = np.linalg.qr(np.hstack([past, y[lags:]]), mode="r")
    theta = cp.Variable((size, p))
    cp.Problem(cp.Minimize(cp.sum_squares(R[:size, :size] @ theta - R[:size, size:]))).solve(solver=cp.CLARABEL)
    shifts = [np.vstack([theta.value[i * w.shape[1] :], np.zeros((i * w.shape[1], p))]) for i in range(lags // 2)]
    left, values, _ = np.linalg.svd(past @ np.hstack(shifts), full_matrices=False)
    x, u, y = left[:, :n] * values[:n], u[lags:], y[lags:]
    C = np.linalg.lstsq(x, y, rcond=None)[0].T
    e = y - x @ C.T
    ABK = np.linalg.lstsq(np.hstack([x, u, e])[:-1], x[1:], rcond=None)[0].T
    A, B, K = np.split(ABK, [n, n + u.shape[1]], axis=1)
    return {"A": A, "B": B, "C": C, "D": np.zeros((p, u.shape[1])), "K": K}

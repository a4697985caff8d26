"""Hand-written CasADi: the nonlinear programmes themselves, solved by IPOPT."""

import casadi as ca
import numpy as np

PACKAGES = ["casadi==3.8.2"]
CANNOT = {}
QUIET = {"ipopt.print_level": 0, "print_time": False, "ipopt.tol": 1e-9}


def compressed(r, functions):
    """Rows y = -a1 y1 - a2 y2 + sum_j f(u(k-j))' theta_j + d without missing samples, reduced to their triangle."""
    y, F = r["y"][:, 0], functions(r["u"][:, 0])
    first = max(r["na"], r["nk"] + r["nb"] - 1)
    past = [-y[first - i : len(y) - i] for i in range(1, r["na"] + 1)]
    lags = [F[first - j : len(y) - j] for j in range(r["nk"], r["nk"] + r["nb"])]
    rows = np.column_stack([*past, *lags, np.ones(len(y) - first), y[first:]])
    return np.linalg.qr(rows[np.isfinite(rows).all(axis=1)], mode="r")


def solved(r, functions, size, rules=None):
    """Minimise over a, b, mu, d from the leading pair of the least-squares matrix."""
    R, na, nb = compressed(r, functions), r["na"], r["nb"]
    x = np.linalg.lstsq(R[:, :-1], R[:, -1], rcond=None)[0]
    left, values, right = np.linalg.svd(x[na:-1].reshape(nb, size).T)
    opti = ca.Opti()
    a, b, mu, d = opti.variable(na), opti.variable(nb), opti.variable(size), opti.variable()
    theta = ca.vertcat(a, ca.reshape(mu @ b.T, -1, 1), d)
    opti.minimize(ca.sumsqr(ca.DM(R[:, :-1]) @ theta - ca.DM(R[:, -1])))
    if rules is None:
        opti.subject_to(b[0] == 1)
    else:
        opti.subject_to(rules(a, b, mu))
    scale = right[0, 0]
    for variable, value in ((a, x[:na]), (b, right[0] / scale), (mu, left[:, 0] * values[0] * scale), (d, x[-1])):
        opti.set_initial(variable, value)
    opti.solver("ipopt", QUIET)
    found = opti.solve()
    a, b, mu, d = (np.ravel(found.value(v)) for v in (a, b, mu, d))

    def drive(u):
        x = np.convolve(functions(u[:, 0]) @ mu, np.concatenate([np.zeros(r["nk"]), b]))[: len(u)]
        return x + d

    return {"a": a, "drive": drive}


def hammerstein(r):
    return solved(r, lambda u: np.column_stack([u**p for p in range(1, r["degree"] + 1)]), r["degree"])


missing = hammerstein


def constrained(r):
    nodes, middle = r["nodes"], len(r["nodes"]) // 2 - 1
    cell = nodes[1] - nodes[0]

    def functions(u):
        """Steps of a piecewise linear curve: f(u) = sum of rises times the part of each cell below u."""
        return np.clip((u[:, None] - nodes[:-1]) / cell, 0, 1)

    def rules(a, b, mu):
        return [mu >= 0, mu[middle] == cell, ca.sum1(b) == 1 + ca.sum1(a)]

    return solved(r, functions, len(nodes) - 1, rules)


def arx_start(r, lags=10):
    """A realisation of a long vector ARX model, to start from."""
    w, p, m, n = np.hstack([r["u"], r["y"]]), r["y"].shape[1], r["u"].shape[1], r["nx"]
    rows = np.column_stack([w[lags - j : len(w) - j] for j in range(1, lags + 1)])
    theta = np.linalg.lstsq(rows, r["y"][lags:], rcond=None)[0]
    H = theta.T.reshape(p, lags, m + p).transpose(1, 0, 2)
    hankel = np.block([[H[i + j] for j in range(lags // 2)] for i in range(lags // 2)])
    left, values, right = np.linalg.svd(hankel)
    obs, Q = left[:, :n] * np.sqrt(values[:n]), np.sqrt(values[:n])[:, None] * right[:n]
    return np.linalg.lstsq(obs[:-p], obs[p:], rcond=None)[0], Q[:, : m + p], obs[:p]


def state_space(r):
    """The predictor x+ = F x + G [u; y], y = C x + e with the states as variables (direct collocation)."""
    w, y, n = np.hstack([r["u"], r["y"]]), r["y"], r["nx"]
    F0, G0, C0 = arx_start(r)
    x0 = np.zeros((n, len(y)))
    for k in range(len(y) - 1):
        x0[:, k + 1] = F0 @ x0[:, k] + G0 @ w[k]
    opti = ca.Opti()
    F, G, C = opti.variable(n, n), opti.variable(n, w.shape[1]), opti.variable(*C0.shape)
    X = opti.variable(n, len(y))
    opti.minimize(ca.sumsqr(y.T - C @ X))
    opti.subject_to(X[:, 1:] == F @ X[:, :-1] + G @ w[:-1].T)
    opti.subject_to(ca.vec(C[:, : C.shape[0]]) == C0[:, : C.shape[0]].ravel(order="F"))
    for variable, value in ((F, F0), (G, G0), (C, C0), (X, x0)):
        opti.set_initial(variable, value)
    opti.solver("ipopt", QUIET | {"ipopt.hessian_approximation": "exact", "ipopt.max_iter": 200})
    found = opti.solve()
    F, G, C = (np.atleast_2d(found.value(v)) for v in (F, G, C))
    m = r["u"].shape[1]
    return {"A": F + G[:, m:] @ C, "B": G[:, :m], "C": C, "D": np.zeros((len(C), m)), "K": G[:, m:]}

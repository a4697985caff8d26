"""python-control: observer Markov parameters (OKID) by `markov`, realised by `eigensys_realization`.

The numbers of lags are those that did best. u, u^2, u^3 are inputs where the plant is a Hammerstein system.
"""

import control
import numpy as np

PACKAGES = ["control==0.10.2"]
CANNOT = {"missing": "no missing samples", "constrained": "no constraints"}


def realised(u, y, nx, lags=10):
    """The predictor x+ = (A - K C) x + [B K] [u; y] from its Markov parameters, no direct effect."""
    m, p = u.shape[1], y.shape[1]
    past = np.vstack([np.zeros((1, m + p)), np.hstack([u, y])[:-1]])
    H = control.markov(y.T, past.T, m=lags, truncate=True)
    H = np.concatenate([np.zeros((p, m + p, 1)), H.reshape(p, m + p, lags)], axis=2)
    system, _ = control.eigensys_realization(H, nx, m=lags // 2, n=lags // 2)
    B, K = system.B[:, :m], system.B[:, m:]
    return {"A": system.A + K @ system.C, "B": B, "C": system.C, "D": np.zeros((p, m)), "K": K}


def powers(u, degree):
    return np.column_stack([u[:, 0] ** p for p in range(1, degree + 1)])


def hammerstein(r):
    u, mean = powers(r["u"], r["degree"]), r["y"].mean(axis=0)
    centre = u.mean(axis=0)
    model = realised(u - centre, r["y"] - mean, r["na"], lags=6)
    return model | {"offset": mean, "features": lambda v: powers(v, r["degree"]) - centre}


def state_space(r):
    return realised(r["u"], r["y"], r["nx"])

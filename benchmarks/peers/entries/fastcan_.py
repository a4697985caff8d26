"""fastcan: a NARX model of the true terms; several outputs as a vector ARX model (it has no states)."""

import numpy as np
from fastcan.narx import NARX

PACKAGES = ["fastcan==0.6.0"]
CANNOT = {"constrained": "bounds on coefficients alone, no gain"}


def shifted(x, k):
    return np.concatenate([np.zeros((k, x.shape[1])), x[: len(x) - k]])


def hammerstein(r):
    """Powers of X[k - d] and y[k - d]; feature 0 is u, 1 is y, -1 stands for one."""
    n, features, delays = r["degree"], [], []
    for d in range(r["nk"], r["nk"] + r["nb"]):
        for p in range(1, n + 1):
            features.append([-1] * (n - p) + [0] * p)
            delays.append([-1] * (n - p) + [d] * p)
    for d in range(1, r["na"] + 1):
        features.append([-1] * (n - 1) + [1])
        delays.append([-1] * (n - 1) + [d])
    model = NARX(feat_ids=features, delay_ids=delays).fit(r["u"], r["y"][:, 0])
    theta, lags, powers = model.coef_, r["nb"], np.arange(1, n + 1)

    def drive(u):
        v = u ** powers
        return model.intercept_ + sum(shifted(v, r["nk"] + j) @ theta[j * n : (j + 1) * n] for j in range(lags))

    return {"a": -theta[lags * n :], "drive": drive}


missing = hammerstein


def state_space(r, lags=6):
    """A vector ARX model: two lags have as many states as the plant, but cannot hold its noise; six do best."""
    m, p = r["u"].shape[1], r["y"].shape[1]
    terms = [(o, f, d) for o in range(p) for f in range(m + p) for d in range(1, lags + 1)]
    model = NARX(feat_ids=[[f] for _, f, _ in terms], delay_ids=[[d] for *_, d in terms],
                 output_ids=[o for o, *_ in terms]).fit(r["u"], r["y"])

    def one_step(u, y):
        both = np.hstack([u, y])
        found = np.tile(model.intercept_, (len(u), 1))
        for (o, f, d), value in zip(terms, model.coef_):
            found[:, o] += value * shifted(both[:, f : f + 1], d)[:, 0]
        return found

    return {"one_step": one_step, "simulate": lambda u, y: model.predict(u, y_init=y[:lags])}

"""nfoursid: N4SID; u, u^2, u^3 as inputs where the plant is a Hammerstein system (it has no nonlinearity)."""

import numpy as np
import pandas as pd
from nfoursid.nfoursid import NFourSID

PACKAGES = ["nfoursid==1.0.2"]
CANNOT = {"missing": "refuses NaN", "constrained": "no constraints"}


def identified(u, y, nx, block_rows):
    names_u, names_y = [f"u{i}" for i in range(u.shape[1])], [f"y{i}" for i in range(y.shape[1])]
    frame = pd.DataFrame(np.hstack([u, y]), columns=names_u + names_y)
    method = NFourSID(frame, output_columns=names_y, input_columns=names_u, num_block_rows=block_rows)
    method.subspace_identification()
    system, covariance = method.system_identification(rank=nx)
    p = y.shape[1]
    return system, covariance[:p, :p], covariance[p:, p:], covariance[p:, :p]


def with_gain(u, y, nx, block_rows):
    """The Kalman gain from the covariances, by iterating the Riccati equation as its `Kalman` does."""
    s, R, Q, S = identified(u, y, nx, block_rows)
    P = Q
    for _ in range(1000):
        K = (s.a @ P @ s.c.T + S) @ np.linalg.inv(s.c @ P @ s.c.T + R)
        P = s.a @ P @ s.a.T + Q - K @ (s.c @ P @ s.a.T + S.T)
    return {"A": s.a, "B": s.b, "C": s.c, "D": s.d, "K": K}


def powers(u, degree):
    return np.column_stack([u[:, 0] ** p for p in range(1, degree + 1)])


def hammerstein(r):
    u, mean = powers(r["u"], r["degree"]), r["y"].mean(axis=0)
    centre = u.mean(axis=0)
    model = with_gain(u - centre, r["y"] - mean, r["na"], 3)
    return model | {"offset": mean, "features": lambda v: powers(v, r["degree"]) - centre}


def state_space(r):
    return with_gain(r["u"], r["y"], r["nx"], r["block_rows"])

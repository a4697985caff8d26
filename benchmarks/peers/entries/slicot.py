"""ctrlsys (SLICOT): IB01AD and IB01BD; u, u^2, u^3 as inputs where the plant is a Hammerstein system."""

import ctrlsys
import numpy as np

PACKAGES = ["ctrlsys==1.1.1"]
CANNOT = {"missing": "no missing samples", "constrained": "no constraints"}


def identified(u, y, nx, rows):
    """Combined method: A and C by MOESP, B and D by N4SID; Cholesky route of the compression, the fastest."""
    (count, m), p = u.shape, y.shape[1]
    uf, yf = np.asfortranarray(u), np.asfortranarray(y)
    _, R, _, warned, info = ctrlsys.ib01ad("M", "C", "N", "O", "N", "N", rows, m, p, uf, yf, 0.0, -1.0)
    if info:
        raise RuntimeError(f"IB01AD: info {info}")
    A, C, B, D, _, _, _, K, warned, info = ctrlsys.ib01bd("C", "A", "K", rows, nx, m, p, count, R, 0.0)
    if info:
        raise RuntimeError(f"IB01BD: info {info}")
    return {"A": A, "B": B, "C": C, "D": D, "K": K}


def powers(u, degree):
    return np.column_stack([u[:, 0] ** p for p in range(1, degree + 1)])


def hammerstein(r):
    u, mean = powers(r["u"], r["degree"]), r["y"].mean(axis=0)
    centre = u.mean(axis=0)
    model = identified(u - centre, r["y"] - mean, r["na"], 3)
    return model | {"offset": mean, "features": lambda v: powers(v, r["degree"]) - centre}


def state_space(r):
    return identified(r["u"], r["y"], r["nx"], r["block_rows"])


def projected(r):
    """The subspace step alone, without a model: IB01AD, its fastest route."""
    m, p = r["u"].shape[1], r["y"].shape[1]
    _, _, values, _, info = ctrlsys.ib01ad("M", "C", "N", "O", "N", "N", r["block_rows"], m, p,
                                           np.asfortranarray(r["u"]), np.asfortranarray(r["y"]), 0.0, -1.0)
    if info:
        raise RuntimeError(f"IB01AD: info {info}")
    return {"values": values}

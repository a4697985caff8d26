"""SIPPY: ARX with u, u^2, u^3 as inputs (it has no nonlinearity); CVA for state space."""

import numpy as np
from sippy_unipi import system_identification

PACKAGES = ["sippy-unipi==1.0.1"]
CANNOT = {"missing": "no missing samples", "constrained": "no constraints but stability"}


def powers(u, degree):
    return np.column_stack([u[:, 0] ** p for p in range(1, degree + 1)])


def hammerstein(r):
    n, mean, centre = r["degree"], r["y"].mean(), powers(r["u"], r["degree"]).mean(axis=0)
    model = system_identification(r["y"].T, powers(r["u"], n).T, "ARX", centering="MeanVal",
                                  ARX_orders=[[r["na"]], [[r["nb"]] * n], [[r["nk"] - 1] * n]])
    a = np.array(model.DENOMINATOR[0][0][1 : r["na"] + 1])
    b = [np.concatenate([[0.0], numerator]) for numerator in model.NUMERATOR[0]]

    def drive(u):
        v = powers(u, n) - centre
        return mean * (1 + a.sum()) + sum(np.convolve(v[:, j], b[j])[: len(u)] for j in range(n))

    return {"a": a, "drive": drive}


def state_space(r):
    model = system_identification(r["y"].T, r["u"].T, "CVA", SS_fixed_order=r["nx"], SS_f=r["block_rows"],
                                  SS_p=r["block_rows"])
    return {"A": model.A, "B": model.B, "C": model.C, "D": model.D, "K": model.K}

"""sysidentpy: FROLS with the regressors of the true structure, u, u^2 and u^3 as inputs."""

import numpy as np
from sysidentpy.basis_function import Polynomial
from sysidentpy.model_structure_selection import FROLS
from sysidentpy.parameter_estimation import LeastSquares

PACKAGES = ["sysidentpy==0.9.0"]
CANNOT = {"missing": "refuses NaN", "state_space": "one output",
          "constrained": "a gain as a second objective (AILS), no monotone curve"}


def powers(u, degree):
    return np.column_stack([u[:, 0] ** p for p in range(1, degree + 1)])


def hammerstein(r):
    n, lags = r["degree"], list(range(1, r["nb"] + 1))
    model = FROLS(ylag=r["na"], xlag=[lags] * n, basis_function=Polynomial(degree=1), order_selection=False,
                  n_terms=1 + r["na"] + n * r["nb"], estimator=LeastSquares())
    model.fit(X=powers(r["u"], n), y=r["y"])
    return {"one_step": lambda u, y: model.predict(X=powers(u, n), y=y, steps_ahead=1),
            "simulate": lambda u, y: model.predict(X=powers(u, n), y=y)}

"""Fits that the tests of printing, figures and reports share; each is made once."""

import warnings
from functools import cache
from typing import Any

import numpy as np

import optid
from optid.errors import DataWarning
from optid.examples import example
from optid.identify.fitting import Fit


def quiet(*arguments: Any, **options: Any) -> Fit:
    """A fit whose remarks about the record are of no interest."""
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        return optid.fit(*arguments, **options)


@cache
def example_fit(name: str, formulation: str = "hammerstein_arx.exact", **more: Any) -> Fit:
    """A built-in record as suggested."""
    chosen = example(name)
    return optid.fit(chosen.data, formulation, **chosen.suggestion, **more)


def two_by_two(n: int = 500, seed: int = 3) -> optid.Data:
    """Two inputs, two outputs with awkward names, three experiments of unequal length, some samples missing."""
    rng = np.random.default_rng(seed)
    us, ys = [], []
    for length in (n, n // 2, n // 3):
        u = rng.uniform(-1, 1, (length, 2))
        f = np.column_stack([u[:, 0] ** 3, np.maximum(u[:, 1], 0)])
        y = np.zeros((length, 2))
        for k in range(1, length):
            y[k] = np.array([[0.6, 0.1], [0.0, 0.5]]) @ y[k - 1] + np.array([[1.0, 0.5], [0.3, -0.8]]) @ f[k]
        y += 0.02 * rng.standard_normal(y.shape)
        y[5:8, 0] = np.nan
        us.append(u)
        ys.append(y)
    return optid.Data(us, ys, 0.5, ["valve <1>", "heat & $x_1$"], ["level_a", 'temp "b"'], ["%", "kW"], ["m", "°C"])


@cache
def mimo_fit() -> Fit:
    """The record of `two_by_two`, fitted."""
    return quiet(two_by_two(), na=1, nb=1, basis="polynomial:3")


@cache
def linear_fit(**options: Any) -> Fit:
    """A noise-free linear ARX record: y(k) = 0.5 y(k-1) - 0.2 y(k-2) + 2 u(k-1) - 3."""
    rng = np.random.default_rng(1)
    u, y = rng.standard_normal(300), np.zeros(300)
    for k in range(2, 300):
        y[k] = 0.5 * y[k - 1] - 0.2 * y[k - 2] + 2 * u[k - 1] - 3
    return optid.fit(optid.Data(u, y, 0.1, name="linear"), "arx", na=2, nb=1, nk=1, **options)


@cache
def feedback_fit() -> Fit:
    """A Van der Pol oscillator with measurement noise: a state-space model with nonlinear feedback."""
    from optid.plants import van_der_pol

    u = np.random.default_rng(0).uniform(-2, 2, 1500)
    data = van_der_pol(u, 1, measurement=0.02, process=0.005)
    return quiet(data, "hammerstein_ss.asivid", nx=2, basis="polynomial:3", feedback_basis="polynomial:3")


@cache
def output_error_fit() -> Fit:
    """The dead zone record, fitted by its simulation error."""
    return quiet(example("dead_zone").data, "hammerstein_oe.exact", na=2, nb=2, basis="triangular:8")

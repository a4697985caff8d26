"""The standard plant of the faults, and others with known parameters."""

import json
from pathlib import Path

import numpy as np
import pytest

from optid.bases import UserFunctions
from optid.data.record import Data
from optid.faults import inject
from optid.models import HammersteinSS, NoiseCovariances, Nonlinearity
from optid.models.kalman import kalman_gain


def noisy(A, B, C, Q, R, **changes):
    """A linear model with the noise of the given covariances and its steady gain."""
    steady = kalman_gain(A, C, Q, R)
    cross = np.zeros((len(A), len(C)))
    return HammersteinSS(A, B, C, K=steady.K, noise=NoiseCovariances(Q, R, cross, steady.innovation), **changes)


def standard(folder: Path) -> tuple[HammersteinSS, np.ndarray]:
    """The plant of fault_plant.json and the direction of its load."""
    p = {key: np.array(value) for key, value in json.loads((folder / "fault_plant.json").read_text()).items()
         if len(key) == 1}
    span = (-1.2, 1.2)
    f1 = UserFunctions((lambda u: u + 0.25 * u**3,), interval=span, outside="extrapolate", names=("f1",))
    f2 = UserFunctions((lambda u: np.tanh(1.5 * u) + 0.15 * u,), interval=span, outside="extrapolate", names=("f2",))
    functions = tuple(Nonlinearity(f, np.ones(1)) for f in (f1, f2))
    return noisy(p["A"], p["B"], p["C"], p["Q"], p["R"], D=p["D"], nonlinearities=functions), p["E"][:, 0]


def levels(count, seed, m=2, hold=5):
    """Inputs uniform on [-1.2, 1.2], every level held."""
    drawn = np.random.default_rng(seed).uniform(-1.2, 1.2, (-(-count // hold), m))
    return np.repeat(drawn, hold, axis=0)[:count]


LOAD = np.array([0.3, -0.2, 0.5])
"""A direction in the state of the plant of three states."""


def record(model, seed, faults=(), missing=0.0, count=50):
    """Inputs and readings of a plant with faults, some readings missing."""
    u = levels(count, seed, model.m)
    y = inject(model, u, faults, seed=seed, process={"load": LOAD})
    y[np.random.default_rng(seed).random(y.shape) < missing] = np.nan
    return Data(u, y, dt=model.dt, outputs=model.outputs)


def refused(*cases):
    """Every call (error, words, call) raises this error with these words."""
    for error, words, call in cases:
        with pytest.raises(error, match=words):
            call()

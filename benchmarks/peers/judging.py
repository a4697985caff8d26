"""What a peer's model predicts, computed the same way for all, and the score of it. Needs numpy alone.

An entry returns its model in one of three forms, whichever its package gives:

* ``{"a": (na,), "drive": u -> (N,)}``: y(k) + a1 y(k-1) + ... = drive(k), where drive may be NaN at the first samples;
* ``{"A", "B", "C", "D", "K", "features", "offset"}``: innovation form in the inputs ``features(u)`` (default u) and the
  outputs less ``offset`` (default 0); without K the one-step prediction is the simulation;
* ``{"one_step": (u, y) -> (N, l), "simulate": (u, y) -> (N, l)}``: the package predicts by itself; from y the
  simulation may take initial values alone.

The first `RUN_IN` samples to score on are left out, so that no initial state matters.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Array = np.ndarray

RUN_IN = 100
LEVELS = 21
HOLD = 150
"""Samples for which each level of the probing staircase is held; the last is taken as the static value."""


def one_step(model: Mapping[str, Any], u: Array, y: Array) -> Array:
    """Predictions (N, l) from the outputs up to the sample before."""
    if "one_step" in model:
        return _shaped(model["one_step"](u, y), y)
    if "A" in model:
        return _states(model, u, y)
    a, predicted = np.ravel(model["a"]), _drive(model, u)
    for i, value in enumerate(a, 1):
        predicted[i:] -= value * y[:-i, 0]
    return predicted[:, None]


def simulate(model: Mapping[str, Any], u: Array, y: Array) -> Array:
    """Simulated outputs (N, l); of y the number of columns and initial values alone count."""
    if "simulate" in model:
        return _shaped(model["simulate"](u, y), y)
    if "A" in model:
        return _states(model, u, None)
    a, drive = np.ravel(model["a"]), _drive(model, u)
    found = np.zeros(len(u))
    for k in range(len(u)):
        found[k] = drive[k] - sum(a[i] * found[k - 1 - i] for i in range(min(len(a), k)))
    return found[:, None]


def _drive(model: Mapping[str, Any], u: Array) -> Array:
    return np.nan_to_num(np.array(model["drive"](u), dtype=float).reshape(len(u)))


def _states(model: Mapping[str, Any], u: Array, y: Array | None) -> Array:
    A, B, C, D = (np.atleast_2d(np.asarray(model[name], dtype=float)) for name in "ABCD")
    inputs = np.asarray(model.get("features", lambda u: u)(u), dtype=float)
    offset = np.ravel(model.get("offset", np.zeros(len(C))))
    K = model.get("K")
    found, x = np.zeros((len(u), len(C))), np.zeros(len(A))
    for k in range(len(u)):
        found[k] = C @ x + D @ inputs[k] + offset
        x = A @ x + B @ inputs[k] + (0 if y is None or K is None else K @ (y[k] - found[k]))
    return found


def _shaped(found: Any, y: Array) -> Array:
    found = np.asarray(found, dtype=float)
    return found.reshape(len(found), -1)[: len(y)] if found.ndim < 2 or found.shape[0] == len(y) else found.T


def fit_percent(y: Array, found: Array) -> float:
    """100 (1 - |y - found| / |y - mean y|) after the run-in, averaged over outputs; at least 0, 0 where not finite."""
    y, found = y[RUN_IN:], found[RUN_IN:]
    if found.shape != y.shape or not np.all(np.isfinite(found)):
        return 0.0
    with np.errstate(over="ignore"):
        rest = np.linalg.norm(y - found, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0)
    return float(np.mean(np.maximum(100 * (1 - rest), 0)))


def static_curve(model: Mapping[str, Any], levels: Array) -> Array:
    """Static outputs (levels,) of a model with one input and one output, from its own simulation of a staircase."""
    u = np.repeat(levels, HOLD)[:, None]
    return simulate(model, u, np.zeros((len(u), 1)))[HOLD - 1 :: HOLD, 0]


def disobeyed(model: Mapping[str, Any], nodes: Array) -> str:
    """Which of the constraints of the row a model does not keep; empty where it keeps both.

    The curve must not fall by more than 1e-5 of its range between levels, the gain over the middle cell be one to 1e-3.
    """
    curve = static_curve(model, np.linspace(nodes[0], nodes[-1], LEVELS))
    middle = nodes[len(nodes) // 2 - 1 : len(nodes) // 2 + 1]
    low, high = static_curve(model, middle)
    gain = (high - low) / (middle[1] - middle[0])
    falls = not np.all(np.diff(curve) >= -1e-5 * np.ptp(curve))
    return "; ".join(["not increasing"] * falls + [f"gain {gain:.3g}"] * (not abs(gain - 1) <= 1e-3))


Model = Mapping[str, Any]
Fitter = Callable[[Mapping[str, Array]], Model]

"""The state of a transfer-function model at the start of a record: by least squares, and from the samples before.

It is that of `optid.models.hammerstein_tf`: what the past adds to the right-hand side of the next equations.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError, StructureError
from optid.models import recursions, roots
from optid.models.experiments import check_inputs, samples_of, scaled_least_squares, signal_units

FORGOTTEN = 1e-12  # a free response below this share of its start carries no information about the initial state


def fit_state(model: Any, simulator: str, u: Array, y: Any, label: str) -> Array:
    """Estimate the initial state, the level included, by least squares of a simulator's errors.

    The errors of each output count in units of its standard deviation, so that the estimate does not depend on
    units. Those of the prediction pass the inverse of the noise filter; ARX and ARMAX predictors have no state, the
    free run gives it. Directions that the record does not determine are set to zero.
    """
    (n, outputs), level = model._state_shape, model.levels is not None
    if not n:  # without lags there is no state
        return np.zeros((n, outputs))
    whitened = simulator == "predict" and model.d is not None
    radius = max(model.radius, roots.radius(model.c) if whitened else 0.0)
    forgotten = 10 * n + (int(2 * np.log(FORGOTTEN) / np.log(radius)) if 0 < radius < 1 else 0)
    count = len(y) if radius >= 1 or level else min(len(y), forgotten)
    units, rest = signal_units(y), (y - model._simulated(u, np.zeros((n, outputs)), label))[:count]
    present = np.isfinite(rest)
    free = model._response(np.eye(outputs)[None], count)
    columns = np.zeros((count, outputs, n, outputs))
    for i in range(min(model.largest_lag, count)):
        columns[i:, :, i] = free[: count - i]
    if level:
        columns[:, :, -1] = np.cumsum(free, axis=0)
    rest, columns = rest / units, columns.reshape(count, outputs, n * outputs) / units[:, None]
    if whitened:
        signals = np.where(present, np.column_stack([rest, columns[:, 0]]), np.nan).T
        errors = [recursions.innovations(s, None, model.c, model.noise_denominator).innovations for s in signals]
        rest, columns = errors[0][:, None], np.column_stack(errors[1:])[:, None]
    return scaled_least_squares(columns[present], rest[present]).reshape(n, outputs)


def state(model: Any, u: ArrayLike, y: ArrayLike) -> Array:
    """Return the state (n, l) that follows the samples u (N, m) and y (N, l), N >= n, of the plant without noise.

    Row i is what these samples add to the right-hand side of the equation i samples ahead.

    Raises:
        DataError: too few samples, or one of the last n missing.
        StructureError: a model with `levels`, of which so few samples do not tell the one of their record.
    """
    if model.levels is not None:
        raise StructureError("Every record of this model has its own constant, which so few samples do not "
                             "tell: choose one by at_level, or use initial_state.")
    u, y, n = samples_of(u, "u", model.m), samples_of(y, "y", model.l), model.largest_lag
    if len(u) < n or len(u) != len(y):
        raise DataError(f"The state follows from {n} samples of u and y; got {len(u)} of u and {len(y)} of y.")
    u, y = u[len(u) - n :], y[len(y) - n :]
    check_inputs(model, u, "The last samples: ")
    if np.isnan(y).any():
        k, o = np.argwhere(np.isnan(y))[0]
        raise DataError(f"Output {model.outputs[o]!r} is missing {n - k} samples before the end.")
    return model.following(u, y)


def following(model: Any, u: Array, y: Array) -> Array:
    """Return the state (n, l) after n complete samples u (n, m) and y (n, l), see `state`, without checks."""
    n = model.largest_lag
    state, f = np.zeros((n, model.l)), np.column_stack([f(one) for f, one in zip(model.nonlinearities, u.T)])
    for i, matrix in enumerate(model.matrices, start=1):
        state[:i] -= y[n - i :] @ matrix.T
    for lag, b in enumerate(model.numerators):
        state[:lag] += f[n - lag :] @ b.T
    return state

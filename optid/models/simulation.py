"""One-step prediction and simulation of A(q) y = sum_c B_c(q) f_c(u_c) + d, without a Python loop over samples.

The state x (n, l) is what the past adds to the right-hand side of the next n equations: the observer form of the model.
It shifts by one every sample and receives B_i f(u) - A_i y, so a free response is 1/A driven by the rows of x.
"""

import sys
import warnings
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, DataWarning, StructureError
from optid.models.recursions import lfilter

if TYPE_CHECKING:
    from optid.models.hammerstein_arx import HammersteinARX

FORGOTTEN = 1e-12
"""A free response below this share of its start no longer informs about the initial state."""


def predict_record(model: "HammersteinARX", u: Array, y: Array, horizon: int = 1) -> Array:
    """Predict each output sample from the outputs `horizon` and more samples before it, and the inputs up to it.

    Args:
        model: the model.
        u: (N, m) inputs, NaN = missing.
        y: (N, l) outputs, NaN = missing.
        horizon: how many samples ahead, from 1.

    Returns:
        (N, l); NaN for the first samples, whose lags reach before the record, and where a sample needed is missing.
    """
    right = driven(model, u)
    right[: model.memory] = np.nan
    matrices = list(enumerate(matrices_of(model), start=1))
    shorter: list[Array] = []  # predictions 1, 2, ... samples ahead, as far back as A looks
    for ahead in range(1, horizon + 1):
        prediction = right.copy()
        if matrices:
            prediction[: model.memory + ahead - 1] = np.nan
        for i, a in matrices:
            known = y if i >= ahead else shorter[-i]
            prediction[i:] -= known[: len(known) - i] @ a.T
        shorter = [*shorter[-max(model.na, 1) :], prediction]
    return shorter[-1]


def simulate_record(model: "HammersteinARX", u: Array, state: Array, label: str = "") -> Array:
    """Compute the outputs (N, l) from the inputs (N, m) and the state (n, l).

    Raises:
        DataError: a missing input, or an output that leaves the range of numbers; named by channel and sample.
    """
    check_inputs(model, u, label)
    right = driven(model, u)
    count = min(len(state), len(right))
    right[:count] += state[:count]
    y = filtered(model, right)
    wild = ~np.isfinite(y).all(axis=1)
    if wild.any():
        k = int(np.argmax(wild))
        name = model.outputs[int(np.argmin(np.isfinite(y[k])))]
        raise DataError(
            f"{label}The simulated output {name!r} leaves the range of numbers at sample {k}: {_radius(model)} "
            "Identify the model with a stability constraint, or simulate fewer samples."
        )
    return y


def fitted_state(model: "HammersteinARX", u: Array, y: Array, label: str = "") -> Array:
    """Estimate the initial state (n, l) by least squares of the simulated on the measured outputs, where present.

    The errors of each output count in units of its standard deviation, so that the estimate does not depend on units.
    Directions that the record does not determine are set to zero.
    """
    n, outputs = model.memory, model.l
    if n == 0:
        return np.zeros((0, outputs))
    rest = (y - simulate_record(model, u, np.zeros((n, outputs)), label))[: _horizon(model, len(y))]
    free = impulse_of_inverse(model, len(rest))  # (T, l, l)
    present = ~np.isnan(rest)
    if not present.any():
        return np.zeros((n, outputs))
    unit = np.array([np.nanstd(column) if np.isfinite(column).any() else 0.0 for column in y.T])
    unit[unit == 0] = 1.0
    columns = np.zeros((len(rest), outputs, n, outputs))
    for i in range(min(n, len(rest))):
        columns[i:, :, i] = free[: len(rest) - i] / unit[:, None]
    design, rest = columns[present].reshape(-1, n * outputs), rest / unit
    sizes = np.linalg.norm(design, axis=0)
    sizes[sizes == 0] = 1.0
    return (np.linalg.lstsq(design / sizes, rest[present])[0] / sizes).reshape(n, outputs)


def following_state(model: "HammersteinARX", u: Array, y: Array) -> Array:
    """Return the state (n, l) after a record: what its last n samples add to the next n equations.

    Args:
        model: the model.
        u: (N, m) inputs, N >= n, none of the last n missing.
        y: (N, l) outputs, none of the last n missing.

    Raises:
        DataError: too short, or a sample missing.
    """
    n = model.memory
    if len(u) < n or len(u) != len(y):
        raise DataError(f"The state follows from {n} samples of u and y; got {len(u)} of u and {len(y)} of y.")
    tail_u, tail_y = u[len(u) - n :], y[len(y) - n :]
    check_inputs(model, tail_u, "The last samples: ")
    if np.isnan(tail_y).any():
        k, o = np.argwhere(np.isnan(tail_y))[0]
        raise DataError(f"Output {model.outputs[o]!r} is missing {n - k} samples before the end: the state needs it.")
    state = np.zeros((n, model.l))
    for i, a in enumerate(matrices_of(model), start=1):
        state[:i] -= tail_y[n - i :] @ a.T
    for c, nonlinearity in enumerate(model.nonlinearities):
        f = nonlinearity(tail_u[:, c])
        for lag, row in lagged(model, c):
            state[:lag] += np.outer(f[n - lag :], row)
    return state


def driven(model: "HammersteinARX", u: Array) -> Array:
    """Return the right-hand side sum_c B_c(q) f_c(u_c) + d, (N, l), with nothing before the record."""
    right = np.tile(model.offset, (len(u), 1))
    for c, nonlinearity in enumerate(model.nonlinearities):
        f = nonlinearity(u[:, c])
        for lag, row in lagged(model, c):
            if lag < len(u):
                right[lag:] += f[: len(u) - lag, None] * row
    return right


def filtered(model: "HammersteinARX", right: Array) -> Array:
    """Solve A(q) y = right for y (N, l), from rest."""
    if not model.na:
        return right
    if model.l == 1:
        return lfilter([1.0], np.concatenate([[1.0], model.a]), right)
    with np.errstate(all="ignore"):
        return _recursion()(np.ascontiguousarray(model.a), np.ascontiguousarray(right))


def impulse_of_inverse(model: "HammersteinARX", count: int) -> Array:
    """Return the impulse response of A^-1, (count, l, l): [k, o, p] of output o to equation p."""
    response = np.zeros((count, model.l, model.l))
    for p in range(model.l):
        impulse = np.zeros((count, model.l))
        impulse[0, p] = 1.0
        response[:, :, p] = filtered(model, impulse)
    return response


def lagged(model: "HammersteinARX", c: int) -> list[tuple[int, Array]]:
    """Return the numerator of input c as (lag, row (l,))."""
    rows = model.b[c] if model.l > 1 else model.b[c][:, None]
    return [(model.nk[c] + j, row) for j, row in enumerate(rows)]


def matrices_of(model: "HammersteinARX") -> Array:
    """Return A_1 .. A_na as (na, l, l) whatever the number of outputs."""
    return model.a.reshape(model.na, model.l, model.l)


def warn_unstable(model: "HammersteinARX") -> None:
    """Say that a simulation will grow without bound.

    Warns:
        DataWarning: with the pole radius.
    """
    if not model.is_stable:
        warnings.warn(
            f"The model is unstable: {_radius(model)} Its simulation grows and tells little about the fit; "
            "use one-step prediction, or identify with a stability constraint.",
            DataWarning,
            stacklevel=3,
        )


def check_inputs(model: "HammersteinARX", u: Array, label: str) -> None:
    """Refuse missing and infinite inputs, which a simulation cannot pass over."""
    bad = ~np.isfinite(u)
    if bad.any():
        k, c = np.argwhere(bad)[0]
        raise DataError(
            f"{label}Input {model.inputs[c]!r} is missing at sample {k} ({int(bad[:, c].sum())} in all): a simulation "
            "needs every input. Interpolate it, or split the record there."
        )


def state_like(model: "HammersteinARX", x0: Any) -> Array:
    """Read an initial state given by the user, (n, l), or (n,) for one output."""
    state = np.asarray(x0, dtype=float)
    wanted = (model.memory, model.l)
    if model.l == 1 and state.ndim == 1:
        state = state[:, None]
    if state.shape != wanted:
        raise StructureError(
            f"x0 has shape {np.shape(x0)}; the state of this model is {wanted}: see HammersteinARX.state."
        )
    if not np.all(np.isfinite(state)):
        raise DataError("x0 contains a value that is not finite.")
    return state


def _radius(model: "HammersteinARX") -> str:
    return f"its largest pole has radius {np.max(np.abs(model.poles), initial=0.0):.6g}."


def _horizon(model: "HammersteinARX", count: int) -> int:
    return min(count, horizon_of(float(np.max(np.abs(model.poles), initial=0.0)), model.memory))


def horizon_of(radius: float, memory: int) -> int:
    """Number of samples that inform about an initial state when the largest pole has this radius."""
    if radius >= 1:
        return sys.maxsize
    return 10 * memory + (0 if radius == 0 else int(2 * np.log(FORGOTTEN) / np.log(radius)))


def _march(a: Array, right: Array) -> Array:
    y = right.copy()
    for k in range(y.shape[0]):
        for i in range(min(a.shape[0], k)):
            for o in range(y.shape[1]):
                for p in range(y.shape[1]):
                    y[k, o] -= a[i, o, p] * y[k - 1 - i, p]
    return y


@cache
def _recursion() -> Any:
    from numba import njit

    return njit(cache=True, nogil=True, error_model="numpy")(_march)

"""The innovation form of a subspace model: the noise model that its prediction errors call for.

With F = A - L C the errors of the observer with gain L obey r = C (qI - F)^-1 (K - L) e + e, linear in K once the
innovations e are known; these are the residuals of a long autoregression of r (Hannan and Rissanen 1982). The Riccati
equation then gives the stabilising gain of the same spectrum.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.data.stretches import runs_of
from optid.errors import DataError, StructureError
from optid.identify.subspace.observer import observer_gain
from optid.models.kalman import NoiseCovariances, kalman_gain
from optid.models.roots import spectral_radius
from optid.statistics.factors import add_to_root

if TYPE_CHECKING:
    from optid.data.record import Data
    from optid.models.hammerstein_ss import HammersteinSS

LONGEST = 40
"""Lags of the autoregression at most."""

CHUNK = 4096
"""Samples whose regressors are formed at once."""

EXACT = 1e-8
"""Prediction errors relative to the outputs below which they are rounding."""


def model_innovations(model: "HammersteinSS", data: "Data") -> tuple["HammersteinSS", str]:
    """Return the model with K and the covariances of its noises, or unchanged with the reason why there are none.

    Args:
        model: a model in the units of the data.
        data: the record it was identified on.
    """
    stretches = []
    for e in data.experiments:
        runs = [(0, len(e.y))]
        if np.isnan(e.u.sum() + e.y.sum()):
            runs = runs_of(~(np.isnan(e.u).any(axis=1) | np.isnan(e.y).any(axis=1)))
        stretches += [(e.u[start:stop], e.y[start:stop]) for start, stop in runs]
    try:
        found = _found(model, data, stretches)
    except (StructureError, DataError) as reason:
        return model, f"none: {reason}"
    except np.linalg.LinAlgError:
        return model, "none: the prediction errors leave the range of numbers where outputs are missing"
    spread = np.std(np.concatenate([y.T for _, y in stretches], axis=1), axis=1)
    if found.noise is None or np.all(np.diag(found.noise.innovation) <= (EXACT * spread) ** 2):
        return model, "none: the prediction errors vanish, there is no noise to model"
    return found, ""


def _found(model: "HammersteinSS", data: "Data", stretches: Sequence[tuple[Array, Array]]) -> "HammersteinSS":
    """Return the model with the innovation form of complete stretches where inputs are missing, else by likelihood.

    The likelihood takes single outputs: what counts there is their number, not how many follow each other.

    Raises:
        StructureError, DataError: too few for a noise model.
    """
    from optid.identify.noise import with_noise

    if any(data.missing[name] for name in data.inputs):
        try:
            regression_lags([len(y) for _, y in stretches], *model.K.shape)
            return _of_stretches(model, stretches)
        except StructureError:  # outputs are missing, too
            pass
    regression_lags([int(np.sum(~np.isnan(e.y)) // e.y.shape[1]) for e in data.experiments], *model.K.shape)
    return with_noise(model, data)


def _of_stretches(model: "HammersteinSS", stretches: Sequence[tuple[Array, Array]]) -> "HammersteinSS":
    """Return the model with the innovation form of the prediction errors of complete stretches (u, y)."""
    gain, errors = observer_gain(model.A, model.C), []
    for u, y in stretches:
        f = model.expanded(u)
        drive = f @ model.B.T + y @ model.L.T + model.offset_x
        for column, g, o in zip(model.E.T, model.feedback, model.output_of):
            drive = drive + np.outer(g(y[:, o]), column)
        errors.append(prediction_errors(model.A, model.C, gain, drive, f @ model.D.T + model.offset_y, y))
    k, noise = innovation_form(model.A, model.C, gain, errors)
    return replace(model, K=k, noise=noise)


def prediction_errors(a: Array, c: Array, gain: Array, drive: Array, direct: Array, y: Array) -> Array:
    """Return y - yhat of the observer x+ = (A - L C) x + drive + L (y - direct), its initial state fitted, (T, l).

    Args:
        a: (n, n).
        c: (l, n).
        gain: (n, l) observer gain L with stable A - L C.
        drive: (T, n) known terms of the state equation.
        direct: (T, l) known terms of the output equation.
        y: (T, l) outputs, NaN = missing (allowed with L = 0 only).
    """
    from optid.statistics.subspace_kernels import state_run

    inner = np.ascontiguousarray(a - gain @ c)
    known = np.ascontiguousarray(drive + (y - direct) @ gain.T if np.any(gain) else drive)
    x = np.empty((len(y), len(a)))
    state_run(inner, known, np.zeros(len(a)), x)
    errors = y - x @ c.T - direct
    count = min(len(y), _settling(inner))
    free = np.empty((count, len(a), len(a)))
    power = np.eye(len(a))
    for k in range(count):
        free[k] = power
        power = inner @ power
    responses = np.einsum("on,kns->kos", c, free)
    present = ~np.isnan(errors[:count])
    x0 = np.linalg.lstsq(responses[present], errors[:count][present], rcond=None)[0]
    errors[:count] -= responses @ x0
    return errors


def _settling(inner: Array) -> int:
    """Samples after which the initial state of an observer is forgotten, at most 2000."""
    radius = spectral_radius(inner)
    return 2000 if radius >= 0.99 else int(min(2000, 10 + len(inner) + np.log(1e-8) / np.log(max(radius, 0.1))))


def regression_lags(lengths: Sequence[int], n: int, l: int) -> int:  # noqa: E741
    """Return the lags of the autoregression of the errors of l outputs, in complete runs of some lengths, order n.

    Raises:
        StructureError: too few for a noise model.
    """
    total = sum(lengths)
    lags = int(min(LONGEST, max(4, 2 * n), max(1, total // (20 * l))))
    if max(lengths, default=0) <= 2 * lags or total < 10 * (lags + n) * l:
        raise StructureError(f"{total} prediction errors are too few for a noise model.")
    return lags


def innovation_form(a: Array, c: Array, gain: Array, errors: Sequence[Array]) -> tuple[Array, NoiseCovariances]:
    """Return K (n, l) and the covariances of the noises from the errors of an observer.

    Args:
        a: (n, n).
        c: (l, n).
        gain: (n, l) gain L of the observer.
        errors: (T, l) its prediction errors, one array per complete run of samples.

    Raises:
        StructureError: errors that determine no gain: too few, zero, or on the stability limit.
    """
    from optid.statistics.subspace_kernels import state_run

    n, l = gain.shape  # noqa: E741
    lags = regression_lags([len(part) for part in errors], n, l)
    errors = [part for part in errors if len(part) > 2 * lags]
    root = np.zeros((lags * l + l, lags * l + l))
    for part in errors:
        for rows in _lagged(part, lags):
            root = add_to_root(root, rows)
    regressive = np.linalg.lstsq(root[: lags * l, : lags * l], root[: lags * l, lags * l :], rcond=None)[0]
    size = n * l
    normal = np.zeros((size + 1, size + 1))
    innovations = [np.concatenate([part[:lags], *(rows[:, lags * l :] - rows[:, : lags * l] @ regressive
                                                  for rows in _lagged(part, lags))]) for part in errors]
    spread = np.sqrt(np.mean(np.concatenate([part[lags:] for part in innovations]) ** 2, axis=0))
    if not np.all(spread > 0):
        raise StructureError("an output is predicted exactly: the covariance of the innovations is singular.")
    inner = np.ascontiguousarray(a - gain @ c)
    for part, e in zip(errors, innovations):
        for out, left in _responses(inner, c, e, part - e, lags):
            for o in range(l):
                normal = add_to_root(normal, np.concatenate([out[:, o], left[:, o, None]], axis=1) / spread[o])
    change = np.linalg.lstsq(normal[:size, :size], normal[:size, size], rcond=None)[0].reshape(l, n).T
    k, rest, count = gain + change, np.zeros((l, l)), 0
    for part, e in zip(errors, innovations):
        x = np.empty((len(e), n))
        state_run(inner, np.ascontiguousarray(e @ change.T), np.zeros(n), x)
        final = (part - x @ c.T)[lags:]
        rest += final.T @ final
        count += len(final)
    covariance = rest / count
    found = kalman_gain(a, c, k @ covariance @ k.T, covariance, k @ covariance)
    noise = NoiseCovariances(k @ covariance @ k.T, covariance, k @ covariance, found.innovation)
    return found.K, noise


def _lagged(errors: Array, lags: int) -> Iterator[Array]:
    """Yield rows [r(k-1) .. r(k-lags) | r(k)], some at a time."""
    windows = np.lib.stride_tricks.sliding_window_view(errors, lags + 1, axis=0)  # (T - lags, l, lags + 1)
    for start in range(0, len(windows), CHUNK):
        part = windows[start : start + CHUNK]
        past = part[:, :, -2::-1].transpose(0, 2, 1).reshape(len(part), -1)
        yield np.concatenate([past, part[:, :, -1]], axis=1)


def _responses(inner: Array, c: Array, e: Array, target: Array, first: int) -> Iterator[tuple[Array, Array]]:
    """Yield, some samples from the first one on at a time, what the entries of M do to C (qI - F)^-1 M e, and targets.

    Args:
        inner: (n, n) F.
        c: (l, n).
        e: (T, l).
        target: (T, l).
        first: sample, less than `CHUNK`.

    Yields:
        (K, l, l n), M column by column, and (K, l).
    """
    from optid.statistics.subspace_kernels import adjoint_responses

    l, n = c.shape  # noqa: E741
    c, state = np.array(c), np.zeros((l, l, n))  # a read-only argument would be compiled for once more
    for start in range(0, len(e), CHUNK):
        signals = np.ascontiguousarray(e[start : start + CHUNK])
        out = np.empty((len(signals), *state.shape))
        adjoint_responses(inner, c, signals, state, out)
        left_out = max(first - start, 0)
        yield out[left_out:].reshape(-1, l, l * n), target[start + left_out : start + CHUNK]

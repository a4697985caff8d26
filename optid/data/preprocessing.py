"""Changes of the samples before a fit, the methods of `Data`; what is affine is undone in reports."""

from collections.abc import Mapping
from functools import partial
from typing import Any, TypeVar

import numpy as np

from optid.arrays import check_integer
from optid.errors import DataError, nearest

Changed = TypeVar("Changed", bound=Any)
"""A record, `optid.Data`."""


def detrend(data: Changed, order: int = 0) -> Changed:
    """Subtract the mean of every channel (order 0), and a drift of the outputs too (order 1).

    The means are taken over all experiments and kept in the transform, so that models report raw units. With
    order 1 each experiment also loses the straight line in time fitted to each output, turned about the middle of
    the experiment: a drift is a disturbance, so it is not restored. Inputs never lose a line: the static nonlinearity
    acts on the level of the input, and no fixed change of units could undo a ramp.

    Raises:
        DataError: order is neither 0 nor 1, or a channel has no samples.
    """
    if isinstance(order, bool) or order not in (0, 1):
        raise DataError(f"detrend order {order!r}: 0 (mean) and 1 (mean, and drift of the outputs) exist.")
    level = data if order == 0 else data.mapped(lambda u: u, _without_drift)
    for channel in level.channels:
        if channel.missing == 1.0:
            raise DataError(f"channel {channel.name!r}: every sample is missing; leave it out with select.")
    shift = np.array([channel.mean for channel in level.channels])
    return _rescaled(level, np.ones_like(shift), shift)


def scale(data: Changed, factors: Mapping[str, float] | None = None) -> Changed:
    """Divide every channel by its standard deviation, or by the factors given; undone in what is reported.

    Args:
        data: the record.
        factors: positive factor per channel name; channels that are not named keep their units.

    Raises:
        DataError: unknown channel, factor that is not positive, or constant channel.
    """
    names = data.inputs + data.outputs
    if factors is None:
        for channel in data.channels:
            if not channel.low < channel.high:
                raise DataError(f"channel {channel.name!r} is constant and has no scale; leave it out with select.")
        factors = {channel.name: channel.std for channel in data.channels}
    for name, value in factors.items():
        if name not in names:
            raise DataError(f"no channel {name!r}. {nearest(name, names)}")
        if not 0 < value < np.inf:
            raise DataError(f"scale of channel {name!r} is {value}; it must be positive.")
    return _rescaled(data, np.array([float(factors.get(name, 1.0)) for name in names]), np.zeros(len(names)))


def decimate(data: Changed, q: int) -> Changed:
    """Low-pass every channel with zero phase and keep every q-th sample; the new dt is q * dt.

    The filter is the FIR filter of `scipy.signal.decimate` (Hamming window, 20 q + 1 taps); the ends are continued
    along the line through the first and the last sample. Filtering does not commute with a static nonlinearity:
    decimate only where the input is slow compared with the new sampling time.

    Raises:
        DataError: q is not a positive integer, samples are missing, or an experiment is shorter than the filter.
    """
    check_integer(q, "q", error=DataError)
    if q == 1:
        return data
    for channel, share in data.missing.items():
        if share:
            raise DataError(f"channel {channel!r}: {share:.2%} of the samples are missing, and a filter would spread "
                            "the gaps. Cut the record around them with window, or fit at the original sampling time.")
    for k, e in enumerate(data.experiments):
        if e.n_samples <= 20 * q:
            raise DataError(f"experiment {k + 1} has {e.n_samples} samples, the anti-alias filter for q = {q} has "
                            f"{20 * q + 1} taps; use a smaller q.")
    from scipy.signal import firwin, resample_poly

    taps = firwin(20 * q + 1, 1.0 / q, window="hamming")
    lowpass = partial(resample_poly, up=1, down=int(q), axis=0, window=taps, padtype="line")
    return data.mapped(lowpass, lowpass, dt=data.dt * int(q))


def _rescaled(data: Changed, scale: np.ndarray, shift: np.ndarray) -> Changed:
    m = data.m
    return data.mapped(
        lambda u: (u - shift[:m]) / scale[:m],
        lambda y: (y - shift[m:]) / scale[m:],
        transform=data.transform.before(scale, shift),
    )


def _without_drift(y: np.ndarray) -> np.ndarray:
    level = y.copy()
    t = np.arange(y.shape[0]) - (y.shape[0] - 1) / 2
    for column in level.T:
        here = ~np.isnan(column)
        if here.sum() > 1:
            column -= np.polyfit(t[here], column[here], 1)[0] * t
    return level

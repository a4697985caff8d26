"""Changes of the samples before a fit, the methods of `Data`; what is affine is undone in reports."""

from collections.abc import Mapping
from fractions import Fraction
from functools import partial
from typing import Any, TypeVar

import numpy as np

from optid.arrays import check_integer, is_number
from optid.data.channels import sampling_time
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
    level = data if order == 0 else data.map_signals(lambda u: u, _without_drift)
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
    """Low-pass every channel with zero phase and keep every q-th sample; the new dt is q * dt; see `resample`.

    Raises:
        DataError: q is not a positive integer, samples are missing, or an experiment is shorter than the filter.
    """
    check_integer(q, "q", error=DataError)
    data.refuse_irregular("decimate")
    return _at_ratio(data, 1, int(q))


def resample(data: Changed, dt: float) -> Changed:
    """Bring every channel onto another sampling time dt, in the ratio of two integers of at most 1000 to the old one.

    The filter is the FIR filter of `scipy.signal.decimate` (Hamming window, 20 taps for each sample of the coarser
    record) with zero phase; the ends are continued along the line through the first and the last sample. Filtering
    does not commute with a static nonlinearity: use it only where the input is slow compared with the coarser
    sampling time. Stamps that are not uniform are the matter of ``optid.read(..., resample=...)``.

    Raises:
        DataError: an impossible sampling time, missing samples, or an experiment shorter than the filter.
    """
    dt = sampling_time(dt)
    data.refuse_irregular("resample")
    ratio = Fraction(data.dt / dt).limit_denominator(1000)
    if not 1e-3 <= ratio <= 1000 or abs(float(ratio) * dt / data.dt - 1) > 1e-9:
        raise DataError(f"dt = {dt:g} is in no ratio of integers up to 1000 to the sampling time of the record, "
                        f"{data.dt:g}; choose another one.")
    found = _at_ratio(data, ratio.numerator, ratio.denominator)
    return found.map_signals(lambda u: u, lambda y: y, dt=dt)


def filter(data: Changed, low: float | None = None, high: float | None = None, order: int = 4) -> Changed:
    """Pass every channel through one Butterworth filter, from rest at its first sample.

    The same causal filter on inputs and outputs leaves a linear plant as it is and weights its frequencies. It does
    not commute with a static nonlinearity: filter the record of a Hammerstein system only where the nonlinearity is
    weak, or not at all. A high-pass removes the levels.

    Args:
        data: the record.
        low: pass frequencies above this one, in Hz (cycles per sample where the unit of time is unknown).
        high: pass frequencies below this one.
        order: order of the filter, 1 to 20.

    Raises:
        DataError: frequencies that are not 0 < low < high < half the sampling rate, or missing samples.
    """
    order = check_integer(order, "order", 1, 20, error=DataError)
    data.refuse_irregular("a filter")
    edges = [edge for edge in (low, high) if edge is not None]
    nyquist = 0.5 / data.dt
    if not edges or not all(map(is_number, edges)) or not all(
            a < b for a, b in zip([0.0, *edges], [*edges, nyquist])):
        raise DataError(f"low={low!r}, high={high!r}: give one or both, 0 < low < high < {nyquist:g} (half the "
                        "sampling rate).")
    _check_whole(data)
    from scipy.signal import butter, sosfilt, sosfilt_zi

    kind = "bandpass" if len(edges) == 2 else "lowpass" if low is None else "highpass"
    sections = butter(order, edges if len(edges) == 2 else edges[0], kind, fs=1 / data.dt, output="sos")
    rest = sosfilt_zi(sections)[:, :, None]

    def filter_samples(samples: np.ndarray) -> np.ndarray:
        return sosfilt(sections, samples, axis=0, zi=rest * samples[:1])[0]

    return data.map_signals(filter_samples, filter_samples)


def _check_whole(data: Any) -> None:
    for channel, share in data.missing.items():
        if share:
            raise DataError(f"channel {channel!r}: {share:.2%} of the samples are missing, and a filter would spread "
                            "the gaps. Cut the record around them with window, or fit at the original sampling time.")


def _at_ratio(data: Changed, up: int, down: int) -> Changed:
    """Return the record with `up` samples for each `down`."""
    if up == down:
        return data
    _check_whole(data)
    q = max(up, down)
    for k, e in enumerate(data.experiments):
        if e.n_samples * up <= 20 * q:
            raise DataError(f"experiment {k + 1} has {e.n_samples} samples, the anti-alias filter for q = {q} has "
                            f"{20 * q + 1} taps; use a sampling time nearer to that of the record.")
    from scipy.signal import firwin, resample_poly

    taps = firwin(20 * q + 1, 1.0 / q, window="hamming")
    lowpass = partial(resample_poly, up=up, down=down, axis=0, window=taps, padtype="line")
    return data.map_signals(lowpass, lowpass, dt=data.dt * down / up)


def _rescaled(data: Changed, scale: np.ndarray, shift: np.ndarray) -> Changed:
    m = data.m
    return data.map_signals(
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

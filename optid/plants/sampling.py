"""Checks of inputs and parameters of the simulated plants, their noise, and the refusal of a run without bounds."""

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError, StructureError
from optid.models.recursions import lfilter

BOUND = 1e8


def as_input(u: ArrayLike, channels: int) -> Array:
    """Return the input as (N, channels); refuse other shapes, and samples that are not finite (`DataError`)."""
    array = np.asarray(u, dtype=float)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2 or array.shape[1] != channels or not len(array):
        wanted = f"(N,) or (N, {channels})" if channels == 1 else f"(N, {channels})"
        raise DataError(f"the input has shape {np.shape(u)}; this plant takes {wanted} with N of at least 1.")
    missing = ~np.isfinite(array)
    if missing.any():
        k, c = (int(i[0]) for i in np.nonzero(missing))
        raise DataError(f"input channel {c + 1} is {array[k, c]} at sample {k}: a simulation needs every sample.")
    return array


def gaussian(rng: np.random.Generator, n: int, channels: int, size: float, colour: float, what: str) -> Array:
    """Return (n, channels) Gaussian noise of standard deviation `size`, first-order autoregressive with pole `colour`.

    Raises:
        StructureError: a negative size, or a pole that is not inside the unit circle.
    """
    check_parameters(positive=False, **{what: size})
    if not abs(colour) < 1:
        raise StructureError(f"colour = {colour}: the pole of the noise must lie strictly between -1 and 1.")
    # Drawn even when the size is zero, so that a seed gives the same numbers to the other noises.
    white = rng.standard_normal((n, channels))
    if size == 0 or colour == 0:
        return size * white
    # The first sample has the stationary deviation; the filter then keeps it.
    white[1:] *= np.sqrt(1 - colour**2)
    return size * lfilter([1.0], [1.0, -colour], white)


def check_bounded(states: Array, plant: str) -> None:
    """Refuse a simulation that left all bounds (`DataError` with the first sample at which it did)."""
    with np.errstate(invalid="ignore"):
        outside = ~(np.abs(states) < BOUND).all(axis=1)
    if outside.any():
        raise DataError(f"the simulated {plant} leaves all bounds at sample {int(np.argmax(outside))}: "
                        "use a smaller input, less noise or a shorter sampling time.")


def as_state(x0: ArrayLike, order: int) -> Array:
    """Return the initial state as (order,); refuse other shapes, and values that are not finite (`DataError`)."""
    state = np.array(x0, dtype=float)
    if state.shape != (order,) or not np.isfinite(state).all():
        raise DataError(f"x0 = {x0!r}: it must be {order} finite numbers.")
    return state


def check_parameters(*, positive: bool = True, **values: float) -> None:
    """Refuse parameters that are not finite and positive, or not negative, by name (`StructureError`)."""
    for name, value in values.items():
        if not (np.isfinite(value) and (value > 0 if positive else value >= 0)):
            wanted = "positive" if positive else "finite and not negative"
            raise StructureError(f"{name} = {value}: it must be {wanted}.")

"""Intake of arrays: what the caller passes becomes a read-only, time-first float64 copy, or a named error."""

import warnings
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.errors import DataError, DataWarning, OptidError, StructureError

Array = NDArray[np.floating]

EXACT_INTEGER = 2**53  # largest magnitude up to which every integer is a float64 (IEEE 754, 53-bit significand)
LARGEST_INTEGER = 2**63 - 1
LARGEST = 1e150
"""Largest magnitude accepted: beyond it squares overflow, and no sensor reads it (it is a marker of lost samples)."""

WRAP = 0.75  # a step between neighbours above this share of an integer type's range looks like a wrap-around


def as_samples(values: Any, what: str, names: Sequence[str] | None = None) -> np.ndarray:
    """Copy one record of a signal into a read-only float64 array with time along the first axis.

    Args:
        values: (N,) or (N, channels) numbers, any real numeric type; NaN (or a masked entry) means missing.
        what: the argument's name, for messages ("u", "experiment 2 of y").
        names: channel names for messages, where they are known already.

    Returns:
        (N, channels) float64, C order, not writeable, independent of the caller's memory.

    Raises:
        DataError: not numbers, infinite, empty, more than two axes, more channels than samples (transposed), or
            integers that float64 cannot hold.

    Warns:
        DataWarning: integer samples at the limit of their type, or steps that look like a wrap-around.
    """
    array = _as_numbers(values, what)
    if array.ndim == 1:
        array = array[:, None]
    check_shape(array, what)
    labels = [f"{what}, channel {name!r}" for name in names] if names and len(names) == array.shape[1] else None
    labels = labels or ([what] if array.shape[1] == 1 else [f"{what}, channel {c + 1}" for c in range(array.shape[1])])
    if array.dtype.kind in "iu":
        check_integers(array, labels)
    with np.errstate(over="ignore"):
        samples = np.array(array, dtype=np.float64, order="C")
    check_finite(samples, labels)
    samples.flags.writeable = False
    return samples


def is_scalar_list(values: Any) -> bool:
    """Tell one record, a list of numbers, from a list of one array per experiment; refuse others (`DataError`)."""
    if not isinstance(values, list | tuple):
        return True
    kinds = {_kind(item) for item in values}
    if kinds <= {"number"}:
        return True
    if kinds == {"array"}:
        return False
    raise DataError("a list may hold the numbers of one record, or one array per experiment; this one is nested or "
                    "mixed. Wrap each record in numpy.asarray(...).")


def as_records(values: Any, what: str, names: Sequence[str] | None = None) -> list[np.ndarray]:
    """Return one array (N, channels) per experiment of a signal; arguments and errors as of `as_samples`."""
    if is_scalar_list(values):
        return [as_samples(values, what, names)]
    records = [as_samples(item, f"{what} of experiment {k + 1}", names) for k, item in enumerate(values)]
    widths = {r.shape[1] for r in records}
    if len(widths) > 1:
        raise DataError(f"{what}: the experiments have {sorted(widths)} channels; each needs the same channels.")
    return records


def one_or_all(arrays: list[np.ndarray]) -> Any:
    """Return the array of the only experiment, or a tuple with one array for each."""
    return arrays[0] if len(arrays) == 1 else tuple(arrays)


def as_list(arrays: Any) -> list[np.ndarray]:
    """Return one array for each experiment, from what `one_or_all` made of them."""
    return list(arrays) if isinstance(arrays, tuple) else [arrays]


def largest(amounts: Iterable[tuple[float, str]]) -> tuple[float, str]:
    """Return the largest of amounts that are not negative, with its name: the first that is no number before all.

    (0.0, "") where nothing is larger.
    """
    found = 0.0, ""
    for amount, name in amounts:
        if np.isnan(amount):
            return amount, name
        if amount > found[0]:
            found = amount, name
    return found


def read_only(array: np.ndarray) -> np.ndarray:
    """Return an array, or a copy of it in C order, that cannot be written."""
    array = np.ascontiguousarray(array)
    array.flags.writeable = False
    return array


def check_finite(samples: np.ndarray, labels: Sequence[str], first: int = 0) -> None:
    """Refuse infinite and absurdly large samples (N, channels); NaN passes, it means missing.

    Raises:
        DataError: with the label of the channel and the sample, counted from `first` where a source comes in chunks.
    """
    # One fused pass decides the usual case; NaN makes both comparisons false and is accepted.
    if not (np.fmax.reduce(samples, axis=None) > LARGEST or np.fmin.reduce(samples, axis=None) < -LARGEST):
        return
    k, c = np.argwhere(np.abs(samples) > LARGEST)[0]
    raise DataError(f"{labels[c]}: sample {first + k} is {samples[k, c]:g}. Write NaN where a sample is missing, or "
                    "remove the fault that produced it.")


def short_repr(value: Any) -> str:
    """Return the value of an argument for a message, shortened; Python writes no integers of thousands of digits."""
    try:
        text = repr(value)
    except ValueError:
        return "an integer of thousands of digits"
    return text if len(text) <= 200 else f"{text[:200]}..."


def is_number(value: Any) -> bool:
    """Whether a value is one real number; NaN and infinity are."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def check_integer(value: Any, name: str, low: int = 1, high: int | None = None,
                  error: type[OptidError] = StructureError) -> int:
    """Return an integer argument as an int; raise `error` for anything else and outside low to high (None: 2^31)."""
    top = 2**31 if high is None else high
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not low <= value <= top:
        kind = {0: "a nonnegative integer", 1: "a positive integer"}.get(low, f"an integer of at least {low}")
        if high is not None or (isinstance(value, int) and value > top):
            kind = f"an integer from {low} to {top}"
        raise error(f"{name} must be {kind}; got {short_repr(value)}.")
    return int(value)


def check_probability(value: Any, name: str) -> None:
    """Refuse an argument that is no probability strictly between 0 and 1 (`StructureError`)."""
    if not is_number(value) or not 0 < value < 1:
        raise StructureError(f"{name}={short_repr(value)}: it must be a probability between 0 and 1.")


def check_weight(value: Any, name: str) -> None:
    """Refuse the weight of a penalty that is not a nonnegative number (`StructureError`)."""
    if not is_number(value) or not 0 <= value <= LARGEST or value == np.inf:  # in float32 LARGEST is infinite
        raise StructureError(f"{name}={short_repr(value)}: it must be a nonnegative number.")


def one_of(name: str, value: Any, known: Sequence[str]) -> None:
    """Refuse a word that is not known (`StructureError`)."""
    if not isinstance(value, str) or value not in known:
        raise StructureError(f"{name}={short_repr(value)}: use one of {', '.join(known)}.")


def finite(values: Any, name: str, largest: float = LARGEST) -> np.ndarray:
    """Copy coefficients into a read-only float64 array; refuse those not finite or too large (`StructureError`)."""
    try:
        array = np.array(values, dtype=float)
    except (OverflowError, TypeError, ValueError) as error:
        raise StructureError(f"{name} must be an array of real numbers ({error}).") from error
    if array.size and not np.abs(array).max() <= largest:
        if not np.isfinite(array).all():
            at = ",".join(str(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise StructureError(f"{name} contains a value that is not finite, {name}[{at}].")
        raise StructureError(f"{name} contains a value above {largest:g}: take larger units.")
    array.flags.writeable = False
    return array


def kron(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the Kronecker product of two matrices, small ones several times as fast as `numpy.kron`."""
    product = left[:, None, :, None] * right[None, :, None, :]
    return product.reshape(left.shape[0] * right.shape[0], left.shape[1] * right.shape[1])


def compact(array: Any) -> np.ndarray:
    """Return an array in the one form that kernels are compiled for: float64, contiguous, not marked as read-only."""
    return np.require(array, dtype=float, requirements=["C", "W"])


def check_integers(array: np.ndarray, labels: Sequence[str], first: int = 0, *, limits: bool = True) -> None:
    """Refuse integers (N, channels) beyond 2**53, which float64 cannot hold; see `check_finite`.

    With `limits` samples at the limits of the type, and steps above three quarters of its range, are warned about
    (`DataWarning`): signs of saturation and of wrap-around.
    """
    info = np.iinfo(array.dtype)
    for column, label in zip(array.T, labels):
        lo, hi = int(column.min()), int(column.max())
        if max(hi, -lo) > EXACT_INTEGER:
            k = int(np.argmax((column > EXACT_INTEGER) | (column < -EXACT_INTEGER)))
            raise DataError(
                f"{label}: sample {first + k} is {column[k]} ({array.dtype}), beyond 2**53, so its digits would be "
                "lost. A negative number stored in an unsigned type looks like this; subtract the offset or rescale "
                "before passing the record."
            )
        if limits and (hi == info.max or (info.min < 0 and lo == info.min)):
            _warn(label, (column == info.max) | ((column == info.min) & (info.min < 0)), 0,
                  f"sample(s) at the limits of {info.dtype}", "the values are saturated or have overflowed. "
                  "Convert to float before any arithmetic, and set saturated samples to NaN.")
        elif limits and hi - lo > WRAP * (int(info.max) - int(info.min)):
            steps = np.abs(np.diff(column.astype(np.float64)))
            _warn(label, steps > WRAP * (float(info.max) - float(info.min)), 1,
                  f"step(s) above {WRAP:.0%} of the range of {info.dtype}",
                  "the values may have wrapped around. Convert to float before any arithmetic.")


def _warn(label: str, found: np.ndarray, offset: int, what: str, remedy: str) -> None:
    if found.any():
        where = f"first at sample {int(np.argmax(found)) + offset}"
        warnings.warn(f"{label}: {int(found.sum())} {what} ({where}): {remedy}", DataWarning, stacklevel=5)


def _kind(item: Any) -> str:
    if hasattr(item, "ndim") or hasattr(item, "__array__"):
        return "array" if np.ndim(item) else "number"
    return "nested" if isinstance(item, list | tuple) else "number"


def _as_numbers(values: Any, what: str) -> np.ndarray:
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise DataError(f"{what}: the rows have different lengths; pass a rectangular array.") from error
    if array.dtype.kind not in "iuf":
        kind = {"b": "truth values", "c": "complex numbers", "O": "objects", "U": "text", "S": "text",
                "M": "dates", "m": "time differences"}.get(array.dtype.kind, "not numbers")
        raise DataError(
            f"{what}: the samples are {kind} (dtype {array.dtype}); they must be real numbers. "
            "Convert with numpy.asarray(x, dtype=float), with NaN where a sample is missing."
        )
    return array


def check_shape(array: np.ndarray, what: str) -> None:
    """Refuse an array that is not (samples, channels), is empty, or has more channels than samples (`DataError`)."""
    if array.ndim != 2:
        raise DataError(f"{what} has shape {array.shape}; it must be (samples,) or (samples, channels).")
    rows, channels = array.shape
    if array.size == 0:
        raise DataError(f"{what} is empty (shape {array.shape}); it must hold at least one sample of one channel.")
    if channels > rows:
        raise DataError(
            f"{what} has shape {array.shape}: {channels} channels but only {rows} sample(s). "
            "Time runs along the first axis; pass the transpose (x.T) if the array is channels by samples."
        )


def import_pandas() -> Any:
    """Return pandas, which frames need; `DataError` where it is not installed."""
    try:
        return import_module("pandas")
    except ImportError:
        raise DataError('to_pandas needs pandas: pip install "optid[tables]"') from None

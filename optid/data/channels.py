"""Channels: names, units, statistics, and the transform to raw units."""

import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import is_number
from optid.errors import DataError, OptidError

TURNS = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}  # characters that turn the direction of text
MOST_LEVELS = 1000  # largest number of distinct values that is counted; above it a channel is continuous


class Ports:
    """Named inputs and outputs of a record, a stream, a regression or a model."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return len(self.outputs)


@dataclass(frozen=True)
class Transform:
    """Affine maps back to the units of the source: raw = value * scale + offset, one pair per channel.

    Attributes:
        u_scale: one positive factor per input.
        u_offset: one offset per input, in raw units.
        y_scale: one positive factor per output.
        y_offset: one offset per output, in raw units.
    """

    u_scale: tuple[float, ...]
    u_offset: tuple[float, ...]
    y_scale: tuple[float, ...]
    y_offset: tuple[float, ...]

    @classmethod
    def identity(cls, m: int, l: int) -> "Transform":  # noqa: E741 - l is the field's letter for outputs
        """Return the transform of data that were never changed, for m inputs and l outputs."""
        return cls((1.0,) * m, (0.0,) * m, (1.0,) * l, (0.0,) * l)

    @property
    def is_identity(self) -> bool:
        """Whether the data are in raw units."""
        return self == Transform.identity(len(self.u_scale), len(self.y_scale))

    def raw_u(self, u: np.ndarray) -> np.ndarray:
        """Return inputs (..., m) in raw units."""
        return u * np.array(self.u_scale) + np.array(self.u_offset)

    def raw_y(self, y: np.ndarray) -> np.ndarray:
        """Return outputs (..., l) in raw units."""
        return y * np.array(self.y_scale) + np.array(self.y_offset)

    def apply_u(self, raw: np.ndarray) -> np.ndarray:
        """Return raw inputs (..., m) in the units of the data; the inverse of `raw_u`."""
        return (raw - np.array(self.u_offset)) / np.array(self.u_scale)

    def apply_y(self, raw: np.ndarray) -> np.ndarray:
        """Return raw outputs (..., l) in the units of the data; the inverse of `raw_y`."""
        return (raw - np.array(self.y_offset)) / np.array(self.y_scale)

    def before(self, scale: np.ndarray, shift: np.ndarray) -> "Transform":
        """Return the transform of new data where old = new * scale + shift, inputs first, then outputs."""
        m = len(self.u_scale)
        old_scale, old_offset = np.array(self.u_scale + self.y_scale), np.array(self.u_offset + self.y_offset)
        gain, offset = (scale * old_scale).tolist(), (shift * old_scale + old_offset).tolist()
        return Transform(tuple(gain[:m]), tuple(offset[:m]), tuple(gain[m:]), tuple(offset[m:]))


@dataclass(frozen=True)
class Channel:
    """Statistics of a channel over all experiments, without missing samples.

    Attributes:
        name: name of the channel.
        unit: its unit, or "".
        role: "input" or "output".
        low: smallest sample.
        high: largest sample.
        mean: mean of the samples.
        std: standard deviation of the samples.
        levels: number of distinct values; counting stops above `MOST_LEVELS`.
        missing: share of missing samples, 0 to 1.
    """

    name: str
    unit: str
    role: str
    low: float
    high: float
    mean: float
    std: float
    levels: int
    missing: float

    @classmethod
    def of(cls, x: np.ndarray, name: str, unit: str, role: str) -> "Channel":
        """Summarise the samples x (N,); the figures are NaN where every sample is missing."""
        here = x[~np.isnan(x)]
        if not here.size:
            return cls(name, unit, role, np.nan, np.nan, np.nan, np.nan, 0, 1.0)
        low, high, mean, std = float(here.min()), float(here.max()), float(here.mean()), float(here.std())
        return cls(name, unit, role, low, high, mean, std, count_levels(here), 1.0 - here.size / x.size)


def count_levels(x: np.ndarray) -> int:
    """Count the distinct values of x (N,); counting stops above `MOST_LEVELS`, so that long records stay cheap."""
    seen = np.empty(0)
    for first in range(0, x.size, 65536):
        seen = np.union1d(seen, x[first : first + 65536])
        if seen.size > MOST_LEVELS:
            break
    return int(seen.size)


def as_name_list(names: str | Sequence[str] | None) -> list[str] | None:
    """Return one name or several as a list; None stays None."""
    if names is None or isinstance(names, str):
        return None if names is None else [names]
    try:
        return list(names)
    except TypeError:
        raise DataError(f"{names!r}: must be a text, or a list of texts, one for each channel.") from None


def numbered_names(letter: str, count: int) -> tuple[str, ...]:
    """Return the letter alone for one channel, numbered from 1 for several."""
    return (letter,) if count == 1 else tuple(f"{letter}{c + 1}" for c in range(count))


def channel_fields(
    m: int, l: int, inputs: Any, outputs: Any, input_units: Any, output_units: Any  # noqa: E741 - the field's letter
) -> dict[str, tuple[str, ...]]:
    """Return the names and units of m inputs and l outputs by the names of these arguments.

    Names are "u" and "y" when not given, numbered from 1 when there are several; units are "".

    Raises:
        DataError: wrong number of names or units, an empty name, one name for two channels, or as of `check_texts`.
    """
    found: dict[str, tuple[str, ...]] = {}
    for kind, letter, count, given, units in (
        ("input", "u", m, inputs, input_units), ("output", "y", l, outputs, output_units)
    ):
        names, units = as_name_list(given), as_name_list(units) or [""] * count
        if names is not None and (len(names) != count or not all(isinstance(name, str) and name for name in names)):
            raise DataError(f"{kind}s {names}: must be one non-empty name for each of the {count} channels.")
        if len(units) != count:
            raise DataError(f"{kind}_units {units}: must be one unit for each of the {count} channels.")
        found[f"{kind}s"] = numbered_names(letter, count) if names is None else tuple(names)
        found[f"{kind}_units"] = tuple(str(unit) for unit in units)
        check_texts(f"the name of an {kind}", found[f"{kind}s"])
        check_texts(f"the unit of an {kind}", found[f"{kind}_units"])
    everything = found["inputs"] + found["outputs"]
    for name, count in Counter(everything).items():
        if count > 1:
            raise DataError(f"two channels are named {name!r}; give every channel its own name.")
    return found


def check_texts(what: str, texts: Iterable[str], error: type[OptidError] = DataError) -> None:
    """Refuse names or units with control characters, which change what a terminal or an editor shows."""
    for text in texts:
        for character in text:
            if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp") or \
                    unicodedata.bidirectional(character) in TURNS:
                shown = text if len(text) <= 60 else f"{text[:60]}..."
                raise error(f"{what} is {shown!r}, which contains the control character U+{ord(character):04X}: use "
                            "printable characters.")


def sampling_time(dt: Any) -> float:
    """Return dt as a float; refuse what is not a positive number (`DataError`)."""
    if not is_number(dt) or not 0 < dt < np.inf:
        raise DataError(f"dt = {dt!r}: the sampling time must be a positive number.")
    return float(dt)


def interval_text(dt: float, time_unit: str) -> str:
    """Write a sampling time with its unit."""
    return f"{dt:g} {time_unit}".rstrip()


def model_meta(data: Any) -> dict[str, Any]:
    """Return the names, units and sampling time of a record or stream that a model carries."""
    return {"dt": data.dt, "time_unit": data.time_unit, "inputs": tuple(data.inputs), "outputs": tuple(data.outputs),
            "input_units": tuple(getattr(data, "input_units", None) or ("",) * len(data.inputs)),
            "output_units": tuple(getattr(data, "output_units", None) or ("",) * len(data.outputs))}

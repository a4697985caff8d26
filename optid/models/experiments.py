"""What every model does with the records it is given: check the channels, undo changes of units, one array each."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, as_samples, is_scalar_list
from optid.data.record import Data
from optid.errors import DataError


class Channels(Protocol):
    """A model as far as its channels go."""

    @property
    def inputs(self) -> tuple[str, ...]: ...  # noqa: D102 - names of the inputs

    @property
    def outputs(self) -> tuple[str, ...]: ...  # noqa: D102 - names of the outputs

    @property
    def dt(self) -> float: ...  # noqa: D102 - sampling time


Record = tuple[Array, Array | None, str]
"""Inputs (N, m), outputs (N, l) or None, and the words that name the experiment in a message."""


def in_units_of(model: Channels, data: Data) -> Data:
    """Return the data in raw units, given that channels and sampling time are the model's.

    Raises:
        DataError: other channels or another sampling time than the model's.
    """
    for kind, given, wanted in (("inputs", data.inputs, model.inputs), ("outputs", data.outputs, model.outputs)):
        if len(given) != len(wanted) or (given != wanted and set(given) == set(wanted)):
            raise DataError(
                f"The data have the {kind} {', '.join(given)}; the model has {', '.join(wanted)}. "
                f"Use data.select({kind}={list(wanted)})."
            )
    if abs(data.dt - model.dt) > 1e-6 * model.dt:
        raise DataError(f"The data are sampled every {data.dt:g}, the model every {model.dt:g}: resample the data.")
    return data if data.transform.is_identity else data.raw()


def records_of(model: Channels, data: Any) -> tuple[list[Record], bool]:
    """Return the record of every experiment, and whether the inputs were one-dimensional.

    Args:
        model: the model.
        data: Data, or inputs (N,) or (N, m), or a list of such arrays, in raw units.

    Raises:
        DataError: other channels or another sampling time than the model's.
    """
    if isinstance(data, Data):
        raw, many = in_units_of(model, data), data.n_experiments > 1
        return [(e.u, e.y, f"Experiment {i}: " * many) for i, e in enumerate(raw.experiments, start=1)], False
    arrays = [data] if is_scalar_list(data) else list(data)
    flat = all(np.ndim(u) == 1 for u in arrays)
    many = len(arrays) > 1
    return [
        (samples_of(u, "u", len(model.inputs)), None, f"Experiment {i}: " * many) for i, u in enumerate(arrays, start=1)
    ], flat


def samples_of(values: ArrayLike, what: str, count: int) -> Array:
    """Read samples (N, count), or (N,) for one channel.

    Raises:
        DataError: another number of channels.
    """
    samples = as_samples(values, what)
    if samples.shape[1] != count:
        raise DataError(f"{what} has {samples.shape[1]} channels; the model has {count}.")
    return samples


def one_or_all(arrays: list[Array]) -> Any:
    """Return the array of the only experiment, or a tuple with one array for each."""
    return arrays[0] if len(arrays) == 1 else tuple(arrays)

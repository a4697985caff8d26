"""Places of faults: where the name of a fault enters the equations of a model, and the matrices of a schedule."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import LookupFailed, StructureError, nearest
from optid.models import HammersteinSS


def place_of(model: HammersteinSS, name: str, direction: Any = None,
             process: Mapping[str, ArrayLike] | None = None) -> tuple[Array, Array]:
    """Return where an additive fault enters: the state equation (n, d) and the output equation (l, d).

    Args:
        model: the model.
        name: "actuator:u1", "sensor:y1", "process:load", "process:x1", "process" or "state".
        direction: (n,) or (n, d) of a "process" fault.
        process: directions by name, where `direction` is not given.

    Raises:
        LookupFailed: no such channel or direction.
        StructureError: a direction of another shape.
    """
    place, _, channel = name.partition(":")
    n, l = model.nx, model.l  # noqa: E741
    if place == "actuator":
        columns = functions_of(model, name)
        return np.array(model.B[:, columns]), np.array(model.D[:, columns])
    if place == "sensor":
        reading = range(l) if not channel else [channel_of(model.outputs, name)]
        return np.zeros((n, len(reading))), np.eye(l)[:, list(reading)]
    if place == "process" and direction is None and channel:
        states = [f"x{i}" for i in range(1, n + 1)]
        if process is not None and channel in process:
            direction = process[channel]
        elif channel in states:
            direction = np.eye(n)[:, states.index(channel)]
        else:
            raise LookupFailed(
                f"{name!r}: no direction of this name. Give direction=(n,) with the fault, or "
                f"process={{{channel!r}: (n,)}}; 'process:x1' is the first state. {nearest(channel, process or states)}"
            )
    if place == "process" and direction is not None:
        columns = np.asarray(direction, dtype=float)
        columns = columns[:, None] if columns.ndim == 1 else columns
        if columns.ndim != 2 or len(columns) != n or not columns.any() or not np.isfinite(columns).all():
            raise StructureError(
                f"{name}: direction of shape {np.shape(direction)}; it must be ({n},), finite and not zero.")
        return columns, np.zeros((l, columns.shape[1]))
    if place in ("process", "state") and not channel:
        return np.eye(n), np.zeros((l, n))
    raise LookupFailed(
        f"{name!r}: a fault is named 'actuator:<input>', 'sensor:<output>', 'process:<direction>' or 'state'.")


def channel_of(names: tuple[str, ...], name: str) -> int:
    """Return the index of the channel that the name of a fault ends in; `LookupFailed`: no such channel."""
    channel = name.partition(":")[2]
    if channel not in names:
        raise LookupFailed(f"{name!r}: there is no channel {channel!r}. {nearest(channel, names)}")
    return names.index(channel)


def functions_of(model: HammersteinSS, name: str) -> list[int]:
    """Return the functions of the input that the name of a fault ends in; errors as `channel_of`."""
    c = channel_of(model.inputs, name)
    return [i for i, of in enumerate(model.input_of) if of == c]


def matrices_of(label: str, word: str, given: Any, samples: range, healthy: Array, count: int) -> Array:
    """Return the matrices A(k) or B(k) (`word`) of a schedule at some samples, (samples, ...).

    Given are one matrix, one for each of the `count` samples of the record, a function of k, or None for the healthy
    one. Matrices of another shape, or not finite, are a `StructureError` that names the label of the fault.
    """
    values = healthy if given is None else given
    values = np.array([values(k) for k in samples]) if callable(values) else np.asarray(values, dtype=float)
    if not callable(given) and values.shape == (count, *healthy.shape):
        values = values[samples.start : samples.stop]
    if values.shape not in (healthy.shape, (len(samples), *healthy.shape)):
        raise StructureError(f"{label}: {word} has shape {values.shape}; it must be {healthy.shape}, or "
                             f"{(count, *healthy.shape)} with one matrix for each sample.")
    if not np.isfinite(values).all():
        raise StructureError(f"{label}: {word} has a value that is not finite.")
    return np.broadcast_to(values, (len(samples), *healthy.shape))

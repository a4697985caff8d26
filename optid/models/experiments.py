"""Records and initial states given to a model: channels, units and shapes are checked here."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, as_samples, is_scalar_list
from optid.data.channels import check_texts, numbered_names
from optid.data.record import Data
from optid.errors import DataError, StructureError

# inputs (N, m), outputs (N, l) or None, and the words that name the experiment in a message
Record = tuple[Array, Array | None, str]


def named_channels(model: Any, m: int, l: int) -> dict[str, tuple[str, ...]]:  # noqa: E741 - the field's letter
    """Return names and units of m inputs and l outputs, defaults where a model has none (`StructureError`: others)."""
    found: dict[str, tuple[str, ...]] = {}
    for kind, letter, count in (("input", "u", m), ("output", "y", l)):
        names = tuple(getattr(model, f"{kind}s")) or numbered_names(letter, count)
        units = tuple(getattr(model, f"{kind}_units")) or ("",) * count
        if len(names) != count or len(units) != count:
            raise StructureError(f"{len(names)} names and {len(units)} units for {count} {kind}s.")
        check_texts(f"the name of an {kind}", map(str, names), StructureError)
        check_texts(f"the unit of an {kind}", map(str, units), StructureError)
        found |= {f"{kind}s": names, f"{kind}_units": units}
    return found


def operating_point(model: Any, u0: ArrayLike) -> Array:
    """Read constant inputs (m,); refuse another number of them (`StructureError`)."""
    points = np.atleast_1d(np.asarray(u0, dtype=float))
    if points.shape != (model.m,):
        raise StructureError(f"u0 has shape {points.shape}; it must be ({model.m},), one operating point per input.")
    return points


def in_units_of(model: Any, data: Data) -> Data:
    """Return data in raw units; refuse channels or a sampling time other than the model's (`DataError`)."""
    for kind, given, wanted in (("inputs", data.inputs, model.inputs), ("outputs", data.outputs, model.outputs)):
        if len(given) != len(wanted) or (given != wanted and set(given) == set(wanted)):
            raise DataError(f"The data have the {kind} {', '.join(given)}; the model has {', '.join(wanted)}. "
                            f"Use data.select({kind}={list(wanted)}).")
    if abs(data.dt - model.dt) > 1e-6 * model.dt:
        raise DataError(f"The data are sampled every {data.interval}, the model every {model.interval}: resample the "
                        "data.")
    return data if data.transform.is_identity else data.raw()


def records_of(model: Any, data: Any) -> tuple[list[Record], bool]:
    """Return the record of every experiment, and whether the inputs were one-dimensional; errors as `in_units_of`.

    The data are Data at regular times, or inputs (N,) or (N, m), or a list of such arrays, in raw units.
    """
    if isinstance(data, Data):
        data.refuse_irregular("this model")
        flat, pairs = False, [(e.u, e.y) for e in in_units_of(model, data).experiments]
    else:
        arrays = [data] if is_scalar_list(data) else list(data)
        flat, pairs = all(np.ndim(u) == 1 for u in arrays), [(samples_of(u, "u", model.m), None) for u in arrays]
    return [(u, y, f"Experiment {i}: " * (len(pairs) > 1)) for i, (u, y) in enumerate(pairs, start=1)], flat


def samples_of(values: ArrayLike, what: str, count: int) -> Array:
    """Read samples (N, count), or (N,) for one channel; refuse another number of channels (`DataError`)."""
    samples = as_samples(values, what)
    if samples.shape[1] != count:
        raise DataError(f"{what} has {samples.shape[1]} channels; the model has {count}.")
    return samples


def check_inputs(model: Any, u: Array, label: str) -> None:
    """Refuse missing and infinite inputs, beyond which no state is known (`DataError`)."""
    bad = ~np.isfinite(u)
    if bad.any():
        k, c = np.argwhere(bad)[0]
        raise DataError(
            f"{label}Input {model.inputs[c]!r} is missing at sample {k} ({int(bad[:, c].sum())} in all): a simulation "
            "needs every input. Interpolate it, or split the record there.")


def state_like(x0: Any, shape: tuple[int, ...]) -> Array:
    """Read an initial state given by the user; with a last dimension of one that may be left out.

    Another shape (`StructureError`) or a value that is not finite (`DataError`) is refused.
    """
    state = np.atleast_1d(np.asarray(x0, dtype=float))
    if shape[1:] == (1,) and state.ndim == 1:
        state = state[:, None]
    if state.shape != shape:
        raise StructureError(f"x0 has shape {np.shape(x0)}; the state of this model is {shape}.")
    if not np.all(np.isfinite(state)):
        raise DataError("x0 contains a value that is not finite.")
    return state


def signal_units(y: Array) -> Array:
    """Standard deviation (l,) of every output, missing samples aside; one where it is zero or unknown."""
    present = [column[np.isfinite(column)] for column in y.T]
    units = np.array([column.std() if column.size else 0.0 for column in present])
    units[units == 0] = 1.0
    return units


def scaled_least_squares(design: Array, target: Array) -> Array:
    """Solve least squares in columns of equal norm; directions without information stay at zero."""
    sizes = np.linalg.norm(design, axis=0)
    sizes[sizes == 0] = 1.0
    return np.linalg.lstsq(design / sizes, target)[0] / sizes

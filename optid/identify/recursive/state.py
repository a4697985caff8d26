"""Common parts of recursive estimators: samples as blocks, the forgetting factor, and the state as a file."""

from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from optid.arrays import Array, check_finite
from optid.errors import DataError, ModelFileError, OptidError, StructureError
from optid.models.files import read_state, write_state

VERSION = 1  # version of the file


class SavedState:
    """An estimator that restarts from a file and continues bit for bit.

    Attributes:
        kind: word for it in the file and in messages.
        arrays: names of the attributes that are arrays of the state.
        settings: names of the attributes that are arguments, in JSON types.
    """

    kind: ClassVar[str]
    arrays: ClassVar[tuple[str, ...]]
    settings: ClassVar[tuple[str, ...]]

    def _head(self) -> dict[str, Any]:
        """Everything beside the arrays, in JSON types."""
        return {"settings": {name: getattr(self, name) for name in self.settings}}

    @classmethod
    def _of_head(cls, head: dict[str, Any], functions: dict[str, Any] | None) -> Self:
        """Build a fresh estimator from what `_head` returned."""
        return cls(**head["settings"])

    def save(self, path: str | Path) -> Path:
        """Write the whole state to an npz file for `load`; the file appears complete or not at all."""
        return write_state(path, self.kind, VERSION, self._head(), {name: getattr(self, name) for name in self.arrays})

    @classmethod
    def load(cls, path: str | Path, functions: dict[str, Any] | None = None) -> Self:
        """Restore a state from a file written by `save`.

        Args:
            path: the file.
            functions: the functions of UserFunctions bases by name, which a file does not contain.

        Raises:
            ModelFileError: a truncated file, or one of another version or kind.
            StructureError: missing functions.
        """
        head, arrays = read_state(path, cls.kind, VERSION, cls.arrays)
        try:
            state = cls._of_head(head, functions)
        except (KeyError, TypeError, AttributeError, OptidError) as error:
            if "functions=" in str(error):
                raise
            raise ModelFileError(f"{path}: the settings in the file cannot be read ({error}).") from error
        for name, array in arrays.items():
            wanted = getattr(state, name)
            if array.dtype != wanted.dtype or array.shape != wanted.shape:
                raise ModelFileError(f"{path}: {name} is {array.dtype} {array.shape}, not {wanted.dtype} "
                                     f"{wanted.shape}.")
            setattr(state, name, np.ascontiguousarray(array))
        return state


def as_block(values: Any, names: tuple[str, ...], what: str, seen: int) -> Array:
    """Return samples, a block (N, channels), (N,) of one channel or one sample, as (N, channels), finite or NaN.

    A wrong shape or an infinite sample of `what` is a `DataError`; samples are counted from `seen` on.
    """
    samples, width = np.asarray(values, dtype=float), len(names)
    if samples.ndim == 0 and width == 1 or samples.ndim == 1 and width > 1 and samples.size == width:
        samples = samples.reshape(1, width)
    elif samples.ndim == 1 and width == 1:
        samples = samples[:, None]
    if samples.ndim != 2 or samples.shape[1] != width:
        raise DataError(f"{what} has shape {np.shape(values)}: it must be a block (N, {width}) or one sample of "
                        f"{width} channel{'s' if width > 1 else ''} ({', '.join(names)}).")
    if samples.size:
        check_finite(samples, [f"{what}, channel {name!r}" for name in names], seen)
    return samples


def forgetting_factor(value: float) -> float:
    """Return a forgetting factor; one outside (0, 1] is a `StructureError`."""
    if not 0 < value <= 1:
        raise StructureError(f"forgetting={value!r} must be above 0 and at most 1, such as 0.995.")
    return float(value)

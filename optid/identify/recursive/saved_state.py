"""The state of an estimator that runs on, as a file."""

from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from optid.errors import ModelFileError, OptidError
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
        """Restore a state.

        Args:
            path: file written by `save`.
            functions: the functions of UserFunctions bases by name, which a file does not hold.

        Raises:
            ModelFileError: truncated, of another version, or the state of something else.
            StructureError: functions that are needed and not given.
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
                raise ModelFileError(f"{path}: {name} is {array.dtype} {array.shape}; {wanted.dtype} {wanted.shape} is "
                                     "needed.")
            setattr(state, name, np.ascontiguousarray(array))
        return state

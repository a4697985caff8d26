"""The state of a recursion on disk."""

from pathlib import Path
from typing import Any

from optid.bases import from_dict
from optid.errors import ModelFileError
from optid.identify.recursive.recursive_arx import RecursiveARX
from optid.models.state_file import read_state, set_arrays, write_state

VERSION = 1
"""Version of the file."""

COUNTS = ("samples", "candidates", "rows", "since_restart")
ARRAYS = ("root", "past_u", "past_y")


def save(state: RecursiveARX, path: str | Path) -> Path:
    """Write the whole state; the file appears complete or not at all."""
    layout = state.layout
    settings = {
        "na": int(layout.na), "nb": [int(b) for b in layout.nb], "nk": [int(k) for k in layout.nk],
        "inputs": layout.inputs, "outputs": layout.outputs, "input_units": state.input_units,
        "output_units": state.output_units, "dt": state.dt, "forgetting": state.forgetting,
    }
    head = {
        "settings": settings,
        "bases": [basis.to_dict() for basis in layout.bases], "counts": {name: getattr(state, name) for name in COUNTS},
    }
    return write_state(path, "recursion", VERSION, head, {name: getattr(state, name) for name in ARRAYS})


def load(path: str | Path, functions: dict[str, Any] | None = None) -> RecursiveARX:
    """Restore a state.

    Args:
        path: file written by `save`.
        functions: the functions of UserFunctions bases by name.

    Raises:
        ModelFileError: truncated, of another version, or not a state of a recursion.
    """
    head, arrays = read_state(path, "recursion", VERSION, ARRAYS)
    try:
        state = RecursiveARX(basis=[from_dict(basis, functions) for basis in head["bases"]], **head["settings"])
        for name in COUNTS:
            setattr(state, name, int(head["counts"][name]))
    except (KeyError, TypeError, AttributeError) as error:
        raise ModelFileError(f"{path}: the settings in the file cannot be read ({error}).") from error
    set_arrays(state, arrays, path)
    return state

"""The state of a tracker on disk."""

from pathlib import Path

from optid.errors import ModelFileError, OptidError
from optid.identify.tracking.tracker import SubspaceTracker
from optid.models.state_file import read_state, set_arrays, write_state

VERSION = 1
ARRAYS = ("W", "root", "sums", "counts")
SETTINGS = ("n", "r", "method", "forgetting", "missing", "names")


def save(state: SubspaceTracker, path: str | Path) -> Path:
    """Write the whole state; the file appears complete or not at all."""
    settings = {name: getattr(state, name) for name in SETTINGS}
    arrays = {name: getattr(state, name) for name in ARRAYS}
    return write_state(path, "tracker", VERSION, {"settings": settings}, arrays)


def load_tracker(path: str | Path) -> SubspaceTracker:
    """Restore a tracker.

    Raises:
        ModelFileError: truncated, of another version, or not the state of a tracker.
    """
    head, arrays = read_state(path, "tracker", VERSION, ARRAYS)
    try:
        state = SubspaceTracker(**head["settings"])
    except (KeyError, TypeError, OptidError) as error:
        raise ModelFileError(f"{path}: the settings in the file cannot be read ({error}).") from error
    set_arrays(state, arrays, path)
    return state

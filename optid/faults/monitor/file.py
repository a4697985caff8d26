"""The state of a monitor on disk: everything that the next sample needs, restored bit for bit."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.errors import ModelFileError
from optid.faults.monitor import layout as at
from optid.faults.monitor.arl import Calibration
from optid.faults.monitor.tables import blank
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Predictor
from optid.models.files import from_content, read_state, write_state

if TYPE_CHECKING:
    from optid.faults.monitor.monitoring import Monitor

VERSION = 1
"""Version of the file."""

PARTS = ("counts", "m", "v", "i")
PLACES = ("into_state", "into_output")
PREDICTOR = ("A", "C", "L", "K", "covariance", "root")


def save(monitor: "Monitor", path: str | Path) -> Path:
    """Write dictionary, thresholds, tables and state; the file appears complete or not at all."""
    found, t, s = monitor.dictionary, monitor._tables, monitor._state
    words = [
        {"name": c.name, "kind": c.kind, "columns": list(c.columns), "members": list(c.members),
         "places": list(c.places), "bounded_deflection": c.bounded_deflection}
        for c in found.candidates
    ]
    head = {
        "model": found.model.to_dict(), "candidates": words, "excluded": dict(found.excluded), "unknown": found.unknown,
        "window": monitor.window, "seed": monitor.seed, "calibration": monitor.calibration.to_dict(),
        "source": monitor.source,
    }
    arrays = {f"table_{name}": part for name, part in zip(t._fields, t)}
    arrays |= {f"state_{name}": getattr(s, name) for name in PARTS} | {"window": s.w[_held(t, s)], "sines": found.sines}
    arrays |= {f"predictor_{name}": getattr(found.predictor, name) for name in PREDICTOR}
    arrays |= {f"{place}_{i}": getattr(c, place) for i, c in enumerate(found.candidates) for place in PLACES}
    return write_state(path, "monitor", VERSION, head, arrays)


def load(monitor: "Monitor", path: str | Path, functions: dict[str, Any] | None = None) -> None:
    """Fill a monitor that has not been set up.

    Args:
        monitor: what is filled.
        path: file written by `save`.
        functions: the functions of UserFunctions bases by name.

    Raises:
        ModelFileError: truncated, of another version, or not the state of a monitor.
    """
    names = [f"table_{name}" for name in at.Tables._fields] + [f"state_{name}" for name in PARTS]
    names += ["window", "sines", *(f"predictor_{name}" for name in PREDICTOR)]
    head, arrays = read_state(path, "monitor", VERSION, names)
    try:
        count = len(head["candidates"])
        _, places = read_state(path, "monitor", VERSION, [f"{p}_{i}" for i in range(count) for p in PLACES])
        model = from_content(head["model"], functions)
        candidates = tuple(
            Candidate(
                c["name"], c["kind"], places[f"into_state_{i}"], places[f"into_output_{i}"], tuple(c["columns"]),
                tuple(c["members"]), tuple(c["places"]), c["bounded_deflection"],
            )
            for i, c in enumerate(head["candidates"])
        )
        steady = Predictor(*(arrays[f"predictor_{name}"] for name in PREDICTOR))
        monitor._of(Dictionary(model, steady, candidates, head["excluded"], arrays["sines"], head["unknown"]),
                    head["window"], head["seed"])
        monitor.calibration = Calibration.from_dict(head["calibration"])
        t = at.Tables(*(np.ascontiguousarray(arrays[f"table_{name}"]) for name in at.Tables._fields))
        s = blank(t)
        for name in PARTS:
            getattr(s, name)[...] = arrays[f"state_{name}"]
        s.w[_held(t, s)] = arrays["window"]
        monitor.source = head["source"]
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        if "functions=" in str(error):
            raise
        raise ModelFileError(f"{path}: the monitor in the file cannot be read ({error}).") from error
    monitor._start(t, s)


def _held(t: at.Tables, s: at.State) -> tuple[slice, slice]:
    """The part of the arrays over onsets that the next sample can read."""
    rows = int(t.i[0, at.S_TAKEN] + s.counts[at.ACTIVE] * t.i[0, at.COLUMNS])
    last = int(s.counts[at.PLACE]) + 1
    return slice(0, rows), slice(max(last - int(t.i[0, at.WINDOW]), 0), last)

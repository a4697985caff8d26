"""The state of a monitor on disk: everything that the next sample needs, restored bit for bit."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.errors import ModelFileError
from optid.faults.monitor.arl import Calibration
from optid.faults.monitor.columns import Window
from optid.faults.monitor.decisions import Decisions, kept
from optid.faults.monitor.running_filter import Direction
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Predictor
from optid.models.files import from_content, read_state, write_state

if TYPE_CHECKING:
    from optid.faults.monitor.monitoring import Monitor

VERSION = 2
"""Version of the file."""

PLACES = ("into_state", "into_output")
PREDICTOR = ("A", "C", "L", "K", "covariance", "root")
PLANT = ("x", "P", "held", "before")


def save(monitor: "Monitor", path: str | Path) -> Path:
    """Write dictionary, thresholds and state; the file appears complete or not at all."""
    found, plant = monitor.dictionary, monitor.plant
    words = [
        {"name": c.name, "kind": c.kind, "columns": list(c.columns), "members": list(c.members),
         "places": list(c.places), "bounded_deflection": c.bounded_deflection}
        for c in found.candidates
    ]
    head = {
        "model": found.model.to_dict(), "candidates": words, "excluded": dict(found.excluded), "unknown": found.unknown,
        "window": monitor.window, "seed": monitor.seed, "calibration": monitor.calibration.to_dict(),
        "rules": {**monitor.decisions.rules, "odd": min(monitor.decisions.rules["odd"], 1e300)},
        "source": monitor.source, "samples": monitor.samples, "remark": monitor.remark,
        "decisions": kept(monitor.decisions), "readings": monitor.checks.memory, "certain": plant.certain,
        "directions": [vars(one) | {"deviation": np.ravel(one.deviation).tolist()} for one in plant.directions],
        "silent": found.predictor.silent,
    }
    arrays = {f"search_{name}": getattr(monitor.search, name) for name in Window.KEPT} | {"sines": found.sines}
    arrays |= {f"plant_{name}": getattr(plant, name) for name in PLANT}
    arrays |= {f"predictor_{name}": getattr(found.predictor, name) for name in PREDICTOR}
    arrays |= {f"{place}_{i}": getattr(c, place) for i, c in enumerate(found.candidates) for place in PLACES}
    return write_state(path, "monitor", VERSION, head, arrays)


def load(monitor: "Monitor", path: str | Path, functions: dict[str, Any] | None = None) -> None:
    """Fill a monitor that has not been set up.

    Args:
        monitor: the monitor.
        path: file written by `save`.
        functions: the functions of UserFunctions bases by name.

    Raises:
        ModelFileError: truncated, of another version, or not the state of a monitor.
    """
    names = [f"search_{name}" for name in Window.KEPT] + [f"plant_{name}" for name in PLANT]
    names += ["sines", *(f"predictor_{name}" for name in PREDICTOR)]
    try:
        head, arrays = read_state(path, "monitor", VERSION, names)
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
        A, C, L, K, covariance, root = (arrays[f"predictor_{name}"] for name in PREDICTOR)
        steady = Predictor(A, C, L, K, covariance, root, int(head["silent"]))
        found = Dictionary(model, steady, candidates, head["excluded"], arrays["sines"], head["unknown"])
        monitor._set(found, head["window"], head["seed"], head["rules"])
        monitor.calibration = Calibration.from_dict(head["calibration"])
        monitor.samples, monitor.source, monitor.remark = head["samples"], head["source"], head["remark"]
        for name in Window.KEPT:
            getattr(monitor.search, name)[...] = arrays[f"search_{name}"]
        for name in PLANT:
            setattr(monitor.plant, name, np.ascontiguousarray(arrays[f"plant_{name}"]))
        monitor.plant.certain = head["certain"]
        monitor.plant.directions = [Direction(**one) for one in head["directions"]]
        monitor.checks.memory = head["readings"]
        monitor.decisions.q = monitor.calibration.q
        monitor.decisions.testable = np.array(head["decisions"]["testable"], dtype=bool)
        for name in Decisions.KEPT:
            setattr(monitor.decisions, name, head["decisions"][name])
    except (KeyError, TypeError, AttributeError, ValueError, IndexError, RecursionError) as error:
        if "functions=" in str(error):
            raise
        raise ModelFileError(f"{path}: the monitor in the file cannot be read ({error}).") from error

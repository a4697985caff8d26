"""The state of a monitor on disk, restored bit for bit, for `Monitor.save` and `Monitor.load`."""

from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import ModelFileError
from optid.faults.curvature import Products
from optid.faults.false_alarms import Calibration
from optid.faults.monitor.columns import Window
from optid.faults.monitor.events import Carried
from optid.faults.monitor.running_filter import Direction, RunningFilter
from optid.faults.monitor.sizes import Recent
from optid.faults.nuisance import ModelUncertainty
from optid.faults.signatures import Candidate, Dictionary
from optid.faults.whitening import Predictor
from optid.models.files import from_content, read_state, write_state

VERSION = 6  # version of the file

WORDS = "name", "kind", "columns", "members", "places", "bounded_deflection", "zero"
PLACES = "into_state", "into_output"
PREDICTOR = "A", "C", "L", "K", "covariance", "root"
RECENT = "recent_u", "recent_y", "known_deviations"


def _parts(monitor: Any) -> dict[str, tuple[Any, tuple[str, ...]]]:
    """The owners of the arrays of the state, by the prefix of their names."""
    return {"search": (monitor.search, Window.KEPT), "plant": (monitor.plant, RunningFilter.KEPT)}


def save(monitor: Any, path: str | Path) -> Path:
    """Write dictionary, thresholds and state atomically."""
    found, plant, decisions = monitor.dictionary, monitor.plant, monitor.decisions
    decided = {name: getattr(part, name) for part in (decisions, decisions.limits) for name in part.KEPT}
    head = {
        "model": found.model.to_dict(), "candidates": [{w: getattr(c, w) for w in WORDS} for c in found.candidates],
        "excluded": dict(found.excluded), "unknown": found.unknown, "window": monitor.window, "seed": monitor.seed,
        "calibration": monitor.calibration.to_dict(),
        "rules": {**decisions.rules, "odd": min(decisions.rules["odd"], 1e300)},
        "source": monitor.source, "samples": monitor.samples, "remark": monitor.remark,
        "decisions": {name: [*value.items()] if isinstance(value, dict) else value for name, value in decided.items()}
        | {"testable": decisions.testable.tolist()},
        "readings": monitor.checks.memory, "certain": plant.certain, "silent": found.predictor.silent,
        "directions": [vars(one) | {"deviation": np.ravel(one.deviation).tolist()} for one in plant.directions],
    }
    arrays = {f"{word}_{name}": getattr(part, name) for word, (part, own) in _parts(monitor).items() for name in own}
    arrays |= {f"predictor_{name}": getattr(found.predictor, name) for name in PREDICTOR} | {"sines": found.sines}
    arrays |= {f"{place}_{i}": getattr(c, place) for i, c in enumerate(found.candidates) for place in PLACES}
    if monitor.recent is not None:
        more, own = _recent(monitor.recent)
        head, arrays = head | more, arrays | own
    return write_state(path, "monitor", VERSION, head, arrays)


def _recent(recent: Recent) -> tuple[dict[str, Any], dict[str, Any]]:
    """The head and the arrays of the last samples and of the model by which they are judged."""
    known, curvature = recent.known, recent.known.curvature
    head = {
        "known": {"model": known.model.to_dict(), "readings": known.readings, "inflation": known.inflation,
                  "deviation": known.deviation, "silent": known.predictor.silent,
                  "levels": None if known.levels is None else known.levels.tolist(),
                  "curvature": None if curvature is None else [curvature.low.tolist(), curvature.high.tolist()]},
        "first": recent.first, "final": [[number, *vars(one).values()] for number, one in recent.final.items()],
    }
    arrays = {f"known_{name}": getattr(known.predictor, name) for name in PREDICTOR} | {
        "recent_u": recent.u, "recent_y": recent.y, "known_deviations": known.root}
    return head, arrays


def _known(head: dict[str, Any], arrays: dict[str, np.ndarray], functions: dict[str, Any] | None) -> ModelUncertainty:
    """The model by which the last samples are judged."""
    model, ends, levels = from_content(head["model"], functions), head["curvature"], head["levels"]
    curvature = None if ends is None else Products(np.array(ends[0]), np.array(ends[1]), model.m)
    levels = None if levels is None else np.array(levels)
    return ModelUncertainty(model, _predictor("known", head, arrays), arrays["known_deviations"], head["readings"],
                            head["inflation"], levels, head["deviation"], curvature)


def _predictor(word: str, head: dict[str, Any], arrays: dict[str, np.ndarray]) -> Predictor:
    parts: dict[str, Any] = {name: arrays[f"{word}_{name}"] for name in PREDICTOR}
    return Predictor(**parts, silent=int(head["silent"]))


def load(monitor: Any, path: str | Path, functions: dict[str, Any] | None = None) -> None:
    """Fill an empty monitor; arguments and errors as of `Monitor.load`."""
    try:
        head, _ = read_state(path, "monitor", VERSION, [])
        names = [f"{place}_{i}" for i in range(len(head["candidates"])) for place in PLACES]
        names += ["sines", *(f"predictor_{name}" for name in PREDICTOR)]
        names += [f"search_{name}" for name in Window.KEPT] + [f"plant_{name}" for name in RunningFilter.KEPT]
        names += [*RECENT, *(f"known_{name}" for name in PREDICTOR)] if "known" in head else []
        _, arrays = read_state(path, "monitor", VERSION, names)
        candidates = []
        for i, c in enumerate(head["candidates"]):
            words: dict[str, Any] = {word: tuple(v) if isinstance(v, list) else v for word, v in c.items()}
            candidates.append(Candidate(**words, into_state=arrays[f"into_state_{i}"],
                                        into_output=arrays[f"into_output_{i}"]))
        found = Dictionary(from_content(head["model"], functions), _predictor("predictor", head, arrays),
                           tuple(candidates), head["excluded"], arrays["sines"], head["unknown"])
        known = _known(head["known"], arrays, functions) if "known" in head else None
        monitor._set(found, head["window"], head["seed"], head["rules"], known)
        if monitor.recent is not None:
            recent = monitor.recent
            recent.u, recent.y, recent.first = arrays["recent_u"], arrays["recent_y"], head["first"]
            recent.final = {number: Carried(label, tuple(size), tuple(deviation), tuple(map(tuple, interval)))
                            for number, label, size, deviation, interval in head["final"]}
        monitor.calibration = Calibration.from_dict(head["calibration"])
        monitor.samples, monitor.source, monitor.remark = head["samples"], head["source"], head["remark"]
        for word, (part, own) in _parts(monitor).items():
            for name in own:
                setattr(part, name, np.ascontiguousarray(arrays[f"{word}_{name}"]))
        monitor.plant.certain = head["certain"]
        monitor.plant.directions = [Direction(**one) for one in head["directions"]]
        monitor.checks.memory = head["readings"]
        monitor._use(monitor.calibration)
        monitor.decisions.testable = np.array(head["decisions"]["testable"], dtype=bool)
        for part in (monitor.decisions, monitor.decisions.limits):
            for name in part.KEPT:
                kept = head["decisions"][name]
                setattr(part, name, dict(kept) if isinstance(getattr(part, name), dict) else kept)
    except (KeyError, TypeError, AttributeError, ValueError, IndexError, RecursionError) as error:
        if "functions=" in str(error):
            raise
        raise ModelFileError(f"{path}: the monitor in the file cannot be read ({error}).") from error

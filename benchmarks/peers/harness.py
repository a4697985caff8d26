"""Run one entry in the interpreter of its environment: fit, time, predict. Needs numpy alone.

    python harness.py LIMIT ENTRY.py KIND RECORD.npz [RECORD.npz ...]

One line of JSON on the standard output before each record (``{"record": ...}``) and after it; whatever the package
prints goes to the standard error. The time is CPU time of this process and its children in the entry's function alone,
and beside it that of what the entry puts off ("later"); the first fit of a process is done twice and the second counts,
unless it takes more than `WARM` seconds.
A fit that takes more than LIMIT CPU seconds ends the process (SIGXCPU).
"""

import importlib.util
import io
import json
import os
import resource
import sys
import traceback
import warnings
from contextlib import redirect_stdout
from pathlib import Path

import judging
import numpy as np

WARM = 30.0


def cpu_seconds() -> float:
    """CPU seconds of this process and of children that have ended."""
    return sum(use.ru_utime + use.ru_stime
               for use in (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)))


def patience(limit: float) -> None:
    """End the process when it has taken so many CPU seconds from now on; what runs in children is not counted."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (int(used.ru_utime + used.ru_stime + limit) + 1, hard))


def load(path: str):
    """The module of an entry."""
    spec = importlib.util.spec_from_file_location("entry_" + Path(path).stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def measured(fitter: judging.Fitter, path: str) -> dict:
    """Fit a record and score the model; what was raised is an outcome."""
    with np.load(path) as file:
        record = {name: file[name] for name in file.files}
    given = {name: value.item() if value.ndim == 0 else value
             for name, value in record.items() if not name.startswith("test_")}
    printed = io.StringIO()
    with warnings.catch_warnings(record=True) as caught, redirect_stdout(printed):
        warnings.simplefilter("always")
        try:
            started = cpu_seconds()
            model = fitter(given)
            seconds = cpu_seconds() - started
            started = cpu_seconds()
            model.get("later", dict)()
            later = cpu_seconds() - started if "later" in model else 0.0
            u, y = record["test_u"], record["test_y"]
            found = {"seconds": seconds, "values": np.ravel(model["values"]).tolist()} if "values" in model else {
                "seconds": seconds, "later": later, "one_step": judging.fit_percent(y, judging.one_step(model, u, y)),
                     "simulation": judging.fit_percent(y, judging.simulate(model, u, y))}
            if "nodes" in record:
                found["disobeyed"] = judging.disobeyed(model, record["nodes"])
        except (Exception, SystemExit) as error:  # SystemExit: one of the packages leaves the interpreter
            place = traceback.extract_tb(error.__traceback__)[-1].name
            found = {"error": type(error).__name__, "message": str(error)[:400], "place": place}
        found["said"] = _said(caught, printed)
    return found


def _said(caught: list, printed: io.StringIO) -> str:
    texts = [f"{w.category.__name__}: {w.message}" for w in caught if not issubclass(w.category, DeprecationWarning)]
    texts += [line for line in printed.getvalue().splitlines() if any(
        word in line.lower() for word in ("warn", "error", "cannot", "nan"))]
    return " | ".join(dict.fromkeys(texts))[:600]


def main() -> None:
    limit, entry, kind, *paths = sys.argv[1:]
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    fitter = getattr(load(entry), kind)
    for i, path in enumerate(paths):
        channel.write(json.dumps({"record": Path(path).stem}) + "\n")
        started = cpu_seconds()
        patience(float(limit))
        found = measured(fitter, path)
        patience(float(limit))
        if i == 0 and cpu_seconds() - started < WARM:
            found = measured(fitter, path)
        channel.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()

"""A function of cells that behaves as it is told: for the tests of whatever runs cells in other processes."""

import ctypes
import os
import resource
import subprocess
import sys
import time
from datetime import UTC, datetime
from typing import Any

import numpy as np

from optid.studies.definition import DataEntry
from optid.studies.execution.cell import keep
from optid.studies.grid import Cell
from optid.studies.storage.rows import as_json, complete

FINE = "fine"


def cell(number: int, do: str = FINE, *, time_limit: float = 300.0, memory_limit: float = 2000.0, repetition: int = 0,
         **words: Any) -> Cell:
    """Return a cell that `behave` handles: ``do`` and ``words`` say how."""
    return Cell(key=f"{number:064x}", repetition=repetition, study="trouble", data="none", formulation=str(number),
                solver=do, data_source=DataEntry("none", system="dead_zone"), data_hash="", samples=100, noise=0.1,
                seed=number, formulation_name="arx", options={}, constraints=(), solver_name="clarabel",
                solver_options={"do": do, **words}, accuracy=1e-8, warm=False, time_limit=time_limit,
                memory_limit=memory_limit, holdout=0.3)


def row(of: Cell, **values: Any) -> dict[str, Any]:
    """Return a row of such a cell, made without running anything."""
    return complete({
        "key": of.key, "repetition": of.repetition, "study": of.study, "data": of.data,
        "formulation": of.formulation, "solver": of.solver, "seed": of.seed, "formulation_name": of.formulation_name,
        "options": "{}", "constraints": "[]", "solver_name": of.solver_name,
        "solver_options": as_json(of.solver_options), "accuracy": of.accuracy, "warm": of.warm, "holdout": of.holdout,
        "time_limit": of.time_limit, "memory_limit": of.memory_limit, "outcome": "done", "unknowns": os.getpid(),
        "started": datetime.now(UTC).isoformat(), "machine": "this one", "versions": "{}", **values})


def behave(cell: Cell) -> Any:
    """Do what the cell says, and return its row where that is possible; ``unknowns`` is the worker's process id."""
    words = dict(cell.solver_options)
    if "log" in words:
        with open(words["log"], "a") as log:
            log.write(f"{cell.key} {cell.repetition}\n")
    return globals()[f"_{words['do']}"](cell, words)


def _fine(cell: Cell, words: dict[str, Any]) -> Any:
    time.sleep(words.get("seconds", 0.0))
    return row(cell)


def _segfault(cell: Cell, words: dict[str, Any]) -> None:
    ctypes.string_at(0)


def _abort(cell: Cell, words: dict[str, Any]) -> None:
    os.abort()


def _orphan(cell: Cell, words: dict[str, Any]) -> None:
    """Die while a child still holds the connection to the parent."""
    if os.fork() == 0:
        time.sleep(600.0)
        os._exit(0)
    os.abort()


def _keep_row(cell: Cell, words: dict[str, Any]) -> Any:
    """Have an answer, and then an end such as ``words`` say."""
    keep(row(cell, objective=5.0))
    return globals()[f"_{words['then']}"](cell, words)


def _leave(cell: Cell, words: dict[str, Any]) -> None:
    os._exit(3)


def _complain(cell: Cell, words: dict[str, Any]) -> None:
    print("terminate called after throwing an instance of 'std::bad_alloc'", file=sys.stderr, flush=True)
    os._exit(134)


def _loop(cell: Cell, words: dict[str, Any]) -> None:
    while True:
        pass


def _stuck(cell: Cell, words: dict[str, Any]) -> None:
    sum(iter(int, 1))  # in C, so that neither a signal nor another thread of Python gets a turn


def _stuck_unless_first(cell: Cell, words: dict[str, Any]) -> Any:
    with open(words["log"]) as log:
        return row(cell) if log.readline().split()[0] == cell.key else _stuck(cell, words)


def _hog(cell: Cell, words: dict[str, Any]) -> None:
    """Take more and more memory, but not all that a slow parent would let it take."""
    held = [np.ones(4_000_000) for _ in range(47)]  # 1.5 GB
    while held:
        time.sleep(1.0)


_kept: list[Any] = []


def _keep(cell: Cell, words: dict[str, Any]) -> Any:
    _kept.append(np.ones(words["megabytes"] * 125_000))
    return row(cell)


def _family(cell: Cell, words: dict[str, Any]) -> Any:
    """Leave the memory and the work to a child; the row has its exit code."""
    child = subprocess.Popen([sys.executable, "-c", words["program"]])
    with open(words["pids"], "a") as file:
        file.write(f"{child.pid}\n")
    return row(cell, iterations=child.wait())


def _cores(cell: Cell, words: dict[str, Any]) -> Any:
    return row(cell, iterations=resource.getrlimit(resource.RLIMIT_CORE)[0])


def _raise(cell: Cell, words: dict[str, Any]) -> None:
    raise KeyError("no such thing")


def _garbage(cell: Cell, words: dict[str, Any]) -> Any:
    return 7


def _partial(cell: Cell, words: dict[str, Any]) -> Any:
    return {"key": cell.key, "outcome": "done"}


def _other(cell: Cell, words: dict[str, Any]) -> Any:
    return row(cell, key="f" * 64)


def _vast(cell: Cell, words: dict[str, Any]) -> Any:
    return {**row(cell), "iterations": 2**70}


def _nan(cell: Cell, words: dict[str, Any]) -> Any:
    return {**row(cell), "objective": float("nan"), "gap": np.float64("inf")}


def _noisy(cell: Cell, words: dict[str, Any]) -> Any:
    for _ in range(2000):
        print("x" * 10_000)
        print("y" * 10_000, file=sys.stderr)
    return row(cell)


def fail_to_start() -> None:
    """Prepare a worker that cannot work."""
    import no_such_module  # pyright: ignore # noqa: F401

"""What a cell of a study costs beyond building and solving its problem.

    python benchmarks/studies/overhead.py [--cells 200] [--workers 2] [--seconds 0.2] [--cpu]

First, for several formulations, one worker runs the same quick cells again and again, the whole way: cell to the
worker, record, fit, judgement, figures on the hold-out, row to the database. The overhead of a cell is
its wall time, from one row to the next, less the time inside build and solve (compilation included, judgement, proof
and figures not). Goal: at most 20 ms.

Then cells of about 200 ms run on all cores. Printed is the share of wall time x workers that was spent inside build
and solve, from the first row of each worker on and for the whole command, which starts the workers. Goal: at least
85 % (of cells in warm workers).

Cells of 200 ms are nuclear-norm relaxations with so many basis functions that they take that. On a machine that
does other work both figures are those of the other work; with --cpu every clock counts CPU time instead, cells run in
this process, and the database is measured apart, on rows that are there already.
"""

import argparse
import os
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from optid.data.reduction import available_cores
from optid.studies.definition import DataEntry, FormulationEntry, SolverEntry
from optid.studies.execution import running
from optid.studies.execution.cell import run_cell
from optid.studies.execution.executors import run_here
from optid.studies.grid import cells
from optid.studies.study import Study

HAMMERSTEIN = {"na": 2, "nb": 2, "basis": "triangular:8"}
QUICK = (("hammerstein_arx.exact", "gauss_newton", HAMMERSTEIN), ("hammerstein_arx.exact", "ipopt", HAMMERSTEIN),
         ("hammerstein_arx.nuclear", "clarabel", HAMMERSTEIN), ("arx", "clarabel", {"na": 2, "nb": 2}),
         ("hammerstein_ss.sid", "auto", {"nx": 2, "basis": "triangular:8"}))
ROWS = 1000  # for the figure of the database alone
FUNCTIONS = (6, 8, 12, 16, 20, 24, 28, 32, 40, 48)


def study(formulation: str, solver: str, options: dict, samples: int, count: int) -> Study:
    """A study of ``count`` cells of one kind, on records of their own."""
    return Study(f"{formulation} {solver}", (DataEntry("dead zone", system="dead_zone", samples=(samples,)),),
                 (FormulationEntry("f", formulation, (), options),), (SolverEntry("s", solver),),
                 seeds=tuple(range(count)))


def inside(row: dict) -> float:
    """Seconds of a cell inside build and solve."""
    return sum(row[name] or 0.0 for name in ("build_s", "compile_s", "solve_s"))


def watched(described: Study, number: int) -> tuple[list[tuple[float, dict]], float, float]:
    """Run a study: (moment, row) as they come, when it was started, and when it had ended."""
    came: list[tuple[float, dict]] = []

    def progress(done: int, total: int, row: dict | None) -> None:
        if row is not None:
            came.append((time.perf_counter(), row))

    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        running.run(described, Path(folder) / "study.sqlite", progress=progress,
                    executor=partial(run_here, workers=number))
        return came, started, time.perf_counter()


def per_cell(count: int) -> None:
    """Print the first table."""
    print(f"{'formulation':<26}{'solver':<14}{'a cell':>9}{'build':>9}{'solve':>9}{'overhead':>10}{'median':>9}"
          "   ms, one worker; goal: overhead <= 20")
    for formulation, solver, options in QUICK:
        came, _, _ = watched(study(formulation, solver, options, 300, count), 1)
        bad = [row["reason"] for _, row in came if row["outcome"] != "done"]
        if bad:
            raise SystemExit(f"{formulation} {solver}: {bad[0]}")
        moments, rows = [moment for moment, _ in came], [row for _, row in came]
        overhead = np.diff(moments) - [inside(row) for row in rows[1:]]
        build, whole = np.mean([row["build_s"] for row in rows]), np.mean([inside(row) for row in rows])
        print(f"{formulation:<26}{solver:<14}{1e3 * np.mean(np.diff(moments)):>9.1f}{1e3 * build:>9.1f}"
              f"{1e3 * (whole - build):>9.1f}{1e3 * np.mean(overhead):>10.1f}{1e3 * np.median(overhead):>9.1f}")


def relaxation(functions: int, count: int) -> Study:
    """The study of the second part."""
    return study("hammerstein_arx.nuclear", "clarabel", {"na": 2, "nb": 5, "basis": f"triangular:{functions}"}, 1000,
                 count)


def functions_for(seconds: float) -> int:
    """Number of basis functions with which a relaxation takes about so long inside build and solve."""
    found = {}
    for functions in FUNCTIONS:
        cell = cells(relaxation(functions, 1))[0]
        found[functions] = min(inside(run_cell(cell)) for _ in range(3))
        if found[functions] > 2 * seconds:
            break
    return min(found, key=lambda functions: abs(found[functions] - seconds))


def shares(count: int, number: int, seconds: float) -> None:
    """Print the shares of the second part."""
    functions = functions_for(seconds)
    came, started, ended = watched(relaxation(functions, count), number)
    times = np.array([inside(row) for _, row in came])
    warm = came[number][0]  # every worker has imported and loaded what it needs
    share = times[number + 1 :].sum() / ((came[-1][0] - warm) * number)
    print(f"\n{count} cells of {1e3 * times.mean():.0f} ms ({functions} functions) on {number} workers, "
          f"{os.cpu_count()} cores")
    print(f"share of wall x workers inside build and solve, warm workers: {100 * share:.1f} % (goal: >= 85)")
    print(f"the same for the whole command, workers started and ended: "
          f"{100 * times.sum() / ((ended - started) * number):.1f} %, {ended - started:.1f} s")


def by_cpu(count: int) -> None:
    """Print the first table in CPU time."""
    time.perf_counter = time.process_time  # of every module: they look it up when they read the clock
    print(f"{'formulation':<26}{'solver':<14}{'a cell':>9}{'inside':>9}{'overhead':>10}   CPU ms, medians; goal: <= 20")
    for formulation, solver, options in QUICK:
        found = []
        for cell in cells(study(formulation, solver, options, 300, count)):
            clock = time.process_time()
            row = run_cell(cell)
            found.append((time.process_time() - clock, inside(row)))
        whole, part = 1e3 * np.median(found[1:], axis=0)
        print(f"{formulation:<26}{solver:<14}{whole:>9.1f}{part:>9.1f}{whole - part:>10.1f}")
    described = study(*QUICK[0][:2], HAMMERSTEIN, 300, ROWS)
    made = run_cell(cells(described)[0])
    rows = [{**made, "key": cell.key} for cell in cells(described)]
    with tempfile.TemporaryDirectory() as folder:
        clock = time.process_time()
        running.run(described, Path(folder) / "study.sqlite", executor=lambda todo: iter(rows))
        print(f"grid and database: {1e3 * (time.process_time() - clock) / ROWS:.1f} CPU ms a row, {ROWS} rows")


def main() -> None:
    """Print both parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=200)
    parser.add_argument("--workers", type=int, default=available_cores(None))
    parser.add_argument("--seconds", type=float, default=0.2, help="length of a cell of the second part")
    parser.add_argument("--cpu", action="store_true", help="the first part in CPU time, for a machine that is busy")
    arguments = parser.parse_args()
    if arguments.cpu:
        by_cpu(arguments.cells)
        return
    print(f"load of the machine before: {os.getloadavg()[0]:.1f}")
    per_cell(arguments.cells)
    shares(arguments.cells, arguments.workers, arguments.seconds)


if __name__ == "__main__":
    main()

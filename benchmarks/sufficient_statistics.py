"""Sufficient statistics in one pass against forming the regressor: time and memory on one core.

The comparison forms 1,000,000 rows of 204 columns and takes their QR decomposition, which needs about 6 GB; use
`--samples 100000` where there is less.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA")}
ROUTES = ("pass", "multiply", "qr")
NA, NB, CELLS = 2, 10, 20


def record(samples: int):
    """A second-order system behind a dead zone, driven by uniform noise."""
    import numpy as np
    from scipy.signal import lfilter

    import optid

    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, samples)
    m = np.sign(u) * np.maximum(np.abs(u) - 0.2, 0)
    y = lfilter([16 / 15, 0.8], [1, -1.5, 0.7], m) + lfilter([1], [1, -1.5, 0.7], 0.1 * rng.standard_normal(samples))
    return optid.Data(u=u, y=y)


def formed(data, layout):
    """[Phi | Y] as one array."""
    import numpy as np

    (experiment,) = data.experiments
    y, first, count = experiment.y[:, 0], layout.first_row, len(experiment.y) - layout.first_row
    rows = np.empty((count, layout.n_columns + 1))
    for i in range(1, layout.na + 1):
        rows[:, i - 1] = -y[first - i : first - i + count]
    values, block = layout.bases[0].values(experiment.u[:, 0]), layout.block(0)
    for lag in range(layout.nb[0]):
        start = block.start + lag * layout.bases[0].size
        rows[:, start : start + layout.bases[0].size] = values[first - lag : first - lag + count]
    rows[:, -2:] = np.column_stack([np.ones(count), y[first:]])
    return rows


def peak_above(work: Callable[[], object]) -> float:
    """Largest resident memory while `work` runs above that before it, in MB."""
    status, page = Path("/proc/self/statm"), os.sysconf("SC_PAGE_SIZE")
    resident = lambda: int(status.read_text().split()[1]) * page / 1e6  # noqa: E731
    before, peak, done = resident(), 0.0, threading.Event()

    def watch() -> None:
        nonlocal peak
        while not done.wait(0.001):
            peak = max(peak, resident())

    watcher = threading.Thread(target=watch)
    watcher.start()
    work()
    done.set()
    watcher.join()
    return max(peak, resident()) - before


def measure(route: str, samples: int) -> dict[str, float]:
    """Time one route in this process, pinned to one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import numpy as np

    import optid
    from optid.statistics import Layout, collect

    data = record(samples)
    basis = optid.Triangular(CELLS).with_interval(-1, 1)
    layout = Layout(na=NA, nb=(NB,), nk=(0,), bases=(basis,), outputs=data.outputs, inputs=data.inputs)
    n = layout.n_columns
    root = None

    def work() -> None:
        nonlocal root
        if route == "pass":
            root = collect(data, layout).root
        elif route == "multiply":
            rows = formed(data, layout)
            root = np.linalg.cholesky(rows.T @ rows).T
        else:
            root = np.linalg.qr(formed(data, layout), mode="r")

    collect(record(5000), layout)  # compiles, or loads what was compiled
    megabytes, times = peak_above(work), []
    for _ in range(7 if route == "pass" else 1):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    theta = np.linalg.solve(root[:n, :n], root[:n, n])
    norm = float(np.linalg.norm(theta[NA:-1]))
    return {"seconds": statistics.median(times), "MB": megabytes, "a1": theta[0], "Theta": norm}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--route", choices=ROUTES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.route:
        print(json.dumps(measure(arguments.route, arguments.samples)))
        return
    found = {}
    for route in ROUTES:
        command = [sys.executable, __file__, "--samples", str(arguments.samples), "--route", route]
        run = subprocess.run(command, env=os.environ | ONE_THREAD, check=True, capture_output=True, text=True)
        found[route] = json.loads(run.stdout)
    fast = found["pass"]
    print(f"{arguments.samples:,} samples, {CELLS + 1} hats, {NB} input and {NA} output lags, one core, compiled")
    print(f"one pass               {1e3 * fast['seconds']:9.1f} ms, {fast['MB']:6.0f} MB above the data")
    for route, words in (("multiply", "form Phi and multiply"), ("qr", "form Phi, QR")):
        slow = found[route]
        ratio = slow["seconds"] / fast["seconds"]
        apart = max(abs(slow[key] / fast[key] - 1) for key in ("a1", "Theta"))
        print(f"{words:22} {1e3 * slow['seconds']:9.1f} ms, {slow['MB']:6.0f} MB, {ratio:.0f} times as long,", end=" ")
        print(f"estimates equal to {apart:.0e}")


if __name__ == "__main__":
    main()

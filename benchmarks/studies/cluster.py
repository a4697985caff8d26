"""One machine against a Dask cluster of several processes: rows of a study, and statistics of one large fit.

Rows: a study of the equation-error formulations with several back ends on a simulated system runs once with the local
workers and once on a LocalCluster whose Dask workers are killed (SIGKILL) at random moments; both write a database of
their own. Printed: cells, rows in each database, kills, and the columns that differ in any row, times, memory and start
aside. Goal: every cell exactly once, no difference.

Statistics: a record of two experiments with missing samples is written as folders of Parquet files. The same fit is
made from the arrays in memory, from the folders read here, and from the folders read by the workers of the cluster,
of which one is killed while they read. Printed: the largest difference of a Gram matrix from the one in memory,
relative to the norms of its two columns, that of the coefficients, and whether cluster and this machine agree to the
last digit on the same parts; wall times. Goal: 1e-12. Workers share this machine: the wall time is no figure of a
cluster.
"""

import argparse
import os
import random
import signal
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

import optid
from optid.models.layout import Layout
from optid.statistics.regression import collect
from optid.studies import Study
from optid.studies.execution import running
from optid.studies.storage import store
from optid.studies.storage.rows import BY_NAME, NAMES

BASIS = "triangular:6"
FORMULATIONS = {
    "exact": ("hammerstein_arx.exact", {"na": 2, "nb": 2, "basis": BASIS}, ()),
    "exact, monotone": ("hammerstein_arx.exact", {"na": 2, "nb": 2, "basis": BASIS}, ("monotone:increasing",)),
    "nuclear": ("hammerstein_arx.nuclear", {"na": 2, "nb": 2, "basis": BASIS, "weight": 0.1}, ()),
    "overparametrised": ("hammerstein_arx.overparametrised", {"na": 2, "nb": 2, "basis": BASIS}, ()),
    "linear": ("arx", {"na": 2, "nb": 2}, ()),
}
SOLVERS = ("gauss_newton", "ipopt", "clarabel", "scs", "osqp")
APART = {"started"}  # with every column in seconds or megabytes


class Killer:
    """Kills a Dask worker at random moments while it is in use."""

    def __init__(self, client: Any, pauses: tuple[float, float], most: int) -> None:
        self._client, self._pauses, self._most = client, pauses, most
        self._stop = threading.Event()
        self.kills = 0
        self._thread = threading.Thread(target=self._work)

    def __enter__(self) -> "Killer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _work(self) -> None:
        rng = random.Random(0)
        while self.kills < self._most and not self._stop.wait(rng.uniform(*self._pauses)):
            workers = self._client.run(os.getpid, on_error="ignore")
            if workers:
                os.kill(rng.choice(sorted(workers.values())), signal.SIGKILL)
                self.kills += 1


def rows_of(study: Study, db: Path, **settings: Any) -> dict[tuple[str, int], dict[str, Any]]:
    running.run(study, db, **settings)
    rows = store.read_rows(db)
    table = [dict(zip(rows, values)) for values in zip(*rows.values())]
    found = {(str(row["key"]), int(row["repetition"])): row for row in table}
    assert len(found) == len(table), "a cell has two rows"
    return found


def different(here: dict[str, Any], there: dict[str, Any]) -> set[str]:
    measured = {name for name in NAMES if BY_NAME[name].unit in ("s", "MB")} - {"time_limit", "memory_limit"}
    return {name for name in NAMES if name not in measured | APART
            and not (here[name] == there[name] or (here[name] != here[name] and there[name] != there[name]))}


def compare_rows(client: Any, seeds: int, folder: Path) -> bool:
    study = Study(
        name="one machine against a cluster", seeds=tuple(range(seeds)), time_limit=120.0,
        data={"system": "dead_zone", "samples": [200, 400], "noise": 0.1}, solvers=SOLVERS,
        formulations={label: {"formulation": name, "constraints": rules, **options}
                      for label, (name, options, rules) in FORMULATIONS.items()})
    clock = time.perf_counter()
    here = rows_of(study, folder / "here.sqlite")
    between = time.perf_counter()
    with Killer(client, (8.0, 15.0), most=6) as killer:
        there = rows_of(study, folder / "there.sqlite", executor=client.get_executor())
    end = time.perf_counter()
    outcomes = {word: sum(row["outcome"] == word for row in here.values())
                for word in sorted({str(row["outcome"]) for row in here.values()})}
    print(f"study       {len(here)} cells: {outcomes}")
    print(f"rows        here {len(here)} in {between - clock:.0f} s, cluster {len(there)} in {end - between:.0f} s "
          f"with {killer.kills} Dask workers killed; same cells: {set(here) == set(there)}")
    columns: dict[str, int] = {}
    for key in here:
        for name in different(here[key], there[key]):
            columns[name] = columns.get(name, 0) + 1
    print(f"columns that differ, times, memory and start aside: {columns or 'none'}   (goal: none)")
    return not columns and set(here) == set(there) and killer.kills > 0


def write_record(folder: Path, lengths: Sequence[int], files: int, missing: float) -> optid.Data:
    """Write one folder of Parquet files per experiment; return the record."""
    import pandas as pd

    rng, us, ys = np.random.default_rng(0), [], []
    for i, n in enumerate(lengths):
        u = rng.uniform(-1, 1, n)
        w = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0)
        y = lfilter([16 / 15, 0.8], [1, -1.5, 0.7], w) + lfilter([1.0], [1, -1.5, 0.7], 0.1 * rng.standard_normal(n))
        u[rng.random(n) < missing], y[rng.random(n) < missing] = np.nan, np.nan
        (folder / f"run{i}").mkdir()
        frame = pd.DataFrame({"u": u, "y": y})
        for k, part in enumerate(np.array_split(np.arange(n), files)):
            frame.iloc[part].to_parquet(folder / f"run{i}" / f"part.{k}.parquet", row_group_size=1 << 18)
        us.append(u)
        ys.append(y)
    return optid.Data(u=us, y=ys, dt=0.1)


def compare_statistics(client: Any, samples: int, folder: Path) -> bool:
    data = write_record(folder, (samples * 2 // 3, samples // 3), files=12, missing=0.002)
    folders = [folder / "run0", folder / "run1"]
    structure = {"na": 2, "nb": 10, "basis": "triangular:10"}
    sources = {"in memory": lambda: data, "parts here": lambda: optid.open_stream(folders, dt=0.1),
               "parts on the cluster": lambda: optid.open_stream(folders, dt=0.1, scheduler=client)}
    fits, grams, seconds = {}, {}, {}
    killer = Killer(client, (0.5, 1.0), most=1)
    for word, source in sources.items():
        clock = time.perf_counter()
        with killer if word == "parts on the cluster" else nullcontext():
            fits[word] = optid.fit(source(), **structure)
        seconds[word] = time.perf_counter() - clock
    # in raw units: a fit scales a stream by what it has seen of it
    layout = Layout(2, (10,), (0,), (fits["in memory"].model.nonlinearities[0].basis,), data.outputs, data.inputs)
    for word, source in sources.items():
        grams[word] = collect(source(), layout).gram
    print(f"\nfit         {samples} samples in 2 experiments, {fits['in memory'].figures['rows']} rows used, "
          f"{fits['in memory'].figures['condition']:.1f} condition; {killer.kills} Dask worker killed")
    whole = grams["in memory"]
    norms, worst = np.sqrt(np.diag(whole)), 0.0
    for word, fit in fits.items():
        off = np.abs((grams[word] - whole) / norms[:, None] / norms).max()
        wanted, worst = fits["in memory"].model, max(worst, off)
        theta = max(np.abs(fit.model.a - wanted.a).max(), np.abs(fit.model.b[0] - wanted.b[0]).max())
        print(f"{word:22s} Gram matrix off by {off:.1e}, coefficients by {theta:.1e}, {seconds[word]:.1f} s"
              + "   (goal: 1e-12)" * (word != "in memory"))
    here, there = grams["parts here"], grams["parts on the cluster"]
    same = np.array_equal(here, there)
    print(f"cluster and this machine on the same parts, every digit the same: {same}")
    return same and worst <= 1e-12 and killer.kills > 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--samples", type=int, default=6_000_000)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    import dask
    from distributed import Client, LocalCluster

    with (tempfile.TemporaryDirectory() as scratch,
          dask.config.set({"distributed.deploy.lost-worker-timeout": "600s"}),  # killed ones come back however slowly
          LocalCluster(n_workers=given.workers, threads_per_worker=1, dashboard_address=":0",
                       silence_logs=50) as cluster,
          Client(cluster, set_as_default=False) as client):
        for name in ("study", "record"):
            (Path(scratch) / name).mkdir()
        good = compare_rows(client, given.seeds, Path(scratch) / "study")
        client.wait_for_workers(given.workers)
        good = compare_statistics(client, given.samples, Path(scratch) / "record") and good
    raise SystemExit(not good)


if __name__ == "__main__":
    main()

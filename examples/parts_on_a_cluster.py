"""A record in parts, folders of Parquet files, fitted here and by the workers of a Dask cluster: the same digits.

The cluster here is two processes of this machine; for a real one give its address, `scheduler="tcp://host:8786"`, and
put the files where every worker sees them under the same path. `open_stream` takes Dask data frames and arrays as well.
"""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from distributed import Client, LocalCluster
from scipy.signal import lfilter

import optid

SAMPLES, FILES = 200_000, 8


def write(folder: Path, seed: int) -> Path:
    """Write one experiment as files that follow one another: u, y of a dead zone before second-order dynamics."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, SAMPLES)
    w = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0.0)
    y = lfilter([16 / 15, 0.8], [1.0, -1.5, 0.7], w) + lfilter([0.1], [1.0, -1.5, 0.7], rng.standard_normal(SAMPLES))
    y[rng.random(SAMPLES) < 0.01] = np.nan
    frame = pd.DataFrame({"t": 0.1 * np.arange(SAMPLES), "u": u, "y": y})
    folder.mkdir()
    for k, rows in enumerate(np.array_split(np.arange(SAMPLES), FILES)):
        frame.iloc[rows].to_parquet(folder / f"part.{k}.parquet")
    return folder


def main() -> dict[str, float]:
    """Return a of the fit on the cluster, the rows it used, and its largest difference from the fit here."""
    structure = {"na": 2, "nb": 2, "basis": "triangular:8"}
    with tempfile.TemporaryDirectory() as scratch:
        folders = [write(Path(scratch) / f"run{i}", seed=i) for i in range(2)]  # two experiments
        here = optid.fit(optid.open_stream(folders), **structure)
        with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as two, Client(two) as client:
            there = optid.fit(optid.open_stream(folders, scheduler=client), **structure)
    print(there.model)
    difference = float(np.abs(there.model.a - here.model.a).max())
    print(f"{there.figures['rows']} rows; difference from the fit here: {difference:g}")
    return {"a1": there.model.a[0], "a2": there.model.a[1], "rows": there.figures["rows"], "difference": difference}


if __name__ == "__main__":
    main()

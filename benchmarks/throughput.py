"""Statistics of a record larger than memory, from npy and Parquet files: samples per second and resident memory.

The record is written to a temporary folder first: 100,000,000 samples of two float32 channels take 0.8 GB as npy and
about as much as Parquet. Every measurement runs in a process of its own, pinned to one core, once with the file in the
page cache and once from the disk.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

NA = 2
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "NUMBA", "ARROW")}
PIECE = 1_000_000


def pieces(samples: int) -> Iterator[np.ndarray]:
    """Yield (n, 2) float32 pieces of u and y: a second-order system behind a dead zone, driven by uniform noise."""
    from scipy.signal import lfilter

    rng, states = np.random.default_rng(0), (np.zeros(2), np.zeros(2))
    for start in range(0, samples, PIECE):
        count = min(PIECE, samples - start)
        u = rng.uniform(-1, 1, count)
        m = np.sign(u) * np.maximum(np.abs(u) - 0.2, 0)
        y, first = lfilter([16 / 15, 0.8], [1, -1.5, 0.7], m, zi=states[0])
        v, second = lfilter([1.0], [1, -1.5, 0.7], 0.1 * rng.standard_normal(count), zi=states[1])
        states = (first, second)
        yield np.column_stack([u, y + v]).astype(np.float32)


def write(folder: Path, samples: int) -> tuple[Path, Path]:
    """Write the record as npy, (samples, 2), and as Parquet, columns u and y."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    npy, parquet = folder / "record.npy", folder / "record.parquet"
    schema = pa.schema([("u", pa.float32()), ("y", pa.float32())])
    with open(npy, "wb") as file, pq.ParquetWriter(parquet, schema, use_dictionary=False) as table:
        header = {"descr": "<f4", "fortran_order": False, "shape": (samples, 2)}
        np.lib.format.write_array_header_1_0(file, header)
        for piece in pieces(samples):
            piece.tofile(file)
            table.write_table(pa.table({"u": piece[:, 0], "y": piece[:, 1]}, schema=schema))
    return npy, parquet


def measure(path: Path, work: str, cells: int, lags: int) -> dict[str, float]:
    """Read the record, or take its statistics, in this process and on one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import optid
    from optid.regressors import Layout, collect

    names = ["u", "y"] if path.suffix == ".npy" else None
    stream = optid.open_stream(path, inputs=["u"], outputs=["y"], columns=names)
    basis = optid.Triangular(cells).fitted(-1, 1)
    layout = Layout(na=NA, nb=(lags,), nk=(0,), bases=(basis,), outputs=stream.outputs, inputs=stream.inputs)
    rng = np.random.default_rng(0)
    collect(optid.Data(u=rng.uniform(-1, 1, 5000), y=rng.standard_normal(5000)), layout)  # compiles
    start, samples, error = time.perf_counter(), 0, float("nan")
    if work == "read":
        for u, _ in stream:
            samples += len(u)
    else:
        statistics = collect(stream, layout)
        samples, n = statistics.rows + layout.first_row, layout.n_columns
        theta = np.linalg.solve(statistics.root[:n, :n], statistics.root[:n, n])
        error = float(np.max(np.abs(theta[:NA] - [-1.5, 0.7])))
    seconds = time.perf_counter() - start
    resident = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"samples": samples, "seconds": seconds, "MB": resident, "error": error}


def compare(path: Path, place: str, cells: int, lags: int) -> None:
    """Print how long the statistics take, and how long just reading takes."""
    found = {}
    for work in ("read", "statistics"):
        with open(path, "rb") as file:
            os.fsync(file)
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
            while place == "cache" and file.read(1 << 24):
                pass
        sizes = ["--cells", str(cells), "--lags", str(lags)]
        command = [sys.executable, __file__, *sizes, "--measure", str(path), work]
        run = subprocess.run(command, env=os.environ | ONE_THREAD, check=True, stdout=subprocess.PIPE, text=True)
        found[work] = json.loads(run.stdout)
    reading, passed = found["read"], found["statistics"]
    print(
        f"{path.suffix[1:]:7} from {place:5} {passed['samples'] / passed['seconds'] / 1e6:5.1f} million samples/s, "
        f"{passed['seconds']:5.2f} s, just reading {reading['seconds']:5.2f} s "
        f"({passed['seconds'] / reading['seconds']:.1f} times), {passed['MB']:.0f} MB resident, "
        f"error of a {passed['error']:.0e}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=100_000_000)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--lags", type=int, default=10)
    parser.add_argument("--folder", type=Path, help="where the temporary folder is made")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        path, work = arguments.measure
        print(json.dumps(measure(Path(path), work, arguments.cells, arguments.lags)))
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        needed = 20 * arguments.samples
        if shutil.disk_usage(folder).free < needed:
            sys.exit(f"{folder} has less than {needed / 1e9:.1f} GB free: use --folder or fewer --samples.")
        sizes = f"{arguments.cells + 1} hats, {arguments.lags} input and {NA} output lags"
        print(f"{arguments.samples:,} samples, {sizes}, one core", flush=True)
        for path in write(Path(folder), arguments.samples):
            for place in ("disk", "cache"):
                compare(path, place, arguments.cells, arguments.lags)


if __name__ == "__main__":
    main()

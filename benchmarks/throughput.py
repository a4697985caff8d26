"""Statistics of a record larger than memory, from npy and Parquet files: samples per second and resident memory.

The record is written to a temporary folder first, 100,000,000 samples of two channels: as npy (float32, 0.8 GB), and as
Parquet the way common tools write their numbers (float64; Snappy is the default of pandas, Zstandard that of polars,
1.6 GB each), and as the file that is cheapest to read (float32, no dictionary). Every measurement runs in a process of
its own, with the file on the disk and in the page cache, pinned to one core and with a thread for every core. Just
reading is measured in the same way: the same columns in chunks of float64, checked, and as the library of the format
hands them out. The three take turns, the median of the rounds is printed, and before every measurement from the disk
the system is asked whether a page of the file is still in its cache (a virtual machine cannot ask its host). CPU time
counts all threads, and is the figure to trust on a machine that others use too.

The goals: at least 15 million samples/s on one core from cached npy, less than 500 MB resident, and statistics from
Parquet on disk in at most twice the time of just reading it.
"""

import argparse
import ctypes
import json
import mmap
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

NA = 2
READ = 131_072
LIBRARIES = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "MKL", "NUMBA")}
PIECE = 1_000_000


def pieces(samples: int) -> Iterator[np.ndarray]:
    """Yield (n, 2) pieces of u and y: a second-order system behind a dead zone, driven by uniform noise."""
    from scipy.signal import lfilter

    rng, states = np.random.default_rng(0), (np.zeros(2), np.zeros(2))
    for start in range(0, samples, PIECE):
        count = min(PIECE, samples - start)
        u = rng.uniform(-1, 1, count)
        m = np.sign(u) * np.maximum(np.abs(u) - 0.2, 0)
        y, first = lfilter([16 / 15, 0.8], [1, -1.5, 0.7], m, zi=states[0])
        v, second = lfilter([1.0], [1, -1.5, 0.7], 0.1 * rng.standard_normal(count), zi=states[1])
        states = (first, second)
        yield np.column_stack([u, y + v])


FORMS: dict[str, dict[str, Any]] = {
    "npy": {},
    "parquet-snappy": {"type": "double", "compression": "snappy"},
    "parquet-zstd": {"type": "double", "compression": "zstd"},
    "parquet-float32": {"type": "float", "compression": "snappy", "use_dictionary": False},
}
"""How a record is stored, with what pyarrow is told where it is not left to its defaults."""


def write(folder: Path, samples: int, form: str) -> Path:
    """Write the record as npy, (samples, 2), or as Parquet, columns u and y."""
    if form == "npy":
        path = folder / "record.npy"
        with open(path, "wb") as file:
            header = {"descr": "<f4", "fortran_order": False, "shape": (samples, 2)}
            np.lib.format.write_array_header_1_0(file, header)
            for piece in pieces(samples):
                piece.astype(np.float32).tofile(file)
        return path
    import pyarrow as pa
    import pyarrow.parquet as pq

    path, settings = folder / "record.parquet", dict(FORMS[form])
    schema = pa.schema([(name, settings["type"]) for name in ("u", "y")])
    settings.pop("type")
    with pq.ParquetWriter(path, schema, **settings) as table:
        for piece in pieces(samples):
            columns = {name: pa.array(column).cast(schema.field(name).type) for name, column in zip("uy", piece.T)}
            table.write_table(pa.table(columns, schema=schema))
    return path


def read_stored(path: Path) -> int:
    """Read the file with the library of its format alone, in the stored type; return the number of samples."""
    samples = 0
    if path.suffix == ".npy":
        with open(path, "rb", buffering=0) as file:
            while (count := np.fromfile(file, np.float32, 2 * READ).size) > 0:
                samples += count // 2
        return samples
    import pyarrow.parquet as pq

    with pq.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False) as file:
        for batch in file.iter_batches(READ, columns=["u", "y"]):
            samples += len(batch)
    return samples


def measure(path: Path, work: str, threads: int, cells: int, lags: int) -> dict[str, float]:
    """Read the record, or take its statistics, in this process."""
    if threads == 1:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import optid
    from optid.statistics import Layout, collect

    names = ["u", "y"] if path.suffix == ".npy" else None
    stream = optid.open_stream(path, inputs=["u"], outputs=["y"], columns=names)
    basis = optid.Triangular(cells).with_interval(-1, 1)
    layout = Layout(na=NA, nb=(lags,), nk=(0,), bases=(basis,), outputs=stream.outputs, inputs=stream.inputs)
    rng = np.random.default_rng(0)
    collect(optid.Data(u=rng.uniform(-1, 1, 50_000), y=rng.standard_normal(50_000)), layout)  # compiles
    start, error = (time.perf_counter(), time.process_time()), float("nan")
    if work == "stored":
        read_stored(path)
    elif work == "stream":
        for _chunk in stream:
            pass
    else:
        root, n = collect(stream, layout, threads=threads).root, layout.n_columns
        error = float(np.max(np.abs(np.linalg.solve(root[:n, :n], root[:n, n])[:NA] - [-1.5, 0.7])))
    taken = {"seconds": time.perf_counter() - start[0], "cpu": time.process_time() - start[1]}
    return taken | {"MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, "error": error}


def resident(path: Path) -> float:
    """Return the share of the file's pages that the system holds in memory, as mincore tells it."""
    with open(path, "r+b") as file, mmap.mmap(file.fileno(), 0) as mapped:
        pages = (ctypes.c_ubyte * -(-len(mapped) // mmap.PAGESIZE))()
        first = ctypes.c_char.from_buffer(mapped)
        try:
            system = ctypes.CDLL(None, use_errno=True)
            if system.mincore(ctypes.c_void_p(ctypes.addressof(first)), ctypes.c_size_t(len(mapped)), pages):
                raise OSError(ctypes.get_errno(), "mincore failed")
        finally:
            del first
    return float(np.mean(np.frombuffer(pages, np.uint8) & 1))


def place_file(path: Path, place: str) -> None:
    """Bring the file into the page cache or out of it."""
    with open(path, "rb") as file:
        os.fsync(file)
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        while place == "cache" and file.read(1 << 24):
            pass
    share = resident(path)
    if share != (place == "cache"):
        sys.exit(f"{share:.1%} of {path} is in the page cache: nothing can be said of reading it from the {place}.")


def compare(path: Path, form: str, place: str, threads: int, arguments: argparse.Namespace) -> None:
    """Print how long the statistics take, and how long just reading takes."""
    works = ("stored", "stream", "statistics")
    limits = LIBRARIES | {"OMP_NUM_THREADS": str(threads)}  # the latter also counts for pyarrow
    sizes = ["--cells", str(arguments.cells), "--lags", str(arguments.lags)]
    rounds: dict[str, list[dict[str, float]]] = {work: [] for work in works}
    for _ in range(arguments.rounds):
        for work in works:
            place_file(path, place)
            command = [sys.executable, __file__, *sizes, "--measure", str(path), work, str(threads)]
            run = subprocess.run(command, env=os.environ | limits, check=True, stdout=subprocess.PIPE, text=True)
            rounds[work].append(json.loads(run.stdout))
    found = {
        work: {key: float(np.median([one[key] for one in runs])) for key in runs[0]} for work, runs in rounds.items()
    }
    passed, scale = found["statistics"], 1e9 / arguments.samples
    print(
        f"{form:15} {place:5} {threads} thread{'s' if threads > 1 else ' '} "
        f"{arguments.samples / passed['seconds'] / 1e6:5.1f} million samples/s, {passed['MB']:.0f} MB resident, "
        f"error of a {passed['error']:.0e}"
    )
    for work, words in (("statistics", "statistics"), ("stream", "just reading chunks"), ("stored", "as stored")):
        wall, cpu = (scale * found[work][clock] for clock in ("seconds", "cpu"))
        ratios = [one["seconds"] / other["seconds"] for one, other in zip(rounds["statistics"], rounds[work])]
        spread = f", ratio {np.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})"
        print(
            f"    {words:20} {wall:6.1f} ns a sample, {cpu:6.1f} ns of CPU{spread if work != 'statistics' else ''}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=100_000_000)
    parser.add_argument("--cells", type=int, default=20)
    parser.add_argument("--lags", type=int, default=10)
    parser.add_argument("--forms", nargs="+", choices=FORMS, default=list(FORMS))
    parser.add_argument("--folder", type=Path, help="where the temporary folder is made")
    parser.add_argument("--places", nargs="+", choices=("disk", "cache"), default=["disk", "cache"])
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each kind, taken in turns")
    parser.add_argument("--measure", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        path, work, threads = arguments.measure
        print(json.dumps(measure(Path(path), work, int(threads), arguments.cells, arguments.lags)))
        return
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        needed = 20 * arguments.samples
        if shutil.disk_usage(folder).free < needed:
            sys.exit(f"{folder} has less than {needed / 1e9:.1f} GB free: use --folder or fewer --samples.")
        sizes = f"{arguments.cells + 1} hats, {arguments.lags} input and {NA} output lags"
        print(f"{arguments.samples:,} samples, {sizes}, one core", flush=True)
        for form in arguments.forms:
            path = write(Path(folder), arguments.samples, form)
            for place in arguments.places:
                for threads in sorted({1, len(os.sched_getaffinity(0))}):
                    compare(path, form, place, threads, arguments)
            path.unlink()


if __name__ == "__main__":
    main()

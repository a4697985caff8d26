"""A table of 53 MB with dates, read by optid and by pandas: seconds and memory.

Each reader runs in a process of its own, in turns; the first reading of the process counts, without imports. pandas is
told to parse the dates; optid also checks every cell and the clock. CPU time counts all threads.

    python benchmarks/reading.py [--rounds 5]
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROWS = 1_250_000
STAMPS = {"ISO dates": "s", "ISO dates with milliseconds": "ms", "seconds": ""}

READERS = {
    "pandas": "import pandas\nread = lambda p, dates: pandas.read_csv(p, parse_dates=['time'] if dates else None)",
    "optid": "import optid, polars\nfrom optid.data import readers\nread = lambda p, dates: optid.read(p)",
}

RUN = """
import json, re, sys, time
{reader}
peak = lambda: int(re.search(r"VmHWM:\s+(\d+)", open("/proc/self/status").read())[1]) / 1024  # of Linux
held = peak()
wall, cpu = time.perf_counter(), time.process_time()
read(sys.argv[1], sys.argv[2] == "True")
print(json.dumps([time.perf_counter() - wall, time.process_time() - cpu, peak() - held]))
"""


def write(path: Path, unit: str) -> None:
    """Write a table of a clock, u and y."""
    r = np.random.default_rng(0)
    u, y = r.normal(size=(2, ROWS)).round(8).astype(str)
    if unit:
        start = np.datetime64("2024-05-01T06:00:00", unit)
        stamps = (start + np.arange(ROWS) * np.timedelta64(1000 if unit == "s" else 125, unit)).astype(str)
    else:
        stamps = (0.125 * np.arange(ROWS)).astype(str)
    path.write_text("time,u,y\n" + "\n".join(map(",".join, zip(stamps.tolist(), u.tolist(), y.tolist()))) + "\n")


def main() -> None:
    """Print the medians of the rounds and their ratios."""
    rounds = argparse.ArgumentParser(description=__doc__)
    rounds.add_argument("--rounds", type=int, default=5)
    count = rounds.parse_args().rounds
    print(f"{'clock':<28} {'MB':>4}  {'reader':<7} {'wall s':>7} {'CPU s':>7} {'memory MB':>10}   ratios of the three")
    with tempfile.TemporaryDirectory() as folder:
        for name, unit in STAMPS.items():
            path = Path(folder) / "record.csv"
            write(path, unit)
            found: dict[str, list[list[float]]] = {reader: [] for reader in READERS}
            for _ in range(count):
                for reader, code in READERS.items():
                    shown = subprocess.run([sys.executable, "-c", RUN.format(reader=code), str(path), str(bool(unit))],
                                           check=True, capture_output=True, text=True)
                    found[reader].append(json.loads(shown.stdout))
            medians = {reader: [statistics.median(one) for one in zip(*runs)] for reader, runs in found.items()}
            for reader, (wall, cpu, memory) in medians.items():
                ratios = [a / b for a, b in zip(medians[reader], medians["pandas"])]
                size = path.stat().st_size / 1e6
                print(f"{name:<28} {size:>4.0f}  {reader:<7} {wall:>7.2f} {cpu:>7.2f} {memory:>10.0f}"
                      + (f"   {ratios[0]:.2f} {ratios[1]:.2f} {ratios[2]:.2f}" if reader != "pandas" else ""))


if __name__ == "__main__":
    main()

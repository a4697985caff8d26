"""kill -9 at ten random moments of a 300-cell study, then resume.

    python benchmarks/studies/kill.py [--kills 10] [--seed 0] [--workers 2]

The command `optid study run` is started and killed (SIGKILL) after a random number of new rows and a random moment
more, ten times; then it runs to its end. Printed for every kill: rows as they were left, how many of them are in the
journal beside the database, and whether the database could be read. At the end every cell must have exactly one row,
every row of before a kill must still be the same one (nothing is computed again), and no worker may live on.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from optid.studies.definition.description import Study
from optid.studies.grid import cells
from optid.studies.storage import journal
from optid.studies.storage.database import finished, read_rows

STUDY = """
name = "three hundred cells"
seeds = 50
solvers = ["gauss_newton", "ipopt", "uno"]
[[data]]
name = "dead zone"
system = "dead_zone"
samples = [200]
noise = [0.1, 0.3]
[[formulation]]
name = "exact"
formulation = "hammerstein_arx.exact"
na = 2
nb = 2
basis = "triangular:6"
"""


def moments(db: Path) -> dict[tuple[str, int], np.datetime64]:
    """When each row of the database was started."""
    if not db.exists():
        return {}
    rows = read_rows(db)
    found = dict(zip(zip(rows["key"], rows["repetition"].tolist()), rows["started"]))
    if len(found) != len(rows["key"]):
        raise SystemExit("a cell has two rows")
    return found


def waiting(db: Path) -> set[tuple[str, int]]:
    """Rows that are in the journal."""
    return {(row["key"], row["repetition"]) for row in journal.kept(db)}


def until_new_rows(process: subprocess.Popen, db: Path, number: int, limit: float = 300.0) -> None:
    """Wait until the process has written so many rows more."""
    before = len(finished(db) | waiting(db))
    until = time.monotonic() + limit
    while process.poll() is None and time.monotonic() < until:
        if len(finished(db) | waiting(db)) - before >= number:
            return
        time.sleep(0.02)


def family(process: subprocess.Popen) -> list[psutil.Process]:
    """Its children, the workers."""
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def main() -> None:
    """Kill, look, kill again, resume, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        file, db = Path(folder) / "study.toml", Path(folder) / "study.duckdb"
        file.write_text(STUDY)
        total = len(cells(Study.from_toml(file)))
        command = [sys.executable, "-m", "optid", "study", "run", str(file), "--db", str(db), "--workers",
                   str(arguments.workers)]
        print(f"{total} cells; kill after so many new rows: rows, of which in the journal, readable")
        seen: dict = {}
        killed = 0
        for _ in range(arguments.kills):
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            number = int(rng.integers(0, 2 * total // (arguments.kills + 2)))
            until_new_rows(process, db, number)
            time.sleep(float(rng.uniform(0.0, 0.3)))
            children = family(process)
            alive = process.poll() is None
            process.kill()
            process.wait()
            killed += alive
            now = moments(db)  # raises where the database cannot be read
            same = all(now.get(identity) == moment for identity, moment in seen.items())
            print(f"  {number:>4}  {len(now):>4}  {len(waiting(db)):>3}  yes{'' if same else '  ROWS CHANGED'}"
                  f"{'' if alive else '  (it had ended)'}")
            seen |= now
            _, living = psutil.wait_procs(children, timeout=10.0)
            if living or not same:
                raise SystemExit(f"workers that live on: {living}" if living else "rows changed")
        clock = time.monotonic()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        rest = moments(db)
        same = all(rest.get(identity) == moment for identity, moment in seen.items())
        wanted = {(cell.key, cell.repetition) for cell in cells(Study.from_toml(file))}
        print(f"resumed to the end in {time.monotonic() - clock:.1f} s; journal left: {len(waiting(db))} rows")
        print(f"{killed} kills; cells {len(wanted)}, rows {len(rest)}, every cell exactly once: {set(rest) == wanted}, "
              f"no row computed again: {same} (goal: both)")
        if set(rest) != wanted or not same or killed < arguments.kills:
            raise SystemExit(1)


if __name__ == "__main__":
    main()

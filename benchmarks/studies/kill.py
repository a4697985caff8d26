"""kill -9 at random moments of a 600-cell study, also inside a write, then resume; other ends of a run.

    python benchmarks/studies/kill.py [--kills 20] [--seed 0] [--workers 2]

The command `optid study run` is started and killed (SIGKILL) after a random number of new rows and a random moment
more, which for every second kill is the moment a write begins (the file of pending writes changes); then it runs to its
end. Printed for every kill: rows as they were left, and whether the database could be read. At the end every cell must
have exactly one row, every row of before a kill must still be the same one (nothing is computed again), and no worker
may live on. Then the study is stopped by SIGTERM and SIGINT, runs on a full disk (a small tmpfs where this process may
mount one, else a limit of the file size), and is reported from a folder that cannot be written; each must leave a
database that the next run completes.
"""

import argparse
import importlib.metadata
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from optid.studies.execution.machine import machine
from optid.studies.grid import cells
from optid.studies.storage.store import read_rows
from optid.studies.study import Study

STUDY = """
name = "six hundred cells"
seeds = 100
solvers = ["gauss_newton", "ipopt", "uno"]
[[data]]
name = "dead zone"
system = "dead_zone"
samples = [10000]
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


def until_new_rows(process: subprocess.Popen, db: Path, number: int, limit: float = 300.0) -> None:
    """Wait until the process has written so many rows more."""
    before = len(moments(db))
    until = time.monotonic() + limit
    while process.poll() is None and time.monotonic() < until:
        if len(moments(db)) - before >= number:
            return
        time.sleep(0.02)


def family(process: subprocess.Popen) -> list[psutil.Process]:
    """Its children, the workers."""
    try:
        return psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return []


def until_a_write(process: subprocess.Popen, db: Path, limit: float = 30.0) -> None:
    """Wait until the file of pending writes changes."""
    pending = db.with_name(db.name + "-wal")

    def changed() -> int:
        try:
            return pending.stat().st_mtime_ns
        except OSError:
            return 0

    before, until = changed(), time.monotonic() + limit
    while changed() == before and process.poll() is None and time.monotonic() < until:
        pass


def main() -> None:
    """Kill, look, kill again, resume, and judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("optid", "numpy"))
    print(f"{machine()}; {versions}")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "study.toml"
        file.write_text(STUDY)
        wanted = {(cell.key, cell.repetition) for cell in cells(Study.from_toml(file))}
        good = killed(file, wanted, arguments.kills, arguments.workers, np.random.default_rng(arguments.seed))
        for name in ("SIGTERM", "SIGINT"):
            good &= stopped(file, wanted, getattr(signal, name), arguments.workers)
        good &= full_disk(file, wanted, arguments.workers)
        good &= read_only(file)
    raise SystemExit(not good)


def command(file: Path, db: Path, workers: int) -> list[str]:
    """The command that runs the study."""
    return [sys.executable, "-m", "optid", "study", "run", str(file), "--db", str(db), "--workers", str(workers)]


def started(file: Path, db: Path, workers: int) -> subprocess.Popen:
    """Start the command without its words."""
    return subprocess.Popen(command(file, db, workers), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def completed(name: str, file: Path, db: Path, workers: int, seen: dict, wanted: set) -> bool:
    """Resume to the end, and say whether every cell is there once and nothing was computed again."""
    clock = time.monotonic()
    subprocess.run(command(file, db, workers), check=True, stdout=subprocess.DEVNULL)
    rest = moments(db)
    same = all(rest.get(identity) == moment for identity, moment in seen.items())
    print(f"{name}: {len(seen)} rows kept, resumed to the end in {time.monotonic() - clock:.1f} s; "
          f"cells {len(wanted)}, rows {len(rest)}, each once: {set(rest) == wanted}, no row computed again: {same}")
    return set(rest) == wanted and same


def killed(file: Path, wanted: set, kills: int, workers: int, rng: np.random.Generator) -> bool:
    """Kill at random moments, and inside writes."""
    db, seen, done = file.with_name("killed.sqlite"), {}, 0
    print(f"{len(wanted)} cells; kill after so many new rows: rows, inside a write, readable")
    for attempt in range(kills):
        process = started(file, db, workers)
        number = int(rng.integers(0, len(wanted) // (kills + 5)))
        until_new_rows(process, db, number)
        inside = attempt % 2 == 1
        until_a_write(process, db) if inside else time.sleep(float(rng.uniform(0.0, 0.05)))
        children = family(process)
        alive = process.poll() is None
        process.kill()
        process.wait()
        done += alive
        now = moments(db)  # raises where the database cannot be read
        same = all(now.get(identity) == moment for identity, moment in seen.items())
        print(f"  {number:>4}  {len(now):>4}  {'yes' if inside else 'no':>3}  yes{'' if same else '  ROWS CHANGED'}"
              f"{'' if alive else '  (it had ended)'}")
        seen |= now
        _, living = psutil.wait_procs(children, timeout=10.0)
        if living or not same:
            raise SystemExit(f"workers that live on: {living}" if living else "rows changed")
    return completed(f"{done} kills", file, db, workers, seen, wanted) and done == kills


def stopped(file: Path, wanted: set, by: signal.Signals, workers: int) -> bool:
    """Stop the run by a signal after some rows."""
    db = file.with_name(f"{by.name}.sqlite")
    process = started(file, db, workers)
    until_new_rows(process, db, 40)
    children = family(process)
    process.send_signal(by)
    code = process.wait(60.0)
    _, living = psutil.wait_procs(children, timeout=10.0)
    return completed(f"{by.name} (exit code {code}, workers that live on: {len(living)})", file, db, workers,
                     moments(db), wanted) and not living


def full_disk(file: Path, wanted: set, workers: int) -> bool:
    """Run on a disk with room for some of the rows; then there is room."""
    disk = file.with_name("disk")
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], capture_output=True)
    try:
        def limit() -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))

        db = disk / "full.sqlite"
        done = subprocess.run(command(file, db, workers), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                              preexec_fn=limit if mounted.returncode else None)
        seen, roomy = moments(db), file.with_name("roomy.sqlite")
        print("full disk:", " ".join(done.stderr.replace("│", " ").split())[:300])
        for name in disk.glob("full.sqlite*"):  # the pending writes with it
            shutil.copyfile(name, roomy.with_name(name.name.replace("full", "roomy")))
        where = "a tmpfs of 1 MB" if mounted.returncode == 0 else "a limit of the file size"
        return completed(f"full disk ({where}, exit code {done.returncode})", file, roomy, workers, seen,
                         wanted) and 0 < len(seen) < len(wanted) and done.returncode != 0
    finally:
        if mounted.returncode == 0:
            subprocess.run(["umount", disk], check=True)


def read_only(file: Path) -> bool:
    """Report a complete database from a folder that cannot be written."""
    folder = file.with_name("read only")
    folder.mkdir()
    shutil.copyfile(file.with_name("killed.sqlite"), folder / "study.sqlite")
    program = ("import os, sys; from optid.studies.storage.store import read_rows; "
               "os.getuid() or os.setuid(65534); print(len(read_rows(sys.argv[1])['key']))")  # root may write anywhere
    folder.chmod(0o555)
    (folder / "study.sqlite").chmod(0o444)
    Path(file.parent).chmod(0o755)
    done = subprocess.run([sys.executable, "-c", program, str(folder / "study.sqlite")], capture_output=True, text=True)
    folder.chmod(0o755)
    print(f"read-only folder: {done.stdout.strip() or done.stderr.strip()[-200:]} rows read")
    return done.returncode == 0 and int(done.stdout) > 0


if __name__ == "__main__":
    main()

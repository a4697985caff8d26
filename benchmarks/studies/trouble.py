"""Workers killed, solvers that segfault, never end, eat memory, lie or raise: the study completes.

    python benchmarks/studies/trouble.py [--seeds 6] [--kills 4]

A small distribution with bad back ends is written to a temporary folder, where `optid study run` finds it as it finds
any third party's. While the study runs, workers are killed from outside as well. Printed is the table of outcomes by
solver with one reason each. Every cell must have a row, the good solvers theirs with a verified answer (but for the
kills from outside), and every bad solver the outcome it deserves.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import psutil

from optid.studies.storage.store import read_rows

SOLVERS = '''
"""Back ends that do not behave."""

import ctypes
import os
import sys
import time

import numpy as np

from optid.backends import Answer, BackEnd, find
from optid.program.solution import Status
from optid.core.least_squares import RankOneForm


def _segfaults(program, settings):
    ctypes.string_at(0)


def _aborts(program, settings):
    os.abort()


def _leaves(program, settings):
    sys.exit(7)


def _endless(program, settings):
    sum(iter(int, 1))  # never comes back from C


def _hungry(program, settings):
    held = []
    while True:
        held.append(np.ones(2_000_000))


def _nan(program, settings):
    return Answer(Status.OPTIMAL, "optimal", {k: v * np.nan for k, v in program.start.items()})


def _lies(program, settings):
    return Answer(Status.OPTIMAL, "optimal", {k: np.asarray(v, dtype=float) + 0.3 for k, v in program.start.items()})


def _raises(program, settings):
    raise RuntimeError("licence expired")


def _slow(program, settings):
    time.sleep(2.0)
    return find("gauss_newton").run(program, settings)


def _silent(program, settings):
    return Answer(Status.OPTIMAL, "optimal")


def family():
    return [BackEnd(name, frozenset(), globals()["_" + name], form="rank-one", takes=RankOneForm.of)
            for name in ("segfaults", "aborts", "leaves", "endless", "hungry", "nan", "lies", "raises", "silent",
                         "slow")]
'''

DESERVED = {"segfaults": "crashed", "aborts": "crashed", "leaves": "error", "endless": "time limit",
            "hungry": "memory limit", "nan": "non-finite", "lies": "done", "raises": "done", "silent": "done"}
GOOD = ("gauss_newton", "ipopt", "slow")

STUDY = """
name = "trouble"
seeds = {seeds}
time_limit = {limit}
memory_limit = 600
solvers = {solvers}
[[data]]
name = "dead zone"
system = "dead_zone"
samples = [200]
[[formulation]]
name = "exact"
formulation = "hammerstein_arx.exact"
na = 2
nb = 2
basis = "triangular:6"
"""


def distribution(folder: Path) -> None:
    """Write a distribution that registers the bad back ends, as an installer leaves it."""
    (folder / "trouble_solvers.py").write_text(SOLVERS)
    info = folder / "trouble_solvers-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: trouble-solvers\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[optid.backends]\ntrouble = trouble_solvers:family\n")


def kill_workers(process: subprocess.Popen, number: int, rng: np.random.Generator) -> int:
    """Kill so many workers from outside, one after another, while the study runs."""
    done = 0
    while done < number and process.poll() is None:
        time.sleep(float(rng.uniform(2.0, 8.0)))
        try:
            children = [child for child in psutil.Process(process.pid).children()
                        if time.time() - child.create_time() > 4.0]  # an older one rather has a cell in hand
            if children:
                children[int(rng.integers(len(children)))].kill()
                done += 1
        except psutil.NoSuchProcess:
            continue
    return done


def main() -> None:
    """Run the study, disturb it, and judge its rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--kills", type=int, default=4)
    parser.add_argument("--limit", type=float, default=15.0, help="seconds a cell may take")
    arguments = parser.parse_args()
    solvers = [*GOOD, *DESERVED]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        distribution(folder)
        file, db = folder / "study.toml", folder / "study.sqlite"
        file.write_text(STUDY.format(seeds=arguments.seeds, limit=arguments.limit, solvers=list(solvers)))
        path = os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH", "")]))
        clock = time.monotonic()
        process = subprocess.Popen([sys.executable, "-m", "optid", "study", "run", str(file), "--db", str(db)],
                                   env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.DEVNULL)
        kills = kill_workers(process, arguments.kills, np.random.default_rng(0))
        code = process.wait()
        rows = read_rows(db)
    print(f"exit code {code} after {time.monotonic() - clock:.0f} s; {kills} workers killed from outside")
    complaints = [] if code == 0 else [f"exit code {code}"]
    if len(rows["key"]) != len(solvers) * arguments.seeds:
        complaints.append(f"{len(rows['key'])} rows of {len(solvers) * arguments.seeds} cells")
    if kills < arguments.kills:
        complaints.append(f"only {kills} workers were killed")
    outside = np.array([text.endswith("signal SIGKILL") for text in rows["reason"]], dtype=bool)
    if outside.sum() > kills:
        complaints.append(f"{outside.sum()} rows were killed, {kills} from here")
    print(f"rows: {len(rows['key'])}, of which lost to the kills from outside: {outside.sum()}\n")
    print(f"{'solver':<14}{'outcomes':<34}{'verified':<22}false   a reason")
    for solver in solvers:
        mine = (rows["solver"] == solver) & ~outside
        outcomes, statuses = Counter(rows["outcome"][mine]), Counter(rows["status_verified"][mine])
        reasons = [text for text in rows["reason"][mine] if text]
        print(f"{solver:<14}{listed(outcomes):<34}{listed(statuses):<22}{int(rows['false_claim'][mine].sum()):<6}"
              f"  {(reasons or [''])[0][:90]}")
        wanted = DESERVED.get(solver, "done")
        if not mine.any():
            complaints.append(f"{solver}: no row left to judge")
        elif set(outcomes) - {wanted} or (solver in GOOD) != bool(rows["reached"][mine].all()):
            complaints.append(f"{solver}: {dict(outcomes)} instead of {wanted!r}")
        if any(not text for text in rows["reason"][(rows["solver"] == solver) & (rows["outcome"] != "done")]):
            complaints.append(f"{solver}: a row without its reason")
    print("\n" + ("; ".join(complaints) if complaints else "the study is complete, each is a row with its reason"))
    raise SystemExit(bool(complaints))


def listed(counts: Counter) -> str:
    """Counts as text."""
    return ", ".join(f"{count} {word}" for word, count in sorted(counts.items()) if word)


if __name__ == "__main__":
    main()

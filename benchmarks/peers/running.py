"""Run an entry over records in its interpreter, each fit with a time limit, and keep what came out."""

import hashlib
import json
import os
import selectors
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
               "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1", "MPLBACKEND": "Agg"}

WALL = 10.0
"""Wall seconds per CPU second of the limit: a backstop, for machines that are busy and for fits that wait."""


def digest(entry: Path, also: Sequence[Path] = ()) -> str:
    """Hash of everything a result depends on: the entry, what runs and judges it, the records, the code under test."""
    files = [entry, *(HERE / name for name in ("harness.py", "judging.py", "records.py")), *sorted(also)]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


def run(python: str, entry: Path, kind: str, paths: Sequence[Path], kept: Path, limit: float, budget: float
        ) -> dict[str, dict]:
    """Return what came of every record, from `kept` where it is there.

    Args:
        python: the interpreter.
        entry: the file of the peer.
        kind: the function in it.
        paths: the records.
        kept: JSON file of results so far; written after every record.
        limit: CPU seconds after which a fit is stopped, or `WALL` times as many wall seconds; records after it are not
            tried.
        budget: wall seconds after which no further record is begun.
    """
    found: dict[str, dict] = json.loads(kept.read_text()) if kept.exists() else {}
    kept.parent.mkdir(parents=True, exist_ok=True)
    started = time.monotonic() - sum(one.get("wall", 0.0) for one in found.values())
    while left := [path for path in paths if path.stem not in found]:
        if time.monotonic() - started > budget or _hopeless(found):
            break
        before = len(found)
        _session(python, entry, kind, left, found, kept, limit, started + budget)
        if len(found) == before:
            break
    return {path.stem: found[path.stem] for path in paths if path.stem in found}


def _hopeless(found: dict[str, dict]) -> bool:
    """Whether a fit was stopped, or the first three all raised: then no further record is tried."""
    return any("stopped" in one for one in found.values()) or (
        len(found) >= 3 and all("error" in one for one in found.values()))


def _session(python: str, entry: Path, kind: str, paths: Sequence[Path], found: dict[str, dict], kept: Path,
             limit: float, until: float) -> None:
    """One process over records until it ends, a fit takes too long, or the budget is spent."""
    noise = kept.with_suffix(".stderr.txt")
    with noise.open("wb") as stderr:
        process = subprocess.Popen(
            [python, str(HERE / "harness.py"), str(limit), str(entry), kind, *map(str, paths)], stdout=subprocess.PIPE,
            stderr=stderr, bufsize=0, env=os.environ | ENVIRONMENT)
        name, began = "", time.monotonic()
        try:
            while (line := _line(process, WALL * limit)) is not None:
                if not line:
                    break
                told = json.loads(line)
                if "record" in told:
                    name, began = told["record"], time.monotonic()
                    continue
                found[name] = told | {"wall": time.monotonic() - began}
                kept.write_text(json.dumps(found, indent=1))
                name = ""
                if time.monotonic() > until or _hopeless(found):
                    return
            if line is None:
                found[name or paths[0].stem] = {"stopped": f"no answer in {WALL * limit:.0f} s", "wall": WALL * limit}
            elif name or process.wait() != 0:
                code = process.wait()
                ended = f"the process ended: signal {-code}" if code < 0 else f"the process ended: exit code {code}"
                if code == -signal.SIGXCPU:
                    ended = f"no answer in {limit:.0f} CPU seconds"
                found[name or paths[0].stem] = {"stopped": ended, "wall": time.monotonic() - began,
                                                "message": noise.read_text(errors="replace")[-400:]}
            kept.write_text(json.dumps(found, indent=1))
        finally:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def _line(process: subprocess.Popen, limit: float) -> bytes | None:
    """The next line of a process, empty at its end, None when there is none within the limit."""
    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        if not selector.select(limit):
            return None
    return process.stdout.readline()

"""How long does a command take in a fresh process? CPU seconds of the process and its children, one thread.

    python benchmarks/first_use.py [--runs 5] [--only fit,report]

"first" is with no compiled kernel on disk (an empty NUMBA_CACHE_DIR), "later" the median of the runs that follow it.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

OPTID = [sys.executable, "-m", "optid"]
FIT = [*OPTID, "fit", "--example", "thruster"]
RECORD = """
import numpy as np, optid
rng = np.random.default_rng(0)
u, y, x = rng.uniform(-1, 1, (2000, 2)), np.zeros((2000, 2)), np.zeros(3)
A = np.array([[0.8, 0.2, 0.0], [-0.2, 0.7, 0.1], [0.0, 0.1, 0.5]])
B, C = np.array([[1.0, 0.2], [0.0, 0.5], [0.3, -1.0]]), np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.2]])
for k in range(2000):
    y[k] = C @ x + 0.05 * rng.standard_normal(2)
    x = A @ x + B @ np.tanh(2 * u[k]) - 0.05 * np.array([y[k, 0] ** 3, 0.0, 0.0])
data = optid.Data(u=u, y=y)
"""
ASIVID = RECORD + """
optid.fit(data, "hammerstein_ss.asivid", nx=3, basis=optid.Triangular(6), feedback_basis=optid.Polynomial(3))
"""
MONITOR = """
import optid
from optid.faults import Monitor
Monitor(optid.load("{folder}/model.json"))
"""
DIAGNOSE = """
import optid
from optid.examples import broken_thruster
from optid.faults import diagnose
diagnose(optid.load("{folder}/model.json"), broken_thruster().data)
"""
JOBS: dict[str, list[str]] = {
    "fit": FIT,
    "report": [*FIT, "--report", "{folder}/report.html"],
    "asivid": [sys.executable, "-c", ASIVID],
    "oe": [*FIT, "--formulation", "oe.exact"],
    "monitor": [sys.executable, "-c", MONITOR],
    "diagnose": [sys.executable, "-c", DIAGNOSE],
    "isolability": [*OPTID, "isolability", "{folder}/model.json"],
    "formulations": [*OPTID, "formulations"],
    "constraints": [*OPTID, "constraints"],
    "solvers": [*OPTID, "solvers"],
    "examples": [*OPTID, "examples"],
    "help": [*OPTID, "--help"],
    "missing file": [*OPTID, "fit", "{folder}/nowhere.csv"],
    "wrong word": [*OPTID, "fit", "--example", "thrster"],
    "wrong command": [*OPTID, "fti"],
}
MODEL = [*FIT, "--formulation", "hammerstein_ss.exact", "--nx", "2", "--set", "criterion=prediction", "--model",
         "{folder}/model.json"]


def seconds(words: list[str], environment: dict[str, str], folder: str) -> float:
    """Run a command and return its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([word.replace("{folder}", folder) for word in words], env=environment, cwd=folder,
                   stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--only", default=",".join(JOBS))
    options = parser.parse_args()
    alone = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
    print(f"{'job':<14} {'first':>7} {'later':>7}   CPU seconds")
    with tempfile.TemporaryDirectory() as folder:
        seconds(MODEL, {**os.environ, **alone}, folder)
        for name in options.only.split(","):
            cache = Path(folder, "kernels", name)
            environment = {**os.environ, **alone, "NUMBA_CACHE_DIR": str(cache)}
            first = seconds(JOBS[name], environment, folder)
            later = statistics.median(seconds(JOBS[name], environment, folder) for _ in range(options.runs))
            print(f"{name:<14} {first:7.2f} {later:7.2f}", flush=True)


if __name__ == "__main__":
    main()

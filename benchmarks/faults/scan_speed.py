"""The search for one fault by the adjoint sweep: time over the length of the window, difference to dense least squares.

Standard plant, five steps and a jump of the state, all onsets. Printed: CPU time of the compiled sweep (correlations
and energies), of a whole `scan` of a new record, and of preparing the search, which is done once for additive faults
and for every record where losses or missing readings are searched. Aim: tens of microseconds for 200 samples.

    python benchmarks/faults/scan_speed.py [--plant $OPTID_DATA/fault_plant.json]
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from plants import PLANT, levels, standard_plant

from optid import Data
from optid.faults import dictionary, inject, scan, whiten
from optid.faults.search.sweeps import sweep


def seconds(work: Callable[[], Any], least: float = 0.3) -> float:
    """Return the CPU time of one call, the smallest of five rounds."""
    work()
    start, calls = time.process_time(), 0
    while time.process_time() - start < least / 5:
        work()
        calls += 1
    rounds = []
    for _ in range(5):
        start = time.process_time()
        for _ in range(calls):
            work()
        rounds.append((time.process_time() - start) / calls)
    return min(rounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plant", type=Path, default=PLANT)
    model, load = standard_plant(parser.parse_args().plant)
    found = dictionary(model, process={"load": load})
    lossy = dictionary(model, kinds=["bias", "loss", "stuck"], process={"load": load})
    print(f"{'samples':>8}{'sweep':>12}{'scan':>12}{'prepare':>12}{'losses, scan':>14}   (milliseconds)")
    for count in (200, 2000, 20_000):
        u = levels(count, 0)
        white = whiten(model, Data(u, inject(model, u, seed=1)), x0="zero")
        prepared = sweep(found, count)
        times = [
            seconds(lambda p=prepared, w=white: p.statistic(p.correlations(w.r))),
            seconds(lambda w=white: scan(found, w)),
            seconds(lambda c=count: sweep(replace(found), c)),  # a copy has nothing kept
            seconds(lambda w=white, i=u: scan(lossy, w, i)),
        ]
        print(f"{count:>8}" + "".join(f"{1e3 * t:>12.3f}" for t in times[:3]) + f"{1e3 * times[3]:>14.3f}", flush=True)
    u = levels(200, 0)
    white = whiten(model, Data(u, inject(model, u, seed=1)), x0="zero")
    result, worst = scan(lossy, white, u), 0.0
    for c, candidate in enumerate(lossy.candidates):
        for onset in np.flatnonzero(~np.isnan(result.statistic[c])):
            G = lossy.signature(candidate, 200, int(onset), u=u).reshape(400, -1)
            axes, sizes, _ = np.linalg.svd(G, full_matrices=False)
            energy = np.sum((axes[:, sizes > 1e-4 * sizes[0]].T @ white.r.ravel()) ** 2)
            worst = max(worst, abs(energy - result.statistic[c, onset]) / max(energy, 1.0))
    print(f"largest difference to dense least squares, relative: {worst:.1e}")


if __name__ == "__main__":
    main()

"""Time between false alarms: requested and realised, and the CUSUM table.

The thresholds come from a simulation of whitened innovations; they are tried on streams of the standard plant, which
the simulation never saw, each run until its first false alarm. Goal: realised over requested 0.8 - 1.25; the CUSUM run
lengths 465.4, 38.0, 10.38 and 4.01 at shifts 0, 0.5, 1 and 2 (k = 0.5, h = 5) to 1 %.

    python benchmarks/faults/arl.py [--streams 240] [--arl0 1000 5000 10000]
"""

import argparse
import time

import numpy as np
from streams import standard_monitor, stream

from optid.faults import cusum_arl

TABLE = {0.0: 465.4, 0.5: 38.0, 1.0: 10.38, 2.0: 4.01}
BLOCK = 2000
LIMIT = 4
"""Streams are so many times ARL0 long; those without an alarm count as censored."""


def first_alarm(arl0: float, window: int, seed: int) -> tuple[int, bool]:
    """Samples until a new monitor raises its first alarm on a healthy plant, or `LIMIT` times ARL0; whether it did."""
    monitor, model = standard_monitor(arl0, window)
    u, y = stream(model, int(LIMIT * arl0), seed)
    for start in range(0, len(u), BLOCK):
        for event in monitor.run(u[start : start + BLOCK], y[start : start + BLOCK]):
            if event.kind == "alarm":
                return event.sample + 1, True
    return len(u), False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", type=int, default=240)
    parser.add_argument("--arl0", type=float, nargs="+", default=[1000, 5000, 10_000])
    parser.add_argument("--window", type=int, default=60)
    given = parser.parse_args()
    print("CUSUM, k = 0.5, h = 5\n shift   table   here")
    for shift, known in TABLE.items():
        print(f"{shift:6.1f} {known:7.2f} {cusum_arl(shift):7.3f}   goal 1 %: {cusum_arl(shift) / known - 1:+.2%}")
    print(f"\nstandard plant, 6 candidates, window {given.window}, {given.streams} streams\n"
          " asked   realised [95 %]          ratio   goal        calibration")
    for arl0 in given.arl0:
        begun = time.process_time()
        calibration = standard_monitor(arl0, given.window)[0].calibration
        spent = time.process_time() - begun
        found = [first_alarm(arl0, given.window, seed) for seed in range(given.streams)]
        alarms = sum(ended for _, ended in found)
        mean = sum(samples for samples, _ in found) / alarms  # maximum likelihood for exponential times
        error = np.exp(1.96 / np.sqrt(alarms))
        print(f"{arl0:6.0f}   {mean:6.0f} [{mean / error:6.0f}, {mean * error:6.0f}] "
              f"{mean / arl0:8.3f}   0.8 - 1.25  {calibration.alarms} alarms in {calibration.samples} samples, "
              f"{spent:.1f} s CPU", flush=True)


if __name__ == "__main__":
    main()

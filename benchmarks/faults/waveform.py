"""Faults of any course: coverage and size of the consistent set, and frozen sensors.

Course: random walks of a given deflection at one of five places, in a window of the standard plant with its noise; the
set at 99 % must hold the true place in at least 98 % at every deflection. Frozen: a sensor freezes (bit-identical, and
with noise of its own on top); detected by three equal readings, or by the test itself on growing windows; named by the
place with the least energy left so many samples later. The window of that test ends at that sample, and the course may
begin at the sample of the alarm less ten.

    python benchmarks/faults/waveform.py [--runs 300] [--frozen 200]
"""

import argparse
from pathlib import Path

import numpy as np
from plants import BEFORE, PLANT, cut, levels, rate, standard_plant, windows

from optid import Data
from optid.faults import Fault, dictionary, inject, scan, thresholds, waveform_test, whiten
from optid.faults.consistency.waveforms import waveform_matrix
from optid.faults.screening import flat_lines

WINDOW = 200
SHOWN = {6: 3.98, 10: 2.29, 15: 1.34, 20: 1.15, 30: 1.01}


def coverage(found, model, load, runs):
    print("random walks of deflection d at one of five places (goal: coverage >= .98)")
    print(f"{'d':>4}  {'coverage of the 99 % set':<36}{'shown':>12}{'mean size':>11}{'shown':>7}")
    places = found.labels[:5]
    worst = 1.0
    for d, size in SHOWN.items():
        held = sizes = 0
        matrices = {}
        for run, window in enumerate(windows(model, [()] * runs, WINDOW, load=load, seed=d)):
            label = places[run % 5]
            if label not in matrices:
                matrices[label] = waveform_matrix(found, found[label], window.whitened)
            rng = np.random.default_rng([d, run])
            onset = int(rng.integers(60, 141))
            course = np.concatenate([np.zeros(onset), np.cumsum(rng.standard_normal(WINDOW - onset))])
            trace = (matrices[label] @ course).reshape(WINDOW, -1)
            white = cut(window.whitened, 0)
            shifted = type(white)(white.r + d * trace / np.linalg.norm(trace), white.innovations, white.present,
                                  white.predictor, white.outputs)
            test = waveform_test(found, shifted, 0.99)
            held += label in test.consistent
            sizes += len(test.consistent)
        worst = min(worst, held / runs)
        print(f"{d:>4}  {rate(held, runs):<36}{'.983-.997':>12}{sizes / runs:>11.2f}{size:>7.2f}", flush=True)
    print(f"      worst coverage {worst:.4f}   (goal .98)")


def frozen(found, model, load, runs):
    print("\nfrozen sensors (goals: detected within 3 samples; named 20 samples after the alarm in >= .99)")
    limits = thresholds(found, 60, draws=20_000)
    for label, shown in (("sensor:y1", "1.5; .975 then .995"), ("sensor:y2", "2.6; .97 then 1.00")):
        for noisy in (False, True):
            delays, named = [], {10: 0, 20: 0}
            missed = early = 0
            for run in range(runs):
                rng = np.random.default_rng([17, run, noisy])
                onset = BEFORE + 60 + int(rng.integers(0, 40))
                u = levels(onset + 60, rng)
                y = inject(model, u, Fault.frozen(label, onset), seed=int(rng.integers(2**31)))
                o = model.outputs.index(label.partition(":")[2])
                if noisy:
                    y[onset:, o] += np.sqrt(model.noise.R[o, o]) * rng.standard_normal(len(y) - onset)
                white = whiten(model, Data(u, y), x0="zero")
                alarm = None
                for k in range(onset - 30, onset + 40):
                    flat = k >= onset and any(line.name == label for line in flat_lines(Data(u[: k + 1], y[: k + 1])))
                    search = scan(found, cut(white, k - 59, k + 1))
                    if flat or np.nanmax(search.gains(limits)) > 0:
                        alarm = k
                        break
                if alarm is None:
                    missed += 1
                    continue
                if alarm < onset:
                    early += 1
                    continue
                delays.append(alarm - onset)
                for later in named:
                    last = alarm + later
                    test = waveform_test(found, cut(white, last - 99, last + 1), onset=99 - later - 10)
                    named[later] += test.places[0].name == label
            told = ", ".join(f"{rate(hits, len(delays))} after {later}" for later, hits in named.items())
            print(f"  {label} {'with its noise' if noisy else 'bit-identical':<15} mean delay {np.mean(delays):.2f}, "
                  f"p95 {np.quantile(delays, .95):.0f}, missed {missed}, alarms before {early}\n"
                  f"    named {told}   shown {shown}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=300, help="records per deflection")
    parser.add_argument("--frozen", type=int, default=200, help="records per sensor")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    coverage(found, model, load, options.runs)
    frozen(found, model, load, options.frozen)


if __name__ == "__main__":
    main()

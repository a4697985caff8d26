"""The course of a fault: relative RMSE at deflection 20 for steps, ramps, pulses and slow drifts.

Five places in turn. The prior is chosen by BIC, and beside it stand the two priors by themselves and the sign given.

    python benchmarks/faults/profile.py [--runs 20]
"""

import argparse
import time
from pathlib import Path

import numpy as np
from plants import PLANT, standard_plant, windows

from optid.faults import dictionary, profile, scan
from optid.faults.consistency.waveforms import waveform_matrix

WINDOW, DEFLECTION = 200, 20
K = np.arange(WINDOW)
SHAPES = {
    "step": ((K >= 80).astype(float), "9.7 (tv)"),
    "ramp": (np.maximum(K - 79, 0) / 120.0, "13.4-13.7"),
    "pulse": (((K >= 80) & (K < 120)).astype(float), "20 (tv)"),
    "slow drift": (np.where(K >= 60, 0.5 - 0.5 * np.cos(np.pi * (K - 60) / 140), 0.0), "12.6 (trend, sign)"),
}
WAYS = {"BIC": {}, "tv": {"prior": "tv"}, "trend": {"prior": "trend"}, "BIC, sign": {"sign": "positive"}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="records per course")
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    ways = {way: WAYS[way] for way in options.ways}
    found = dictionary(model, process={"load": load})
    print(f"relative RMSE in %, mean and median, at d = {DEFLECTION}, {options.runs} records each (prior chosen, "
          "tv : trend)")
    print(f"{'course':<12}" + "".join(f"{name:>18}" for name in ways) + f"{'shown':>20}")
    gap, clock, count = 0.0, 0.0, 0
    for name, (course, shown) in SHAPES.items():
        errors: dict[str, list[float]] = {way: [] for way in ways}
        chosen: dict[str, list[str]] = {way: [] for way in ways}
        for run, window in enumerate(windows(model, [()] * options.runs, WINDOW, load=load, seed=6)):
            label = found.labels[run % 5]
            T = waveform_matrix(found, found[label], window.whitened)
            f = course * DEFLECTION / np.linalg.norm(T @ course)
            white = window.whitened
            white = type(white)(white.r + (T @ f).reshape(WINDOW, -1), white.innovations, white.present,
                                white.predictor, white.outputs)
            search = scan(found, white, window.u)
            for way, how in ways.items():
                start = time.process_time()
                result = profile(search, label, **how)
                clock, count = clock + time.process_time() - start, count + 1
                gap = max(gap, result.gap)
                errors[way].append(float(np.linalg.norm(result.course - f) / np.linalg.norm(f)))
                chosen[way].append(result.prior)
        sizes = {way: 100 * np.quantile(values, 0.5) for way, values in errors.items()}
        means = {way: 100 * np.mean(values) for way, values in errors.items()}
        cells = [f"{means[way]:.1f}, {sizes[way]:.1f} ({chosen[way].count('tv')}:{chosen[way].count('trend')})"
                 for way in errors]
        print(f"{name:<12}" + "".join(f"{cell:>18}" for cell in cells) + f"{shown:>20}", flush=True)
    print(f"largest relative duality gap {gap:.1e}; CPU per profile {clock / count:.2f} s")


if __name__ == "__main__":
    main()

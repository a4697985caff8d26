"""Is the forecast of isolability right? It is to be within .03 of a Monte Carlo study of the plant itself.

The forecast is simulated in signature space, before any data. Against it stand records of the standard plant with its
process and measurement noise: a fault of the size that the forecast calls just isolable (and fractions and multiples of
it) with an onset drawn from the middle of the window, the innovations of the steady Kalman filter from 100 samples
before the window on, and a dense search over all candidates and onsets by least squares. Printed beside them is the
formula for two rivals at a known onset, which ignores that the onset is searched.

    python benchmarks/faults/isolability.py [--runs 1000] [--window 100] [--plant $OPTID_DATA/fault_plant.json]
"""

import argparse
import time
from pathlib import Path

import numpy as np
from plants import BEFORE, PLANT, levels, standard_plant
from scipy.stats import norm

from optid import Data
from optid.faults import Fault, dictionary, inject, isolability, whiten
from optid.faults.isolability_study import MIDDLE
from optid.faults.signatures import Dictionary


def dense(found: Dictionary, window: int) -> list[np.ndarray]:
    """Orthonormal axes (T, N l, d) of every candidate at every onset, by least squares on whole windows."""
    banks = []
    for candidate in found.candidates:
        needed = -(-candidate.dimension // found.model.l)
        banks.append(np.stack([
            np.linalg.qr(found.signature(candidate, window, onset).reshape(window * found.model.l, -1))[0]
            for onset in range(window - needed + 1)
        ]))
    return banks


def search(banks: list[np.ndarray], r: np.ndarray) -> np.ndarray:
    """Largest explained energy (C,) of every candidate in a window (N, l)."""
    return np.array([np.sum(np.einsum("tkd,k->td", bank, r.ravel()) ** 2, axis=1).max() for bank in banks])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000, help="records per fault and size")
    parser.add_argument("--window", type=int, default=100)
    parser.add_argument("--draws", type=int, default=4000)
    parser.add_argument("--shares", type=float, nargs="+", default=[0.6, 1.0, 1.5], help="of the isolable size")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    start = time.process_time()
    forecast = isolability(found, options.window, draws=options.draws)
    print(f"{forecast}\n\nforecast in {time.process_time() - start:.1f} s of CPU time; Monte Carlo with {options.runs} "
          "records each\n")
    banks = dense(found, options.window)
    rng = np.random.default_rng(1)
    print(f"{'fault':<16}{'size':>8}{'deflection':>11}   {'named: forecast':>15}{'records':>9}{'formula':>9}   "
          f"{'detected: forecast':>18}{'records':>9}{'d by':>7}")
    worst = worst_detected = 0.0
    count = BEFORE + options.window
    for c, label in enumerate(forecast.labels):
        if found[label].dimension > 1:
            continue
        for share in options.shares:
            size = share * forecast.isolable[c]
            named = detected = 0
            for _ in range(options.runs):
                low, high = (int(part * options.window) for part in MIDDLE)
                onset = int(rng.integers(low, high))
                u = levels(count, rng)
                fault = Fault.step(label, BEFORE + onset, size)
                y = inject(model, u, fault, seed=int(rng.integers(2**32)), process={"load": load})
                excess = search(banks, whiten(model, Data(u, y), x0="zero").r[BEFORE:]) - forecast.thresholds
                detected += bool(excess.max() > 0)
                named += bool(excess.max() > 0 and excess.argmax() == c)
            expected, d = forecast.forecast(label, size), forecast.deflection(label, size)
            rival = forecast.labels.index(forecast.rivals[c])
            formula = float(norm.cdf(d * forecast.sines[c, rival] / 2))
            off = named / options.runs - expected.isolated
            worst = max(worst, abs(off))
            worst_detected = max(worst_detected, abs(detected / options.runs - expected.detected))
            print(f"{label:<16}{size:>8.3g}{d:>11.2f}   {expected.isolated:>15.3f}{named / options.runs:>9.3f}"
                  f"{formula:>9.3f}   {expected.detected:>18.3f}{detected / options.runs:>9.3f}{off:>+7.3f}",
                  flush=True)
    healthy = sum(
        bool(np.any(search(banks, whiten(model, Data(u, inject(model, u, seed=run)), x0="zero").r[BEFORE:])
                    > forecast.thresholds))
        for run in range(options.runs)
        for u in [levels(count, rng)]
    )
    print(f"\nnamed, forecast off by at most {worst:.3f}   (goal .03)"
          f"\n           detected, off by at most {worst_detected:.3f}"
          f"\nfalse alarms of {options.runs} healthy records {100 * healthy / options.runs:.2f} %   (nominal 1 %)")


if __name__ == "__main__":
    main()

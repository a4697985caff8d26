"""Set membership: proofs that a plant is not healthy, none of them false.

Windows of 40 samples of the standard plant. Healthy ones with Gaussian noise (bounds at two standard deviations, which
single samples exceed) and with noise that keeps its bounds exactly; faulty ones of a given deflection, with the set of
candidates that are possible. Every proof is checked without the solver: the readings less a simulation of the model are
added up with the parity vector and compared with what noise within its bounds can add up to.

    python benchmarks/faults/membership.py [--runs 40] [--faulty 40] [--sets 8]
"""

import argparse
import time
from pathlib import Path

import numpy as np
from plants import BEFORE, PLANT, deflected, levels, rate, standard_plant

from optid import Data
from optid.faults import dictionary, inject, membership

WINDOW = 40
BOUND = 2.0
SHOWN = {7: ("0 %", "-"), 10: ("25 %", "3.0"), 20: ("100 %", "1.5"), 30: ("100 %", "1.0")}


def by_hand(model, u, y, proof, process, output):
    """Add up the proof from the matrices of the model alone: sum and what it may be at most."""
    p, q = proof.weights, np.zeros(model.nx)
    f = model.expand_inputs(u)
    x, total = np.zeros(model.nx), 0.0
    for k in range(len(y)):
        total += p[k] @ (y[k] - model.C @ x - model.D @ f[k] - model.offset_y)
        x = model.A @ x + model.B @ f[k] + model.offset_x
    most = 0.0
    for k in range(len(y) - 1, -1, -1):
        most += np.abs(p[k]) @ output + np.abs(q) @ process
        q = model.A.T @ q + model.C.T @ p[k]
    return abs(total), most, float(np.abs(q).max())  # q is now what the state at the start is weighed with


def bounded(model, u, rng, process, output):
    """A record whose noise keeps its bounds."""
    f, x, y = model.expand_inputs(u), np.zeros(model.nx), np.empty((len(u), model.l))
    for k in range(len(u)):
        y[k] = model.C @ x + model.D @ f[k] + model.offset_y + output * rng.uniform(-1, 1, model.l)
        x = model.A @ x + model.B @ f[k] + model.offset_x + process * rng.uniform(-1, 1, model.nx)
    return y


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=40, help="healthy windows of each kind")
    parser.add_argument("--faulty", type=int, default=40, help="faulty windows per deflection")
    parser.add_argument("--sets", type=int, default=8, help="of them, those whose set of candidates is found, too")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    process, output = (BOUND * np.sqrt(np.diag(c)) for c in (model.noise.Q, model.noise.R))
    checked = 0
    clock = 0.0
    for kind in ("Gaussian noise, bounds at two sigma", "noise within its bounds"):
        factors, false = [], 0
        for run in range(options.runs):
            rng = np.random.default_rng([26, run])
            u = levels(BEFORE + WINDOW, rng)
            y = inject(model, u, seed=run) if kind.startswith("G") else bounded(model, u, rng, process, output)
            start = time.process_time()
            result = membership(model, Data(u[BEFORE:], y[BEFORE:]), BOUND, solver="highs")
            clock += time.process_time() - start
            false += result.impossible
            factors.append(result.factor)
        print(f"healthy, {kind}: false proofs {false} of {options.runs} (goal 0, shown 0 of 40);\n"
              f"    largest factor {max(factors):.2f} (shown .76)", flush=True)
    print(f"CPU per healthy window with posing and judging: {1e3 * clock / (2 * options.runs):.0f} ms (shown 13)")
    wrong = 0
    for d, (shown, size) in SHOWN.items():
        proved = held = 0
        sizes, rng = [], np.random.default_rng([d, 26])
        for run in range(options.faulty):
            label = found.labels[run % 5]
            u = levels(BEFORE + WINDOW, rng)
            fault, _ = deflected(found, label, WINDOW, int(rng.integers(5, 20)), d, rng)
            y = inject(model, u, fault, seed=int(rng.integers(2**31)), process={"load": load})[BEFORE:]
            wanted = found if run < options.sets else None
            result = membership(model, Data(u[BEFORE:], y), BOUND, wanted, candidates=False, solver="highs")
            proved += result.impossible
            if result.impossible:
                total, most, left = by_hand(model, u[BEFORE:], y, result.proof, process, output)
                checked += 1
                wrong += not (total > most and abs(total / most - result.proof.factor) < 1e-6 and left < 1e-9)
                if wanted is not None:
                    held += label in result.consistent
                    sizes.append(len(result.consistent))
        mean = f"{np.mean(sizes):.2f}" if sizes else "-"
        print(f"d = {d}: proved {rate(proved, options.faulty)} (shown {shown}); possible candidates {mean} "
              f"(shown {size}), the true one among them {held} of {len(sizes)}", flush=True)
    print(f"proofs checked by hand: {checked}, wrong {wrong}")


if __name__ == "__main__":
    main()

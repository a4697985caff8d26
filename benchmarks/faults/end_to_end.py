"""From the alarm to the rebuilt model: how soon the name, how good the fit.

A monitor watches streams of the standard plant; at sample 300 an actuator sticks, dies or weakens. Counted are the
samples from the onset until one candidate is left and it is the right part; 15 samples later, and not before 35 samples
after the onset, the last 100 samples are diagnosed and the model is reformulated from the diagnosis: unless it is
ambiguous, what broke is refitted. The fit is that of a noise-free simulation of 1,500 unseen samples, all outputs
pooled, before and after. A diagnosis that does not leave one answer by then leaves the healthy model; its fit counts as
it is.

    python benchmarks/faults/end_to_end.py [--runs 120]
"""

import argparse
import warnings
from dataclasses import replace

import numpy as np
from plants import levels, rate
from streams import ONSET, standard_monitor, stream

from optid import Data
from optid.bases import Triangular
from optid.errors import OptidError
from optid.faults import Fault, diagnose, dictionary, reformulate
from optid.models import HammersteinSS, Nonlinearity

SETTLE, LEAST, SEEN, AFTER, UNSEEN = 15, 35, 100, 60, 1500

CASES = {
    "act2 stuck at 0.6": Fault.stuck("actuator:u2", ONSET, 0.6),
    "act1 dead": Fault.loss("actuator:u1", ONSET, 1.0),
    "act1 -50 %": Fault.loss("actuator:u1", ONSET, 0.5),
    "act2 -50 %": Fault.loss("actuator:u2", ONSET, 0.5),
    "act1 -20 %": Fault.loss("actuator:u1", ONSET, 0.2),
}
HARD = ("act2 stuck at 0.6", "act1 dead")


def broken(model: HammersteinSS, fault: Fault) -> HammersteinSS:
    """Return the plant with the fault."""
    column = model.inputs.index(fault.channel)
    functions = list(model.nonlinearities)
    if fault.kind == "loss" and fault.size < 1:
        functions[column] = replace(functions[column], mu=(1 - fault.size) * functions[column].mu)
        return replace(model, nonlinearities=tuple(functions))
    value = 0.0 if fault.kind == "loss" else float(functions[column](fault.size))
    functions[column] = Nonlinearity(Triangular(1, (-1.2, 1.2)), np.zeros(1))
    return replace(model, nonlinearities=tuple(functions), offset_x=model.B[:, column] * value,
                   offset_y=model.D[:, column] * value)


def fit(truth: np.ndarray, simulated: np.ndarray) -> float:
    """Return 100 (1 - error / spread), all outputs pooled."""
    return float(100 * (1 - np.linalg.norm(truth - simulated) / np.linalg.norm(truth - truth.mean(axis=0))))


def one(arl0: float, window: int, fault: Fault, seed: int) -> tuple[int, int, bool, int, float, str]:
    """Return delays of alarm and name (-1 without), whether it is right, samples refitted from, fit, and status."""
    monitor, model = standard_monitor(arl0, window)
    u, y = stream(model, ONSET + AFTER + 200, seed, fault)
    alarm, named, right = -1, -1, False
    for k, (now, reading) in enumerate(zip(u, y)):
        for event in monitor.step(now, reading):
            if k < ONSET:
                continue
            if event.kind == "alarm" and alarm < 0:
                alarm = k - ONSET
            if event.kind == "isolated" and alarm >= 0 and len(event.candidates) == 1 and named < 0:
                named, right = k - ONSET, event.candidates[0][0].startswith(fault.name)
        if named >= 0:
            break
    used = max(max(named, 0) + SETTLE, LEAST)
    end = min(ONSET + used, len(u))
    last = slice(end - SEEN, end)
    record = Data(u[last], y[last])
    kinds = dictionary(model, kinds=["loss", "stuck", "bias"])
    unseen = levels(UNSEEN, 77)
    truth = broken(model, fault).simulate(unseen)
    try:
        found = reformulate(model, diagnose(model, record, kinds, seed=0), record)
        return alarm, named, right, used, fit(truth, found.model.simulate(unseen)), found.status
    except OptidError as error:
        return alarm, named, right, used, fit(truth, model.simulate(unseen)), type(error).__name__


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=120, help="streams per fault")
    parser.add_argument("--arl0", type=float, default=5000)
    parser.add_argument("--window", type=int, default=100)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    model = standard_monitor(options.arl0, options.window)[1]
    unseen = levels(UNSEEN, 77)
    print(f"{options.runs} streams per fault, ARL0 {options.arl0:g}\n")
    print(f"{'fault':<20}{'alarm mean/p95':>16}{'named mean/p95':>16}{'right':>8}{'refitted from':>15}"
          f"{'fit before':>12}{'after':>8}{'10 %':>8}  status")
    hard, medians = [], {}
    for word, fault in CASES.items():
        rows = [one(options.arl0, options.window, fault, 10_000 + run) for run in range(options.runs)]
        alarms, names = (np.array([row[i] for row in rows if row[i] >= 0]) for i in (0, 1))
        fits = np.array([row[4] for row in rows])
        before = fit(broken(model, fault).simulate(unseen), model.simulate(unseen))
        medians[word] = float(np.median(fits))
        hard += [row[1] for row in rows if row[1] >= 0] if word in HARD else []
        counts = {status: sum(row[5] == status for row in rows) for status in sorted({row[5] for row in rows})}
        print(f"{word:<20}{alarms.mean():>9.1f} /{np.quantile(alarms, .95):>4.0f} {names.mean():>10.1f} /"
              f"{np.quantile(names, .95):>4.0f}{np.mean([row[2] for row in rows]):>8.3f}"
              f"{np.mean([row[3] for row in rows]):>15.1f}{before:>12.1f}{medians[word]:>8.1f}"
              f"{np.quantile(fits, .1):>8.1f}  {counts}", flush=True)
        print(f"{'':<20}right: {rate(sum(row[2] for row in rows), len(rows))}")
    print(f"\nhard-over, onset to one right name, mean {np.mean(hard):.1f}, p95 {np.quantile(hard, .95):.0f}"
          f"   (goal 12, 20)"
          f"\nfit after, worst case {min(medians.values()):.1f} %, median case "
          f"{np.median(list(medians.values())):.1f} %   (goal 90 %, 95 %)")


if __name__ == "__main__":
    main()

"""What monitor and diagnosis do with a model from a subspace fit: false alarms, names, kinds, intervals, sets.

Every run identifies a model of its own from 3,000 healthy samples of the tanks, the motor and the heater of
`physical_plants.py`.

    python benchmarks/faults/strange_figures.py FIGURE... [--runs 4] [--first 0] [--plant tanks motor heater]

Figures:

* inside: false alarms of the monitor in 30,000 healthy samples, white and AR(0.8) sensor noise, against the budget;
* outside: false alarms where the inputs leave the identified range by a fifth, and of `diagnose`;
* monitor: the parts that the monitor names;
* gains: named sensors with half their gain, before and behind their noise, and the coverage of the interval of the
  share lost;
* losses: kind named for a partial loss of an actuator;
* leaks: what a leak of unstated direction is called;
* sets: coverage of the set of answers over all faults, and healthy records that alarm;
* drifts: coverage of the interval of the onset.
"""

import argparse
import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from physical_plants import START, Failure, identified, record
from physical_plants import simulate as simulate_many

from optid.errors import DataError
from optid.faults import Monitor, diagnose, dictionary

SAMPLES, ARL0, HEALTHY = 400, 10_000, 30_000
KINDS = "bias", "loss", "stuck", "drift", "frozen", "noise", "spike"
WATCHED = "bias", "loss", "stuck", "drift"
HALF = {"tanks": "h1", "motor": "w", "heater": "T"}

FAILURES: dict[str, tuple[Failure, ...]] = {
    "tanks": (Failure("actuator:v1", "loss", 0, 0.5), Failure("actuator:v2", "stuck", 0, 0.8),
              Failure("sensor:h1", "bias", 0, 12.0), Failure("sensor:h2", "drift", 0, 0.2),
              Failure("sensor:h1", "frozen", 0), Failure("sensor:h2", "dead", 0), Failure("sensor:h1", "gain", 0, 0.5),
              Failure("sensor:h2", "noise", 0, 4.0), Failure("process:leak", "leak", 0, 4.0)),
    "motor": (Failure("actuator:u", "loss", 0, 0.4), Failure("actuator:u", "stuck", 0, 2.0),
              Failure("sensor:i", "bias", 0, 10.0), Failure("sensor:w", "drift", 0, 0.07),
              Failure("sensor:w", "frozen", 0), Failure("sensor:i", "dead", 0), Failure("sensor:w", "gain", 0, 0.5),
              Failure("sensor:i", "noise", 0, 4.0), Failure("process:leak", "leak", 0, 0.02)),
    "heater": (Failure("actuator:v", "loss", 0, 0.4), Failure("actuator:v", "stuck", 0, 5.0),
               Failure("sensor:T", "bias", 0, 12.0), Failure("sensor:T", "drift", 0, 0.25),
               Failure("sensor:T", "frozen", 0), Failure("sensor:T", "dead", 0), Failure("sensor:T", "gain", 0, 0.5),
               Failure("sensor:T", "noise", 0, 4.0), Failure("process:leak", "leak", 0, 4.0)),
}
"""Faults of each plant; the onset is set by the run."""


@cache
def fitted(plant: str, run: int) -> Any:
    return identified(plant, run, 3000 + START)


def simulate(plant: str, samples: int, seed: int, failure: Failure | None = None, **how: float) -> Any:
    u, y = simulate_many(plant, samples, seed, [failure], **how)
    return u[0], y[0]


@cache
def candidates(plant: str, run: int) -> Any:
    return dictionary(fitted(plant, run)[0].model, kinds=KINDS)


def parts_of(labels: Any) -> set[str]:
    return {word.split(" ")[0] for label in labels for word in label.replace(", ", "|").split("|")}


def asked(plant: str, run: int, failure: Failure, seed: int = 3000) -> Any:
    u, y = simulate(plant, SAMPLES, seed + run, failure._replace(onset=SAMPLES // 2))
    return diagnose(fitted(plant, run)[0], record(plant, u, y), candidates(plant, run))


def inside(plant: str, runs: range) -> None:
    for pole in (0.0, 0.8):
        counts = []
        for run in runs:
            fit, data = fitted(plant, run)
            healthy = record(plant, *simulate(plant, 6000, 500 + run, pole=pole)) if pole else None
            monitor = Monitor(fit.model, arl0=ARL0, uncertainty=data, healthy=healthy)
            u, y = simulate(plant, HEALTHY, 7000 + run, pole=pole, reach=0.95)
            counts.append(Counter(e.kind for e in monitor.run(u, y)))
            print(f"  {plant} {run} pole {pole:g}: {dict(counts[-1])} cpu {time.process_time():.0f}", flush=True)
        alarms, budget = sum(c["alarm"] for c in counts), len(counts) * HEALTHY / ARL0
        print(f"inside {plant}, pole {pole:g}: {alarms} alarms, budget {budget:g}: {alarms / budget:.2f} times",
              flush=True)


def outside(plant: str, runs: range) -> None:
    counts, alarmed, said = Counter(), 0, 0
    for run in runs:
        fit, data = fitted(plant, run)
        monitor = Monitor(fit.model, arl0=ARL0, uncertainty=data)
        u, y = simulate(plant, HEALTHY // 2, 8000 + run, reach=1.2)
        counts.update(e.kind for e in monitor.run(u, y))
        try:
            answer = diagnose(fit, record(plant, u[:SAMPLES], y[:SAMPLES]), candidates(plant, run))
        except DataError as refusal:  # too much of the record is outside
            said += "outside" in str(refusal)
        else:
            alarmed += answer.detected
            said += "outside" in answer.status
        print(f"  {plant} {run}: {dict(counts)}", flush=True)
    budget = len(runs) * HEALTHY / 2 / ARL0
    print(f"outside {plant}: {counts['alarm']} alarms, budget {budget:g}: {counts['alarm'] / budget:.2f} times; "
          f"diagnose: {alarmed} of {len(runs)} alarmed, {said} say outside", flush=True)


def monitored(plant: str, runs: range) -> None:
    right, said = Counter(), {}
    for run in runs:
        fit, data = fitted(plant, run)
        built = Monitor(fit.model, dictionary(fit.model, kinds=WATCHED), arl0=ARL0, uncertainty=data)
        for failure in FAILURES[plant]:
            monitor = Monitor(fit.model, built.dictionary, window=built.window, arl0=ARL0,
                              thresholds=built.calibration) if failure is not FAILURES[plant][0] else built
            u, y = simulate(plant, 3 * SAMPLES, 4000 + run, failure._replace(onset=SAMPLES))
            named = [e for e in monitor.run(u, y) if e.kind == "isolated" and e.sample >= SAMPLES]
            first = named[0].candidates if named else ()
            key = f"{failure.part} {failure.kind}"
            right[key] += failure.part in parts_of(label for label, _ in first)
            said.setdefault(key, Counter())[", ".join(label for label, _ in first) or "nothing"] += 1
    for key, names in said.items():
        print(f"monitor {plant}: {key:<22}{right[key]} of {len(runs)}; {dict(names)}", flush=True)


def gains(plant: str, runs: range) -> None:
    for kind in ("gain", "early gain"):
        failure = Failure(f"sensor:{HALF[plant]}", kind, 0, 0.5)
        errors, said = [], Counter()
        for run in runs:
            answer = asked(plant, run, failure)
            said[answer.best.label if answer.best else answer.verdict] += 1
            for a in answer.candidates:
                for one in a.faults:
                    if one.name == failure.part and one.kind == "loss":
                        low, high = one.size_interval[0]
                        errors.append(((low + high) / 2 - 0.5) / ((high - low) / 3.92))
                        print(f"  {plant} {run}: {low:.4f} .. {high:.4f} p {a.posterior:.2f}", flush=True)
        z = np.array(errors)
        print(f"gains {plant}, {kind}: named {z.size} of {len(runs)}, covered {np.sum(np.abs(z) <= 1.96)}, error "
              f"{np.sqrt(np.mean(z**2)):.2f} standard errors; {dict(said)}", flush=True)


def losses(plant: str, runs: range) -> None:
    failure = FAILURES[plant][0]
    right, said = 0, Counter()
    for run in runs:
        answer = asked(plant, run, failure)
        label = answer.best.label if answer.best else answer.verdict
        said[label] += 1
        right += answer.best is not None and answer.best.faults[0].kind == "loss" and (
            answer.best.faults[0].name == failure.part)
    print(f"losses {plant}: right kind {right} of {len(runs)}; {dict(said)}", flush=True)


def leaks(plant: str, runs: range) -> None:
    failure, best, alone, said = FAILURES[plant][-1], 0, 0, Counter()
    for run in runs:
        answer = asked(plant, run, failure)
        labels = [a.label for a in answer.candidates]
        said[" | ".join(labels) or answer.verdict] += 1
        best += any(label.startswith("process") for label in labels)
        alone += bool(labels) and not any(label.startswith("process") for label in labels)
    print(f"leaks {plant}: process in the set {best} of {len(runs)}, only others {alone}; {dict(said)}", flush=True)


def sets(plant: str, runs: range) -> None:
    right, total, empty, alarms = Counter(), 0, Counter(), 0
    for run in runs:
        healthy = record(plant, *simulate(plant, SAMPLES, 2000 + run))
        alarms += diagnose(fitted(plant, run)[0], healthy, candidates(plant, run)).detected
        for failure in FAILURES[plant]:
            if failure.kind == "dead":  # readings that are missing are no statistics; the monitor reports them
                continue
            answer = asked(plant, run, failure)
            parts = parts_of(label for a in answer.candidates for label in a.labels)
            true = "process" if failure.kind == "leak" else failure.part
            key = f"{failure.part} {failure.kind}"
            hit = any(p.startswith(true) for p in parts)
            right[key] += hit
            total += 1
            if not hit:
                empty[f"{run} {key}: {answer.verdict} {', '.join(a.label for a in answer.candidates)}"] += 1
    for line in empty:
        print(f"  missed {plant} {line}", flush=True)
    print(f"sets {plant}: {sum(right.values())} of {total}; {dict(right)}; {alarms} of {len(runs)} healthy records "
          "alarmed", flush=True)


def drifts(plant: str, runs: range) -> None:
    failure = next(f for f in FAILURES[plant] if f.kind == "drift")
    named = covered = 0
    for run in runs:
        answer = asked(plant, run, failure)
        hits = [one for a in answer.candidates for one in a.faults if one.name == failure.part and one.kind == "drift"]
        if hits:
            named += 1
            low, high = hits[0].onset_interval
            covered += low <= SAMPLES // 2 <= high
            print(f"  {plant} {run}: {low} .. {high}", flush=True)
    print(f"drifts {plant}: named {named} of {len(runs)}, onset covered {covered}", flush=True)


FIGURES: dict[str, Callable[[str, range], None]] = {
    "inside": inside, "outside": outside, "monitor": monitored, "gains": gains, "losses": losses, "leaks": leaks,
    "sets": sets, "drifts": drifts,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", nargs="+", choices=list(FIGURES))
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--plant", nargs="+", default=list(FAILURES), choices=list(FAILURES))
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for plant in given.plant:
        for figure in given.figure:
            FIGURES[figure](plant, range(given.first, given.first + given.runs))


if __name__ == "__main__":
    main()

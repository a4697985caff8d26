"""What monitor, diagnosis and repair do on three plants under control that optid does not describe exactly.

    python benchmarks/faults/controlled.py FIGURE... [--runs 20] [--plant reactor greenhouse drive]

Reactor, greenhouse and drive of `physical_plants.py` are identified once from a healthy record without its start-up.
Figures:

* parts: of single faults of sensors and actuators, the true one among those named 120 samples after the onset;
* kinds: of partial losses of 10 to 50 %, the kind among those told 60 samples after the onset, and the number of kinds;
  the same for stuck and offset actuators;
* alarms: of the monitor in healthy records, against those due: as identified; with a season, declared as a drift, and
  with coloured noise, both in the later healthy record, too; with set-points a third beyond the identified range;
* sizes: coverage of the 95 % intervals of the share lost, by `diagnose` and by the monitor after 200 samples;
* repairs: the promised error of `reformulate` against that in a later record of the same faulty plant.
"""

import argparse
import copy
import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from physical_plants import PERIOD, PLANTS, Failure, identified, record, simulate

from optid.faults import Monitor, diagnose, dictionary, model_uncertainty, reformulate
from optid.faults.repair.promise import errors, rms

ONSET, SOON, LATE, ARL0 = 300, 60, 200, 10_000
KINDS = "bias", "loss", "stuck", "spike"
LOSSES = 0.1, 0.2, 0.3, 0.5
DUE = 6000
SEASON = {"reactor": 3.0, "greenhouse": 4.0, "drive": 2.0}


@cache
def built(plant: str, season: float = 0.0, pole: float = 0.0, kinds: tuple[str, ...] = KINDS) -> Monitor:
    """The monitor of a plant: two commands, the second with a later healthy record."""
    fit, data = identified(plant)
    u, y = simulate(plant, 6000, 900, season=season, pole=pole)
    return Monitor(fit.model, dictionary(fit.model, kinds=kinds), arl0=ARL0, uncertainty=data,
                   healthy=record(plant, u[0], y[0]), drift=PERIOD if season else None)


def afresh(plant: str, **how: Any) -> Monitor:
    """The same before its first sample."""
    return copy.deepcopy(built(plant, **how))


def told(events: list[Any], until: int) -> set[str]:
    """The labels told last before a sample."""
    named = [e for e in events if e.kind in ("isolated", "revised") and ONSET <= e.sample < until]
    return {label for label, _ in named[-1].candidates} if named else set()


def kinds(plant: str, runs: int) -> None:
    for kind, sizes in (("loss", LOSSES), ("stuck", (0.0,)), ("offset", (0.1, -0.1))):
        right, counts, seen, missed = 0, [], 0, Counter()
        for name in PLANTS[plant].inputs:
            cases = [Failure(f"actuator:{name}", kind, ONSET, sizes[r % len(sizes)]) for r in range(runs)]
            for case, u, y in zip(cases, *simulate(plant, ONSET + SOON + 1, 7100, cases)):
                labels = told(afresh(plant).run(u, y), ONSET + SOON)
                true = f"actuator:{name}" + (f" {kind}" if kind != "offset" else "")
                right += true in labels
                seen += 1
                counts.append(len(labels))
                if true not in labels:
                    missed[f"{true} {case.size:g}: {', '.join(sorted(labels)) or 'nothing'}"] += 1
        for text, count in missed.items():
            print(f"    {count} x {text}")
        print(f"kinds {plant}: {kind} in the set {right} of {seen}, mean set {np.mean(counts):.2f}", flush=True)


def parts(plant: str, runs: int) -> None:
    right = Counter()
    cases = [Failure(f"sensor:{name}", kind, ONSET, size) for name in PLANTS[plant].outputs
             for kind, size in (("bias", 8.0), ("drift", 0.3), ("frozen", 0.0))]
    cases += [Failure(f"actuator:{name}", "loss", ONSET, 0.3) for name in PLANTS[plant].inputs]
    cases += [Failure(f"actuator:{name}", "stuck", ONSET) for name in PLANTS[plant].inputs]
    for case in cases:
        for u, y in zip(*simulate(plant, ONSET + 2 * SOON, 7200, [case] * runs)):
            labels = told(afresh(plant, kinds=(*KINDS, "drift")).run(u, y), ONSET + 2 * SOON)
            right[case.part, case.kind] += any(case.part in label for label in labels)
    print(f"parts {plant}: {sum(right.values())} of {runs * len(cases)}; {dict(right)}", flush=True)


def alarms(plant: str, runs: int) -> None:
    for word, known, how in (("as identified", {}, {}), ("season", {"season": SEASON[plant]}, {}),
                             ("colour", {"pole": 0.8}, {}), ("set-points", {}, {"reach": 2.0})):
        counts: Counter[str] = Counter()
        for u, y in zip(*simulate(plant, DUE, 7400, [None] * runs, **known, **how)):
            counts.update(e.kind for e in afresh(plant, **known).run(u, y))
        due = runs * DUE / ARL0
        print(f"alarms {plant}, {word}: {counts['alarm']} ({due:g} due), {counts['untrusted']} x model not trusted",
              flush=True)


def sizes(plant: str, runs: int) -> None:
    fit, data = identified(plant)
    found, known = dictionary(fit.model, kinds=KINDS), model_uncertainty(fit.model, data)
    for name in PLANTS[plant].inputs:
        for share in (0.1, 0.2, 0.3):
            hits, widths, late, carried = 0, [], 0, 0
            for u, y in zip(*simulate(plant, ONSET + LATE, 7300, [Failure(f"actuator:{name}", "loss", ONSET, share)]
                                      * runs)):
                answer = diagnose(fit.model, record(plant, u, y), found, model_uncertainty=known)
                own = [e for a in answer.candidates for e in a.faults if e.label == f"actuator:{name} loss"]
                if own:
                    low, high = own[0].size_interval[0]
                    widths.append(high - low)
                    hits += low <= share <= high
                monitor = afresh(plant)
                monitor.run(u, y)
                for one in monitor.carried:
                    if one.label == f"actuator:{name} loss":
                        carried += 1
                        late += one.interval[0][0] <= share <= one.interval[0][1]
            print(f"sizes {plant}: {name} {share:g}: covered {hits} of {len(widths)}, mean width "
                  f"{np.mean(widths) if widths else np.nan:.2f}; monitor {late} of {carried}", flush=True)


def repairs(plant: str, runs: int) -> None:
    fit, data = identified(plant)
    found, known = dictionary(fit.model, kinds=KINDS), model_uncertainty(fit.model, data)
    said: Counter[str] = Counter()
    kept = bounds = worse = 0
    for name in PLANTS[plant].inputs:
        cases = [Failure(f"actuator:{name}", *BROKEN[r % len(BROKEN)]) for r in range(runs)]
        broken = simulate(plant, ONSET + LATE, 7500, cases)
        c = PLANTS[plant].inputs.index(name)
        same = [case._replace(onset=0, size=u[ONSET, c] if case.kind == "stuck" else case.size)
                for case, u in zip(cases, broken[0])]
        later = simulate(plant, LATE + 100, 7600, same)
        for case, u, y, u_later, y_later in zip(cases, *broken, *later):
            answer = diagnose(fit.model, record(plant, u, y), found, model_uncertainty=known)
            if not answer.candidates:
                said[answer.verdict] += 1
                continue
            repair = reformulate(fit.model, answer, record(plant, u[: answer.window], y[: answer.window]))
            said[repair.status] += 1
            if repair.status != "refitted":
                continue
            fresh = record(plant, u_later[100:], y_later[100:])
            low, high = known.levels
            if np.any(np.abs(2 * fresh.y - low - high) > 2 * (high - low)):
                said["later run far outside the range of the identification"] += 1
                continue
            bound = np.array(list(repair.error_bound.values()))
            got, usual = rms(errors(repair.model, fresh)), rms(errors(fit.model, fresh))
            scale = np.array(PLANTS[plant].noise)
            lost = np.linalg.norm(got / scale) > np.linalg.norm(usual / scale)
            worse += lost
            if np.isfinite(bound).all():
                bounds += 1
                kept += bool(np.all(got <= bound))
            if lost or not np.all(got <= bound):
                print(f"    {case.part} {case.kind} {case.size:g}: rms {got.round(3)}, bound {bound.round(3)}, "
                      f"unrepaired {usual.round(3)}; {repair.members[0].label}")
    print(f"repairs {plant}: bound kept {kept} of {bounds}, worse than unrepaired {worse}; {dict(said)}", flush=True)


BROKEN = ("loss", ONSET, 0.1), ("loss", ONSET, 0.2), ("stuck", ONSET, 0.0), ("offset", ONSET, 0.1), (
    "offset", ONSET, -0.1)
FIGURES: dict[str, Callable[[str, int], None]] = {"kinds": kinds, "parts": parts, "alarms": alarms, "sizes": sizes,
                                                  "repairs": repairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("figure", nargs="+", choices=list(FIGURES))
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--plant", nargs="+", default=list(SEASON), choices=list(SEASON))
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    for plant in given.plant:
        for figure in given.figure:
            FIGURES[figure](plant, given.runs)
            print(f"  ({time.process_time():.0f} s)", flush=True)


if __name__ == "__main__":
    main()

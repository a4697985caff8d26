"""Faults from beginning to end: identify, monitor, break, isolate, refit, re-allocate.

Run: python faults_end_to_end.py [folder for the figure]
"""

import sys
from pathlib import Path

import numpy as np
from common import LOST, ONSET, draw, fit, held, levels, plant

import optid
from optid import Data
from optid.faults import Fault, Monitor, allocate, diagnose, inject, reformulate


def main(folder: Path) -> dict[str, float]:
    """Return the delay of the alarm, the share lost, fits before and after, and the errors of what is held."""
    folder.mkdir(parents=True, exist_ok=True)
    true, damaged, u = plant(), plant(1 - LOST), levels(3000, 1)
    identified = optid.fit(Data(u, inject(true, u, seed=1)), "hammerstein_ss.asivid", nx=3, basis="triangular:6")
    model = identified.model

    w = levels(ONSET + 100, 2)
    y = inject(true, w, Fault.loss("actuator:u2", ONSET, LOST), seed=2)
    monitor = Monitor(model, arl0=2000, window=60)
    events = monitor.run(w, y)
    print("\n".join(map(str, events)))
    record = Data(w[ONSET - 140 :], y[ONSET - 140 :])
    answer = diagnose(model, record)
    rebuilt = reformulate(model, answer, record)
    print(f"\n{answer}\n\n{rebuilt}")

    fresh = levels(1000, 3)
    truth = damaged.simulate(fresh)
    r = allocate(damaged).members[0].rest_output(np.array([0.8, 0.3]))
    courses = {"healthy model": held(damaged, model, r), "rebuilt model": held(damaged, rebuilt.model, r)}
    draw(folder / "faults_end_to_end.png", (w, y), events, rebuilt, courses, r)
    errors = {name: float(np.sqrt(np.mean((course[10:] - r) ** 2))) for name, course in courses.items()}
    alarm = next(event.sample for event in events if event.kind == "alarm")
    return {
        "delay": alarm - ONSET, "unique": float(rebuilt.if_ambiguous is None),
        "share lost": float(answer.best.faults[0].size[0]),
        "fit before": fit(truth, model.simulate(fresh)), "fit after": fit(truth, rebuilt.model.simulate(fresh)),
        "control gains": errors["healthy model"] / errors["rebuilt model"],
    }


if __name__ == "__main__":
    print(main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(".")))

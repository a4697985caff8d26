"""Tables 5.1 and 5.2: linear (LSID) and Hammerstein (SIVID, ASIVID) models of the pendulum, orders 1 to 8.

Error of angle / speed in % with measured feedback, or the rank that the sinusoid leaves too small: `rank` in common.py.
The numbers of the source are lost, the reference is a replacement of its experiments.
Run: python ch5_tables.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import judged, run
from drawing import draw_record, draw_responses

import optid
from optid import plants

REFERENCES = {
    ("sinusoid", "LSID"): {2: "9.6/106", 3: "0.6/6.4", 4: "0.6/2.3", 6: "0.6/2.3", 8: "0.6/2.4"},
    ("sinusoid", "SIVID"): {2: "6.4/104", 3: "0.7/9.5", 4: "0.8/1.3", 6: "0.6/0.8", 8: "1.3/0.8"},
    ("chirp", "LSID"): {2: "97/28", 3: "6.8/3.5", 4: "6.9/3.0", 6: "6.9/2.3", 8: "7.0/2.4"},
    ("chirp", "ASIVID"): {2: "99/21", 3: "0.7/2.5", 4: "0.5/1.9", 6: "0.9/1.9", 8: "0.5/1.8"},
}
TABLES = {"5.1": ("sinusoid", ("LSID", "SIVID", "ASIVID"), 250), "5.2": ("chirp", ("LSID", "ASIVID"), 1000)}
REASON = """\
rank r of s: the sinusoid excites r of the s regressors that ASIVID needs with the fewest block rows, or gives r numbers
for the s responses of states to functions that LSID and SIVID solve for (singular directions left out).
"""


def record(kind: str) -> tuple[optid.Data, optid.Data]:
    """4000 samples for the estimate, 1000 for validation."""
    first = plants.pendulum_input(kind, 4000)
    return plants.pendulum(np.concatenate([first, first[:1000]]), 1).split(4000)


def main(folder: Path) -> dict[str, float]:
    """Return the errors of every model there is, inf where there is none; save figures 5.3 to 5.6."""
    found = {}
    for (table, (kind, methods, shown)), number in zip(TABLES.items(), (3, 5)):
        (train, test), fits = record(kind), {}
        print(f"Table {table}: {kind}\n{'order':<6}" + "".join(f"{m:>16}{'reference':>12}" for m in methods))
        for nx in range(1, 9):
            line = f"{nx:<6}"
            for method in methods:
                fits[method, nx], error, text = judged(kind, method, train, test, nx)
                line += f"{text:>16}{REFERENCES.get((kind, method), {}).get(nx, ''):>12}"
                found |= {f"{kind} {method} {nx} {name}": float(e) for name, e in zip(train.outputs, error)}
            print(line)
        print(REASON * (table == "5.1"))
        title = f"experiment {table[-1]}, {kind}"
        draw_record(folder, f"5.{number}", f"{kind}_record", f"{title}: record", test.window(0, shown))
        draw_responses(folder, f"5.{number + 1}", f"{kind}_responses", f"{title}, order 3", [
            ("", test, {method: fits[method, 3].model for method in methods[:2]})], shown)
    return found


if __name__ == "__main__":
    run(main)

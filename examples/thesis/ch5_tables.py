"""Tables 5.1 and 5.2: linear (LSID) and Hammerstein (ASIVID) models of the pendulum, orders 1 to 8.

Prints the error of angle / speed in % with measured feedback; the numbers of the source are lost, the reference is a
replacement of its experiments. The sinusoid of table 5.1 does not determine a Hammerstein model: optid refuses it, and
with singular directions left out on request (SIVID) it says which orders are undetermined. Run: python ch5_tables.py
"""

import numpy as np
from common import feedback_error, subspace

import optid
from optid import plants

REFERENCES = {
    "sinusoid": {"LSID": {2: "9.6/106", 3: "0.6/6.4", 4: "0.6/2.3", 6: "0.6/2.3", 8: "0.6/2.4"},
                 "ASIVID": {2: "6.4/104", 3: "0.7/9.5", 4: "0.8/1.3", 6: "0.6/0.8", 8: "1.3/0.8"}},
    "chirp": {"LSID": {2: "97/28", 3: "6.8/3.5", 4: "6.9/3.0", 6: "6.9/2.3", 8: "7.0/2.4"},
              "ASIVID": {2: "99/21", 3: "0.7/2.5", 4: "0.5/1.9", 6: "0.9/1.9", 8: "0.5/1.8"}},
}
BASES = {"LSID": {"basis": "linear"}, "ASIVID": {"basis": "polynomial:4", "feedback_basis": "polynomial:4"}}


def record(kind: str) -> tuple[optid.Data, optid.Data]:
    """4000 samples for the estimate, 1000 for validation."""
    first = plants.pendulum_input(kind, 4000)
    return plants.pendulum(np.concatenate([first, first[:1000]]), 1).split(4000)


def identified(kind: str, method: str, train: optid.Data, nx: int) -> optid.HammersteinSS:
    """Return the model; of the sinusoid by SIVID, whose tolerance leaves singular directions out."""
    settings = {"nx": nx, "block_rows": 10, **BASES[method]}
    if kind == "sinusoid":
        return subspace(train, "sivid", instruments="inputs+past", tolerance=0.1, split="lumped", **settings)
    return subspace(train, "sid" if method == "LSID" else "asivid", noise="white", **settings,
                    **({"weighting": "cva"} if method == "ASIVID" else {}))


def main() -> dict[str, float]:
    """Return the errors of every model there is; inf where the record does not determine one."""
    found = {}
    for kind, number in (("sinusoid", "5.1"), ("chirp", "5.2")):
        train, test = record(kind)
        print(f"\nTable {number}: {kind}\n{'order':<6}" + "".join(f"{m:>18}{'reference':>12}" for m in BASES))
        for nx in range(1, 9):
            line = f"{nx:<6}"
            for method in BASES:
                try:
                    error = feedback_error(identified(kind, method, train, nx), test)
                except optid.errors.RankError:
                    error = np.full(2, np.inf)
                text = f"{error[0]:.3g}/{error[1]:.3g}" if np.isfinite(error).all() else "undetermined"
                line += f"{text:>18}{REFERENCES[kind][method].get(nx, ''):>12}"
                found |= {f"{kind} {method} {nx} {name}": float(e) for name, e in zip(train.outputs, error)}
            print(line)
    return found


if __name__ == "__main__":
    main()

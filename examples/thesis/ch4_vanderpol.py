"""Section 4.5.3: a Van der Pol oscillator with one measured output, nonlinearities unknown, orthonormal series.

Degree p for f and for the feedback: with p = 2 the cubic damping is not available, from p = 3 on it is. Data by the
difference equation; sampled data of the differential equation (RK4) lie outside the model class.
Run: python ch4_vanderpol.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import feedback_error, run, subspace
from drawing import draw_functions, draw_responses

import optid
from optid import plants

SETTINGS = {"nx": 2, "block_rows": 6}


def record(noise: float, method: str = "euler") -> tuple[optid.Data, optid.Data]:
    """6000 samples for the estimate, 1000 for validation; u uniform within 2."""
    u = np.random.default_rng(3).uniform(-2, 2, 7000)
    return plants.van_der_pol(u, 0, process=noise / 4, measurement=noise, method=method).split(6000)


def identified(train: optid.Data, degree: int, feedback: str) -> optid.HammersteinSS:
    """ASIVID with past outputs among the instruments (the noise is white), no feedthrough; SID for degree 1."""
    words = {"basis": f"polynomial:{degree}:outside=extrapolate", "feedback_basis": f"{feedback}:outside=extrapolate",
             "noise": "white", "feedthrough": False}
    return subspace(train, "asivid" if degree > 1 else "sid", **SETTINGS, **(words if degree > 1 else {})).model


def main(folder: Path) -> dict[str, float]:
    """Return the error in % of every case, and the poles; save figures 4.7 to 4.9."""
    found, models, records = {}, {}, {"noise free": record(0.0), "noisy": record(0.02), "RK4": record(0.0, "rk4")}
    cases = [(f"p = q = {p}, {name}" if p > 1 else f"SID, {name}", name, p, f"polynomial:{p}", reference)
             for p, *references in ((2, "73", "73"), (3, "1.2", "7"), (4, "1.2", "7"), (1, "73 to 76", "73 to 76"))
             for name, reference in zip(records, references)]
    cases += [("trigonometric feedback, noisy", "noisy", 4, "trigonometric:4:half_range=1.25", "11.5"),
              ("RK4 data, p = q = 4", "RK4", 4, "polynomial:4", "15 to 19")]
    print(f"{'Van der Pol, error of y in %':<36}{'here':>9}   reference")
    for name, data, degree, feedback, reference in cases:
        models[name] = identified(records[data][0], degree, feedback)
        found[name] = float(feedback_error(models[name], records[data][1])[0])
        print(f"{name:<36}{found[name]:>9.3g}   {reference}")
    poles = models["p = q = 4, noisy"].poles
    print(f"poles {np.round(poles, 4)}, reference 0.99 +- 0.1j: near the circle, the mean energy injection is in A")
    for p, number in ((2, "4.7"), (4, "4.8")):
        draw_responses(folder, number, f"vanderpol_p_q_{p}", f"Van der Pol, p = q = {p}", [
            (f"{name}: ", records[name][1], {"SID": models[f"SID, {name}"], "ASIVID": models[f"p = q = {p}, {name}"]})
            for name in ("noise free", "noisy")], 400, "time")
    draw_functions(folder, "4.9", "vanderpol_functions", "Van der Pol, noisy: f, and g up to its linear part",
                   {f"p = q = {p}": models[f"p = q = {p}, noisy"] for p in (2, 4)},
                   plants.van_der_pol_drive, lambda y: -y**3 / 3)
    return found | {"radius": float(np.abs(poles).max()), "angle": float(np.abs(np.angle(poles)).max())}


if __name__ == "__main__":
    run(main)

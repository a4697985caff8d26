"""Section 4.5.3: a Van der Pol oscillator with one measured output, nonlinearities unknown, orthonormal series.

Degree p for f and for the feedback: with p = 2 the cubic damping is not available, from p = 3 on it is. Data by the
difference equation; sampled data of the differential equation (RK4) lie outside the model class. Limit: the error of
the model that minimises it on the estimation record. Run: python ch4_vanderpol.py
"""

import numpy as np
from common import feedback_error, subspace

import optid
from optid import plants

SETTINGS = {"nx": 2, "block_rows": 6}


def record(noise: float, method: str = "euler") -> tuple[optid.Data, optid.Data]:
    """6000 samples for the estimate, 1000 for validation; u uniform within 2."""
    u = np.random.default_rng(3).uniform(-2, 2, 7000)
    return plants.van_der_pol(u, 0, process=noise / 4, measurement=noise, method=method).split(6000)


def identified(train: optid.Data, basis: str, feedback: str) -> optid.HammersteinSS:
    """ASIVID with past outputs among the instruments (the noise is white), no feedthrough."""
    beyond = ":outside=extrapolate"
    return subspace(train, "asivid", basis=basis + beyond, feedback_basis=feedback + beyond, noise="white",
                    feedthrough=False, **SETTINGS)


def main() -> dict[str, float]:
    """Return the error in % of every case, and the poles."""
    found = {}
    clean, noisy, sampled = record(0.0), record(0.02), record(0.0, "rk4")
    cases = [(f"p = q = {p}, {name}", data, f"polynomial:{p}", f"polynomial:{p}", reference)
             for p, references in ((2, ("73", "73")), (3, ("1.2", "7")), (4, ("1.2", "7")))
             for name, data, reference in zip(("noise free", "noisy"), (clean, noisy), references)]
    cases += [("trigonometric feedback, noisy", noisy, "polynomial:4", "trigonometric:4:half_range=1.25", "11.5"),
              ("RK4 data, p = q = 4", sampled, "polynomial:4", "polynomial:4", "15 to 19")]
    print(f"{'Van der Pol, error of y in %':<36}{'here':>9}   reference")
    for name, (train, test), basis, feedback, reference in cases:
        model = identified(train, basis, feedback)
        found[name] = float(feedback_error(model, test)[0])
        print(f"{name:<36}{found[name]:>9.3g}   {reference}")
        if name == "p = q = 4, noisy":
            poles = model.poles
    for name, (train, test) in (("noise free", clean), ("noisy", noisy)):
        found[f"SID, {name}"] = float(feedback_error(subspace(train, "sid", **SETTINGS), test)[0])
        print(f"{'linear SID, ' + name:<36}{found[f'SID, {name}']:>9.3g}   73 to 76")
    found |= {"radius": float(np.abs(poles).max()), "angle": float(np.abs(np.angle(poles)).max())}
    print(f"poles {np.round(poles, 4)}, reference 0.99 +- 0.1j: near the circle, the mean energy injection is in A")
    return found


if __name__ == "__main__":
    main()

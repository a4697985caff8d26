"""Section 4.5.2, Example 1: order 3, two inputs and outputs, nonlinear feedback, nonlinearities known up to scale.

ASIVID against a Hammerstein model without feedback and a linear one (SID); the source's numbers are lost, the reference
is a replacement of its example. The noise floor is the error of the true system with measured feedback.
Run: python ch4_example1.py
"""

import numpy as np
from common import feedback_error, subspace

import optid
from optid import plants

CASES = {  # samples, process and measurement noise, reference: ASIVID, floor, SID
    "noise free": (6000, 0.0, 0.0, "below 0.2", "0", ""),
    "N = 6000": (6000, 0.05, 0.1, "3.2 / 6.2", "2.5 / 4.6", "26 / 32"),
    "N = 7000": (7000, 0.1, 0.3, "8.6 / 17.3", "7.6 / 14.2", "28.6 / 38.6"),
}
BEYOND = {"outside": "extrapolate"}
BASIS = [optid.UserFunctions((lambda u: u, lambda u: u**3), ("u", "u^3"), **BEYOND),
         optid.UserFunctions((lambda u: np.tanh(2 * u),), ("tanh",), **BEYOND)]
FEEDBACK = [optid.UserFunctions((lambda y: -np.sin(y),), ("sine",), **BEYOND),
            optid.UserFunctions((lambda y: -y * np.abs(y) / (1 + y**2),), ("drag",), **BEYOND)]


def floor(test: optid.Data) -> np.ndarray:
    """Error of the true system with the outputs in its feedback taken from the record."""
    p = plants.EXAMPLE1
    true = optid.HammersteinSS(
        A=p.a, B=p.b, C=p.c, D=p.d, E=p.e, output_of=(0, 1),
        nonlinearities=(optid.Nonlinearity(BASIS[0].fitted(-2, 2), np.array([1, 0.5])),
                        optid.Nonlinearity(BASIS[1].fitted(-2, 2), np.ones(1))),
        feedback=tuple(optid.Nonlinearity(b.fitted(-20, 20), np.ones(1)) for b in FEEDBACK),
        inputs=test.inputs, outputs=test.outputs, dt=test.dt)
    return feedback_error(true, test)


def main() -> dict[str, float]:
    """Return the errors of both outputs in % for every case and method."""
    found = {}
    print(f"{'Example 1, error of y1 / y2 in %':<34}{'here':>16}   reference")
    for name, (n, process, measurement, *references) in CASES.items():
        u = np.random.default_rng(1).uniform(-2, 2, (n, 2))
        train, test = plants.EXAMPLE1.record(u, 2, process=process, measurement=measurement).split(n - 1000)
        common = {"nx": 3, "block_rows": 5, "basis": BASIS}
        errors = {
            "ASIVID": feedback_error(subspace(train, "asivid", feedback_basis=FEEDBACK, **common), test),
            "noise floor": floor(test),
            "SID": feedback_error(subspace(train, "sid", nx=3, block_rows=5), test),
            "no feedback": feedback_error(subspace(train, "sid", **common), test),
        }
        for (method, error), reference in zip(errors.items(), [*references, "10.6 / 17" if measurement == 0.1 else ""]):
            print(f"{name + ', ' + method:<34}{error[0]:>8.3g} / {error[1]:.3g}{'':<4}   {reference}")
            found |= {f"{name} {method} y{i + 1}": float(e) for i, e in enumerate(error)}
    return found


if __name__ == "__main__":
    main()

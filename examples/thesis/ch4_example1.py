"""Section 4.5.2, Example 1: order 3, two inputs and outputs, nonlinear feedback, nonlinearities known up to scale.

ASIVID, a Hammerstein model without feedback, a linear one (SID), and the plant itself (noise floor). The source's
numbers are lost; the reference replaces its example. Run: python ch4_example1.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import feedback_error, run, subspace
from drawing import draw_orders, draw_record, draw_responses

import optid
from optid import plants

CASES = {  # figure, samples, process and measurement noise, reference: SID, ASIVID, no feedback, noise floor
    "noise free": ("4.3", 6000, 0.0, 0.0, "", "below 0.2", "", "0"),
    "N = 6000": ("4.4", 6000, 0.05, 0.1, "26 / 32", "3.2 / 6.2", "10.6 / 17", "2.5 / 4.6"),
    "N = 7000": ("4.5", 7000, 0.1, 0.3, "28.6 / 38.6", "8.6 / 17.3", "", "7.6 / 14.2"),
}
BEYOND = {"outside": "extrapolate"}
BASIS = [optid.UserFunctions((lambda u: u, lambda u: u**3), ("u", "u^3"), **BEYOND),
         optid.UserFunctions((lambda u: np.tanh(2 * u),), ("tanh",), **BEYOND)]
FEEDBACK = [optid.UserFunctions((lambda y: -np.sin(y),), ("sine",), **BEYOND),
            optid.UserFunctions((lambda y: -y * np.abs(y) / (1 + y**2),), ("drag",), **BEYOND)]


def true_model(test: optid.Data) -> optid.HammersteinSS:
    """The plant; its error with the measured outputs in the feedback is the noise floor."""
    p, mus = plants.EXAMPLE1, ([1, 0.5], [1], [1], [1])
    functions = [optid.Nonlinearity(b.with_interval(-20, 20), np.array(mu)) for b, mu in zip(BASIS + FEEDBACK, mus)]
    return optid.HammersteinSS(p.a, p.b, p.c, p.d, E=p.e, output_of=(0, 1), nonlinearities=tuple(functions[:2]),
                               feedback=tuple(functions[2:]), inputs=test.inputs, outputs=test.outputs)


def main(folder: Path) -> dict[str, float]:
    """Return the errors of both outputs in % for every case and method; save figures 4.2 to 4.6."""
    found, fits = {}, {}
    print(f"{'Example 1, error of y1 / y2 in %':<34}{'here':>16}   reference")
    for name, (number, n, process, measurement, *references) in CASES.items():
        u, known = np.random.default_rng(1).uniform(-2, 2, (n, 2)), {"nx": 3, "block_rows": 5, "basis": BASIS}
        train, test = plants.EXAMPLE1.record(u, 2, process=process, measurement=measurement).split(n - 1000)
        fits[name] = {"SID": subspace(train, "sid", nx=3, block_rows=5),
                      "ASIVID": subspace(train, "asivid", feedback_basis=FEEDBACK, **known),
                      "no feedback": subspace(train, "sid", **known)}
        models = {method: fit.model for method, fit in fits[name].items()} | {"noise floor": true_model(test)}
        for (method, model), reference in zip(models.items(), references):
            error = feedback_error(model, test)
            print(f"{name + ', ' + method:<34}{error[0]:>8.3g} / {error[1]:.3g}{'':<4}   {reference}")
            found |= {f"{name} {method} y{i + 1}": float(e) for i, e in enumerate(error)}
        draw_responses(folder, number, f"example1_{name.replace(' = ', '_').replace(' ', '_')}", f"Example 1, {name}",
                       [("", test, {method: models[method] for method in ("SID", "ASIVID")})], 60, "sample")
    draw_record(folder, "4.2", "example1_record", "Example 1, N = 7000: record", test.window(0, 100), "sample")
    draw_orders(folder, "4.6", "example1_singular_values", "Example 1 (order 3): singular values", fits)
    return found


if __name__ == "__main__":
    run(main)

"""Sums, polynomials and state-space models as text: equations for few states, a summary beyond."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.models.functions import latent_names, static_functions

READABLE = 4
"""Most states whose equations are written out."""


def signed_terms(terms: Iterable[tuple[float, str]], digits: int = 4) -> str:
    """Write " + 1.5 y(k-1) - 0.7" from values and their names, without the terms that are zero."""
    return "".join(
        f" {'-' if value < 0 else '+'} {abs(value):.{digits}g}" + (f" {name}" if name else "")
        for value, name in terms if value
    )


def signed_sum(terms: Iterable[tuple[float, str]], digits: int = 4) -> str:
    """Write "1.5 y(k-1) - 0.7" from values and their names; "0" where all are zero."""
    text = signed_terms(terms, digits)
    return ("-" if text.startswith(" -") else "") + text[3:] or "0"


def polynomial(coefficients: Iterable[float], digits: int = 4) -> str:
    """Write 1 + c_1 q^-1 + c_2 q^-2 + ..., without the terms that are zero."""
    return "1" + signed_terms(((float(c), f"q^-{i}") for i, c in enumerate(coefficients, start=1)), digits)


def state_equations(model: Any, digits: int = 4) -> str:
    """Write a state-space model as equations: one per state up to four states, in matrices beyond."""
    return _equations(model, digits) if model.nx <= READABLE else _summary(model)


def matrix_entries(model: Any) -> list[tuple[str, float]]:
    """Return (name, value) of the entries of all matrices, as tables show them; zero matrices are left out."""
    functions, fed = _names(model)
    words, signals = latent_names(model)
    states = [f"x{i + 1}" for i in range(model.nx)]
    columns = {
        "A": (states, states), "B": (states, functions), "C": (model.outputs, states), "D": (model.outputs, functions),
        "E": (states, fed), "L": (states, model.outputs), "K": (states, model.outputs),
        **dict(zip(("Ez", "Fz", "Cz", "Dz"), ((states, words), (model.outputs, words), (signals, states),
                                              (signals, model.inputs)))),
    }
    found = []
    for name, (rows, names) in columns.items():
        matrix = getattr(model, name)
        if name in "ABC" or np.any(matrix):
            found += [(f"{name}[{rows[i]},{names[j]}]", float(value)) for (i, j), value in np.ndenumerate(matrix)]
    for name, rows in (("offset_x", states), ("offset_y", model.outputs), ("offset_z", signals)):
        if np.any(getattr(model, name)):
            found += [(f"{name}[{row}]", float(value)) for row, value in zip(rows, getattr(model, name))]
    return found


def _names(model: Any) -> tuple[list[str], list[str]]:
    """Words of the functions of inputs and outputs; of a linear function that an input has alone the input's name."""
    found = static_functions(model)
    alone = [f.is_linear and model.input_of.count(f.channel) == 1 for f in found]
    own = [f.name if linear else f.word for f, linear in zip(found, alone) if not f.fed_back]
    return own, [f.word for f in found if f.fed_back]


def _equations(model: Any, digits: int) -> str:
    functions, (names, words) = [], _names(model)
    for f, c, name in zip(model.nonlinearities, model.input_of, names):
        sample = f"{model.inputs[c]}(k)"
        linear = name == model.inputs[c]
        functions.append((float(f.mu[0]), sample) if linear else (1.0, f"{name}({sample})"))
    fed = [(1.0, f"{name}({model.outputs[o]}(k))") for name, o in zip(words, model.output_of)]
    states = [(1.0, f"x{i + 1}(k)") for i in range(model.nx)]
    measured = [(1.0, f"{name}(k)") for name in model.outputs]
    errors = [(1.0, f"e_{name}(k)" if model.l > 1 else "e(k)") for name in model.outputs]
    one, (inner, signals) = [(1.0, "")], latent_names(model)
    latent, inputs = [(1.0, f"{h}({z}(k))") for h, z in zip(inner, signals)], [(1.0, f"{u}(k)") for u in model.inputs]
    lines = []
    for i in range(model.nx):
        rows = [
            (model.A[i], states), (model.B[i], functions), (model.E[i], fed), (model.L[i], measured),
            (model.Ez[i], latent), (model.offset_x[[i]], one), (model.K[i], errors),
        ]
        lines.append(f"x{i + 1}(k+1) = {_sum(rows, digits)}")
    for o, name in enumerate(model.outputs):
        rows = [(model.C[o], states), (model.D[o], functions), (model.Fz[o], latent), (model.offset_y[[o]], one)]
        tail = f" + {errors[o][1]}" if np.any(model.K) else ""
        lines.append(f"{name}(k) = {_sum(rows, digits)}{tail}")
    for i, name in enumerate(signals):
        rows = [(model.Cz[i], states), (model.Dz[i], inputs), (model.offset_z[[i]], one)]
        lines.append(f"{name}(k) = {_sum(rows, digits)}")
    return "\n".join(lines)


def _sum(rows: Sequence[tuple[Array, Sequence[tuple[float, str]]]], digits: int) -> str:
    """Write the sum of rows of coefficients times (scale, name) of what they multiply."""
    terms = [(float(v) * scale, name) for values, words in rows for v, (scale, name) in zip(values, words)]
    return signed_sum(terms, digits)


def _summary(model: Any) -> str:
    arguments = ", ".join(model.inputs)
    state = f"x(k+1) = A x(k) + B f({arguments})"
    if model.feedback:
        state += f" + E g({', '.join(dict.fromkeys(model.outputs[o] for o in model.output_of))})"
    for name, term in (("L", "L y(k)"), ("Ez", "Ez h(z)"), ("offset_x", "offset_x"), ("K", "K e(k)")):
        state += f" + {term}" if np.any(getattr(model, name)) else ""
    output = "y(k) = C x(k)" + (f" + D f({arguments})" if np.any(model.D) else "")
    output += " + Fz h(z)" if np.any(model.Fz) else ""
    output += (" + offset_y" if np.any(model.offset_y) else "") + (" + e(k)" if np.any(model.K) else "")
    sizes = f"{model.nx} states, {len(model.nonlinearities)} functions of the inputs"
    sizes += f", {len(model.feedback)} of the outputs" if model.feedback else ""
    names = "A, B, C, D, E" if model.feedback else "A, B, C, D"
    if model.latent:
        output += "\nz(k) = Cz x(k) + Dz u(k) + offset_z"
        sizes += f", {len(model.latent)} of latent signals"
        names += ", Ez, Fz, Cz, Dz"
    return f"{state}\n{output}\n{sizes}; the matrices are {names} of the model"

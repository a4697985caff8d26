"""A state-space model as text: equations for few states, a summary beyond."""

from collections.abc import Sequence

import numpy as np

from optid.arrays import Array
from optid.models.functions import static_functions
from optid.models.state_space import StateSpace
from optid.models.text import signed_sum

READABLE = 4
"""Most states whose equations are written out."""


def written(model: StateSpace, digits: int = 4) -> str:
    """Write the equations with coefficients of so many significant digits; see `HammersteinSS.equation`."""
    return _equations(model, digits) if model.nx <= READABLE else _summary(model)


def listed(model: StateSpace) -> list[tuple[str, float]]:
    """Names and values of all matrices, one line each; see `HammersteinSS.coefficients`."""
    functions, fed = _function_names(model), _feedback_names(model)
    states = [f"x{i + 1}" for i in range(model.nx)]
    columns = {
        "A": (states, states), "B": (states, functions), "C": (model.outputs, states), "D": (model.outputs, functions),
        "E": (states, fed), "L": (states, model.outputs), "K": (states, model.outputs),
    }
    found = []
    for name, (rows, names) in columns.items():
        matrix = getattr(model, name)
        if name in "ABC" or np.any(matrix):
            found += [(f"{name}[{rows[i]},{names[j]}]", float(value)) for (i, j), value in np.ndenumerate(matrix)]
    for name, rows in (("offset_x", states), ("offset_y", model.outputs)):
        if np.any(getattr(model, name)):
            found += [(f"{name}[{row}]", float(value)) for row, value in zip(rows, getattr(model, name))]
    return found


def _function_names(model: StateSpace) -> list[str]:
    """Words of the functions of the inputs; the input itself where it is linear and has no other."""
    found = [function for function in static_functions(model) if not function.fed_back]
    several = [model.input_of.count(function.channel) > 1 for function in found]
    return [
        function.name if function.is_linear and not many else function.word for function, many in zip(found, several)
    ]


def _feedback_names(model: StateSpace) -> list[str]:
    return [function.word for function in static_functions(model) if function.fed_back]


def _equations(model: StateSpace, digits: int) -> str:
    functions = []
    for (f, c), name in zip(zip(model.nonlinearities, model.input_of), _function_names(model)):
        sample = f"{model.inputs[c]}(k)"
        linear = name == model.inputs[c]
        functions.append((float(f.mu[0]), sample) if linear else (1.0, f"{name}({sample})"))
    fed = [(1.0, f"{name}({model.outputs[o]}(k))") for name, o in zip(_feedback_names(model), model.output_of)]
    states = [(1.0, f"x{i + 1}(k)") for i in range(model.nx)]
    measured = [(1.0, f"{name}(k)") for name in model.outputs]
    errors = [(1.0, f"e_{name}(k)" if model.l > 1 else "e(k)") for name in model.outputs]
    one = [(1.0, "")]
    lines = []
    for i in range(model.nx):
        rows = [
            (model.A[i], states), (model.B[i], functions), (model.E[i], fed), (model.L[i], measured),
            (model.offset_x[[i]], one), (model.K[i], errors),
        ]
        lines.append(f"x{i + 1}(k+1) = {_sum(rows, digits)}")
    for o, name in enumerate(model.outputs):
        rows = [(model.C[o], states), (model.D[o], functions), (model.offset_y[[o]], one)]
        tail = f" + {errors[o][1]}" if np.any(model.K) else ""
        lines.append(f"{name}(k) = {_sum(rows, digits)}{tail}")
    return "\n".join(lines)


def _sum(rows: Sequence[tuple[Array, Sequence[tuple[float, str]]]], digits: int) -> str:
    """Write the sum of rows of coefficients times (scale, name) of what they multiply."""
    terms = [(float(v) * scale, name) for values, words in rows for v, (scale, name) in zip(values, words)]
    return signed_sum(terms, digits)


def _summary(model: StateSpace) -> str:
    arguments = ", ".join(model.inputs)
    state = f"x(k+1) = A x(k) + B f({arguments})"
    if model.feedback:
        state += f" + E g({', '.join(dict.fromkeys(model.outputs[o] for o in model.output_of))})"
    for name, term in (("L", "L y(k)"), ("offset_x", "offset_x"), ("K", "K e(k)")):
        state += f" + {term}" if np.any(getattr(model, name)) else ""
    output = "y(k) = C x(k)" + (f" + D f({arguments})" if np.any(model.D) else "")
    output += (" + offset_y" if np.any(model.offset_y) else "") + (" + e(k)" if np.any(model.K) else "")
    sizes = f"{model.nx} states, {len(model.nonlinearities)} functions of the inputs"
    sizes += f", {len(model.feedback)} of the outputs" if model.feedback else ""
    names = "A, B, C, D, E" if model.feedback else "A, B, C, D"
    return f"{state}\n{output}\n{sizes}; the matrices are {names} of the model"

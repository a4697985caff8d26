"""Models as text: sums, polynomials, and equations; of state-space models with many states a summary."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from optid.models.functions import latent_names, static_functions
from optid.models.state_space import MATRICES

READABLE = 4  # most states whose equations are written out
# the matrices of every equation in the order in which they are written, and what they multiply
TERMS = {"x": {"A": "x", "B": "f", "E": "g", "L": "y", "Ez": "h", "offset_x": "", "K": "e"},
         "y": {"C": "x", "D": "f", "Fz": "h", "offset_y": ""},
         "z": {"Cz": "x", "Dz": "u", "offset_z": ""}}


def signed_terms(terms: Iterable[tuple[float, str]], digits: int = 4) -> str:
    """Write " + 1.5 y(k-1) - 0.7" from values and their names, without the terms that are zero."""
    return "".join(f" {'-' if value < 0 else '+'} {abs(value):.{digits}g}" + (f" {name}" if name else "")
                   for value, name in terms if value)


def signed_sum(terms: Iterable[tuple[float, str]], digits: int = 4) -> str:
    """Write "1.5 y(k-1) - 0.7" from values and their names; "0" where all are zero."""
    text = signed_terms(terms, digits)
    return ("-" if text.startswith(" -") else "") + text[3:] or "0"


def polynomial(coefficients: Iterable[float], digits: int = 4) -> str:
    """Write 1 + c_1 q^-1 + c_2 q^-2 + ..., without the terms that are zero."""
    return "1" + signed_terms(((float(c), f"q^-{i}") for i, c in enumerate(coefficients, start=1)), digits)


def noise(model: Any) -> str:
    """Write C and D of a transfer-function model; "" for ARX, whose name says it."""
    c, d = polynomial(model.c), polynomial(() if model.d is None else model.d)
    return {"arx": "", "armax": f"C = {c}, D = A", "bj": f"C = {c}, D = {d}",
            "oe": "e is added to the output: C = D = 1"}[model.structure]


def coefficients(model: Any) -> list[tuple[str, float]]:
    """Return (name, value) of every coefficient of A, B, the offset, C and (Box-Jenkins) D, as tables show them."""
    several, found = model.l > 1, []
    for (i, *pair), value in np.ndenumerate(model.a):
        pair = f"[{','.join(model.outputs[o] for o in pair)}]" if several else ""
        found.append((f"a{i + 1}{pair}", float(value)))
    for channel, b in zip(model.inputs, model.b):
        for (j, *output), value in np.ndenumerate(b):
            words = ([channel] if model.m > 1 else []) + [model.outputs[o] for o in output]
            found.append((f"b{j}" + (f"[{','.join(words)}]" if words else ""), float(value)))
    for name, value in zip(model.outputs, model.offset):
        found.append((f"offset[{name}]" if several else "offset", float(value)))
    for name, values in (("c", model.c), ("d", () if model.d is None else model.d)):
        found += [(f"{name}{i}", float(value)) for i, value in enumerate(values, start=1)]
    return found


def equations(model: Any, digits: int = 4) -> str:
    """Write the model as difference equations, one per output; of the noise where D is apart.

    f is `f`: where its offset is identifiable the constant is inside f, otherwise it stands at the end.
    """
    noise = signed_terms(((v, f"e(k-{i})") for i, v in enumerate(model.c, start=1)), digits)
    if model.d is None:
        lines = [_equation(model, o, model.outputs, digits) for o in range(model.l)]
        return "\n".join(lines) + (" + e(k)" + noise if model.c.size else "")
    name = model.outputs[0]
    x = next(word for word in ("x", "x0", "x_plant", f"{name}_x") if word not in (*model.inputs, name))
    plant = _equation(model, 0, (x,), digits)
    if model.structure == "oe":
        return f"{plant}\n{name}(k) = {x}(k) + e(k)"
    past = signed_terms(((-v, f"v(k-{i})") for i, v in enumerate(model.d, start=1)), digits)
    return f"{plant}\nv(k) = e(k){noise}{past}\n{name}(k) = {x}(k) + v(k)"


def _equation(model: Any, o: int, outputs: tuple[str, ...], digits: int) -> str:
    terms = []
    for i, matrix in enumerate(model.matrices, start=1):
        terms += [(-float(matrix[o, p]), f"{name}(k-{i})") for p, name in enumerate(outputs)]
    for c, (name, f) in enumerate(zip(model.inputs, model.nonlinearities)):
        function = "f" if model.m == 1 else f"f_{name}"
        for lag, b in enumerate(model.numerators[:, o, c]):
            sample = f"{name}(k-{lag})" if lag else f"{name}(k)"
            gain = float(b) * (float(f.mu[0]) if f.is_linear else 1.0)
            terms.append((gain, sample if f.is_linear else f"{function}({sample})"))
    if model.c0 is None:
        terms.append((float(model.offset[o]), ""))
    return f"{outputs[o]}(k) = {signed_sum(terms, digits)}"


def state_equations(model: Any, digits: int = 4) -> str:
    """Write a state-space model as equations: one per state up to four states, in matrices beyond."""
    if model.nx > READABLE:
        return _summary(model)
    functions, (names, words), (inner, latent) = [], _names(model), latent_names(model)
    for f, c, name in zip(model.nonlinearities, model.input_of, names):
        sample = f"{model.inputs[c]}(k)"
        linear = name == model.inputs[c]
        functions.append((float(f.mu[0]), sample) if linear else (1.0, f"{name}({sample})"))
    errors = [f"e_{name}(k)" if model.l > 1 else "e(k)" for name in model.outputs]
    samples = {
        "x": [f"x{i + 1}(k)" for i in range(model.nx)], "y": [f"{name}(k)" for name in model.outputs], "e": errors,
        "g": [f"{name}({model.outputs[o]}(k))" for name, o in zip(words, model.output_of)], "": [""],
        "h": [f"{h}({z}(k))" for h, z in zip(inner, latent)], "u": [f"{name}(k)" for name in model.inputs]}
    signals = {signal: [(1.0, name) for name in names] for signal, names in samples.items()} | {"f": functions}
    lines = []
    for kind, left in (("x", [f"x{i + 1}(k+1)" for i in range(model.nx)]), ("y", samples["y"]),
                       ("z", [f"{name}(k)" for name in latent])):
        for i, name in enumerate(left):
            terms = [(float(value) * scale, word) for matrix, signal in TERMS[kind].items()
                     for value, (scale, word) in zip(np.atleast_1d(getattr(model, matrix)[i]), signals[signal])]
            tail = f" + {errors[i]}" if kind == "y" and np.any(model.K) else ""
            lines.append(f"{name} = {signed_sum(terms, digits)}{tail}")
    return "\n".join(lines)


def matrix_entries(model: Any) -> list[tuple[str, float]]:
    """Return (name, value) of the entries of all matrices, as tables show them; zero matrices are left out."""
    functions, fed = _names(model)
    words, signals = latent_names(model)
    columns = {"n": [f"x{i + 1}" for i in range(model.nx)], "r": functions, "s": fed, "l": model.outputs, "k": words,
               "m": model.inputs}
    rows, found = {**columns, "k": signals}, []
    for name, (row, *column) in sorted(MATRICES.items(), key=lambda item: -len(item[1])):  # the constants come last
        if name in "ABC" or np.any(getattr(model, name)):
            axes = [rows[row], *(columns[letter] for letter in column)]
            found += [(f"{name}[{','.join(axis[i] for axis, i in zip(axes, at))}]", float(value))
                      for at, value in np.ndenumerate(getattr(model, name))]
    return found


def _names(model: Any) -> tuple[list[str], list[str]]:
    """Words of the functions of inputs and outputs; of a linear function that an input has alone the input's name."""
    found = static_functions(model)
    alone = [f.is_linear and model.input_of.count(f.channel) == 1 for f in found]
    own = [f.name if linear else f.word for f, linear in zip(found, alone) if f.family == "nonlinearities"]
    return own, [f.word for f in found if f.family == "feedback"]


def _summary(model: Any) -> str:
    fed = ", ".join(dict.fromkeys(model.outputs[o] for o in model.output_of))
    words = {"x": " x(k)", "f": f" f({', '.join(model.inputs)})", "g": f" g({fed})", "y": " y(k)", "h": " h(z)",
             "u": " u(k)", "e": " e(k)", "": ""}
    always = {"A", "B", "C", "Cz", "Dz", "offset_z"} | ({"E"} if model.feedback else set())
    state, output, latent = (
        " + ".join(matrix + words[signal] for matrix, signal in terms.items()
                   if matrix in always or np.any(getattr(model, matrix))) for terms in TERMS.values())
    text = f"x(k+1) = {state}\ny(k) = {output}{' + e(k)' * bool(np.any(model.K))}\n"
    sizes = f"{model.nx} states, {len(model.nonlinearities)} functions of the inputs"
    sizes += f", {len(model.feedback)} of the outputs" if model.feedback else ""
    names = "A, B, C, D, E" if model.feedback else "A, B, C, D"
    if model.latent:
        text += f"z(k) = {latent}\n"
        sizes += f", {len(model.latent)} of latent signals"
        names += ", Ez, Fz, Cz, Dz"
    return f"{text}{sizes}; the matrices are {names} of the model"

"""A model as text: one difference equation per output."""

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from optid.bases.expansions import Linear
from optid.models import simulation

if TYPE_CHECKING:
    from optid.models.hammerstein_arx import HammersteinARX
    from optid.models.hammerstein_tf import HammersteinTF


def written(model: "HammersteinARX", digits: int = 4) -> str:
    """Write one difference equation per output, with coefficients of so many significant digits."""
    return "\n".join(_equation(model, o, digits) for o in range(model.l))


def written_with_noise(model: "HammersteinTF", digits: int = 4) -> str:
    """Write the equations of a model with a noise filter: of the plant and, where it is apart, of the noise."""
    name = model.outputs[0]
    noise = "".join(f" {'-' if v < 0 else '+'} {abs(v):.{digits}g} e(k-{i})" for i, v in enumerate(model.c, 1) if v)
    if model.shares_poles:
        return written(model.plant, digits) + " + e(k)" + noise
    x = next(word for word in ("x", "x0", "x_plant", f"{name}_x") if word not in (*model.inputs, name))
    plant = written(replace(model.plant, outputs=(x,)), digits)
    if model.structure == "oe":
        return f"{plant}\n{name}(k) = {x}(k) + e(k)"
    past = "".join(f" {'+' if v < 0 else '-'} {abs(v):.{digits}g} v(k-{i})" for i, v in enumerate(model.d, 1) if v)
    return f"{plant}\nv(k) = e(k){noise}{past}\n{name}(k) = {x}(k) + v(k)"


def polynomial(coefficients: Iterable[float], digits: int = 4) -> str:
    """Write 1 + c_1 q^-1 + c_2 q^-2 + ..., without the terms that are zero."""
    terms = [f" {'-' if c < 0 else '+'} {abs(c):.{digits}g} q^-{i}" for i, c in enumerate(coefficients, start=1) if c]
    return "1" + "".join(terms)


def _equation(model: "HammersteinARX", o: int, digits: int) -> str:
    terms = []
    for i, matrix in enumerate(simulation.matrices_of(model), start=1):
        terms += [(-float(matrix[o, p]), f"{name}(k-{i})") for p, name in enumerate(model.outputs)]
    for c, (name, f) in enumerate(zip(model.inputs, model.nonlinearities)):
        linear = isinstance(f.basis, Linear)
        function = "f" if model.m == 1 else f"f_{name}"
        for lag, row in simulation.lagged(model, c):
            sample = f"{name}(k-{lag})" if lag else f"{name}(k)"
            gain = float(row[o]) * (float(f.mu[0]) if linear else 1.0)
            terms.append((gain, sample if linear else f"{function}({sample})"))
    if model.c0 is None:
        terms.append((float(model.offset[o]), ""))
    text = ""
    for value, name in terms:
        if value:
            size = f"{abs(value):.{digits}g}" + (f" {name}" if name else "")
            text += (" - " if value < 0 else " + ") + size
    text = text.removeprefix(" + ")
    text = "-" + text.removeprefix(" - ") if text.startswith(" - ") else text
    return f"{model.outputs[o]}(k) = {text or '0'}"

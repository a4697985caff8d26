"""The static characteristic ``y = (f(u) sum(b) + d) / (1 + sum(a))`` in the variables of a formulation.

In state space it is ``C (I - A)^-1 B f(u) + D f(u) + d``.
"""

from typing import Any

import cvxpy as cp
import numpy as np

from optid.errors import StructureError
from optid.program.limits import Limit
from optid.program.view import View

SETTLES = 1e-6
"""Least ``1 + sum(a)`` of a model that has a static characteristic."""


def basis_of(view: View, channel: str | None) -> Any:
    """Return the basis of an input, of the only one where none is named.

    Raises:
        StructureError: several inputs and none named, or no such input.
    """
    if channel is None:
        if len(view.channels) != 1:
            raise StructureError(f"this constraint needs channel=, one of {', '.join(view.channels)}")
        channel = view.channels[0]
    if channel not in view.bases:
        raise StructureError(f"there is no input {channel!r}; the inputs are {', '.join(view.channels)}")
    return view.bases[channel]


def static_theta(view: View, channel: str | None, output: str | None = None) -> Any:
    """Coefficients of the static curve, times ``1 + sum(a)``: Theta summed over the lags, or through A, B, C and D."""
    basis_of(view, channel)
    if view.kind == "realisation":
        a, c = view.reference["A"], view.reference["C"]
        try:
            row = np.linalg.solve((np.eye(len(a)) - a).T, c[output_index(view, output)])
        except np.linalg.LinAlgError:
            raise StructureError("the model has a pole at 1, hence no static characteristic; add 'stable'") from None
        return view[view.key("Theta", channel)] @ through_matrices(view, channel, row, output)
    if view.kind == "tangent" and "C" in view.reference:  # states: to first order in A, B, C and D
        if view.key("static", channel) not in view:
            raise StructureError("nonlinear feedback: the static characteristic does not follow from the inputs alone")
        return view[view.key("static", channel)][:, output_index(view, output)]
    if view["offset"].size > 1:
        raise StructureError("constraints on the static characteristic are defined for one output")
    if view.key("Theta", channel) not in view:  # a linear model has b alone
        return cp.hstack([cp.sum(view[view.key("b", channel)])])
    return cp.sum(view[view.key("Theta", channel)], axis=1)


def through_matrices(view: View, channel: str | None, row: np.ndarray, output: str | None, direct: float = 1.0
                     ) -> np.ndarray:
    """Return the weights w of one output with ``Theta w = (row B + direct D_output) of every function``.

    Args:
        view: of a realisation step; Theta is (functions, n) where the input has no direct feedthrough.
        channel: name of the input.
        row: (n,) weights of the states.
        output: name of the output.
        direct: weight of its feedthrough.
    """
    a, c = view.reference["A"], view.reference["C"]
    weights = np.concatenate([row, np.zeros(len(c))])
    weights[len(a) + output_index(view, output)] = direct
    return weights[: view[view.key("Theta", channel)].shape[1]]


def output_index(view: View, output: str | None) -> int:
    """Position of an output; the only one where none is named.

    Raises:
        StructureError: several outputs and none named, or no such output.
    """
    if output is None and len(view.reference["C"]) == 1:
        return 0
    if output not in view.outputs:
        wrong = "needs output=" if output is None else f"names no output {output!r}"
        raise StructureError(f"this constraint {wrong}; the outputs are {', '.join(view.outputs)}")
    return view.outputs.index(output)


def offset_of(view: View, output: str | None) -> Any:
    """Return the constant of the curve of an output, times ``1 + sum(a)``."""
    if "C" in view.reference:
        level = view["offset"][output_index(view, output)] if "offset" in view else 0.0
        for channel, origin in zip(view.channels, view.units.u_offset if view.units else ()):
            if origin:  # the programme counts a linear input from its level
                level = level - origin * static_theta(view, channel, output)[0]
        return level
    return view["offset"][0]


def denominator(view: View) -> Any:
    """Return ``1 + sum(a)``, one where there is no a."""
    return 1 + cp.sum(view["a"]) if "a" in view else 1.0


def settles(view: View) -> list[Any]:
    """Return the constraint ``1 + sum(a) > 0``, without which there is no static characteristic."""
    return [Limit(denominator(view) >= SETTLES, bound="settles")] if "a" in view else []

"""Constraints on the responses of a state-space model, in the step that chooses B and D with A and C held.

With ``Theta_c = functions x [B_c; D_c]`` the effect of an input on an output after k samples is linear in Theta:
``C A^(k-1) B`` and, at once, D. Positive realness is a linear matrix inequality in (B, D) and a matrix P of its own
when it is stated on the transposed system. ``channel`` and ``output`` are names, needed where there are several.
"""

from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.rule import Rule, label, recorded, sign_of
from formulations.constraints.shape import slopes_at
from optid.errors import StructureError
from optid.program.limits import Limit
from optid.program.view import View

__all__ = ["impulse_response", "no_effect", "positive_real", "step_response"]

HORIZON = 50  # samples over which the sign of a response is imposed
REAL = 1e-9  # least eigenvalue in the inequality of positive realness, relative to the size of C


@recorded
def impulse_response(sign: str = "positive", horizon: float = HORIZON, at: float | None = None,
                     channel: str | None = None, output: str | None = None) -> Rule:
    """The response to a small impulse at an operating point has one sign.

    Args:
        sign: "positive" or "negative".
        horizon: samples over which it is imposed.
        at: operating point; default the middle of the interval.

    Raises:
        StructureError: unknown sign, or a horizon below one.
    """
    return _response("impulse_response", sign, horizon, channel, output, lambda basis: slopes_at(basis, at)[0],
                     summed=False)


@recorded
def step_response(sign: str = "positive", horizon: float = HORIZON, low: float | None = None,
                  high: float | None = None, channel: str | None = None, output: str | None = None) -> Rule:
    """The response to a step of the input from ``low`` up to ``high`` has one sign at every sample: no undershoot.

    By default the step goes over the interval of the basis. Other arguments as in `impulse_response`, as are the errors
    raised.
    """

    def rows(basis: Any) -> np.ndarray:
        ends = basis.interval[0] if low is None else low, basis.interval[1] if high is None else high
        values = basis.values(np.array(ends, dtype=float))
        return values[1] - values[0]

    return _response("step_response", sign, horizon, channel, output, rows, summed=True)


@recorded
def no_effect(channel: str, output: str | None = None) -> Rule:
    """An input acts on no output, or not on a given one: its column of the transfer matrix is zero there."""

    def build(view: View) -> Any:
        _needs_realisation(view, "no_effect")
        theta = view[view.key("Theta", view.channel(channel))]
        if output is None:
            return Limit(theta == 0, band=np.eye(theta.size), span=np.eye(theta.size))
        rows = markov_rows(view, channel, output, len(view.reference["A"]) + 1)
        # the rows of an output that does not see every state are dependent: a basis of them says the same
        left, sizes, _ = np.linalg.svd(rows.T, full_matrices=False)
        independent = left[:, sizes > 1e-10 * sizes[0]].T
        return Limit((theta @ independent.T).T == 0, band=rows, span=independent)

    return Rule(f"no_effect:{channel}" + ("" if output is None else f",{output}"), build)


@recorded
def positive_real(margin: float = 0.0) -> Rule:
    """The transfer matrix is positive real: ``G + G* >= 2 margin`` on and outside the unit circle.

    The margin, in units of the gain, is the least passivity. Needs as many inputs as outputs, one function per input (a
    linear model, or known nonlinearities), and a stable A.

    Raises:
        StructureError: a negative margin.
    """
    if margin < 0:
        raise StructureError(f"the margin of positive realness is not negative; got {margin!r}")

    def build(view: View) -> Any:
        _needs_realisation(view, "positive_real")
        a, c = view.reference["A"], view.reference["C"]
        n, l = len(a), len(c)  # noqa: E741
        thetas = [view[view.key("Theta", channel)] for channel in view.channels]
        if len(thetas) != l or any(theta.shape[0] != 1 for theta in thetas):
            raise StructureError(f"positive_real needs one function for each of as many inputs as outputs; there are "
                                 f"{l} outputs and inputs with {', '.join(str(t.shape[0]) for t in thetas)} functions")
        columns = [cp.hstack([t[0], np.zeros(n + l - t.shape[1])]) for t in thetas]
        whole = cp.vstack(columns).T
        b, d = whole[:n], whole[n:]
        p = view.auxiliary("P of positive_real", (n, n), symmetric=True)
        corner = b - a @ p @ c.T
        lmi = cp.bmat([[p - a @ p @ a.T, corner], [corner.T, d + d.T - c @ p @ c.T - 2 * margin * np.eye(l)]])
        lowered = np.diag(np.repeat([0.0, 2.0], [n, l])).ravel()
        return [Limit(lmi - REAL * np.linalg.norm(c) * np.eye(n + l) >> 0, lowered)]

    return Rule("positive_real" + (f":{margin:g}" if margin else ""), build)


def markov_rows(view: View, channel: str | None, output: str | None, count: int) -> np.ndarray:
    """Return (count, n + l or n) weights whose products with Theta are D, C B, C A B, ... of one output."""
    a, c = view.reference["A"], view.reference["C"]
    row = c[view.output(output)]
    found = [view.weights(channel, np.zeros(len(a)), output)]
    for _ in range(count - 1):
        found.append(view.weights(channel, row, output, direct=0.0))
        row = row @ a
    return np.array(found)


def _response(word: str, sign: str, horizon: float, channel: str | None, output: str | None, rows: Any, *,
              summed: bool) -> Rule:
    factor = sign_of("sign", sign, "positive", "negative")
    if horizon < 1:
        raise StructureError(f"the horizon is at least one sample; got {horizon!r}")

    def build(view: View) -> Any:
        _needs_realisation(view, word)
        one = view.channel(channel)
        weights = markov_rows(view, one, output, int(horizon) + 1)
        weights = np.cumsum(weights, axis=0) if summed else weights
        sizes = np.linalg.norm(weights, axis=1)
        weights = weights[sizes > 1e-12 * np.max(sizes, initial=0.0)]
        return factor * (weights @ view[view.key("Theta", one)].T @ rows(view.bases[one])) >= 0

    return Rule(label(f"{word}:{sign}", channel, output), build)


def _needs_realisation(view: View, word: str) -> None:
    if not view.holds_matrices:
        raise StructureError(f"constraint {word!r} acts where B and D of a state-space model are chosen; "
                             "this formulation has no such step")

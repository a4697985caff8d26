"""Constraints on responses: of a state-space model in the step that chooses B and D with A and C held.

With ``Theta_c = functions x [B_c; D_c]`` the effect of an input on an output after k samples is linear in Theta:
``C A^(k-1) B`` and, at once, D. Positive realness is a linear matrix inequality in (B, D) and an auxiliary matrix P
when it is stated on the transposed system. The step response of a polynomial model, too, can be kept in a band, by its
tangent. ``channel`` and ``output`` are names, needed where there are several.
"""

from collections.abc import Mapping
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import toeplitz

from formulations.constraints.rule import Rule, check_bounds, label, record_arguments, sign_of
from formulations.constraints.shape import slopes_at
from optid.errors import StructureError
from optid.program.limits import Limit
from optid.program.view import View

__all__ = ["impulse_response", "no_effect", "positive_real", "step_band", "step_response"]

LATEST = 10_000  # last sample of a band: its rows are held
HORIZON = 50  # samples over which the sign of a response is imposed
REAL = 1e-9  # least eigenvalue in the inequality of positive realness, relative to the size of C


@record_arguments
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


@record_arguments
def step_response(sign: str = "positive", horizon: float = HORIZON, low: float | None = None,
                  high: float | None = None, channel: str | None = None, output: str | None = None) -> Rule:
    """The response to a step of the input from ``low`` up to ``high`` has one sign at every sample: no undershoot.

    By default the step goes over the interval of the basis. Other arguments as in `impulse_response`, as are the errors
    raised.
    """
    return _response("step_response", sign, horizon, channel, output, lambda basis: _step(basis, low, high),
                     summed=True)


@record_arguments
def step_band(low: float | None = None, high: float | None = None, first: float = 0, last: float = HORIZON,
              channel: str | None = None, output: str | None = None, around: Any = None) -> Rule:
    """The response to a step of the input over the interval of its basis lies in [low, high] from sample first to last.

    Exact in the state-space formulations, and for equation errors without past outputs. With past outputs the response
    is bilinear in A and the rest; the rule is then its tangent at a model. Repeated fits, each around the model of the
    fit before, end where the response itself obeys; the fit says whether it does.

    Args:
        low: lower bound, in units of the output.
        high: upper bound.
        first: first sample, counted from that of the step.
        last: last sample.
        around: the model for the tangent, such as that of the fit without this rule.

    Raises:
        StructureError: no bound, crossing bounds, no sample, or no model where one is needed.
    """
    check_bounds("step_band", low, high)
    if not 0 <= first <= last <= LATEST:
        raise StructureError(f"step_band needs 0 <= first <= last <= {LATEST}; got {first!r}, {last!r}")
    if around is not None and not (hasattr(around, "a") and hasattr(around, "inputs")):
        raise StructureError(f"step_band: around= takes a model with past outputs, such as fit.model; got {around!r}")
    name, count = label("step_band", channel, output), int(last) + 1

    def build(view: View) -> Any:
        one = view.channel(channel)
        theta, step = view[view.key("Theta", one)], _step(view.basis(one), None, None)
        if view.holds_matrices:
            response = np.cumsum(markov_rows(view, one, output, count), axis=0) @ theta.T @ step
        elif one not in view.delays or view["offset"].size > 1:
            raise StructureError("step_band is defined for equation errors of one output, and for state-space "
                                 "formulations that choose B and D with A and C held")
        else:
            reached = np.subtract.outer(np.arange(count) - view.delays[one], np.arange(theta.shape[1])) >= 0
            response = reached.astype(float) @ theta.T @ step
            if "a" in view:
                from scipy.signal import lfilter

                if around is None:
                    raise StructureError("step_band needs around=, the model of a fit without it, where there are "
                                         "past outputs")
                a = np.asarray(around.a, dtype=float)
                if a.shape != view["a"].shape or one not in around.inputs:
                    raise StructureError("step_band: the model around= has other orders or inputs than this fit")
                c = around.inputs.index(one)
                before = _stepped(around, c, count)
                moved = toeplitz(np.append(0.0, before[:-1]), np.zeros(a.size)) @ (view["a"] - a)
                pulse = lfilter([1.0], [1.0, *a], np.eye(1, count)[0])  # of 1 / A
                response = toeplitz(pulse, np.zeros(count)) @ (response - moved)
        inside = response[int(first):]
        return [*([Limit(inside >= low, bound="low")] if low is not None else []),
                *([Limit(inside <= high, bound="high")] if high is not None else [])]

    def verify(model: Any) -> str:
        c = 0 if channel is None else model.inputs.index(channel)
        found = _stepped(model, c, count, 0 if output is None else model.outputs.index(output))[int(first):]
        room = 1e-3 * float(np.ptp(found))
        obeys = (low is None or np.min(found) >= low - room) and (high is None or np.max(found) <= high + room)
        return "" if obeys else (f"constraint {name!r}: the step response goes from {np.min(found):.4g} to "
                                 f"{np.max(found):.4g}; fit again around this model")

    def stand_in(arguments: Mapping[str, Any]) -> str:
        return "its tangent" if around is not None and arguments.get("na") else ""

    return Rule(name, build, verify, stand_in=stand_in)


@record_arguments
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


@record_arguments
def positive_real(margin: float = 0.0) -> Rule:
    """The transfer matrix is positive real: ``G + G* >= 2 margin`` on and outside the unit circle.

    The margin, in units of the gain, is the least passivity. Needs as many inputs as outputs, one function per input (a
    linear model, or known nonlinearities), and a stable A.

    Raises:
        StructureError: a negative margin.
    """
    if margin < 0:
        raise StructureError(f"the margin of positive realness must be nonnegative; got {margin!r}")

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
        p = view.auxiliary(f"P of {name}", (n, n), symmetric=True)
        corner = b - a @ p @ c.T
        lmi = cp.bmat([[p - a @ p @ a.T, corner], [corner.T, d + d.T - c @ p @ c.T - 2 * margin * np.eye(l)]])
        lowered = np.diag(np.repeat([0.0, 2.0], [n, l])).ravel()
        return [Limit(lmi - REAL * np.linalg.norm(c) * np.eye(n + l) >> 0, lowered)]

    name = "positive_real" + (f":{margin:g}" if margin else "")
    return Rule(name, build, matrix=True)


def markov_rows(view: View, channel: str | None, output: str | None, count: int) -> np.ndarray:
    """Return (count, n + l or n) weights whose products with Theta are D, C B, C A B, ... of one output."""
    a, c = view.reference["A"], view.reference["C"]
    row = c[view.output(output)]
    found = [view.weights(channel, np.zeros(len(a)), output)]
    for _ in range(count - 1):
        found.append(view.weights(channel, row, output, direct=0.0))
        row = row @ a
    return np.array(found)


def _stepped(model: Any, c: int, count: int, o: int = 0) -> np.ndarray:
    """Response (count,) of an output to a step of an input over the interval of its basis."""
    f = model.nonlinearities[c]
    return model.step_response(count).reshape(count, model.l, -1)[:, o, c] * (_step(f.basis, None, None) @ f.mu)


def _step(basis: Any, low: float | None, high: float | None) -> np.ndarray:
    """What every function of a basis does in a step from ``low`` to ``high``, by default over its interval."""
    ends = [end if given is None else given for given, end in zip((low, high), basis.interval)]
    values = basis.values(np.array(ends, dtype=float))
    return values[1] - values[0]


def _response(word: str, sign: str, horizon: float, channel: str | None, output: str | None, rows: Any, *,
              summed: bool) -> Rule:
    factor = sign_of("sign", sign, "positive", "negative")
    if horizon < 1:
        raise StructureError(f"the horizon must be at least one sample; got {horizon!r}")

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

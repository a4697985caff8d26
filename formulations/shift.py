"""The programmes for A of a state-space model from its observability matrix, poles where constraints want them.

    min over P, Q:  ‖(Gamma_up Q - Gamma_dn P)‖     A = Q P^-1     (the fit weighted by P: Lacy and Bernstein 2003)
    min over A:     ‖Gamma_up A - Gamma_dn‖         P given
    max over P:     the margin of A in the inequalities

P is definite with trace n, and any `Rule` about poles that is a linear matrix inequality in P and Q = A P takes part
(Miller and de Callafon 2013). `optid.identify.subspace.shift` has their sequence.
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.psd import PSD

from formulations.constraints.rule import Rule
from optid.core.problem import Problem
from optid.core.terms import Inner, Length
from optid.identify.subspace import shift
from optid.identify.subspace.shift import Shifting, ShiftStep
from optid.program.limits import named

DEFINITE = 1e-3  # least eigenvalue of P where its trace is n: bounds the norm of P^-1


def constrained_shift(up: np.ndarray, down: np.ndarray, rules: Sequence[Rule] = ()) -> Shifting:
    """Solve ``min ‖up A - down‖`` under rules, as `optid.identify.subspace.shift.constrained_shift`."""
    return shift.constrained_shift(up, down, rules, (fit_of_shift, centre_of_shift))


def fit_of_shift(step: ShiftStep, rules: Sequence[Rule], given: tuple[np.ndarray, np.ndarray] | None = None) -> Problem:
    """Return min ‖residual‖ under rules: in P and Q, weighted by P; with P and a start for A given, in A alone.

    The model is A. The norm rather than its square: where a plant obeys almost exactly, the square would vanish in the
    tolerance.
    """
    n = len(step.basis)
    common: dict[str, Any] = {"model": step.recover, "facts": {"reference": {"A": step.free}}, "scale": step.size,
                              "energy": step.size}
    if given is None:
        contracted = step.free * min(1.0, 0.5 / max(np.max(np.abs(np.linalg.eigvals(step.free))), 1e-12))
        root = np.hstack([-np.kron(step.change.T, step.low), np.kron(step.change.T, step.top)])
        return Problem(
            "shift", {"P": np.eye(n), "Q": contracted},
            (Length(root, np.zeros(len(root)), ("P", "Q")),),  # ‖(top Q - low P) change‖
            restrictions=(_normalised,), builders=tuple(rules), symmetric=frozenset({"P"}), **common)
    p = (given[0] + given[0].T) / 2
    target = np.ravel(step.low @ step.change, order="F")
    return Problem(
        "shift with fixed P", {"A": step.inner(given[1])},
        (Length(np.kron(step.change.T, step.top), target, ("A",)),),  # ‖(top A - low) change‖
        further=lambda variables, _: {"P": cp.Constant(p), "Q": variables["A"] @ p, "A": None},
        builders=tuple(rules), **common)


def centre_of_shift(step: ShiftStep, a: np.ndarray, rules: Sequence[Rule]) -> Problem:
    """Return the problem for the P that leaves a given A the largest margin in the matrix inequalities."""
    inner = step.inner(a)

    def ease(view: Any) -> dict[str, list[Any]]:
        # the rules hold at A already: here they are not the user's, so that their prices stay those of the fit
        members = [limit.member for rule in rules for limits in named(rule(view), "").values() for limit in limits]
        return {"margin": [one.args[0] - view["margin"] * np.eye(one.args[0].shape[0]) >> 0
                           if isinstance(one, PSD) else one for one in members]}

    return Problem(
        "centre", {"P": np.eye(len(a)), "margin": np.zeros(())}, (Inner({"margin": np.array(-1.0)}),),
        further=lambda variables, _: {"Q": inner @ variables["P"]}, facts={"reference": {"A": step.free}},
        restrictions=(_normalised, ease), symmetric=frozenset({"P"}))


def _normalised(view: Any) -> dict[str, list[Any]]:
    p = view["P"]
    return {"positive": [p - DEFINITE * np.eye(p.shape[0]) >> 0], "trace": [cp.trace(p) == p.shape[0]]}

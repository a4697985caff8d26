"""The programmes for A of a state-space model from its observability matrix, poles where constraints want them.

    min over P, Q:  ‖(Gamma_up Q - Gamma_dn P)‖     A = Q P^-1     (the fit weighted by P: Lacy and Bernstein 2003)
    min over A:     ‖Gamma_up A - Gamma_dn‖         P given
    max over P:     the margin of A in the inequalities

P is definite with trace n, and any `Rule` about poles that is a linear matrix inequality in P and Q = A P takes part
(Miller and de Callafon 2013). `optid.identify.subspace.shift` has their sequence.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.psd import PSD

from formulations.constraints.rule import Rule
from optid.identify.subspace import shift
from optid.identify.subspace.shift import DEFINITE, Shifting, ShiftStep
from optid.program.program import Program
from optid.program.view import View


def constrained_shift(up: np.ndarray, down: np.ndarray, rules: Sequence[Rule] = ()) -> Shifting:
    """Solve ``min ‖up A - down‖`` under rules, as `optid.identify.subspace.shift.constrained_shift`."""
    return shift.constrained_shift(up, down, rules, (fitted, centred))


def fitted(step: ShiftStep, rules: Sequence[Rule], given: tuple[np.ndarray, np.ndarray] | None = None) -> Program:
    """Return min ‖residual‖ under rules: in P and Q, weighted by P; with P and a start for A given, in A alone.

    ``recover`` gives A. The norm rather than its square: where a plant obeys almost exactly, the square would vanish in
    the tolerance.
    """
    n = len(step.basis)
    if given is None:
        p, q = cp.Variable((n, n), symmetric=True, name="P"), cp.Variable((n, n), name="Q")
        contracted = step.free * min(1.0, 0.5 / max(np.max(np.abs(np.linalg.eigvals(step.free))), 1e-12))
        variables, start = {"P": p, "Q": q}, {"P": np.eye(n), "Q": contracted}
        name, fit, structural = "shift", step.top @ q - step.low @ p, _normalised(p)
    else:
        inner = cp.Variable((n, n), name="A")
        p, q = cp.Constant((given[0] + given[0].T) / 2), inner @ given[0]
        variables, start = {"A": inner}, {"A": step.inner(given[1])}
        name, fit, structural = "shift with fixed P", step.top @ inner - step.low, {}
    residual, height = cp.Variable(fit.size, name="residual"), cp.Variable(name="height")
    error = cp.vec(fit @ step.change, order="F")
    constraints = {"residual": (residual == error,), "norm": (cp.SOC(height, residual),), **structural}
    view = View({"P": p, "Q": q}, reference={"A": step.free})
    return Program(name, cp.Minimize(height), constraints, {**variables, "residual": residual, "height": height},
                   start, step.recover, view, structural=frozenset(constraints), derived={"residual": error},
                   scale=step.size).subject_to(*rules)


def centred(step: ShiftStep, a: np.ndarray, rules: Sequence[Rule]) -> Program:
    """Return the programme for the P that leaves a given A the largest margin in the matrix inequalities."""
    p, margin = cp.Variable(a.shape, symmetric=True, name="P"), cp.Variable(name="margin")
    view = View({"P": p, "Q": step.inner(a) @ p}, reference={"A": step.free})
    structural = _normalised(p)
    bare = Program("centre", cp.Minimize(-margin), structural, {"P": p, "margin": margin}, {}, dict, view,
                   structural=frozenset(structural)).subject_to(*rules)
    eased = {name: tuple(c.args[0] - margin * np.eye(c.args[0].shape[0]) >> 0
                         if isinstance(c, PSD) and name not in structural else c for c in group)
             for name, group in bare.constraints.items()}
    # the rules hold at A already: here they are not the user's, so that their prices stay those of the fit
    return replace(bare, constraints=eased, structural=frozenset(eased))


def _normalised(p: cp.Variable) -> dict[str, tuple[Any, ...]]:
    n = p.shape[0]
    return {"positive": (p - DEFINITE * np.eye(n) >> 0,), "trace": (cp.trace(p) == n,)}

"""Models with states at every sample as unknowns: functions as expressions, and what an answer is worth."""

from typing import Any

import cvxpy as cp
import numpy as np

from optid.arrays import Array
from optid.bases.basis import Basis, span
from optid.bases.expansions import Polynomial, Trigonometric
from optid.errors import StructureError
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.prediction_error.tangent_descent import NO_BOUND
from optid.models.roots import spectral_radius
from optid.program.solution import Solution, Status

# relative difference between the objective and the squared errors of a run of the model that is rounding
SAME_RUN = 1e-6


def judged_by_run(errors: StateErrors, x: Array, solution: Solution) -> tuple[Status, str]:
    """Take the solver's status only where the model is stable and its run has the errors of the programme."""
    if solution.status not in (Status.LOCAL, Status.OPTIMAL):
        return solution.status, solution.reason
    radius = spectral_radius(errors.unknowns.unpack(x).A)
    if radius >= errors.limit:
        return Status.INACCURATE, (f"the model is unstable (spectral radius of A {radius:.6g}): its states satisfy the "
                                   "equations, but no run from x0 will; use the .exact formulation or stability='free'")
    value = errors.value(x)
    if not abs(value - solution.objective) <= SAME_RUN * abs(value) + 1e-9 * errors.energy:
        return Status.INACCURATE, (f"a run of the model has the squared errors {value:.6g}, the programme "
                                   f"{solution.objective:.6g}: it is unstable, or leaves the interval of a function, "
                                   "where this programme continues it; give that basis outside='extrapolate'")
    return Status.LOCAL, NO_BOUND.format(errors.errors)


def expressed(basis: Basis, v: Any, coefficients: Any) -> Any:
    """Return sum_j coefficients[j] eta_j(v) of a basis with a formula, as an expression of a course v."""
    low, high = span(basis)
    if isinstance(basis, Polynomial):
        t = (2 * v - low - high) / (high - low)
        before, now = cp.Constant(np.ones(v.size)), t
        functions = [t]
        for k in range(1, basis.p):
            before, now = now, ((2 * k + 1) * cp.multiply(t, now) - k * before) / (k + 1)
            functions.append(now)
    elif isinstance(basis, Trigonometric):
        angle = np.pi / (basis.half_range * (high - low) / 2) * (v - (low + high) / 2)
        atoms: Any = cp  # the stubs know no trigonometric functions
        functions = [atom(j * angle) for j in range(1, basis.p + 1) for atom in (atoms.cos, atoms.sin)]
    else:
        raise StructureError(f"a {type(basis).__name__.lower()} basis of outputs or latent signals has no formula that "
                             "NLP solvers can differentiate: use 'polynomial:p' or 'trigonometric:p', or the .exact "
                             "formulation")
    return sum(coefficients[j] * function for j, function in enumerate(functions))

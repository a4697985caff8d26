"""Places of increased noise by covariance matching, a convex programme for several places at once (F8).

White noise of variance rho at a place adds rho Lambda(l) to the covariance at lag l of the whitened innovations, which
is I at lag 0 and zero beyond for a healthy plant. With S(l) the sample covariances of the window,

    min over rho >= 0:  1/2 sum_l ‖W_l (S(l) - I delta_l - sum_c rho_c Lambda_c(l))‖²            ("places")

is a non-negative least-squares problem; weights W are the inverse standard deviations of S when healthy. With full
covariances of the added process and sensor noise, positive semidefinite, in place of rho it is a semidefinite
programme ("full"), which needs no candidates but does not distinguish directions with the same covariances.

Named variables: ``rho`` (C,), variances in units of the places; or ``Q`` (n, n) and ``R`` (l, l).
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from optid.core.problem import Problem
from optid.core.terms import Squares
from optid.errors import StructureError, nearest
from optid.faults.consistency.noise_matching import CovarianceMatch, CovarianceProblem, covariance_problem
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened
from optid.solving.solve import Evidence, Procedure

FORMS = ("places", "full")


def covariance(found: Dictionary, whitened: Whitened, *, form: str = "places", lags: int | None = None, onset: int = 0,
               constraints: Sequence[Any] = ()) -> Procedure:
    """Match the covariances of a window.

    Args:
        found: the noise candidates; if there are none, one for each place in the dictionary.
        whitened: the window; one experiment.
        form: "places" (non-negative variances of the candidates) or "full" (covariances of any noise).
        lags: largest lag; None for the settling of the predictor, at most a tenth of the window.
        onset: first sample that is used.
        constraints: further constraints on the named variables.

    Returns:
        An `optid.faults.consistency.noise_matching.CovarianceMatch`.

    Raises:
        DataError: too few readings.
        StructureError: words or numbers that do not fit.
    """
    if form not in FORMS:
        raise StructureError(f"form={form!r}. {nearest(str(form), FORMS)}")
    problem = covariance_problem(found, whitened, lags=lags, onset=onset)
    solution = yield (_places if form == "places" else _full)(problem).subject_to(*constraints)
    return Evidence.of(solution, CovarianceMatch.of(problem, solution), {"lags": problem.lags})


def _places(problem: CovarianceProblem) -> Problem:
    """The non-negative least-squares problem of the candidates."""
    sizes = np.linalg.norm(problem.signatures, axis=0)
    units = problem.signatures / sizes
    return Problem(
        "fault.noise_covariance", {"scaled": np.maximum(units.T @ problem.target, 1.0)},
        (Squares.half(problem.target, {"scaled": units}),),
        further=lambda v, _: {"rho": cp.multiply(1 / sizes, v["scaled"])},
        restrictions=(lambda view: {"variances": view["rho"] >= 0},),
        scale=0.5 * float(problem.target @ problem.target))


def _full(problem: CovarianceProblem) -> Problem:
    """The semidefinite problem of full covariances of the added process and sensor noise."""
    of_process, of_sensor = problem.units
    parts = {"Q": problem.by_process * of_process.ravel(order="F"), "R": problem.by_sensor * of_sensor.ravel(order="F")}
    return Problem(
        "fault.noise_covariance full", {"Q": np.eye(problem.nx), "R": np.eye(problem.l)},
        (Squares.half(problem.target, parts),), symmetric=frozenset("QR"),
        further=lambda v, _: {"Q": cp.multiply(of_process, v["Q"]), "R": cp.multiply(of_sensor, v["R"])},
        restrictions=(lambda view: {"process covariance": view["Q"] >> 0, "sensor covariance": view["R"] >> 0},),
        scale=0.5 * float(problem.target @ problem.target))

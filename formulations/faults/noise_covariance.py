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
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure

FORMS = ("places", "full")

NOTHING = 1e-4
"""Covariances, in standard deviations, below which the result of an interior-point method is zero."""


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
    bound = solution.bound or Bound.none(solution.reason)
    return Evidence(_matched(problem, solution), solution.objective, bound, solution.status, solution.reason,
                    {"lags": problem.lags})


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
    of_process, of_sensor = _units(problem)
    parts = {"Q": problem.by_process * of_process.ravel(order="F"), "R": problem.by_sensor * of_sensor.ravel(order="F")}
    return Problem(
        "fault.noise_covariance full", {"Q": np.eye(problem.nx), "R": np.eye(problem.l)},
        (Squares.half(problem.target, parts),), symmetric=frozenset("QR"),
        further=lambda v, _: {"Q": cp.multiply(of_process, v["Q"]), "R": cp.multiply(of_sensor, v["R"])},
        restrictions=(lambda view: {"process covariance": view["Q"] >> 0, "sensor covariance": view["R"] >> 0},),
        scale=0.5 * float(problem.target @ problem.target))


def _units(problem: CovarianceProblem) -> list[np.ndarray]:
    """Units of the entries of Q and of R."""
    return [np.sqrt(np.outer(units, units)) for units in (problem.state_units, problem.output_units)]


def _matched(problem: CovarianceProblem, solution: Solution) -> CovarianceMatch:
    """Read the solution of either programme."""
    rho, gains, Q, R = np.full(len(problem.labels), np.nan), np.full(len(problem.labels), np.nan), None, None
    if solution.has_point and "scaled" in solution.values:
        scaled = np.asarray(solution.values["scaled"])
        gains = np.where(scaled > NOTHING, scaled, 0.0)
        rho = gains / np.linalg.norm(problem.signatures, axis=0)
    elif solution.has_point:
        Q, R = (np.asarray(solution.values[name]) * units for name, units in zip("QR", _units(problem)))
    certified = solution.status in (Status.OPTIMAL, Status.LOCAL) and solution.proof
    status = "" if certified else f"{solution.status}: {solution.reason}".rstrip(": ")
    return CovarianceMatch(problem.labels, rho, gains, Q, R, solution.objective, solution.gap, certified, problem.lags,
                           status)

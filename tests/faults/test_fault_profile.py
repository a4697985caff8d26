"""The course of a fault: programmes that are optimal, courses that are right, constraints that hold."""

import numpy as np
import pytest
from fault_plants import LOAD, record, refused
from scipy.optimize import nnls
from test_fault_injection import small

from formulations.faults.profile import course_of_changes, random_walk
from optid.backends import Answer, BackEnd
from optid.core.statement import statement_of
from optid.errors import DataError, SolverFailed, StructureError
from optid.faults import Fault, dictionary, profile, scan, whiten
from optid.faults.consistency.profiles import course_problem
from optid.program.solution import Status
from optid.solving.solve import solve

N = 60


@pytest.fixture(scope="module")
def found():
    return dictionary(small(), process={"load": LOAD}, kinds=["bias", "loss", "stuck", "noise"])


def search(found, faults, seed=1, missing=0.0):
    data = record(found.model, seed, faults, missing, N)
    return scan(found, whiten(found.model, data, x0="zero"), data.u)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("fault, label, prior, course", [
    (Fault.step("sensor:y1", 20, 1.5), "sensor:y1", "tv", 1.5 * (np.arange(N) >= 20)),
    (Fault.step("sensor:y2", 20, 1.5, end=40), "sensor:y2", "tv",
     1.5 * ((np.arange(N) >= 20) & (np.arange(N) < 40))),
    (Fault.ramp("sensor:y1", 20, 0.1), "sensor:y1", "trend", 0.1 * np.maximum(np.arange(N) - 19, 0)),
    (Fault.loss("actuator:u1", 20, 0.9), "actuator:u1 loss", "tv", 0.9 * (np.arange(N) >= 20))])
def test_courses_are_found_and_the_prior_is_chosen(found, fault, label, prior, course, missing):
    result = profile(search(found, fault, missing=missing), label)
    assert result.prior == prior and result.certified and result.gap < 1e-6
    assert result.bic[prior] == min(result.bic.values()) and set(result.bic) == {"tv", "trend"}
    error = np.linalg.norm(result.course - course) / np.linalg.norm(course)
    assert error < 0.25 and len(result.changes) <= 4
    k, sigma = np.arange(N) >= 45, result.std
    assert np.all(np.abs(result.course - course)[k] < 6 * sigma[k] + 1e-12)
    assert max(map(len, str(result).splitlines())) <= 80


@pytest.mark.parametrize("prior", ["tv", "trend"])
def test_own_solver_agrees_with_clarabel_and_the_conditions_hold(found, prior):
    problem = course_problem(search(found, Fault.step("sensor:y1", 20, 1.0)), "sensor:y1")
    stated = course_of_changes(problem, prior)
    own, other = (solve(stated, solver, accuracy=1e-9) for solver in ("block_descent", "clarabel"))
    assert own.proof and other.proof and other.objective == pytest.approx(own.objective, rel=1e-6)
    columns = problem.matrix @ problem.shapes[prior]
    penalty = stated.weights["lambda"]
    slopes = columns.T @ (problem.r - columns @ own.values["changes"][:, 0])
    assert np.all(np.abs(slopes) <= penalty * (1 + 1e-4))
    active = np.abs(own.values["changes"][:, 0]) > 1e-7
    np.testing.assert_allclose(np.abs(slopes[active]), penalty, rtol=1e-4)


def test_the_random_walk_is_the_smoother(found):
    problem = course_problem(search(found, Fault.step("sensor:y1", 20, 1.0)), "sensor:y1")
    D = np.eye(N) - np.eye(N, k=-1)
    known = np.linalg.solve(problem.matrix.T @ problem.matrix + 9 * D.T @ D, problem.matrix.T @ problem.r)
    np.testing.assert_allclose(solve(random_walk(problem, 9.0)).values["f"], known, atol=1e-6)
    result = profile(search(found, Fault.step("sensor:y1", 20, 1.0)), "sensor:y1", "smooth")
    assert result.prior == "smooth" and result.certified and 1 < result.freedom < N
    assert np.linalg.norm(result.course - 1.0 * (np.arange(N) >= 20)) < 0.4 * np.sqrt(40)


def test_constraints_hold_and_cost(found):
    s = search(found, Fault.step("sensor:y1", 20, 1.5))
    free = profile(s, "sensor:y1", "tv")
    for how, holds in (({"sign": "positive"}, lambda f: f.min() >= -1e-7),
                       ({"sign": "negative"}, lambda f: f.max() <= 1e-7),
                       ({"limit": 0.7}, lambda f: np.abs(f).max() <= 0.7 + 1e-6),
                       ({"slew": 0.2}, lambda f: np.abs(np.diff(f, prepend=0.0)).max() <= 0.2 + 1e-6)):
        held = profile(s, "sensor:y1", "tv", **how)
        assert held.certified and holds(held.course), how
        assert held.bic["tv"] >= free.bic["tv"] - 1e-6
    own = profile(s, "sensor:y1", "tv", constraints=[lambda v: {"late": v["f"][:30] == 0}])
    assert np.abs(own.course[:30]).max() < 1e-6 and own.constraints == ("late",)
    assert np.abs(profile(s, "sensor:y1", "tv", sign="negative").course).max() < 1e-6


def test_the_refit_under_a_sign_is_non_negative_least_squares(found):
    s = search(found, Fault.step("sensor:y1", 20, 1.5))
    held = profile(s, "sensor:y1", "tv", constraints=[lambda v: {"rising": v["changes"] >= 0}])
    problem = course_problem(s, "sensor:y1")
    kept = sorted(held.changes)
    columns = (problem.matrix @ problem.shapes["tv"])[:, kept]
    np.testing.assert_allclose([held.changes[k] for k in kept], nnls(columns, problem.r)[0], atol=1e-6)


@pytest.mark.slow
def test_a_healthy_window_has_no_course(found):
    result = profile(search(found, []), "sensor:y1")
    assert len(result.changes) <= 2 and np.abs(result.course).max() < 0.8


def test_moving_ends_where_no_single_move_gains(found):
    problem = course_problem(search(found, Fault.step("sensor:y1", 20, 1.5, end=40)), "sensor:y1")
    columns = problem.matrix @ problem.shapes["tv"]
    start = np.array([14, 46])
    kept = problem.move_changes(columns, start)
    energy = problem.refit(columns[:, kept])[1]
    assert energy <= problem.refit(columns[:, start])[1] and kept.size == 2
    for i in range(2):
        for k in range(N):
            trial = sorted({*np.delete(kept, i).tolist(), k})
            assert problem.refit(columns[:, trial])[1] >= energy - 1e-7


def test_solvers_that_fail_or_lie(found):
    s = search(found, Fault.step("sensor:y1", 20, 1.5))
    classes = frozenset({"QP", "SOCP", "group-sparse"})
    with pytest.raises(SolverFailed, match="no memory"):
        profile(s, "sensor:y1", solver=BackEnd("broken", classes, lambda *_: Answer(Status.FAILED, "no memory")))

    def liar(program, settings):
        values = {name: np.asarray(program.start.get(name, np.zeros(v.shape))) + 0.1
                  for name, v in statement_of(program).variables.items()}
        duals = {name: np.zeros(0) for name in statement_of(program).constraints}
        return Answer(Status.OPTIMAL, "optimal", values, duals)

    with pytest.raises(SolverFailed, match="not stationary"):
        profile(s, "sensor:y1", solver=BackEnd("liar", classes, liar))


def test_bad_input(found):
    s = search(found, [])
    without, still = scan(found, s.whitened), scan(found, s.whitened, np.zeros((N, 2)))
    refused(*((error, words, lambda where=where, label=label, how=how: profile(where, label, **how))
              for error, words, where, label, how in (
        (StructureError, "prior=", s, "sensor:y1", {"prior": "wavy"}),
        (StructureError, "sign=", s, "sensor:y1", {"sign": "up"}),
        (StructureError, "limit=", s, "sensor:y1", {"limit": 0.0}),
        (StructureError, "slew=", s, "sensor:y1", {"slew": np.nan}),
        (StructureError, "penalties=", s, "sensor:y1", {"penalties": []}),
        (StructureError, "penalties=", s, "sensor:y1", {"penalties": [-1]}),
        (StructureError, "several magnitudes", s, "state", {}),
        (StructureError, "several magnitudes", s, "actuator:u1 stuck", {}),
        (StructureError, "noise has no course", s, "sensor:y1 noise", {}),
        (StructureError, "depends on the input", without, "actuator:u1 loss", {}),
        (DataError, "untestable", still, "actuator:u2 loss", {}))))

"""solve: look-up, refusal, misbehaving back ends, time limits, re-solving without compiling again."""

import pickle
import time
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from problems import record
from refusals import refuses
from zoo import ABORTING, EVERYTHING, HANGING, RAISING, case, claiming, pose

import optid
from optid.backends import Answer, BackEnd, Settings, back_ends, choice
from optid.core.problem import Problem
from optid.core.statement import for_solvers, statement_of
from optid.core.terms import Squares
from optid.errors import LookupFailed, SolverMissing, SolverRefused, StructureError
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import run, solve


def projection():
    """min ‖x - (2, 2)‖² on x1 + x2 <= 2: x = (1, 1), value 2, multiplier 2."""
    x = cp.Variable(2, name="x")
    return pose("projection", cp.sum_squares(x - 2), {"budget": cp.sum(x) <= 2}, [x], start={"x": np.zeros(2)})


NAN = float("nan")


@pytest.mark.parametrize(("claim", "x", "dual", "status", "words"), [
    (Status.OPTIMAL, [2.0, 2.0], 0.0, Status.FAILED, ["budget", "claims success"]),
    (Status.OPTIMAL, [1.0 + 1e-5] * 2, 2.0, Status.INACCURATE, ["budget"]),
    (Status.OPTIMAL, [0.5, 0.5], 0.0, Status.INACCURATE, ["not stationary"]),
    (Status.OPTIMAL, [1.0, 1.0], 2.0, Status.OPTIMAL, []),
    *((Status.OPTIMAL, [1.0, 1.0], dual, Status.OPTIMAL, []) for dual in (None, NAN, 0.0, -3.0, 1e9)),  # ours count
    *((Status.OPTIMAL, [0.9, 0.9], dual, Status.INACCURATE, ["not stationary"]) for dual in (None, NAN, np.inf)),
    (Status.INACCURATE, [1.0, 1.0], 2.0, Status.OPTIMAL, []),
    (Status.INACCURATE, [1.0, 1.0], None, Status.OPTIMAL, []),
    (Status.INACCURATE, [0.9, 0.9], None, Status.INACCURATE, []),
    (Status.OPTIMAL, [NAN, 1.0], None, Status.FAILED, ["non-finite"]),
    (Status.OPTIMAL, [np.inf, 1.0], None, Status.FAILED, ["non-finite"]),
    (Status.OPTIMAL, [1e200, 1.0], None, Status.FAILED, ["non-finite"]),
    (Status.OPTIMAL, [1.0, 2.0, 3.0], None, Status.FAILED, ["cannot be judged: cannot reshape"]),
    (Status.OPTIMAL, None, None, Status.FAILED, ["no point"]),
    (Status.INFEASIBLE, None, None, Status.FAILED, ["start"]),
    (Status.INFEASIBLE, [0.0, 0.0], None, Status.FAILED, ["satisfies every constraint"]),
    (Status.LIMIT, [2.0, 2.0], None, Status.LIMIT, ["its word", "budget"]),
    (Status.UNBOUNDED, None, None, Status.FAILED, ["never below zero"]),
])
def test_a_claim_is_judged_at_its_point(claim, x, dual, status, words):
    duals = None if dual is None else {"budget": np.array([dual])}
    found = solve(projection(), claiming({} if x is None else {"x": x}, claim, duals, "its word"))
    assert found.status is status and all(word in found.reason for word in words)
    assert found.claim is claim and found.claimed == "its word"
    assert found.proof == (status is Status.OPTIMAL)
    taken_back = claim in (Status.INFEASIBLE, Status.UNBOUNDED) or \
        claim is Status.OPTIMAL and status not in (Status.OPTIMAL, Status.LOCAL)
    assert found.false_claim == taken_back
    if found.has_point and status is not Status.FAILED:
        assert found.objective == pytest.approx(np.sum((np.array(x) - 2) ** 2))
        assert np.isfinite(found.residuals.stationarity) or status is Status.LIMIT
    assert found.has_point == (x is not None and len(x) == 2 and bool(np.all(np.abs(x) < 1e100)))


def late(program, settings):
    raise TimeoutError("no licence")


def lost(program, settings):
    raise ChildProcessError("no licence")


@pytest.mark.parametrize("limit", [None, 5.0])
@pytest.mark.parametrize("broken, name", [(late, "TimeoutError"), (lost, "ChildProcessError")])
def test_an_error_of_the_solver_itself_is_no_limit_of_ours(broken, name, limit):
    found = solve(projection(), broken, time_limit=limit)
    assert found.status is Status.FAILED and f"{name}: no licence" in found.claimed + found.reason


def test_nothing_claimed_is_not_false():
    assert not Solution(Status.FAILED, "", "").false_claim


@pytest.mark.parametrize("values", [{}, {"x": np.array([NAN, 1.0])}, {"y": np.ones(2)}])
def test_an_answer_without_a_usable_point_is_in_units_of_the_record(values):
    found = solve(replace(projection(), scale=3.0, unit=4.0), claiming(values, Status.LOCAL))
    assert found.status is Status.FAILED and found.scale == 12.0


@pytest.mark.parametrize("solver", ["clarabel", "ipopt", "osqp"])
def test_the_time_of_compiling_is_part_of_the_solve(solver):
    times = solve(projection(), solver).times
    assert 0.0 < times.compile <= times.solve
    assert times.total == pytest.approx(times.build + times.solve + times.judge + times.prove)


def test_multiplier_of_the_wrong_sign_does_not_make_a_point_stationary():
    # the minimum is inside; at (1, 1) on the border the dual -2 would balance a gradient that points inwards
    x = cp.Variable(2, name="x")
    program = pose("side", cp.sum_squares(x - 2), {"floor": cp.sum(x) >= 2}, [x])
    found = solve(program, claiming({"x": [1.0, 1.0]}, duals={"floor": np.array([-2.0])}))
    assert found.status is Status.INACCURATE and found.residuals.stationarity > 0.1


@pytest.mark.parametrize(("constraint", "dual"), [
    (lambda x: cp.diag(x) >> 0, np.array([-2.0, 0, 0, 0])),
    (lambda x: cp.SOC(x[0], x[1:]), np.array([-2.0, 0.0])),
])
def test_multipliers_outside_their_cone_count_as_missing(constraint, dual):
    x = cp.Variable(2, name="x")
    program = pose("cone", cp.sum_squares(x - np.array([2.0, 0.0])), {"cone": constraint(x)}, [x])
    found = solve(program, claiming({"x": [1.0, 0.0]}, duals={"cone": dual}))
    assert found.status is Status.INACCURATE


def test_success_with_half_of_a_point_is_a_failure():
    x, y = cp.Variable(name="x"), cp.Variable(name="y")
    program = pose("two", cp.square(x) + cp.square(y), {"sum": x + y == 1}, [x, y])
    found = solve(program, claiming({"x": 0.5}))
    assert found.status is Status.FAILED and "y" in found.reason


def test_bounds_of_the_variables_themselves_are_judged():
    x = cp.Variable(2, name="x", nonneg=True)
    program = pose("bounded", cp.sum(x), {"sum": x[0] - x[1] == 0}, [x])
    found = solve(program, claiming({"x": [-0.5, -0.5]}, duals={"sum": np.array([0.0])}))
    assert found.status is Status.FAILED and found.residuals.worst == "x"
    found = solve(program, claiming({"x": [0.0, 0.0]}, duals={"sum": np.array([0.0])}))
    assert found.status is Status.OPTIMAL
    found = solve(program, claiming({"x": [0.5, 0.5]}, duals={"sum": np.array([0.0])}))
    assert found.status is Status.INACCURATE


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_the_verdict_does_not_depend_on_units(unit):
    def pose_in(unit):
        x = cp.Variable(2, name="x")
        return pose("units", cp.sum_squares(x - 2 * unit), {"budget": cp.sum(x) <= 2 * unit}, [x], scale=8 * unit**2)

    right = claiming({"x": np.ones(2) * unit}, duals={"budget": np.array([2.0 * unit])})
    wrong = claiming({"x": 0.9 * np.ones(2) * unit}, duals={"budget": np.array([0.0])})
    assert solve(pose_in(unit), right).status is Status.OPTIMAL
    assert solve(pose_in(unit), wrong).status is Status.INACCURATE


def test_certificate_judges_where_the_objective_has_kinks():
    x = cp.Variable(name="x")

    def certify(program, values, duals):
        gap = abs(float(values["x"]))
        return Bound(0.0, gap < 1e-9, "by hand", f"off by {gap:.0e}"), None

    program = pose("kink", cp.abs(x), {}, [x], proof=certify)
    assert solve(program, claiming({"x": 0.0})).status is Status.OPTIMAL
    refuted = solve(program, claiming({"x": 1e-3}))
    assert refuted.status is Status.INACCURATE and "off by" in refuted.reason


def test_better_start_of_a_certificate_is_tried_and_kept_only_when_better():
    x = cp.Variable(name="x")
    value = cp.square(cp.square(x) - 1) + 0.2 * x  # minima near -1 (global) and near 1

    def certify(program, values, duals):
        return Bound(-1.0, False, "by hand"), {"x": np.array(-0.9)}

    program = pose("two valleys", value, {"box": cp.square(x) <= 9}, [x], start={"x": np.array(0.9)}, proof=certify)
    assert solve(program, "ipopt", prove=False).values["x"] > 0.5
    assert solve(program, "ipopt").values["x"] < -0.5


@pytest.mark.parametrize("solver, words", [(RAISING, "ZeroDivisionError"), (ABORTING, "SIGABRT")])
def test_a_crash_inside_a_solver_is_an_outcome(solver, words):
    found = solve(projection(), solver, isolate=solver is ABORTING)
    assert found.status is Status.FAILED and words in found.reason


def test_time_limit_is_kept_for_a_solver_that_does_not():
    clock = time.monotonic()
    found = solve(projection(), HANGING, time_limit=0.2)
    assert found.status is Status.LIMIT and time.monotonic() - clock < 30.0  # it would never end


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["clarabel", "ipopt", "uno", "highs"])
def test_answer_in_a_process_of_its_own_is_the_same(name):
    here, there = solve(case("qp_box").build(), name), solve(case("qp_box").build(), name, time_limit=30.0)
    assert there.status is here.status is Status.OPTIMAL
    assert there.values["x"] == pytest.approx(here.values["x"], abs=1e-9)
    assert set(there.duals) == {"upper", "lower"}


def strict(program, settings):
    raise StructureError(f"no such function in {program.name!r}")


@pytest.mark.parametrize("isolate", [False, True])
def test_a_refusal_of_the_solver_is_a_refusal_from_everywhere(isolate):
    refuses(SolverRefused, "no such function in 'projection'", solve, projection(), strict, isolate=isolate)


def test_a_solver_that_no_process_can_import_is_refused_by_its_name():
    refuses(SolverRefused, "test_solving.*<lambda> cannot be sent.*define it in a module that can be imported.*"
            "neither time_limit nor isolate", solve, projection(), lambda program, settings: None, time_limit=5.0)


@pytest.mark.parametrize("limit", [np.inf, 1e400, 1e300, 10**400, 3.2e7])
def test_a_limit_of_years_is_none(limit):
    assert solve(projection(), "clarabel", time_limit=limit).status is Status.OPTIMAL


@pytest.mark.parametrize("limit", [0, 0.0, -1, -np.inf, np.nan, "5", True, [5.0], 1j])
def test_a_time_limit_that_is_no_positive_number_is_named(limit):
    refuses(StructureError, "time_limit=.*must be a positive number of seconds", solve, projection(), time_limit=limit)


def test_what_only_models_and_proofs_need_stays_here():
    problem = replace(projection(), model=lambda values: values, proof=lambda *_: (Bound(2.0, True, "hand"), None))
    found = solve(problem, "clarabel", time_limit=30.0)
    assert found.status is Status.OPTIMAL and found.bound.method == "hand"


def _budget(view):
    return {"budget": cp.sum(view["x"]) <= 2}


@pytest.mark.parametrize(("restrictions", "point"), [((_budget,), 1.0), ((), 2.0)])
def test_a_pickled_problem_does_not_share_ids_with_what_is_made_after_it(monkeypatch, restrictions, point):
    from cvxpy.lin_ops.lin_utils import ID_COUNTER  # not public: this fails first if CVXPY counts otherwise

    objective = Squares(np.eye(2), np.full(2, 2.0), 0.0, ("x",))
    problem = for_solvers(Problem("projection", {"x": np.zeros(2)}, (objective,), restrictions=restrictions))
    statement_of(problem)
    packed = pickle.dumps(problem)
    monkeypatch.setattr(ID_COUNTER, "count", 0)  # as in another process
    problem = pickle.loads(packed)
    known = {v.id for v in statement_of(problem).problem.variables()}
    assert not known & {cp.Variable().id for _ in range(max(known) + 1)}
    assert solve(problem, "clarabel").values["x"] == pytest.approx([point, point], abs=1e-6)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("solver", ["gauss_newton", "alternating", "ipopt"])
@pytest.mark.parametrize("constraints", [(), (lambda view: {"first": view["mu"][0] <= 0.5},)])
def test_a_programme_stated_late_starts_elsewhere_where_it_starts_here(solver, constraints):
    fit = optid.fit(record(), "hammerstein_arx.exact", na=1, nb=1, basis="triangular:4", constraints=constraints)
    here, there = (solve(fit.problem, solver, isolate=isolate) for isolate in (False, True))
    assert there.status is here.status and there.iterations == here.iterations
    assert there.objective == pytest.approx(here.objective, rel=1e-12)


def test_a_solver_is_found_by_its_word_in_any_case_and_one_that_is_missing_comes_with_the_pip_line(monkeypatch):
    assert solve(projection(), "CLARABEL").solver == "clarabel"
    refuses(LookupFailed, "clarabel", solve, projection(), "clarabell")
    known = {**back_ends(), "absent": BackEnd("absent", EVERYTHING, RAISING.run, False, "absent-solver"),
             "vendor": BackEnd("vendor", EVERYTHING, RAISING.run, False)}
    monkeypatch.setattr(choice, "back_ends", lambda: known)
    refuses(SolverMissing, "pip install absent-solver", solve, projection(), "absent")
    refuses(SolverMissing, "vendor's package", solve, projection(), "vendor")


def test_convex_solver_refuses_a_nonconvex_programme_by_the_name_of_its_part():
    refuses(StructureError, "constraint 'product'", solve, case("nlp_hyperbola").build(), "clarabel")
    refuses(StructureError, "class SDP", solve, case("sdp_largest_eigenvalue").build(), "osqp")


def test_auto_says_what_it_chose():
    for name, solver in {"qp_box": "clarabel", "nlp_hs071": "uno", "rank_one_fit": "gauss_newton"}.items():
        found = solve(case(name).build())
        assert found.solver == solver and solver in found.chosen


def test_plain_function_is_a_solver_too():
    def by_hand(program, settings: Settings) -> Answer:
        assert settings.accuracy == 1e-6 and settings.options == {"depth": 3}
        return Answer(Status.LOCAL, "done", {"x": np.ones(2)}, {"budget": np.array([2.0])})

    found = solve(projection(), by_hand, accuracy=1e-6, depth=3)
    assert found.status is Status.OPTIMAL and found.solver == "by_hand"


@pytest.mark.parametrize("name", ["ipopt", "uno"])
def test_warm_start_begins_at_the_start_of_the_programme(name):
    program = case("nlp_rosenbrock").build()
    cold = solve(program, name)
    warm = solve(replace(program, start=cold.values), name)
    assert warm.status is Status.LOCAL and warm.iterations <= cold.iterations / 2


def test_procedure_gets_its_solutions_and_returns_its_model():
    def procedure():
        first = yield projection()
        second = yield case("qp_equality").build()
        return first.objective + second.objective

    outcome = run(procedure(), "clarabel")
    assert outcome.model == pytest.approx(2.0 + 1 / 9, rel=1e-6)
    assert [name for name, _ in outcome.steps] == ["projection", "qp_equality"]


def test_a_broken_plug_in_does_not_take_the_others_away(monkeypatch):
    class Point:
        name, value = "theirs", "their_package:back_end"

        def load(self):
            raise ImportError("no module named their_package")

    shipped = list(choice.entry_points(group=choice.GROUP))
    monkeypatch.setattr(choice, "entry_points", lambda group: [*shipped, Point()])
    choice.back_ends.cache_clear()
    try:
        assert choice.find("clarabel").installed
        with pytest.raises(SolverMissing, match="'theirs' cannot be loaded: their_package:back_end fails: ImportError"):
            choice.find("theirs")
    finally:
        choice.back_ends.cache_clear()


@pytest.mark.parametrize("corridor", ["low=22.5,high=25.7,first=33.7,last=66.1", "low=38,high=46.1,first=57.6,last=86"])
def test_a_solver_that_stops_early_at_a_good_point_has_arrived(corridor):
    """Steps along the border of a corridor do not settle to nine digits; what is measured at the point decides."""
    rules = ["monotone:increasing", f"range:{corridor}"]
    data = optid.examples.heater().data
    form = {"na": 2, "nb": 2, "nk": 0, "basis": "triangular:8", "constraints": rules}
    found = optid.fit(data, "hammerstein_arx.exact", **form).solution
    other = optid.fit(data, "hammerstein_arx.exact", solver="ipopt", **form).solution
    assert found.status is Status.OPTIMAL and found.objective == pytest.approx(other.objective, rel=1e-7)


def test_a_word_of_a_limit_is_judged_as_any_other():
    program = case("qp_box").build()
    good = solve(program, "clarabel")
    early = solve(program, claiming(good.values, Status.LIMIT, good.duals))
    assert good.status is Status.OPTIMAL and early.status is Status.OPTIMAL and early.claim is Status.LIMIT
    away = {name: 0.9 * value for name, value in good.values.items()}
    assert solve(program, claiming(away, Status.LIMIT, good.duals)).status is Status.LIMIT


def test_a_step_of_a_procedure_is_judged_without_a_bound():
    program = for_solvers(case("qp_box").build())
    whole, step = solve(program, "clarabel"), solve(replace(program, step=True), "clarabel")
    assert whole.status is Status.OPTIMAL and whole.bound is not None
    assert step.status is Status.LOCAL and step.bound is None
    away = claiming({name: 0.9 * value for name, value in whole.values.items()})
    assert solve(replace(program, step=True), away).status not in (Status.LOCAL, Status.OPTIMAL)


@pytest.mark.parametrize(("name", "followed"), [("ipopt", False), ("uno", False), ("clarabel", True)])
def test_a_general_nonlinear_solver_that_does_not_arrive_is_not_followed_by_another(name, followed, monkeypatch):
    """It has taken thousands of steps, and so would the next one."""
    spent = replace(claiming({"x": [0.0, 0.0]}, Status.LIMIT), name=name)
    monkeypatch.setattr("optid.solving.solve.choose", lambda program: (spent, "chosen"))
    found = solve(projection())
    assert (found.failed == name and found.status is Status.OPTIMAL) if followed else found.status is Status.LIMIT


def test_old_multipliers_do_not_survive():
    program = projection()
    assert "budget" in solve(program, "clarabel").duals
    found = solve(program, claiming({"x": [1.0, 1.0]}))
    assert found.duals["budget"] == pytest.approx(2.0)
    assert statement_of(program).duals() == {}  # ours, not those of before

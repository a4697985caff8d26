"""Problems and their statements: named parts, further constraints, freezing, values and duals by name."""


import cvxpy as cp
import numpy as np
import pytest
from problems import record
from refusals import refuses
from zoo import CASES, case, pose

from optid import Polynomial, fit
from optid.backends import Answer, BackEnd
from optid.core.least_squares import RankOneForm
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.statement import class_of, for_solvers, statement_of
from optid.core.terms import Squares
from optid.errors import StructureError
from optid.program.limits import name_limits
from optid.program.solution import Status
from optid.program.view import View
from optid.solving.solve import solve
from optid.structures.rank_one import RankOne


def bilinear(*builders):
    """min ‖mu bᵀ - T‖², ‖b‖ = 1; with b held it is least squares with the closed form mu = T b."""
    target = np.array([[1.0, 2.0], [0.0, 1.0], [-1.0, 1.0]])
    objective = Squares.of(RankOne(np.eye(6), target.ravel(order="F"), 0.0, ((3, 2),), 0, 1.0), ("Theta",))
    return Problem("bilinear", {"mu": np.ones(3), "b": np.array([0.6, 0.8])}, (objective,), (Product("mu", "b"),),
                   builders=builders), target


def test_class_of_every_case_is_what_its_name_says():
    for name, entry in CASES.items():
        kind = class_of(for_solvers(entry.build()))
        expected = {"lp": {"LP"}, "qp": {"QP"}, "socp": {"SOCP"}, "sdp": {"SDP"}, "exp": {"conic"}, "nlp": {"NLP"},
                    "rank": {"NLP"}, "nuclear": {"SDP"}, "group": {"SOCP"}}[name.split("_")[0]]
        assert kind in expected, name


@pytest.mark.parametrize(("atom", "kind"), [
    (cp.normNuc, "SDP"), (cp.lambda_max, "SDP"), (cp.sigma_max, "SDP"), (lambda x: cp.norm(x, "fro"), "SOCP"),
    (lambda x: cp.log_sum_exp(x), "conic"), (lambda x: cp.norm1(cp.vec(x, order="F")), "LP"),
    (lambda x: cp.sum_squares(x), "QP"), (lambda x: cp.power(x[0, 0], 1.5), "SOCP"),
])
def test_class_by_atom(atom, kind):
    x = cp.Variable((2, 2), name="x", symmetric=True)
    assert class_of(pose("class", atom(x), {"fixed": x[0, 1] == 1}, [x])) == kind


def test_what_is_neither_convex_nor_smooth_is_named():
    x = cp.Variable(2, name="x")
    program = pose("rough", x[0] * x[1], {"cap": cp.max(x) <= 1, "gap": cp.max(x) >= 0.5}, [x])
    with pytest.raises(StructureError, match="constraint 'gap'"):
        _ = class_of(program)
    assert statement_of(program).nonconvex_parts() == ["the objective", "constraint 'gap'"]


def test_constraints_of_every_form_get_names():
    x = cp.Variable(2, name="x")
    group = name_limits({"one": x <= 1, "two": [x >= 0, x[0] == 0.5]}, "default")
    assert [len(g) for g in group.values()] == [1, 2]
    assert list(name_limits(x <= 1, "default")) == ["default"]
    assert list(name_limits([x <= 1, x >= 0], "pair")) == ["pair[0]", "pair[1]"]
    refuses(StructureError, "'truth'.*bool", name_limits, {"truth": True}, "default")


def test_constraint_in_a_callable_sees_the_named_variables():
    problem = case("qp_equality").build().subject_to(lambda v: {"first": v["x"][0] <= 0})
    found = solve(problem, "clarabel")
    # with x0 = 0: minimum norm on 2 x1 + 2 x2 = 1
    assert found.values["x"] == pytest.approx([0.0, 0.25, 0.25], abs=1e-6)
    assert found.duals["first"] == pytest.approx([0.25], abs=1e-5)


def test_a_problem_itself_never_changes():
    problem, _ = bilinear()
    extended = problem.subject_to(lambda v: {"sign": v["mu"] >= 0})
    assert not problem.constraint_names and extended.constraint_names == ("sign",)


def test_a_bilinear_problem_with_one_factor_held_is_least_squares():
    problem, target = bilinear()
    for b in ([0.6, 0.8], [0.8, -0.6]):
        held = problem.holding({**problem.start, "b": np.array(b)}, ["b"])
        assert class_of(problem) == "NLP" and class_of(held) == "QP" and set(held.start) == {"mu"}
        found = solve(held, "clarabel")
        assert found.values["mu"] == pytest.approx(target @ b, abs=1e-6)
        assert held.model(found.values)["b"] == pytest.approx(b)


def test_constraints_stay_in_force_where_a_factor_is_held():
    problem, target = bilinear(lambda v: {"sign": v["mu"] >= 0})
    held = problem.holding({**problem.start, "b": np.array([0.8, 0.4])}, ["b"])
    free = target @ [0.8, 0.4] / 0.8
    assert free.min() < -0.1
    assert solve(held, "clarabel").values["mu"] == pytest.approx(np.maximum(free, 0), abs=1e-6)
    turned = bilinear(lambda v: {"sum": cp.sum(v["b"]) == 3})[0]
    assert solve(turned.holding({**turned.start, "b": np.array([1.0, 0.0])}, ["b"]), "clarabel"
                 ).status is Status.INFEASIBLE


def test_holding_what_is_not_there_or_of_another_shape():
    problem, _ = bilinear()
    refuses(StructureError, "'mu2'.*'mu'", problem.holding, {"mu2": np.ones(1)}, ["mu2"])
    refuses(StructureError, r"'b' has shape \(2,\).*\(3,\)", problem.holding, {"b": np.ones(3)}, ["b"])


def test_duals_are_flat_and_by_name():
    program = for_solvers(case("qp_repeated_constraints").build())
    found = solve(program, "clarabel")
    assert {name: d.shape for name, d in found.duals.items()} == {"once": (1,), "twice": (1,), "cap": (2,)}
    statement_of(program).begin(program.start)
    assert statement_of(program).duals() == {}


def test_point_outside_the_bounds_of_a_variable_can_be_assigned_and_judged():
    x = cp.Variable(2, name="x", nonneg=True)
    program = pose("bounded", cp.sum(x), {}, [x])
    statement_of(program).assign({"x": np.array([-1e-9, 0.0])})
    assert statement_of(program).values()["x"][0] == -1e-9


def test_view_of_several_inputs_asks_for_the_channel():
    x = cp.Variable(2)
    view = View({"mu[valve]": x}, channels=("valve", "pump"))
    assert view.key("mu", "valve") == "mu[valve]"
    refuses(StructureError, "valve, pump", view.key, "mu")
    assert View({"mu": x}, channels=("valve",)).key("mu") == "mu"


@pytest.mark.parametrize(("change", "status"), [
    (lambda v: {"b": 1.01 * v["b"]}, Status.FAILED), (lambda v: {"mu": v["mu"] + 0.1}, Status.INACCURATE),
    (lambda v: {"b": np.ones(3)}, Status.FAILED), (lambda v: {"a": 1e200 * v["a"]}, Status.FAILED),
    (lambda v: {"a": np.array([np.nan, 0.0])}, Status.FAILED)])
def test_a_lie_about_a_programme_that_is_not_stated_is_found_out(change, status):
    found = fit(record(noise=0.1), "hammerstein_arx.exact", na=2, nb=2, nk=1, basis=Polynomial(3))
    values = {**found.solution.values, **change(found.solution.values)}
    liar = BackEnd("liar", frozenset(), lambda program, settings: Answer(Status.OPTIMAL, "trust me", values),
                   form="rank-one", takes=RankOneForm.of)
    assert solve(found.problem, liar).status is status

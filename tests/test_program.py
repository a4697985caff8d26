"""Program: named parts, further constraints, freezing, values and duals by name."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest
from problems import record
from refusals import refuses
from zoo import CASES, case, pose

from optid import Polynomial, fit
from optid.backends import Answer, BackEnd
from optid.errors import StructureError
from optid.program.judging import judge
from optid.program.program import named
from optid.program.solution import Status
from optid.program.view import View
from optid.solving.solve import solve
from optid.structures.least_squares import RankOneStructure


def bilinear():
    """min ‖mu bᵀ - T‖², ‖b‖ = 1; with b held it is least squares with the closed form mu = T b."""
    mu, b = cp.Variable(3, name="mu"), cp.Variable(2, name="b")
    target = np.array([[1.0, 2.0], [0.0, 1.0], [-1.0, 1.0]])
    return pose("bilinear", cp.sum_squares(cp.outer(mu, b) - target), {"gauge": cp.sum_squares(b) == 1}, [mu, b],
                start={"mu": np.ones(3), "b": np.array([0.6, 0.8])}, structural=frozenset({"gauge"})), target


def test_class_of_every_case_is_what_its_name_says():
    for name, entry in CASES.items():
        kind = entry.build().kind
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
    assert pose("class", atom(x), {"fixed": x[0, 1] == 1}, [x]).kind == kind


def test_what_is_neither_convex_nor_smooth_is_named():
    x = cp.Variable(2, name="x")
    program = pose("rough", x[0] * x[1], {"cap": cp.max(x) <= 1, "gap": cp.max(x) >= 0.5}, [x])
    with pytest.raises(StructureError, match="constraint 'gap'"):
        _ = program.kind
    assert program.nonconvex_parts() == ["the objective", "constraint 'gap'"]


# subject_to

def test_constraints_of_every_form_get_names():
    x = cp.Variable(2, name="x")
    group = named({"one": x <= 1, "two": [x >= 0, x[0] == 0.5]}, "default")
    assert [len(g) for g in group.values()] == [1, 2]
    assert list(named(x <= 1, "default")) == ["default"]
    assert list(named([x <= 1, x >= 0], "pair")) == ["pair[0]", "pair[1]"]
    refuses(StructureError, "'truth'.*bool", named, {"truth": True}, "default")


def test_constraint_in_a_callable_sees_the_named_variables():
    program = case("qp_equality").build().subject_to(lambda v: {"first": v["x"][0] <= 0})
    found = solve(program, "clarabel")
    # with x0 = 0: minimum norm on 2 x1 + 2 x2 = 1
    assert found.values["x"] == pytest.approx([0.0, 0.25, 0.25], abs=1e-6)
    assert found.duals["first"] == pytest.approx([0.25], abs=1e-5)


def test_unknown_variable_names_the_nearest():
    program, _ = bilinear()
    refuses(StructureError, "'mi'.*'mu'", program.subject_to, lambda v: v["mi"] >= 0)


def test_foreign_variable_is_named():
    program, _ = bilinear()
    refuses(StructureError, "stranger", program.subject_to, {"odd": cp.Variable(name="stranger") >= 0})


def test_names_are_used_once():
    program, _ = bilinear()
    refuses(StructureError, "two constraints named 'gauge'", program.subject_to, lambda v: {"gauge": v["b"][0] >= 0})


def test_nonconvex_constraint_in_a_convex_formulation_is_refused():
    program = case("qp_equality").build()
    refuses(StructureError, "'ring' is not convex", program.subject_to, lambda v: {"ring": cp.sum_squares(v["x"]) >= 1})
    nonconvex, _ = bilinear()
    assert "ring" in nonconvex.subject_to(lambda v: {"ring": cp.sum_squares(v["mu"]) >= 1}).user_constraints


def test_program_itself_never_changes():
    program, _ = bilinear()
    extended = program.subject_to(lambda v: {"sign": v["mu"] >= 0})
    assert set(program.constraints) == {"gauge"} and set(extended.constraints) == {"gauge", "sign"}
    assert set(extended.user_constraints) == {"sign"} and set(extended.without("sign").constraints) == {"gauge"}


# freeze

def test_frozen_bilinear_programme_is_least_squares():
    program, target = bilinear()
    frozen = program.freeze(b=[0.6, 0.8])
    assert program.kind == "NLP" and frozen.kind == "QP"
    assert set(frozen.variables) == {"mu"} and "gauge" not in frozen.constraints
    for b in ([0.6, 0.8], [0.8, -0.6]):
        frozen.parameters["b"].value = np.array(b)
        found = solve(frozen, "clarabel")
        assert found.values["mu"] == pytest.approx(target @ b, abs=1e-6)
    assert frozen.recover(found.values)["b"] == pytest.approx([0.8, -0.6])


def test_frozen_constraints_stay_in_force():
    program, target = bilinear()
    frozen = program.subject_to(lambda v: {"sign": v["mu"] >= 0}).freeze(b=[0.8, 0.4])
    found = solve(frozen, "clarabel")
    free = target @ [0.8, 0.4] / 0.8
    assert free.min() < -0.1
    assert found.values["mu"] == pytest.approx(np.maximum(free, 0), abs=1e-6)


def test_freezing_what_is_not_there_or_of_another_shape():
    program, _ = bilinear()
    refuses(StructureError, "'mu2'.*'mu'", program.freeze, mu2=[1.0])
    refuses(StructureError, r"'b' has shape \(2,\).*\(3,\)", program.freeze, b=[1.0, 0.0, 0.0])


# values and duals

def test_derived_variables_follow_the_others():
    program = case("qp_monotone_with_residuals").build()
    program.assign({"x": np.zeros(4), "r": np.ones(4)})
    assert program.values()["r"] == pytest.approx([-1.0, -3.0, -2.0, -4.0])


def test_duals_are_flat_and_by_name():
    program = case("qp_repeated_constraints").build()
    found = solve(program, "clarabel")
    assert {name: d.shape for name, d in found.duals.items()} == {"once": (1,), "twice": (1,), "cap": (2,)}
    program.clear_duals()
    assert program.duals() == {}


def test_point_outside_the_bounds_of_a_variable_can_be_assigned_and_judged():
    x = cp.Variable(2, name="x", nonneg=True)
    program = pose("bounded", cp.sum(x), {}, [x])
    program.assign({"x": np.array([-1e-9, 0.0])})
    assert program.values()["x"][0] == -1e-9


def test_view_of_several_inputs_asks_for_the_channel():
    x = cp.Variable(2)
    view = View({"mu[valve]": x}, channels=("valve", "pump"))
    assert view.key("mu", "valve") == "mu[valve]"
    refuses(StructureError, "valve, pump", view.key, "mu")
    assert View({"mu": x}, channels=("valve",)).key("mu") == "mu"


def test_infeasible_status_of_a_frozen_programme():
    program, _ = bilinear()
    frozen = program.subject_to(lambda v: {"sum": cp.sum(v["b"]) == 3}).freeze(b=[1.0, 0.0])
    assert solve(frozen, "clarabel").status is Status.INFEASIBLE


@pytest.mark.parametrize("gauge", ["norm", "gain", "b0"])
def test_a_programme_that_is_not_stated_is_judged_as_one_that_is(gauge):
    found, twin = (fit(record(noise=0.1), "hammerstein_arx.exact", na=2, nb=2, nk=1, basis=Polynomial(3), gauge=gauge)
                   for _ in range(2))
    program, at, stated = found.program, found.solution.values, replace(twin.program)
    assert (program.kind, program.size) == (stated.kind, stated.size)
    assert found.solution.proof and stated.is_stated and not program.is_stated and program.shapes == stated.shapes
    for point in (at, {**at, "b": 1.1 * at["b"]}, {**at, "mu": at["mu"] + 0.1}, {**at, "a": at["a"] - 0.05}):
        (values, value, ours), (others, same, theirs) = (judge(one, point, {}) for one in (program, stated))
        assert value == pytest.approx(same, rel=1e-12) and ours.stationarity == pytest.approx(theirs.stationarity)
        assert (ours.violation > 1e-4, ours.worst or "gauge") == (theirs.violation > 1e-4, theirs.worst or "gauge")
        assert list(values) == list(others)
        assert all(values[name] == pytest.approx(others[name], abs=1e-12) for name in values)
    program.assign(at)
    assert program.variables["mu"].value == pytest.approx(at["mu"])  # it is there once it is stated


@pytest.mark.parametrize(("change", "status"), [
    (lambda v: {"b": 1.01 * v["b"]}, Status.FAILED), (lambda v: {"mu": v["mu"] + 0.1}, Status.INACCURATE),
    (lambda v: {"b": np.ones(3)}, Status.FAILED), (lambda v: {"a": 1e200 * v["a"]}, Status.FAILED),
    (lambda v: {"a": np.array([np.nan, 0.0])}, Status.FAILED)])
def test_a_lie_about_a_programme_that_is_not_stated_is_found_out(change, status):
    found = fit(record(noise=0.1), "hammerstein_arx.exact", na=2, nb=2, nk=1, basis=Polynomial(3))
    values = {**found.solution.values, **change(found.solution.values)}
    liar = BackEnd("liar", frozenset(), lambda program, settings: Answer(Status.OPTIMAL, "trust me", values),
                   structures=(RankOneStructure,))
    assert solve(found.program, liar).status is status

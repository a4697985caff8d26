"""The pitfalls of the formulation layer that were found by prototype, one by one; where possible with the evidence."""

from importlib.metadata import entry_points

import cvxpy as cp
import numpy as np
import pytest
import scipy.sparse as sp
from refusals import refuses
from zoo import case, pose

from optid.backends import Answer, BackEnd, Settings, back_ends
from optid.backends import casadi as casadi_backend
from optid.backends.dnlp import smooth
from optid.conformance.zoo import planted_fit
from optid.core.problem import Problem
from optid.core.statement import for_solvers, statement_of
from optid.errors import LookupFailed, StructureError
from optid.program.solution import Status
from optid.solving.solve import solve


def through_cvxpy(program: Problem, settings: Settings) -> Answer:
    """CVXPY's own interface to Uno, believed as it is."""
    stated = statement_of(program)
    stated.problem.solve(solver="UNO", nlp=True)
    status = Status.OPTIMAL if stated.problem.status == "optimal" else Status.FAILED
    return Answer(status, stated.problem.status, stated.values(), stated.duals())


def test_1_success_at_an_infeasible_stationary_point_is_not_believed():
    program = for_solvers(case("nlp_infeasible_stationary").build())
    believed = BackEnd("believed", frozenset({"NLP"}), through_cvxpy)
    claim = through_cvxpy(program, Settings())
    assert claim.word == "optimal"  # the evidence: x² = -1 has no solution
    found = solve(program, believed)
    assert found.status is Status.FAILED and "circle" in found.reason
    for name in ("uno", "ipopt"):  # they say so too, which no convex relaxation confirms
        assert solve(program, name).status is Status.FAILED and "infeasib" in solve(program, name).reason


def test_1_multipliers_of_an_earlier_solve_are_not_handed_on():
    program = case("qp_equality").build()
    known = solve(program, "clarabel").duals["plane"]

    def remembers(program: Problem, settings: Settings) -> Answer:
        assert statement_of(program).duals() == {}
        return Answer(Status.LOCAL, "done", {"x": np.array([1.0, 2.0, 2.0]) / 9}, statement_of(program).duals())

    assert known.size == 1
    assert solve(program, remembers).duals["plane"] == pytest.approx(known)  # ours


@pytest.mark.parametrize("name", ["uno", "ipopt", "fatrop"])
def test_1_our_nlp_back_ends_return_multipliers(name):
    found = solve(case("nlp_hs071").build(), name)
    assert set(found.duals) == {"product", "sphere", "lower", "upper"}
    assert found.residuals.stationarity < 1e-8 and found.residuals.complementarity < 1e-7


@pytest.mark.parametrize("name", ["uno", "ipopt", "fatrop"])
def test_2_zero_is_a_saddle_and_the_start_belongs_to_the_programme(name):
    target = np.outer([1.0, 2.0], [2.0, 1.0])

    def fit(start):
        mu, b = cp.Variable(2, name="mu"), cp.Variable(2, name="b")
        return pose("fit", cp.sum_squares(cp.outer(mu, b) - target), {}, [mu, b], start=start)

    stuck = solve(fit({"mu": np.zeros(2), "b": np.zeros(2)}), name)
    assert stuck.objective == pytest.approx(np.sum(target**2), rel=1e-6)  # the evidence: it stays at zero
    free = solve(fit({"mu": np.ones(2), "b": np.ones(2)}), name)
    assert free.objective == pytest.approx(0.0, abs=1e-8)
    program = fit({"mu": np.ones(2), "b": np.ones(2)})
    statement_of(program).variables["mu"].value = np.zeros(2)  # what a variable happens to hold does not matter
    assert solve(program, name).objective == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("name", ["uno", "ipopt", "fatrop"])
def test_3_multipliers_come_back_by_inverse_data_not_by_position(name):
    # the epigraph rows of abs and max and the rows of the symmetric variable stand between the named ones
    def build():
        x, m = cp.Variable(3, name="x"), cp.Variable((2, 2), name="m", symmetric=True)
        distance = cp.sum_squares(x - np.array([3.0, -2.0, 1.0])) + cp.sum_squares(m - np.array([[1, 2], [2, 5]]))
        return pose("mixed", distance, {
            "size": cp.abs(x) <= np.array([1.0, 1.5, 4.0]), "link": x[0] + m[0, 0] == 1.5, "top": cp.max(x) <= 0.9,
            "tie": m[0, 1] + x[2] <= 1}, [x, m], start={"x": np.zeros(3), "m": np.eye(2)})

    found, known = solve(build(), name), solve(build(), "clarabel")
    for key in ("size", "link", "top", "tie"):
        assert found.duals[key] == pytest.approx(known.duals[key], abs=1e-5), key
    assert np.max(np.abs(known.duals["size"])) > 0.1 and abs(known.duals["link"][0]) > 0.1
    assert found.status is Status.LOCAL or found.proof


def jacobian_entries(program: Problem) -> int:
    import casadi as ca

    parts = casadi_backend.translate(smooth(statement_of(program).problem))
    return ca.jacobian(parts["g"], parts["x"]).nnz()


def test_4_constant_data_keep_their_sparsity():
    matrix = np.triu(np.arange(1.0, 26.0).reshape(5, 5))

    def rows(data, level):
        x = cp.Variable(5, name="x")
        return pose("rows", cp.sum(cp.power(x, 4)), {"rows": data @ x == level}, [x])

    entries, level = np.count_nonzero(matrix), np.ones(5)
    assert jacobian_entries(rows(matrix, level)) == entries
    assert jacobian_entries(rows(sp.csc_array(matrix), level)) == entries


def test_5_objectives_are_in_data_units_because_residuals_are_variables():
    rng = np.random.default_rng(1)
    a, y = rng.standard_normal((50, 4)), 1e5 + 1e-2 * rng.standard_normal(50)
    a[:, 0] = 1.0
    known = float(np.linalg.lstsq(a, y)[1][0])
    triangle = np.asarray(np.linalg.qr(np.column_stack([a, y]), mode="r"))
    root, target, remainder = triangle[:-1, :-1], triangle[:-1, -1], triangle[-1, -1] ** 2
    z, r = cp.Variable(4, name="z"), cp.Variable(4, name="r")
    program = pose("fit", cp.sum_squares(r) + remainder, {"residual": r == root @ z - target}, [z, r],
                   scale=float(y @ y))
    assert solve(program, "clarabel").objective == pytest.approx(known, rel=1e-6)
    gram = root.T @ root
    square = cp.quad_form(z, cp.psd_wrap(gram)) - 2 * (root.T @ target) @ z + float(y @ y)
    cp.Problem(cp.Minimize(square)).solve(solver="CLARABEL")
    expanded = float(np.sum((a @ z.value - y) ** 2))
    assert abs(expanded - known) > 1e-5 * known or abs(float(square.value) - known) > 1e-3 * known  # the evidence


def test_6_highs_is_never_offered_through_casadi():
    offered = [back_end for point in entry_points(group="optid.backends") for back_end in point.load()()]
    assert {back_end.name for back_end in offered if back_end.pip == "casadi"} == {"ipopt", "fatrop"}
    assert "highs" in {back_end.name for back_end in offered if back_end.about == "through CVXPY"}


def test_6_highs_and_casadi_live_in_one_process():
    for name in ("highs", "ipopt", "highs", "fatrop"):
        assert solve(case("qp_box").build(), name).status is Status.OPTIMAL


@pytest.mark.parametrize("name", ["sleqp", "bonmin", "sqpmethod", "madnlp", "blocksqp", "feasiblesqpmethod"])
def test_7_what_does_not_pass_the_suite_is_not_offered(name):
    refuses(LookupFailed, name, solve, case("nlp_hs071").build(), name)


def test_7_sqpmethod_indeed_does_not_pass():
    import casadi as ca

    stated = statement_of(for_solvers(case("rank_one_fit").build()))
    stated.begin({})
    form = smooth(stated.problem)
    quiet = {"print_time": False, "print_header": False, "print_iteration": False, "print_status": False,
             "error_on_fail": False, "qpsol": "qrqp", "max_iter": 50,
             "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False}}
    solver = ca.nlpsol("s", "sqpmethod", casadi_backend.translate(form), quiet)
    found = solver(x0=form.start(), lbg=form.row_bounds[0], ubg=form.row_bounds[1])
    assert not solver.stats()["success"] or float(found["f"]) > 1.01 * case("rank_one_fit").value


def fit(gauge: str, **constraint) -> Problem:
    matrix, y = planted_fit()
    mu, b, a = cp.Variable(4, name="mu"), cp.Variable(2, name="b"), cp.Variable(1, name="a")
    residual = matrix @ cp.hstack([a, cp.vec(cp.outer(mu, b), order="F")]) - y
    gauges = {"norm": cp.sum_squares(b) == 1, "b0": b[0] == 1}
    program = pose(f"fit {gauge}", cp.sum_squares(residual), {"gauge": gauges[gauge]}, [a, mu, b],
                   start={"a": np.zeros(1), "mu": np.array([-1.0, 0, 0, 1.0]), "b": np.array([1.0, 0.5])})
    return program.subject_to(*(lambda v, name=name, build=build: {name: build(v["mu"])}
                                for name, build in constraint.items()))


def test_8_a_bound_on_mu_means_something_only_under_its_normalisation():
    free = {gauge: solve(fit(gauge), "ipopt").objective for gauge in ("norm", "b0")}
    assert free["norm"] == pytest.approx(free["b0"], rel=1e-8)
    shaped = {gauge: solve(fit(gauge, odd=lambda mu: mu + mu[::-1] == 0), "ipopt").objective for gauge in free}
    assert shaped["norm"] == pytest.approx(shaped["b0"], rel=1e-8) and shaped["norm"] > 1.0001 * free["norm"]
    bounded = {gauge: solve(fit(gauge, range=lambda mu: mu <= 0.5), "ipopt").objective for gauge in free}
    assert abs(bounded["norm"] - bounded["b0"]) > 1e-2 * free["norm"]


def test_8_there_is_no_automatic_relaxation():
    assert not [name for name in dir(Problem) if "relax" in name or "convexify" in name]
    refuses(StructureError, "not convex", solve, fit("norm"), "clarabel")


def test_9_hessians_are_exact():
    import casadi as ca

    program = for_solvers(case("rank_one_fit").build())
    assert solve(program, "ipopt").status in (Status.LOCAL, Status.OPTIMAL)
    kept = statement_of(program).problem._solver_cache["optid"].values()
    compiled = [value for value in kept if isinstance(value, ca.Function)]
    assert len(compiled) == 1 and compiled[0].stats()["n_call_nlp_hess_l"] > 0


def test_9_a_limited_memory_hessian_is_refused():
    for key in ("hessian_approximation", "ipopt.hessian_approximation"):
        with pytest.raises(StructureError, match="limited-memory"):
            solve(case("rank_one_fit").build(), "ipopt", **{key: "limited-memory"})
    assert back_ends()["ipopt"].installed

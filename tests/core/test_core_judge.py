"""The judge of the core: solved points stand, with multipliers that agree with those of programmes; others do not."""

import warnings

import cvxpy as cp
import numpy as np
import pytest
from test_core import exact_problem, record

import optid
from formulations.arx import _problem as arx_problem
from optid.core.judge import judge, largest_excess
from optid.core.leaves import LeafSpace, Quantity
from optid.core.prices import price_constraints
from optid.core.problem import Problem
from optid.core.statement import for_solvers, is_stated, statement_of
from optid.core.terms import GroupNorms, NuclearNorms, Squares
from optid.errors import DataWarning
from optid.identify.equation_error import EquationStructure, compress
from optid.program.solution import relative_gap
from optid.solving.solve import solve

pytestmark = pytest.mark.numerical
RECORD = record(5)
WORDS = [(), ("monotone:increasing",), ("odd", "gain:1"), ("range:-0.15,0.1",), ("coefficients:a,-1.5,-0.95",),
         ("monotone:increasing", "stable:0.5"), ("dead_zone:3,5",), ("saturation:-2,8", "gain:0.5"), ("convex",),
         ("slope:0,0.01",)]


def solved(problem):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        solution = solve(for_solvers(problem), prove=False)
    assert str(solution.status) in ("optimal", "locally optimal"), solution
    return {name: np.asarray(solution.values[name]) for name in problem.start}, solution


@pytest.mark.parametrize("words", WORDS)
@pytest.mark.parametrize("seed", range(2))
def test_a_solution_is_stationary_and_its_multipliers_are_those_of_the_programme(words, seed):
    problem = exact_problem(seed, words)
    x, solution = solved(problem)
    found = judge(problem, x, {})
    assert found.objective * problem.unit == pytest.approx(solution.objective, rel=1e-9)
    assert found.residuals.violation <= 1e-7 and found.residuals.stationarity <= 1e-6
    assert found.residuals.complementarity <= 1e-6
    for name in problem.constraint_names:
        ours, theirs = found.duals[name], np.asarray(solution.duals[name])
        if np.linalg.matrix_rank(np.vstack([one.slope(problem.space, {}) @ problem.slope(x)
                                            for one in problem.constraints() if one.name == name])) == len(ours):
            np.testing.assert_allclose(ours, theirs, atol=2e-3 * np.max(np.abs(theirs)) + 1e-6 * found.objective)


@pytest.mark.parametrize("words", WORDS[1:5])
def test_other_points_do_not_stand_whatever_is_claimed_of_them(words):
    problem = exact_problem(1, words)
    x, _ = solved(problem)
    right = judge(problem, x, {})
    for claim in ({}, right.duals, {name: np.nan * d for name, d in right.duals.items()},
                  {name: d[:-1] for name, d in right.duals.items()}, {name: -d - 1 for name, d in right.duals.items()}):
        found = judge(problem, x, claim)
        binding = any(np.any(dual) for dual in right.duals.values())
        assert found.residuals.stationarity <= 1e-6 and (not binding or found.fitted == (claim is not right.duals))
        rng = np.random.default_rng(0)
        for size in (1e-3, 0.1):
            there = problem.in_gauge({name: value * (1 + size * rng.normal(size=value.shape))
                                      for name, value in x.items()})
            off = judge(problem, there, claim).residuals
            assert not (off.stationarity <= 1e-6 and off.violation <= 1e-7 and off.complementarity <= 1e-6)
    nothing = {name: np.full_like(value, np.nan) for name, value in x.items()}
    bad = judge(problem, nothing, {}).residuals
    assert not bad.violation <= 1 and not bad.stationarity <= 1


def test_a_constraint_on_one_factor_has_a_multiplier_of_the_gauge_beside_it():
    problem = exact_problem(2, [lambda v: {"first": v["b"][0] >= 0.995}])
    x, solution = solved(problem)
    found = judge(problem, x, {})
    assert found.residuals.stationarity <= 1e-6 and found.duals["first"][0] > 0
    assert float(np.ravel(x["b"])[0]) == pytest.approx(0.995, abs=1e-8)


def test_a_matrix_constraint_is_judged_by_its_null_directions():
    target = np.array([2.0, 1.0, 1.0, 3.0])
    problem = Problem("ball", {"M": np.eye(2)}, (Squares(np.eye(4), target, 0.0, ("M",)),), symmetric=frozenset({"M"}),
                      builders=(lambda v: {"below": np.eye(2) - v["M"] >> 0},))
    x = {"M": np.eye(2)}  # the projection of a matrix whose eigenvalues are above one
    found = judge(problem, x, {})
    assert found.residuals.stationarity <= 1e-6 and found.residuals.violation == 0 and found.fitted
    z = 2 * (target.reshape(2, 2) - np.eye(2))  # the multiplier: minus the gradient
    assert judge(problem, x, {"below": np.ravel(z * found_sizes(problem))}).residuals.stationarity <= 1e-12
    outside = judge(problem, {"M": 1.5 * np.eye(2)}, {})
    assert outside.residuals.violation == pytest.approx(0.5 / 2.5, rel=0.2) and outside.residuals.worst == "below"
    inside = judge(problem, {"M": 0.9 * np.eye(2)}, {})
    assert inside.residuals.stationarity > 1e-2


def found_sizes(problem):
    return problem.constraints()[0].sizes[0]


@pytest.mark.parametrize("kind", ["nuclear", "group"])
def test_kinks_are_judged_by_the_nearest_subgradient(kind):
    rng = np.random.default_rng(4)
    root, target = rng.normal(size=(20, 12)), rng.normal(size=20)
    norms = NuclearNorms({"Q": 12.0}) if kind == "nuclear" else GroupNorms({"Q": np.array([3.0, 12.0, 40.0])})
    problem = Problem("kinks", {"Q": np.ones((3, 4))}, (Squares(root, target, 0.0, ("Q",)), norms))
    v = cp.Variable((3, 4))
    cp.Problem(cp.Minimize(sum(term.express({"Q": v}) for term in problem.terms))).solve("CLARABEL")
    assert v.value is not None
    q = np.array(v.value)
    if kind == "group":  # an interior point leaves what vanishes at rounding
        q[np.linalg.norm(q, axis=1) < 1e-6] = 0.0
    else:
        u, s, vt = np.linalg.svd(q, full_matrices=False)
        q = (u * np.where(s > 1e-6 * s[0], s, 0.0)) @ vt
    assert np.linalg.matrix_rank(q, 1e-5) < 3
    assert judge(problem, {"Q": q}, {}).residuals.stationarity <= 1e-4
    assert judge(problem, {"Q": 1.01 * q}, {}).residuals.stationarity > 5e-4


@pytest.mark.parametrize("word, fixed", [
    *((word, True) for word in ("monotone:increasing", "convex", "sign:b,negative")),
    *((word, False) for word in ("odd", "stable", "gain:1", "coefficients:a,-1.5,1", "dead_zone:3,5", "range:-5,5"))])
def test_constraints_fix_the_signs_of_f_and_b_only_where_they_tell_them_apart(word, fixed):
    problem = exact_problem(0, (word,))
    assert problem.fixes_signs is fixed
    turned = {**problem.start, "mu": -problem.start["mu"], "b": -problem.start["b"]}
    start = problem.signed_start()
    assert problem.violation(start) == min(problem.violation(problem.start), problem.violation(turned))
    if word == "sign:b,negative":
        assert np.all(start["b"] <= 0)


def test_a_constrained_fit_states_nothing_in_cvxpy_until_it_is_needed():
    fit = optid.fit(RECORD, na=2, nb=2, nk=1, basis="triangular:6", constraints=["monotone:increasing", "gain:0.5"])
    assert not is_stated(fit.problem) and fit.prices[1].binding and fit.solution.proof
    assert set(fit.problem.constraint_names) == {"monotone:increasing", "gain"}
    assert fit.values["Theta"].shape == (6, 2) and not is_stated(fit.problem)
    assert statement_of(fit.problem).problem.is_dcp() is False and is_stated(fit.problem)


def test_what_is_no_number_is_a_violation_whatever_comes_after_it():
    """A root of what has become negative is no number; the row after it holds."""
    root = Quantity("root", lambda x: np.sqrt(x["x"]), lambda x: {"x": np.diag(0.5 / np.sqrt(x["x"]))})
    squares = Squares(np.eye(1), np.array([-1.0]), 0.0, ("x",))
    problem = Problem("rooted", {"x": np.ones(1)}, (squares,), (root,), builders=(
        lambda v: {"root": v["root"] >= 0.5, "below": v["x"] <= 4.0},))
    with np.errstate(invalid="ignore"):
        found = judge(problem, {"x": -np.ones(1)}, {})
        outside = largest_excess(problem, {"x": -np.ones(1)})
    assert found.residuals.violation == found.residuals.stationarity == outside == np.inf
    assert found.residuals.worst == "root"


@pytest.mark.parametrize("objective, bound", [(np.nan, 1.0), (1.0, np.nan), (np.nan, np.nan)])
def test_a_gap_of_what_is_no_number_proves_nothing(objective, bound):
    assert not relative_gap(objective, bound, 1.0) <= 1.0
    assert relative_gap(2.0, 1.0, 1.0) == 0.5 and relative_gap(1.0, 2.0, 1.0) == 0.0
    assert relative_gap(1.0, -np.inf, 1.0) == np.inf


def test_a_matrix_with_what_is_no_number_is_not_definite():
    held = Problem("matrix", {"x": np.eye(2)}, (Squares(np.eye(4), np.zeros(4), 0.0, ("x",)),), builders=(
        lambda v: {"above": v["x"] >> 0},), symmetric=frozenset({"x"})).constraints()[0]
    space = LeafSpace({"x": np.eye(2)}, frozenset({"x"}))
    assert np.isnan(held.violation(space, {"x": np.full((2, 2), np.nan)}))
    assert held.violation(space, {"x": np.diag([1.0, -2.0])}) == pytest.approx(2.0)


def test_degenerate_multipliers_are_priced_by_the_least():
    def twice(v):
        return {"one": v["a"][0] <= -1.0, "same": 2 * v["a"][0] <= -2.0, "idle": v["a"][1] >= -50}

    problem = arx_problem(compress(RECORD, EquationStructure(2, 2, 1, "linear")), (twice,))
    x, solution = solved(problem)
    judged = judge(problem, x, solution.duals)
    prices = {p.name: p.multiplier for p in price_constraints(problem, x, judged.duals, judged.objective)}
    assert prices["one"] == pytest.approx(0, abs=1e-6 * solution.objective) == prices["same"] == prices["idle"]


def test_multipliers_are_the_rates_of_the_optimum():
    def optimum(high):
        problem = arx_problem(compress(RECORD, EquationStructure(2, 2, 1, "linear")),
                              (lambda v: {"high": v["a"][0] <= high},))
        x, solution = solved(problem)
        return solution.objective, judge(problem, x, {}), problem

    _, found, problem = optimum(-1.0)
    rate = (optimum(-1.001)[0] - optimum(-0.999)[0]) / 0.002  # the objective falls where the bound rises
    (one,) = problem.constraints()
    assert problem.unit * found.duals["high"][0] / one.sizes[0] == pytest.approx(rate, rel=1e-3)

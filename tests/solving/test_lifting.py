"""Certificates under user constraints: valid bounds, no false proof, a reason where there is none."""

import cvxpy as cp
import numpy as np
import pytest
from problems import BASIS, record, search

import optid
from formulations.constraints import shape
from optid.certificate.lifting import lift
from optid.core.least_squares import RankOneForm
from optid.core.statement import for_solvers, statement_of
from optid.registry import formulation
from optid.solving.claims import proof_of

SETS = {
    "cone": [shape.monotone()],
    "cone and direction": [shape.monotone(), shape.sign("b")],
    "direction": [shape.sign("b")],
    "linear": [shape.slope(0.5, 2.0)],
    "linear and cone": [shape.gain(1.5, at=0.1), shape.convex()],
    "equalities on mu": [shape.dead_zone(-0.3, 0.3)],
    "linear in a": [shape.stable(0.6), lambda v: {"sum": cp.sum(v["a"]) >= -0.7}],
    "everything": [shape.monotone(), shape.sign("b"), shape.value_range(-2, 2), shape.stable(0.9)],
}


def stated(data, **arguments):
    return for_solvers(formulation("hammerstein_arx.exact")[1](data, na=2, nb=2, basis=BASIS, **arguments))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("gain, seed", [(1.0, 0), (-1.0, 1), (1.0, 2)])
@pytest.mark.parametrize("name", SETS)
def test_bounds_hold_and_proofs_are_true(name, gain, seed):
    fit = optid.fit(record(gain, count=50, noise=1.0, seed=seed), na=2, nb=2, basis=BASIS, constraints=SETS[name])
    best = search(fit.problem, 48)
    assert fit.solution.bound.value <= best * (1 + 1e-7)
    assert fit.solution.objective >= best * (1 - 1e-7)
    if fit.solution.proof:
        assert fit.solution.objective == pytest.approx(best, rel=1e-6)
    else:
        assert "not proved" in fit.solution.bound.reason


@pytest.mark.slow
def test_a_point_that_is_not_optimal_is_never_proved():
    """The certificate is asked about points away from the optimum, some of them stationary for another branch."""
    data = record(count=60, noise=1.0)
    program = stated(data, constraints=[shape.monotone()])
    fit = optid.fit(data, na=2, nb=2, basis=BASIS, constraints=[shape.monotone()])
    rng = np.random.default_rng(0)
    for _ in range(10):
        mu = np.sort(rng.normal(size=7))
        b = rng.normal(size=2)
        values = {**fit.solution.values, "mu": np.delete(mu - mu[3], 3), "b": b / np.linalg.norm(b)}
        bound, _ = proof_of(program, values, {})
        assert not bound.proved
        assert bound.value <= fit.solution.objective * (1 + 1e-8)


@pytest.mark.parametrize("rule", [
    lambda v: {"curved": cp.sum_squares(v["a"]) <= 1.2},
    lambda v: {"curved": v["mu"][0] + v["b"][0] <= 3},
    lambda v: {"curved": v["mu"] >= -9},
])
def test_what_is_not_lifted_leaves_no_proof_and_says_why(rule):
    fit = optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[rule])
    assert not fit.solution.proof and fit.solution.bound.value == -np.inf
    assert "constraint 'curved'" in fit.solution.bound.reason


@pytest.mark.parametrize("gauge", ["norm", "b0"])
def test_lifted_rows_are_the_constraints_themselves(gauge):
    """At random points of the factored problem both readings have the same left-hand sides."""
    rules = [shape.slope(0.5, 2.0), shape.dead_zone(-0.3, 0.3), lambda v: {"a": 2 * v["a"][0] - v["a"][1] <= 3}]
    program = stated(record(), constraints=rules, gauge=gauge)
    lifted = lift(program, RankOneForm.of(program))
    assert not lifted.refused and not lifted.cones
    rows, right, equal = lifted.linear.rows, lifted.linear.right, lifted.linear.equality
    rng = np.random.default_rng(1)
    _ = statement_of(program).objective  # which states it
    for _ in range(5):
        a, mu, b, d = rng.normal(size=2), rng.normal(size=6), rng.normal(size=2), rng.normal(size=1)
        statement_of(program).assign({"a": a, "mu": mu, "b": b, "offset": d})
        z = np.concatenate([a, d, np.kron(b, mu)])
        values = rows @ z - right
        member = [np.ravel(c.expr.value, order="F") for name in program.constraint_names
                  for c in statement_of(program).constraints[name] if name in ("slope", "a")]
        assert np.allclose(values[~equal], np.concatenate(member))
        (zone,) = statement_of(program).constraints["dead_zone:-0.3,0.3"]
        flat = np.ravel(zone.expr.value)
        assert np.allclose(values[equal], np.kron(b, flat))


def test_products_of_two_cones():
    program = stated(record(), constraints=[lambda v: {"rising": BASIS.increments() @ v["mu"] >= 0}, shape.sign("b")])
    lifted = lift(program, RankOneForm.of(program))
    assert set(lifted.cones) == set(lifted.directions) == {0}
    assert lifted.add_products(RankOneForm.of(program).problem) == [] and set(lifted.cones) == {0}
    rows, right, equal = lifted.linear.rows, lifted.linear.right, lifted.linear.equality
    assert not right.any() and not equal.any()
    mu, b = np.random.default_rng(2).normal(size=6), np.array([0.3, 2.0])
    z = np.concatenate([np.zeros(3), np.kron(b, mu)])
    held = {one.name: one for one in program.constraints()}
    curve, sign = held["rising"], held["sign:b:positive"]
    ratio = -rows @ z / np.kron(b / sign.sizes, BASIS.increments() @ mu / curve.sizes)
    assert ratio[0] > 0 and np.allclose(ratio, ratio[0])  # one factor, that of the units


def test_only_constraints_linear_in_the_products_are_lifted():
    program = stated(record(), constraints=[lambda v: {"mixed": v["Theta"][2, 1] - 3 * v["a"][1] <= 4}])
    statement_of(program).assign(program.start)
    found = lift(program, RankOneForm.of(program))
    (one,) = program.constraints()
    rows = found.linear.rows * one.sizes
    assert rows.shape == (1, 15) and found.linear.right * one.sizes == pytest.approx([4]) and not found.refused
    view = statement_of(program).view
    unit = float(view["Theta"].value[2, 1] / view.inner["Theta"].value[2, 1])
    assert dict(zip(np.flatnonzero(rows).tolist(), rows[rows != 0])) == pytest.approx({1: -3.0, 11: unit})
    for name, build in (("both", lambda v: v["mu"][0] + v["a"][0] <= 1),
                        ("ball", lambda v: cp.sum_squares(v["a"]) <= 1)):
        program = stated(record(), constraints=[lambda v, name=name, build=build: {name: build(v)}])
        assert lift(program, RankOneForm.of(program)).refused == name

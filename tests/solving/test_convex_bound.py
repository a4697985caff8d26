"""Bounds of convex programmes: dual values, whatever the multipliers; no poor point is ever called optimal."""

import warnings

import cvxpy as cp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import BASIS, record

import optid
from formulations.constraints import shape
from optid.backends import Answer, BackEnd, back_ends
from optid.certificate.convex import certify_convex
from optid.core.statement import for_solvers, statement_of
from optid.errors import DataWarning
from optid.program.solution import Status
from optid.registry import formulation
from optid.solving.solve import solve

CONVEX = {
    "arx": ("arx", {"na": 2, "nb": 3}, [shape.gain(0.7)]),
    "overparametrised": ("hammerstein_arx.overparametrised", {"na": 2, "nb": 2, "basis": BASIS}, [shape.monotone()]),
    "nuclear": ("hammerstein_arx.nuclear", {"na": 2, "nb": 2, "basis": BASIS, "weight": 2.0}, [shape.monotone()]),
    "disc": ("hammerstein_arx.overparametrised", {"na": 2, "nb": 2, "basis": BASIS},
             [lambda v: {"radius": cp.norm(v["a"]) <= 1.2}]),
}


def posed(name, data=None, constrained=True):
    word, arguments, constraints = CONVEX[name]
    return for_solvers(formulation(word)[1](record() if data is None else data,
                                            constraints=constraints if constrained else (), **arguments))


def careless(share, inner="clarabel", duals=True):
    """A back end whose answer lies beside the optimum by a share of the solution, and claims to be optimal."""

    def run(program, settings):
        answer = back_ends()[inner].run(program, settings)
        values = {name: np.asarray(value) * (1 + share) for name, value in answer.values.items()}
        return Answer(Status.OPTIMAL, "optimal", values, answer.duals if duals else {})

    return BackEnd("careless", frozenset({"LP", "QP", "SOCP", "SDP"}), run)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["arx", "overparametrised", "disc"]), st.floats(-3, 3))
def test_any_multipliers_give_a_bound(seed, name, size):
    program = posed(name)
    best = solve(program, "clarabel", accuracy=1e-10)
    rng = np.random.default_rng(seed)
    wild = {key: dual + 10.0**size * rng.standard_normal(np.shape(dual)) for key, dual in best.duals.items()}
    point = {key: value + 0.1 * rng.standard_normal(np.shape(value)) for key, value in best.values.items()}
    statement_of(program).assign(point)
    bound = certify_convex(program, statement_of(program).values(), wild)
    assert program.unit * bound.value <= best.objective * (1 + 1e-8)


@pytest.mark.parametrize("constrained", [False, True])
@pytest.mark.parametrize("name", CONVEX)
def test_good_multipliers_close_the_gap(name, constrained):
    found = solve(posed(name, constrained=constrained), "clarabel")
    assert found.status is Status.OPTIMAL and found.gap < 1e-6
    assert found.bound.value <= found.objective * (1 + 1e-9)


@pytest.mark.parametrize("name", ["arx", "overparametrised"])
def test_multipliers_of_our_own_serve_where_a_solver_gives_none(name):
    found, known = solve(posed(name), careless(0.0, duals=False)), solve(posed(name), "clarabel")
    assert found.status is Status.OPTIMAL and found.duals
    assert "least-distance" in certify_convex(posed(name), known.values, {}).reason
    assert found.bound.value == pytest.approx(known.objective, rel=1e-7)


@pytest.mark.parametrize("level", [0.0, 30.0, 1e3, 1e6])
@pytest.mark.parametrize("r, s", [(1.0, 1.0), (1e-8, 1e5), (1e6, 1e-7)])
@pytest.mark.parametrize("share", [1e-1, 1e-3, 1e-4])
def test_no_careless_point_is_called_optimal(share, r, s, level):
    rng = np.random.default_rng(3)
    u, y = rng.uniform(-1, 1, 200), np.zeros(200)
    for k in range(2, 200):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + np.tanh(2 * u[k]) + 0.6 * np.tanh(2 * u[k - 1])
    data = optid.Data(u=s * u, y=r * (y + 1e-2 * rng.standard_normal(200) + level))
    for name, basis in (("arx", {}), ("hammerstein_arx.overparametrised", {"basis": "triangular:6"})):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            best, found = (optid.fit(data, name, na=2, nb=2, solver=solver, raises=False, **basis)
                           for solver in ("clarabel", careless(share)))
        excess = found.solution.objective / best.solution.objective - 1
        assert best.solution.status is Status.OPTIMAL
        if excess > 1e-6:
            assert found.solution.status not in (Status.OPTIMAL, Status.LOCAL)
            assert not found.solution.proof


@pytest.mark.parametrize("name", sorted(name for name, one in back_ends().items()
                                        if one.installed and "QP" in one.classes and "NLP" not in one.classes))
@pytest.mark.parametrize("level", [0.0, 1e3])
def test_every_solver_is_called_optimal_only_near_the_optimum(name, level):
    data = record(noise=0.05)
    data = optid.Data(u=data.u, y=data.y + level)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        best = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS, constraints=["monotone"])
        found = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS, constraints=["monotone"],
                          solver=name, raises=False)
    if found.solution.status is Status.OPTIMAL:
        assert found.solution.objective == pytest.approx(best.solution.objective, rel=1e-6)


def test_a_smooth_programme_without_least_squares_is_bounded_by_a_tangent():
    x = cp.Variable(3, name="x")
    from zoo import pose

    program = pose("plain", cp.sum_squares(x - np.array([1.0, 2.0, 3.0])), {"cap": cp.sum(x) <= 3}, [x])
    found = solve(program, "clarabel", accuracy=1e-10)
    assert found.bound.method == "tangent" and found.bound.value <= 3.0 + 1e-9 and found.gap < 1e-6
    far = certify_convex(program, {"x": np.array([1.0, 1.0, 1.0])}, {"cap": np.array([1.0])})
    assert far.value <= 3.0 and not far.proved

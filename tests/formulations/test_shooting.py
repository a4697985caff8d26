"""Output error with outputs as variables: the optimum of the Gauss-Newton route, constraints on states, refusals."""

import cvxpy as cp
import numpy as np
import pytest
from refusals import refuses
from test_noise_models import BASIS, MU, A, B, quiet, record, system

import optid
from formulations.constraints import shape
from formulations.simultaneous import hammerstein_oe
from optid.bases import Polynomial
from optid.core.statement import class_of, for_solvers, statement_of
from optid.data.record import Data
from optid.errors import DataError, OptidError, RankError, StructureError
from optid.models import HammersteinTF, Nonlinearity
from optid.program.solution import Status

ORDERS = {"na": 2, "nb": 2, "nk": 1, "basis": BASIS}


def plain(counts=(300,), **options):
    return record(system("bj", c=[], d=[]), counts, **options)


def same(data, solver="ipopt", rel=1e-6, **options):
    ours = optid.fit(data, "hammerstein_oe.shooting", solver=solver, **options)
    theirs = optid.fit(data, "hammerstein_oe.exact", **options)
    assert ours.solution.status is Status.LOCAL
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=rel)
    for c in range(len(data.inputs)):
        assert ours.model.theta(c) == pytest.approx(theirs.model.theta(c), rel=1e-4, abs=1e-5)
    assert ours.model.a == pytest.approx(theirs.model.a, abs=1e-5)
    return ours


@pytest.mark.parametrize("solver", ["ipopt", "uno", "fatrop"])
def test_back_ends_find_the_optimum_of_gauss_newton(solver):
    if not optid.backends.back_ends()[solver].installed:
        pytest.skip(f"{solver} is not installed")
    fit = same(plain((120,)), solver, **ORDERS)
    assert fit.model.structure == "oe" and not fit.solution.bound.proved


@pytest.mark.parametrize("seed", range(4))
def test_random_records(seed):
    rng = np.random.default_rng(seed)
    model = system("bj", a=np.poly(rng.uniform(-0.9, 0.95, 2))[1:], mu=rng.normal(size=4), c=[], d=[])
    same(record(model, (400,), seed=seed, noise=0.1), **ORDERS)


def test_gaps_and_several_experiments():
    data = plain((200, 150), gaps=0.2)
    fit = same(data, **ORDERS)
    assert fit.values["x[2]"].shape == (150,)
    # every experiment has a state of its own: the residuals are those of a simulation with the fitted state
    simulated = fit.model.simulate(data, x0="fit")
    for i, x in enumerate(simulated, start=1):
        assert fit.values[f"x[{i}]"] == pytest.approx(x[:, 0], abs=1e-5)


def test_two_inputs_without_a_constant_and_the_gauges():
    functions = Nonlinearity(BASIS, MU), Nonlinearity(Polynomial(2).with_interval(-1.0, 1.0), [0.8, 0.3])
    plant = HammersteinTF(A, (B / np.linalg.norm(B), [1.0]), functions, (0, 2), 0.0)
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (400, 2))
    data = Data(u, plant.simulate(u) + 0.1 * rng.standard_normal((400, 1)))
    options = {"na": 2, "nb": [2, 1], "nk": [0, 2], "basis": [BASIS, functions[1].basis], "offset": False}
    for gauge in ("norm", "gain", "b0"):
        fit = same(data, gauge=gauge, **options)
        assert fit.model.offset == pytest.approx([0.0]) and fit.model.gauge == gauge


def test_no_poles():
    data = record(HammersteinTF([], (B,), (Nonlinearity(BASIS, MU),), (1,), 0.3, d=()), (200,))
    ours = optid.fit(data, hammerstein_oe, na=0, nb=2, nk=1, basis=BASIS, solver="ipopt")
    theirs = optid.fit(data, "hammerstein_oe.exact", na=0, nb=2, nk=1, basis=BASIS)
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-8)


def test_shape_constraints_agree_with_gauss_newton():
    data = record(system("bj", mu=np.array([-0.2, -0.5, 0.5, 0.4]), c=[], d=[]), (300,), seed=2)
    fit = same(data, rel=1e-5, constraints=[shape.monotone("increasing")], **ORDERS)
    assert fit.prices[0].active


def test_constraints_on_the_simulated_output_and_nonconvex_ones():
    data = plain()
    free = optid.fit(data, hammerstein_oe, solver="ipopt", **ORDERS)
    ceiling = 0.9 * float(np.max(free.values["x"]))
    rules = [lambda v: {"ceiling": v["x"] <= ceiling}, lambda v: {"pole": cp.multiply(v["a"][0], v["a"][0]) >= 1.6}]
    fit = optid.fit(data, hammerstein_oe, solver="ipopt", constraints=rules, **ORDERS)
    assert np.max(fit.model.simulate(data, x0="fit")) <= ceiling + 1e-2
    assert np.max(fit.values["x"]) <= ceiling + 1e-6 and fit.model.a[0] ** 2 >= 1.6 - 1e-6
    assert fit.solution.objective > free.solution.objective


def test_start_satisfies_the_programme_and_judging_is_ours():
    program = for_solvers(hammerstein_oe(plain((150, 100), gaps=0.1), **ORDERS))
    statement_of(program).assign(program.start)
    for group in statement_of(program).constraints.values():
        for member in group:
            assert np.max(np.abs(member.violation())) < 1e-9
    assert class_of(program) == "NLP"


@pytest.mark.parametrize(("name", "channels", "orders"), [
    ("lab_hydraulic_actuator", ("u_valve", "y_pressure"), {"na": 3, "nb": 2, "basis": "triangular:6"}),
    ("daisy_robotarm", ("u", "y"), {"na": 4, "nb": 4, "basis": "linear"}),
    ("nlid_reflex", ("u", "y"), {"na": 2, "nb": 3, "basis": "triangular:6"})])
def test_measured_records(real_data, name, channels, orders):
    """Plants with poles near the unit circle, of which the equations alone would allow some outside."""
    data = optid.read(real_data / f"{name}.csv", inputs=channels[:1], outputs=channels[1:], dt=1.0).window(0, 800)
    ours = quiet(data, hammerstein_oe, nk=1, solver="ipopt", **orders)
    theirs = quiet(data, "hammerstein_oe.exact", nk=1, **orders)
    assert ours.model.is_stable and ours.solution.status is Status.LOCAL
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-6)


def test_poles_on_the_edge_are_held():
    """A record that grows is best explained by a pole outside; the programme stops on the circle."""
    u = np.random.default_rng(0).uniform(-1, 1, 80)
    y = np.zeros(80)
    for k in range(1, 80):
        y[k] = 1.03 * y[k - 1] + u[k - 1]
    fit = quiet(Data(u, y), hammerstein_oe, na=1, nb=1, nk=1, basis="linear", solver="ipopt", raises=False)
    assert fit.model.a[0] == pytest.approx(-1.0, abs=1e-5) and fit.model.is_stable


def test_refusals():
    data = plain((200,))
    with pytest.raises(StructureError, match="30000 samples.*up to 20000.*hammerstein_oe.exact"):
        quiet(Data(np.tile(data.u, (150, 1)), np.tile(data.y, (150, 1))), hammerstein_oe, **ORDERS)
    refuses(StructureError, "is not convex and is taken by", quiet, data, hammerstein_oe, solver="clarabel", **ORDERS)
    refuses(StructureError, "gauge=.*use one of norm", quiet, data, hammerstein_oe, gauge="none", **ORDERS)
    refuses(StructureError, "one output", quiet, Data(data.u, np.hstack([data.y, data.y**2])), hammerstein_oe, **ORDERS)
    refuses(StructureError, "na .the number of poles.", quiet, data, hammerstein_oe, **ORDERS | {"na": -1})
    refuses(RankError, "samples for", quiet, Data(data.u[:10], data.y[:10]), hammerstein_oe, **ORDERS)
    refuses(DataError, "'y'", lambda: quiet(Data(data.u, np.full((200, 1), np.nan)), hammerstein_oe, **ORDERS))
    with pytest.raises(OptidError):
        quiet(data, hammerstein_oe, solver="ipopt",
              constraints=[lambda v: {"up": v["a"][0] >= 1, "down": v["a"][0] <= -1}], **ORDERS)

"""Steps of problems whose errors are nonlinear: leaves, errors and constraints to first order about a point."""

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest

import optid
from formulations.prediction_error import _problem as transfer_problem
from optid.backends.back_end import Settings
from optid.backends.conic import solve_with
from optid.core.leaves import Affine, Product, Quantity
from optid.core.statement import class_of, for_solvers, is_stated, statement_of
from optid.errors import StructureError
from optid.identify.prediction_error.criterion import criterion_of, step_problem
from optid.identify.prediction_error.static_curve import static_curve
from optid.identify.prediction_error.transfer_errors import TransferOrders, transfer_errors
from optid.program.solution import Status

pytestmark = pytest.mark.numerical


def record(seed, samples=200):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-2, 2, samples)
    x, f = np.zeros(samples), u + 0.3 * u**2
    for k in range(2, samples):
        x[k] = 1.1 * x[k - 1] - 0.3 * x[k - 2] + f[k - 1]
    return optid.Data(3 + 2 * u, 40 + 5 * (x + 0.1 * rng.standard_normal(samples)), dt=0.5)


def fit_of(seed, *builders, gauge="norm"):
    """The fit of an output-error model, and a point somewhere near an optimum."""
    errors = transfer_errors(record(seed), TransferOrders(2, 2, 1), "polynomial:3", gauge, True)
    rng = np.random.default_rng(seed)
    x = errors.normalise(np.concatenate([[-1.1, 0.3], rng.uniform(0.5, 1.5, errors.unknowns.size - 2)]))
    problem = transfer_problem("a test", errors, x).subject_to(*builders)
    return problem, x


def moved(x, name, k, step):
    value = np.array(x[name], dtype=float)
    value.flat[np.ravel_multi_index(np.unravel_index(k, value.shape, order="F"), value.shape)] += step
    return {**x, name: value}


@pytest.mark.parametrize("inputs, outputs, linear", [(1, 1, False), (1, 3, False), (2, 2, True)])
@pytest.mark.parametrize("direct", [False, True])
def test_the_slope_of_a_static_curve_is_that_of_differences(inputs, outputs, linear, direct):
    rng = np.random.default_rng(inputs + outputs)
    x = {"A": 0.5 * rng.normal(size=(3, 3)), "C": rng.normal(size=(outputs, 3)),
         "b": rng.normal(size=3 + direct * outputs), **({} if linear else {"mu": rng.normal(size=4)})}
    leaf = static_curve("mu", "b", "static")
    direct_part = x["b"][3:] if direct else 0.0
    gain = x["C"] @ np.linalg.solve(np.eye(3) - x["A"], x["b"][:3]) + direct_part
    np.testing.assert_allclose(leaf.value(x), np.outer(x.get("mu", np.ones(1)), gain), rtol=1e-10)
    slopes = leaf.slope(x)
    assert slopes.keys() == x.keys()
    for name, slope in slopes.items():
        for k in range(np.size(x[name])):
            there, here = (leaf.value(moved(x, name, k, sign * 1e-6)).ravel(order="F") for sign in (1, -1))
            np.testing.assert_allclose(slope[:, k], (there - here) / 2e-6, rtol=1e-5, atol=1e-7)


def test_a_pole_at_one_leaves_the_static_curve_finite():
    leaf = static_curve("mu", "b", "static")
    x = {"A": np.eye(2), "C": np.ones((1, 2)), "b": np.ones(2), "mu": np.ones(2)}
    assert np.all(np.isfinite(leaf.value(x)))


@pytest.mark.parametrize("seed", range(3))
def test_a_leaf_to_first_order_touches_the_leaf(seed):
    rng = np.random.default_rng(seed)
    x = {"mu": rng.normal(size=3), "b": rng.normal(size=2)}
    product = Product("mu", "b")
    affine = Affine.of(product, x)
    np.testing.assert_array_equal(affine.value(x), product.value(x))
    step = {name: 1e-5 * rng.normal(size=value.shape) for name, value in x.items()}
    there = {name: x[name] + step[name] for name in x}
    np.testing.assert_allclose(affine.value(there), product.value(there), atol=1e-9)
    variables = {name: cp.Variable(value.shape, value=there[name]) for name, value in x.items()}
    np.testing.assert_allclose(np.asarray(affine.express(variables).value), affine.value(there), rtol=1e-12)
    pull = rng.normal(size=6)
    for name, part in affine.chain(pull, there).items():
        np.testing.assert_allclose(part, affine.slopes[name].T @ pull)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("gauge", ["norm", "gain", "b0"])
def test_the_tangent_has_the_value_and_the_gradient_of_the_errors(seed, gauge):
    fit, z0 = fit_of(seed, gauge=gauge)
    x, problem = criterion_of(fit).variables.values(z0), fit
    step = problem.tangent(x, criterion_of(fit).variables.squares(x), None)
    value, gradient, _ = problem.pull(x)
    there, slope, _ = step.pull(x)
    assert value == pytest.approx(criterion_of(fit).value(z0), rel=1e-9) and there == pytest.approx(value, rel=1e-9)
    np.testing.assert_allclose(slope, gradient, rtol=1e-8, atol=1e-8 * np.abs(gradient).max())
    for k, name in enumerate(np.repeat(list(x), [np.size(one) for one in x.values()])):
        place = problem.slices[name].start
        up, down = (criterion_of(fit).variables.value(moved(x, name, k - place, sign * 1e-6)) for sign in (1, -1))
        assert gradient[k] == pytest.approx((up - down) / 2e-6, rel=1e-3, abs=1e-3 * np.abs(gradient).max())


def test_rows_are_read_once_and_what_looks_at_the_iterate_at_every_one():
    calls = {"still": 0, "moving": 0}

    def still(view):
        calls["still"] += 1
        return {"still": view["Theta"][0, 0] >= 1.0}

    def moving(view):
        calls["moving"] += 1
        return {"moving": view["mu"][0] <= 2 * abs(view.reference["mu"][0])}

    fit, z0 = fit_of(0, still, moving)
    for size in (1.0, 1.1, 1.2):
        x = {**criterion_of(fit).variables.values(z0), "mu": size * criterion_of(fit).variables.values(z0)["mu"]}
        step = fit.tangent(x, criterion_of(fit).variables.squares(x), None)
        (bound,) = (one for one in step.constraints(x) if one.name == "moving")
        assert bound.right[0] * bound.sizes[0] == pytest.approx(2 * abs(x["mu"][0]))
        assert not any(one.moving for one in step.constraints())
        assert step.constraint_names == ("still", "moving")
    assert calls["still"] == 1 and calls["moving"] == 4


def gain(view):
    return {"gain": cp.sum(view["Theta"]) == 1.0 + cp.sum(view["a"])}


def definite(view):
    a = view["a"]
    return {"definite": cp.bmat([[1.0, a[0] / 2 + 0.3, 0.1], [a[0] / 2 + 0.3, 0.5, a[1]], [0.1, a[1], 0.4]]) >> 0}


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rule, kind, damping, near", [
    (gain, "QP", 0.0, 1e-4), (gain, "QP", 0.3, 1e-4), (definite, "SDP", 0.0, 1e-3)])
def test_a_step_in_rows_is_that_of_the_programme_in_cvxpy(seed, rule, kind, damping, near):
    fit, z0 = fit_of(seed, rule, lambda v: {"large": v["Theta"] <= 0.4})
    at, names = criterion_of(fit).linearise(z0), criterion_of(fit).variables.names
    program, stated = (step_problem(fit, z0, at, damping) for _ in range(2))
    assert class_of(program) == kind == class_of(stated)
    rows = solve_with("clarabel", program, Settings(1e-10))
    whole = solve_with("clarabel", stated, Settings(1e-10, options={"max_iter": 400}))
    assert not is_stated(program) and is_stated(stated) and class_of(stated) == kind
    assert rows.status == whole.status == Status.OPTIMAL
    for name in names:
        np.testing.assert_allclose(rows.values[name], whole.values[name], rtol=near, atol=near / 10)
    for name in ("large", rule.__name__):
        np.testing.assert_allclose(rows.duals[name], whole.duals[name], rtol=10 * near,
                                   atol=near * np.abs(whole.duals[name]).max())
    if kind == "SDP":
        dual, matrix = rows.duals["definite"].reshape(3, 3), statement_of(stated).constraints["definite"][0].args[0]
        statement_of(stated).assign({name: rows.values[name] for name in names})
        assert np.linalg.eigvalsh(dual)[0] > -1e-6 * np.abs(dual).max()
        assert abs(np.sum(dual * matrix.value)) < 1e-5 * np.abs(dual).max()


def test_a_constraint_that_is_not_convex_is_refused():
    with pytest.raises(StructureError, match="constraint 'far' is not convex, and 'hammerstein_oe.exact' is a convex"):
        optid.fit(record(0), "hammerstein_oe.exact", na=2, nb=2, nk=1,
                  constraints=[lambda v: {"far": cp.sum_squares(v["Theta"]) >= 3}])


def test_a_name_of_the_formulation_is_taken():
    with pytest.raises(StructureError, match="two constraints named 'gauge'"):
        optid.fit(record(0), "hammerstein_oe.exact", na=2, nb=2, nk=1,
                  constraints=[lambda v: {"gauge": v["a"][0] <= 0}])


def test_a_quantity_of_the_unknowns_is_a_leaf_like_any_other():
    fit, z0 = fit_of(1)
    x = criterion_of(fit).variables.values(z0)
    size = Quantity("size", lambda y: np.array([y["mu"] @ y["mu"]]), lambda y: {"mu": 2 * y["mu"][None]})
    problem = fit.subject_to(lambda v: {"small": v["size"] <= 0.5})
    problem = replace(problem, leaves=(*problem.leaves, size), facts={**problem.facts, "units": None})
    step = problem.tangent(x, criterion_of(fit).variables.squares(x), None)
    found = solve_with("clarabel", for_solvers(step), Settings(1e-10)).values
    change = float(2 * x["mu"] @ (found["mu"] - x["mu"]) + x["mu"] @ x["mu"])
    assert change <= 0.5 + 1e-7

"""The core: terms, leaves and constraints against finite differences, CVXPY, and their definitions."""

import warnings

import cvxpy as cp
import numpy as np
import pytest
from refusals import refuses

import optid
from formulations.hammerstein_arx import _factored
from optid.arrays import kron
from optid.core.constraint import symmetric_part
from optid.core.judge import judge
from optid.core.leaves import Product, Quantity
from optid.core.problem import Problem
from optid.core.statement import class_of, for_solvers, statement_of
from optid.core.terms import Errors, Expressed, GroupNorms, Length, NuclearNorms, Squares, flat
from optid.errors import StructureError
from optid.identify.equation_error import EquationStructure, compress
from optid.program.solution import Status
from optid.registry import named_constraint

pytestmark = pytest.mark.numerical
SHAPES = {"a": (2,), "Q": (3, 4), "c": ()}
WORDS = ["monotone:increasing", "convex", "odd", "even", "dead_zone:-0.2,0.2", "saturation:-0.5,0.5", "slope:0,3",
         "range:-4,4", "gain:2", "gain:1,3", "coefficients:a,-1.5,1", "sign:b,positive", "stable:0.9", "through:0,0"]


def leaves(seed, shapes=SHAPES):
    rng = np.random.default_rng(seed)
    return {name: rng.normal(size=shape) for name, shape in shapes.items()}


def terms(seed):
    """Every smooth term over the leaves."""
    rng = np.random.default_rng(seed)
    root, target = rng.normal(size=(9, 15)), rng.normal(size=9)
    matrix, vector, z = rng.normal(size=(3, 4)), rng.normal(size=2), ("Q", "a", "c")
    return {"squares": Squares(root, target, 0.3, z), "length": Length(root, target, z),
            "linear": Expressed(lambda v: cp.sum(cp.multiply(matrix, v["Q"])) + vector @ v["a"]),
            "errors": Errors(lambda y: Squares(root, target, 0.3, z), lambda y: Squares(root, target, 0.3, z).value(y))}


def kinks(seed):
    rng = np.random.default_rng(seed)
    return {"nuclear": NuclearNorms({"Q": 0.7}), "group": GroupNorms({"Q": rng.uniform(0.2, 2, 3)})}


def shifted(y, name, index, step):
    moved = {key: np.array(value) for key, value in y.items()}
    moved[name].flat[np.ravel_multi_index(np.unravel_index(index, moved[name].shape, order="F"),
                                          moved[name].shape) if moved[name].ndim else 0] += step
    return moved


def by_differences(value, y, step=1e-6):
    return {name: np.array([(value(shifted(y, name, k, step)) - value(shifted(y, name, k, -step))) / (2 * step)
                            for k in range(np.size(y[name]))]) for name in y}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", terms(0))
def test_the_gradient_of_a_term_is_that_of_its_value(name, seed):
    term, y = terms(seed)[name], leaves(seed)
    found, expected = term.pull(y), by_differences(term.value, y)
    assert found.value == pytest.approx(term.value(y), rel=1e-12)
    for leaf, slope in expected.items():
        np.testing.assert_allclose(found.gradient.get(leaf, np.zeros(slope.size)), slope, atol=1e-6)
    assert all(np.all(np.abs(g) <= found.magnitudes[leaf] * (1 + 1e-12)) for leaf, g in found.gradient.items())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", [*terms(0), *kinks(0)])
def test_a_term_in_cvxpy_has_its_value(name, seed):
    term, y = (terms(seed) | kinks(seed))[name], leaves(seed)
    if name == "errors":
        assert not hasattr(term, "express")
        return
    expression = term.express({key: cp.Constant(value) for key, value in y.items()})
    assert float(np.asarray(expression.value)) == pytest.approx(term.value(y), rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", kinks(0))
@pytest.mark.parametrize("rank", [0, 1, 3])
def test_the_nearest_subgradient_is_one_and_is_nearest(name, seed, rank):
    rng = np.random.default_rng(seed)
    term, pull = kinks(seed)[name], 0.6 * rng.normal(size=(3, 4))
    at = rng.normal(size=(3, rank)) @ rng.normal(size=(rank, 4)) if name == "nuclear" else (
        rng.normal(size=(3, 4)) * (np.arange(3) < rank)[:, None])
    found, value = term.nearest("Q", at, pull), term.value({"Q": at})
    for _ in range(20):  # f(y) >= f(x) + <g, y - x>
        there = at + rng.normal(size=(3, 4)) * rng.choice([1e-3, 1.0, 10.0])
        assert term.value({"Q": there}) >= value + np.sum(found * (there - at)) - 1e-9
    # it is nearest to -pull exactly where the derivative along d = -(g + pull) is <g, d>, the largest over subgradients
    along, step = -(found + pull), 1e-7
    slope = (term.value({"Q": at + step * along}) - value) / step
    assert slope == pytest.approx(np.sum(found * along), abs=1e-5)


@pytest.mark.parametrize("gauge", ["norm", "gain", "b0"])
@pytest.mark.parametrize("shape", [(3,), (3, 2)])
def test_a_product_its_slope_chain_and_gauge(gauge, shape):
    if gauge == "gain" and len(shape) > 1:
        return
    one = Product("mu[valve]", "b[valve]", gauge)
    x = leaves(1, {"a": (2,), "mu[valve]": (4,), "b[valve]": shape})
    x["b[valve]"] = np.abs(x["b[valve]"])
    assert one.name == "Theta[valve]" and one.value(x).shape == (4, np.prod(shape))
    pull = np.random.default_rng(0).normal(size=one.value(x).size)
    expected = by_differences(lambda y: float(pull @ np.ravel(one.value(y), order="F")), x)
    slope, chain = one.slope(x), one.chain(pull, x)
    for name in ("mu[valve]", "b[valve]"):
        np.testing.assert_allclose(slope[name].T @ pull, expected[name], atol=1e-7)
        np.testing.assert_allclose(chain[name], expected[name], atol=1e-7)
    level = by_differences(lambda y: one.level(y)[0], x)
    for name, part in level.items():
        np.testing.assert_allclose(one.level(x)[1].get(name, np.zeros(part.size)), part, atol=1e-7)
    scaled = one.in_gauge(x)
    assert one.level(scaled)[0] == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(one.value(scaled), one.value(x))
    assert np.all(np.isfinite(one.in_gauge({**x, "a": np.array([-1.5, 0.5])})["mu[valve]"]))  # a pole at 1
    nothing = {**x, "b[valve]": np.zeros(shape)}
    assert np.all(np.isfinite(one.in_gauge(nothing)["mu[valve]"]))


def record(seed=0, n=120, m=1):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (n, m))
    y = np.zeros(n)
    for k in range(2, n):
        y[k] = 0.9 * y[k - 1] - 0.3 * y[k - 2] + np.tanh(2 * u[k - 1]).sum() + 0.3 * u[k - 2, 0]
    return optid.Data(10 * u + 3, 0.1 * (y + 0.05 * rng.normal(size=n)))


def exact_problem(seed, words=(), m=1):
    compressed = compress(record(seed, m=m), EquationStructure(2, 2, 1, "triangular:6"))
    return _factored(compressed, tuple(named_constraint(w) if isinstance(w, str) else w for w in words), "norm")


@pytest.mark.parametrize("m", [1, 2])
def test_the_gradient_of_a_problem_is_that_of_its_value(m):
    problem = exact_problem(3, m=m)
    x = problem.in_gauge({name: value + 0.3 * np.random.default_rng(1).normal(size=np.shape(value))
                          for name, value in problem.start.items()})
    value, gradient, magnitudes = problem.pull(x)
    assert value == pytest.approx(problem.value(x), rel=1e-12)
    expected = by_differences(problem.value, x)
    np.testing.assert_allclose(gradient, np.concatenate([expected[name] for name in problem.start]),
                               atol=1e-5 * np.max(magnitudes))
    slope = problem.slope(x)
    expected = by_differences(lambda y: float(problem.space.vector(problem.leaf_values(y)) @ np.arange(len(slope))), x)
    np.testing.assert_allclose(np.arange(len(slope)) @ slope, np.concatenate([expected[n] for n in problem.start]),
                               atol=1e-4)
    np.testing.assert_array_equal(problem.pack(problem.unpack(problem.pack(x))), problem.pack(x))


@pytest.mark.parametrize("word", WORDS)
def test_the_rows_of_a_word_are_those_of_its_programme(word):
    problem = exact_problem(2, [word])
    program = for_solvers(problem)
    stated = statement_of(program)
    rng = np.random.default_rng(0)
    for _ in range(3):
        x = {name: value + 0.5 * rng.normal(size=np.shape(value)) for name, value in problem.start.items()}
        statement_of(program).assign(x)
        held = problem.constraints(x)
        y = problem.leaf_values(x)
        theirs = [(name, member) for name in program.constraint_names for member in stated.constraints[name]]
        assert [one.name for one in held] == [name for name, _ in theirs] and not any(one.moving for one in held)
        for one, (_, member) in zip(held, theirs):
            assert one.violation(problem.space, y) > 0 or np.max(member.violation()) <= 1e-9
            if one.cone != "other":
                np.testing.assert_allclose(one.residual(problem.space, y),
                                           np.ravel(np.asarray(member.expr.value), order="F"), atol=1e-9)
        expected = by_differences(lambda z, held=held: sum(
            float(np.arange(1, len(one) + 1) @ one.residual(problem.space, problem.leaf_values(z))) for one in held), x)
        slope = problem.slope(x)
        found = sum(np.arange(1, len(one) + 1) @ one.slope(problem.space, problem.leaf_values(x)) @ slope
                    for one in held)
        np.testing.assert_allclose(found, np.concatenate([expected[name] for name in problem.start]),
                                   atol=1e-5 * (1 + np.max(np.abs(found))))


def test_constraints_of_the_user_rows_cones_and_what_cvxpy_measures():
    def build(v):
        first, second = v["a"][:1], v["a"][1:]
        return {"small": cp.norm(v["a"]) <= 0.1, "matrix": cp.bmat([[first, second], [second, first]]) >> 0}

    rules = [build]
    problem = exact_problem(0, rules)
    small, matrix = problem.constraints()
    assert (small.cone, matrix.cone) == ("other", "psd") and problem.constraint_names == ("small", "matrix")
    x = {**problem.start, "a": np.array([-1.0, 2.0])}
    y = problem.leaf_values(x)
    assert small.violation(problem.space, y) * small.sizes[0] == pytest.approx(np.sqrt(5) - 0.1)
    assert matrix.violation(problem.space, y) * matrix.sizes[0] == pytest.approx(3.0)
    np.testing.assert_allclose(-symmetric_part(matrix.residual(problem.space, y) * matrix.sizes), [[-1, 2], [2, -1]])
    assert problem.violation(x) == pytest.approx(
        small.violation(problem.space, y) + matrix.violation(problem.space, y))


def test_a_builder_that_looks_at_an_iterate_is_read_there_again():
    calls = []

    def about(v):
        calls.append(float(v.reference["q"][0]))
        return {"ball": v.reference["q"] @ v["q"] <= 1.0, "plain": v["q"] >= -5}

    problem = Problem("ball", {"q": np.array([2.0, 0.0])}, (Squares(np.eye(2), np.zeros(2), 0.0, ("q",)),),
                      builders=(about, lambda v: {"still": v["q"] <= 7}))
    assert [one.moving for one in problem.constraints()] == [True, True, False]
    there = problem.constraints({"q": np.array([0.0, 3.0])})
    assert [one.name for one in there] == ["ball", "plain", "still"] and calls == [2.0, 0.0]
    np.testing.assert_allclose(there[0].rows[0] * there[0].sizes[0], [0.0, 3.0])
    assert there[2] is problem.constraints()[2]
    fixed = Problem("ball", problem.start, problem.terms, facts={"reference": {"q": np.ones(2)}}, builders=(about,))
    assert not any(one.moving for one in fixed.constraints({"q": np.zeros(2)}))


@pytest.mark.parametrize("rules, words", [
    ([lambda v: {"one": v["a"] <= 1}, lambda v: {"one": v["a"] >= 0}], "two constraints named 'one'"),
    ([lambda v: {"mine": cp.Variable(2, name="w") <= 1}], "uses w, which is not a variable"),
    ([lambda v: {"ring": 3.0}], "'ring' is a float, not a CVXPY constraint"),
    ([lambda v: {"truth": True}], "'truth' is a bool, not a CVXPY constraint"),
    ([lambda v: v["mi"] <= 1], "asks for 'mi'.*'mu'"),
])
def test_constraints_that_cannot_be_read(rules, words):
    with pytest.raises(StructureError, match=words):
        exact_problem(0, rules).constraints()


def test_a_convex_problem_refuses_what_is_not_convex():
    term = Squares(np.eye(2), np.zeros(2), 0.0, ("q",))
    ring = [lambda v: {"ring": cp.sum_squares(v["q"]) >= 1}]
    problem = Problem("least", {"q": np.ones(2)}, (term,), builders=tuple(ring))
    refuses(StructureError, "'ring' is not convex", problem.constraints)
    assert len(exact_problem(0).bilinear_terms) == 1
    (one,) = exact_problem(0, [lambda v: {"ring": cp.sum_squares(v["b"]) >= 1}]).constraints()
    assert one.cone == "other"


def test_any_other_quantity_is_a_leaf():
    square = Quantity("square", lambda x: x["q"] ** 2, lambda x: {"q": np.diag(2 * x["q"])})
    problem = Problem("squares of squares", {"q": np.array([1.0, 2.0])},
                      (Squares(np.eye(2), np.ones(2), 0.0, ("square",)),), (square,),
                      builders=(lambda v: {"low": v["square"] <= 2},))
    x = {"q": np.array([0.5, -1.5])}
    assert problem.value(x) == pytest.approx(0.75**2 + 1.25**2)
    np.testing.assert_allclose(problem.pull(x)[1], [2 * -0.75 * 1.0, 2 * 1.25 * -3.0])
    (low,) = problem.constraints()
    assert low.residual(problem.space, problem.leaf_values(x)) * low.sizes == pytest.approx([-1.75, 0.25])


def test_the_objective_of_a_programme_is_that_of_its_factored():
    for m in (1, 2):
        problem = exact_problem(1, m=m)
        program = for_solvers(problem)
        x = {name: value + 0.1 for name, value in problem.start.items()}
        stated = statement_of(program)
        stated.assign(x)
        assert float(np.asarray(stated.objective.expr.value)) == pytest.approx(problem.value(x), rel=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_squares_join_into_one(seed):
    rng = np.random.default_rng(seed)
    y = leaves(seed)
    first = Squares(rng.normal(size=(7, 14)), rng.normal(size=7), 0.3, ("Q", "a"))
    second = Squares(rng.normal(size=(2, 3)), rng.normal(size=2), 0.1, ("a", "c"))
    one = Squares.of_sum([first, second], {name: np.size(value) for name, value in y.items()})
    assert one.z == ("Q", "a", "c") and np.allclose(one.root, np.triu(one.root))
    for _ in range(3):
        y = {name: value + rng.normal(size=np.shape(value)) for name, value in y.items()}
        assert one.value(y) == pytest.approx(first.value(y) + second.value(y), rel=1e-10)


def test_a_term_that_is_no_expression_is_named():
    problem = Problem("a name", {"a": np.ones(2)}, (Errors(lambda y: None, lambda y: 0.0),))
    with pytest.raises(StructureError, match="Errors, a term of 'a name', is no expression of its unknowns"):
        _ = class_of(for_solvers(problem))


@pytest.mark.parametrize("seed", range(3))
def test_a_problem_of_several_terms_is_solved_and_judged(seed):
    """A nuclear norm with squares: singular values of the answer are those of the squares, less a threshold."""
    rng = np.random.default_rng(seed)
    target = rng.normal(size=(3, 4))
    squares = Squares(np.eye(12), target.ravel(order="F"), 0.0, ("Q",))
    problem = Problem("denoised", {"Q": np.zeros((3, 4))}, (squares, NuclearNorms({"Q": 1.2})),
                      scale=float(np.sum(target**2)))
    solution = optid.solve(problem, accuracy=1e-9)
    left, size, right = np.linalg.svd(target, full_matrices=False)
    np.testing.assert_allclose(solution.values["Q"], left * np.maximum(size - 0.6, 0) @ right, atol=1e-4)
    assert solution.objective == pytest.approx(problem.value(solution.values), rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_a_short_length_is_judged_by_the_best_of_its_directions(seed):
    """A residual of 1e-6 has a direction of few digits; a symmetric unknown has one multiplier for two entries."""
    rng = np.random.default_rng(seed)
    p, root = rng.normal(size=(3, 3)), rng.normal(size=(12, 9))
    p = p @ p.T + np.eye(3)
    target = root @ flat(p) + 1e-6 * rng.normal(size=12)
    problem = Problem(
        "short", {"P": np.eye(3)}, (Length(root, target, ("P",)),), symmetric=frozenset({"P"}), scale=10.0,
        builders=(lambda v: {"definite": [v["P"] - 1.1 * np.eye(3) >> 0], "trace": [cp.trace(v["P"]) == np.trace(p)]},))
    found = optid.solve(problem, "clarabel", prove=False)
    assert found.status is Status.LOCAL, found.reason
    x = {"P": found.values["P"]}
    assert judge(problem, x, found.duals).residuals.stationarity < 1e-6
    x = {"P": x["P"] + 0.01 * (root[:3].T @ root[:3])[:3, :3]}
    assert judge(problem, {"P": (x["P"] + x["P"].T) / 2}, found.duals).residuals.stationarity > 1e-3


def test_an_unknown_that_is_to_be_symmetric_is_and_one_that_is_not_is_a_violation():
    """With squares alone and rows, which are solved without CVXPY where nothing is symmetric."""
    rng = np.random.default_rng(3)
    root, target = rng.normal(size=(12, 9)), rng.normal(size=12)
    problem = Problem("symmetric", {"P": np.eye(3)}, (Squares(root, target, 0.0, ("P",)),), symmetric=frozenset({"P"}),
                      scale=float(target @ target), builders=(lambda v: {"definite": v["P"] >> 0},))
    found = optid.solve(problem)
    p = found.values["P"]
    assert found.status is Status.OPTIMAL and np.allclose(p, p.T, atol=1e-9)
    x = cp.Variable((3, 3), symmetric=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # old versions of SCS speak of the form of a matrix
        squares = cp.sum_squares(root @ cp.vec(x, order="F") - target)
        value = cp.Problem(cp.Minimize(squares), [x >> 0]).solve(solver="SCS")
    assert found.objective == pytest.approx(value, rel=1e-3)
    skew = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert judge(problem, {"P": p + 0.1 * skew}, found.duals).residuals.violation > 0.01


@pytest.mark.parametrize("left", [(1, 3), (4, 1), (0, 2), (2, 0)])
@pytest.mark.parametrize("right", [(2, 2), (1, 5), (3, 0)])
def test_kronecker_products_are_those_of_numpy(left, right):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=left), rng.normal(size=right)
    np.testing.assert_array_equal(kron(a, b), np.kron(a, b))

"""A zoo of small problems with known value, point and multipliers, on which every back end is tried.

Each entry is known in closed form or by a route that shares nothing with a solver (eigenvalues, a one-dimensional
search, the literature). Multipliers follow ``L = f + dual (lhs - rhs)``; they are given where they are unique.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cvxpy as cp
import numpy as np

from optid.core.leaves import Product
from optid.core.low_rank import LowRank
from optid.core.problem import Problem
from optid.core.terms import Expressed, GroupNorms, Squares
from optid.structures.group_sparse import GroupProblem
from optid.structures.nuclear_norm import NuclearProblem
from optid.structures.rank_one import RankOne

SOLVED, INFEASIBLE, UNBOUNDED = "solved", "infeasible", "unbounded"


@dataclass(frozen=True)
class Case:
    """One problem and what is known about it."""

    name: str  # name of the case and of its problem
    build: Callable[[], Problem]  # makes a fresh problem
    value: float = float("nan")  # optimal value (``nan`` unless solved)
    point: Mapping[str, Any] = field(default_factory=dict)  # {variable: array}, the unique minimiser or parts of it
    duals: Mapping[str, Any] = field(default_factory=dict)  # {constraint: flat multipliers}, where unique
    outcome: str = SOLVED  # "solved", "infeasible" or "unbounded"
    # badly scaled or degenerate: an honest "inaccurate" or "failed" is acceptable, a wrong claim is not
    hard: bool = False


@cache
def cases() -> tuple[Case, ...]:
    """Return every case, classes LP, QP, SOCP, SDP, conic, NLP, rank-one, nuclear and group-sparse among them."""
    return (*_linear(), *_quadratic(), _least_squares(), *_conic(), *_nonlinear(), *_rank_one(), _nuclear(),
            _group_sparse())


def pose(name: str, shapes: Mapping[str, Any], statement: Callable[..., tuple[Any, Mapping[str, Any]]],
         start: Mapping[str, Any] | None = None, expressions: Callable[..., Mapping[str, Any]] | None = None,
         **parts: Any) -> Problem:
    """Make a problem of plain parts.

    Args:
        name: of the problem.
        shapes: of the unknowns by name; "symmetric" or "nonneg" beside a shape, as {"shape": 4, "nonneg": True}.
        statement: unknowns -> objective and named constraints.
        start: values to begin with, zero where none are given.
        expressions: unknowns -> further named expressions, which constraints may use.
        parts: other attributes of `Problem`.
    """
    full = {key: shape if isinstance(shape, dict) else {"shape": shape} for key, shape in shapes.items()}
    begin = {key: np.zeros(one["shape"]) for key, one in full.items()}
    begin |= {key: np.asarray(value, dtype=float) for key, value in (start or {}).items()}
    return Problem(
        name, begin, (Expressed(lambda v: statement(*(v[key] for key in full))[0]),),
        restrictions=(lambda v: statement(*(v[key] for key in full))[1],),
        further=None if expressions is None else lambda v, _: expressions(*(v[key] for key in full)),
        bounds={key: (np.zeros_like(begin[key]), np.full_like(begin[key], np.inf))
                for key, one in full.items() if one.get("nonneg")},
        symmetric=frozenset(key for key, one in full.items() if one.get("symmetric")), **parts)


def _case(name: str, shapes: Mapping[str, Any], statement: Callable[..., tuple], start: Mapping[str, Any] | None = None,
          **known: Any) -> Case:
    """State a case: unknowns by name and shape, objective and constraints as in `pose`, and what is known of it."""
    return Case(name, lambda: pose(name, shapes, statement, start), **known)


def _linear() -> list[Case]:
    cost = np.array([3.0, 1.0, 2.0, 5.0])
    simplex: dict[str, Any] = {"value": 1.0, "point": {"x": [0.0, 1.0, 0.0, 0.0]}}
    rows = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [2.0, 2.0], [1.0, 2.0]])
    return [
        _case("lp_vertex", {"x": 2}, lambda x: (-3 * x[0] - 5 * x[1], {
            "plants": cp.hstack([x[0], 2 * x[1], 3 * x[0] + 2 * x[1]]) <= np.array([4.0, 12.0, 18.0]), "sign": x >= 0}),
              value=-36.0, point={"x": [2.0, 6.0]}, duals={"plants": [0.0, 1.5, 1.0], "sign": [0.0, 0.0]}),
        _case("lp_simplex", {"x": 4}, lambda x: (cost @ x, {"total": cp.sum(x) == 1, "sign": x >= 0}),
              **simplex, duals={"total": [-1.0], "sign": [2.0, 0.0, 1.0, 4.0]}),
        _case("lp_bounds_as_attributes", {"x": {"shape": 4, "nonneg": True}},
              lambda x: (cost @ x, {"total": cp.sum(x) == 1}), **simplex, duals={"total": [-1.0]}),
        _case("lp_degenerate", {"x": 2}, lambda x: (-x[0] - x[1], {
            "rows": rows @ x <= np.array([2.0, 1.0, 1.0, 4.0, 3.0]), "sign": x >= 0}),
              value=-2.0, point={"x": [1.0, 1.0]}, hard=True),
        _case("lp_badly_scaled", {"x": 2}, lambda x: (-3e-3 * x[0] - 5e3 * x[1], {
            "plants": cp.hstack([x[0], 2e3 * x[1], 3e-3 * x[0] + 2e3 * x[1]]) <= np.array([4e3, 12.0, 18.0]),
            "sign": x >= 0}), start={"x": np.zeros(2)}, value=-36.0, point={"x": [2e3, 6e-3]}, hard=True),
        _case("lp_infeasible", {"x": 2}, lambda x: (cp.sum(x), {"low": x[0] + x[1] >= 3, "high": x <= 1}),
              outcome=INFEASIBLE),
        _case("lp_unbounded", {"x": 2}, lambda x: (-x[0], {"band": x[1] <= 1, "sign": x >= 0}), outcome=UNBOUNDED),
    ]


def _quadratic() -> list[Case]:
    target, normal = np.array([2.0, -0.5, 0.25]), np.array([1.0, 2.0, 2.0])
    data, unit = np.array([1.0, 3.0, 2.0, 4.0]), np.array([1e-4, 1e4])
    return [
        _case("qp_box", {"x": 3}, lambda x: (cp.sum_squares(x - target), {"upper": x <= 1, "lower": x >= 0}),
              value=1.25, point={"x": [1.0, 0.0, 0.25]}, duals={"upper": [2.0, 0.0, 0.0], "lower": [0.0, 1.0, 0.0]}),
        _case("qp_equality", {"x": 3}, lambda x: (cp.sum_squares(x), {"plane": normal @ x == 1}),
              value=1 / 9, point={"x": normal / 9}, duals={"plane": [-2 / 9]}),
        _case("qp_monotone_with_residuals", {"x": 4, "r": 4}, lambda x, r: (cp.sum_squares(r) + 10.0, {
            "residual": r == x - data, "monotone": x[:-1] - x[1:] <= 0}),
              value=10.5, point={"x": [1.0, 2.5, 2.5, 4.0]},
              duals={"residual": [0.0, 1.0, -1.0, 0.0], "monotone": [0.0, 1.0, 0.0]}),
        _case("qp_badly_scaled", {"x": 2}, lambda x: (
            cp.sum_squares(cp.multiply(unit, x) - 1), {"budget": unit @ x <= 1}), start={"x": np.zeros(2)},
              value=0.5, point={"x": [5e3, 5e-5]}, duals={"budget": [1.0]}, hard=True),
        _case("qp_repeated_constraints", {"x": 2}, lambda x: (cp.sum_squares(x - 1), {
            "once": cp.sum(x) == 1, "twice": 2 * cp.sum(x) == 2, "cap": [x[0] <= 0.5, 3 * x[0] <= 1.5]}),
              value=0.5, point={"x": [0.5, 0.5]}, hard=True),
        _case("qp_infeasible", {"x": 2}, lambda x: (cp.sum_squares(x), {"sum": cp.sum(x) == 5, "cap": x <= 1}),
              outcome=INFEASIBLE),
        _case("qp_unbounded", {"x": 2}, lambda x: (cp.square(x[0]) - x[1], {"band": x[0] <= 1}), outcome=UNBOUNDED),
    ]


def _conic() -> list[Case]:
    cost, normal, centre = np.array([3.0, -4.0]), np.array([2.0, -1.0, 2.0]), np.ones(3)
    matrix = np.array([[2.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 4.0]])
    levels, vectors = np.linalg.eigh(matrix)
    first, last = (np.outer(vectors[:, k], vectors[:, k]) for k in (0, -1))
    return [
        _case("socp_ball", {"x": 2}, lambda x: (cost @ x, {"ball": cp.norm(x) <= 1}),
              value=-5.0, point={"x": [-0.6, 0.8]}, duals={"ball": [5.0]}),
        _case("socp_distance_to_plane", {"x": 3, "t": ()}, lambda x, t: (
            t, {"cone": cp.SOC(t, x - centre), "plane": normal @ x == 0}),
              value=1.0, point={"x": centre - normal / 3, "t": 1.0}, duals={"plane": [1 / 3]}),
        _case("socp_infeasible", {"x": 2}, lambda x: (cost @ x, {"ball": cp.norm(x) <= 1, "far": x[0] >= 2}),
              outcome=INFEASIBLE),
        _case("sdp_smallest_eigenvalue", {"x": {"shape": (3, 3), "symmetric": True}}, lambda x: (
            cp.trace(matrix @ x), {"trace": cp.trace(x) == 1, "psd": x >> 0}), value=float(levels[0]),
              point={"x": first}, duals={"trace": [-levels[0]], "psd": np.ravel(matrix - levels[0] * np.eye(3))}),
        _case("sdp_largest_eigenvalue", {"t": ()}, lambda t: (t, {"psd": t * np.eye(3) - matrix >> 0}),
              value=float(levels[-1]), point={"t": levels[-1]}, duals={"psd": np.ravel(last)}),
        _case("sdp_infeasible", {"x": {"shape": (2, 2), "symmetric": True}}, lambda x: (
            cp.trace(x), {"psd": x >> 0, "corner": x[0, 0] == -1}), outcome=INFEASIBLE),
        _case("exp_entropy", {"x": 4}, lambda x: (-cp.sum(cp.entr(x)), {"total": cp.sum(x) == 1}),
              start={"x": np.array([0.1, 0.2, 0.3, 0.4])},
              value=-np.log(4.0), point={"x": np.full(4, 0.25)}, duals={"total": [np.log(4.0) - 1]}),
        _case("exp_log_sum_exp", {"x": 3}, lambda x: (cp.log_sum_exp(x), {"total": cp.sum(x) == 3}),
              value=1.0 + np.log(3.0), point={"x": np.ones(3)}, duals={"total": [-1 / 3]}),
    ]


def _nonlinear() -> list[Case]:
    return [
        _case("nlp_rosenbrock", {"x": 2}, lambda x: (
            cp.square(1 - x[0]) + 100 * cp.square(x[1] - cp.square(x[0])), {"disc": cp.sum_squares(x) <= 3}),
              start={"x": np.array([-1.2, 1.0])}, value=0.0, point={"x": [1.0, 1.0]}, duals={"disc": [0.0]}),
        _case("nlp_hs071", {"x": 4}, lambda x: (x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2], {
            "product": x[0] * x[1] * x[2] * x[3] >= 25, "sphere": cp.sum_squares(x) == 40, "lower": x >= 1,
            "upper": x <= 5}), start={"x": np.array([1.0, 5.0, 5.0, 1.0])},
              # problem 71 of Hock and Schittkowski (1981); digits by Newton's method on its optimality conditions
              value=17.014017289156303, point={"x": [1.0, 4.742999637264417, 3.821149984184874, 1.3794082931726723]},
              duals={"product": [0.5522936601207269], "sphere": [0.16146856677050583],
                     "lower": [1.0878712286669403, 0, 0, 0], "upper": [0, 0, 0, 0]}),
        _case("nlp_hyperbola", {"x": 2}, lambda x: (cp.sum(x), {"product": x[0] * x[1] >= 1, "sign": x >= 0}),
              start={"x": np.array([3.0, 1.0])},
              value=2.0, point={"x": [1.0, 1.0]}, duals={"product": [1.0], "sign": [0.0, 0.0]}),
        _case("nlp_elementary_functions", {"x": (), "y": ()}, lambda x, y: (
            cp.exp(x) - 2 * x + cp.square(y - cp.exp(-x)), {"ceiling": cp.logistic(y) <= 1}),
              start={"x": 0.0, "y": 0.0},
              value=2 - 2 * np.log(2.0), point={"x": np.log(2.0), "y": 0.5}, duals={"ceiling": [0.0]}),
        _case("nlp_matrix_factor", {"left": (2, 1), "right": (1, 2)}, lambda left, right: (
            cp.sum_squares(left @ right - np.diag([3.0, 1.0])), {"gauge": cp.sum_squares(right) == 1}),
              start={"left": np.array([[1.0], [1.0]]), "right": np.array([[1.0, 0.2]])},
              value=1.0, point={"left": [[3.0], [0.0]], "right": [[1.0, 0.0]]}, duals={"gauge": [0.0]}),
        _case("nlp_infeasible", {"x": 2}, lambda x: (cp.sum_squares(x), {
            "product": x[0] * x[1] >= 4, "cap": x <= 1, "sign": x >= 0}), start={"x": np.array([0.5, 0.4])},
              outcome=INFEASIBLE),
        _case("nlp_infeasible_stationary", {"x": ()}, lambda x: (x, {"circle": cp.square(x) == -1}), start={"x": 0.3},
              outcome=INFEASIBLE),
        _case("nlp_unbounded", {"x": 2}, lambda x: (x[0] * x[1], {"line": cp.sum(x) == 1}),
              start={"x": np.array([2.0, -1.0])}, outcome=UNBOUNDED),
    ]


def planted_fit() -> tuple[np.ndarray, np.ndarray]:
    """Return (A, y) of ``y = A [a; vec(mu bᵀ)] + noise`` with one linear term, four values mu and two lags b."""
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((60, 9))
    truth = np.concatenate([[0.5], np.kron([0.8, 0.6], np.linspace(-1.0, 1.0, 4) ** 3)])
    return matrix, matrix @ truth + 0.1 * rng.standard_normal(60)


def _compressed_fit() -> RankOne:
    matrix, y = planted_fit()
    triangle = np.asarray(np.linalg.qr(np.column_stack([matrix, y]), mode="r"))
    return RankOne(triangle[:-1, :-1], triangle[:-1, -1], float(triangle[-1, -1] ** 2), ((4, 2),), 1, float(y @ y))


def _least_squares() -> Case:
    """The same fit without the products, by the normal equations."""
    (matrix, y), fit = planted_fit(), _compressed_fit()
    best = np.linalg.solve(matrix.T @ matrix, matrix.T @ y)

    def build() -> Problem:
        return Problem("qp_compressed_fit", {"z": np.zeros(9)}, (Squares.of(fit, ("z",)),), scale=fit.scale)

    return Case("qp_compressed_fit", build, value=float(np.sum((y - matrix @ best) ** 2)), point={"z": best})


def _rank_one() -> list[Case]:
    rising = {"mu": np.array([-1.0, 0.0, 0.0, 1.0]), "b": np.array([0.7, 0.7])}

    def bilinear(name: str, sign: float, convex: bool, value: float) -> Case:
        def build() -> Problem:
            problem = _compressed_fit()
            start = {"a": np.zeros(1), **{key: sign * value for key, value in rising.items()}}
            rules = (lambda v: {"convex": cp.diff(v["mu"], 2) >= 0},) if convex else ()
            return Problem(name, start, (Squares.of(problem, ("a", "Theta")),), (Product("mu", "b"),),
                           builders=rules, scale=problem.scale)
        return Case(name, build, value=value)

    # digits by least squares for every direction of b, a single angle
    return [bilinear("rank_one_fit", 1.0, False, 0.34051374007229496),
            bilinear("rank_one_convex", -1.0, True, 8.641311715505692)]


def _nuclear() -> Case:
    """A Hankel matrix of one block row has independent entries: its singular values are reduced by half the weight."""
    y = np.random.default_rng(1).normal(size=(9, 3)) + np.outer(np.arange(9.0), [1.0, -0.5, 0.2])
    weight = 0.4
    left, values, right = np.linalg.svd(y, full_matrices=False)
    kept = np.maximum(values - 0.5 / weight, 0.0)
    best = (left * kept) @ right

    def build() -> Problem:
        matrix = LowRank(NuclearProblem(y, np.arange(9), 1))
        return Problem("nuclear_shrinkage", matrix.start(), (matrix, matrix.misfit(weight)),
                       scale=weight * float(np.sum(y**2)), weights={"weight": weight})

    return Case("nuclear_shrinkage", build, value=float(np.sum(kept) + weight * np.sum((best - y) ** 2)),
                point={"yhat": best}, duals={"structure": np.ravel(-2 * weight * (y - best).T, order="F")})


def _group_sparse() -> Case:
    """With an orthonormal design every group of coefficients is shrunk by itself."""
    rng = np.random.default_rng(5)
    design, target = np.linalg.qr(rng.normal(size=(12, 7)))[0], 3.0 * rng.normal(size=12)
    weights, penalty, edges = np.array([1.0, 2.0, 0.5, 1.5]), 0.9, np.array([0, 1, 2, 5, 7])
    groups = np.split(design.T @ target, edges[1:-1])
    shrunk = [max(0.0, 1 - penalty * w / float(np.linalg.norm(z))) * z for w, z in zip(weights, groups)]
    rest = target - design @ np.concatenate(shrunk)
    value = 0.5 * float(rest @ rest) + penalty * sum(w * float(np.linalg.norm(z)) for w, z in zip(weights, shrunk))
    shapes = {f"a{i + 1}": z.shape for i, z in enumerate(groups)}

    def build() -> Problem:
        half = np.sqrt(0.5)
        misfit = Squares(half * design, half * target, 0.0, tuple(shapes), GroupProblem(design, target, edges, weights))
        norms = GroupNorms({name: np.array(penalty * w) for name, w in zip(shapes, weights)})
        start = {name: np.zeros(shape) for name, shape in shapes.items()}
        return Problem("group_shrinkage", start, (misfit, norms), scale=0.5 * float(target @ target),
                       weights={"lambda": penalty})

    return Case("group_shrinkage", build, value=value, point=dict(zip(shapes, shrunk)),
                duals={"residual": np.sqrt(2.0) * rest})

"""A zoo of small programmes with known value, point and multipliers, on which every back end is tried.

Each entry is known in closed form or by a route that shares nothing with a solver (eigenvalues, a one-dimensional
search). Multipliers follow ``L = f + dual (lhs - rhs)``; they are given where they are unique.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cvxpy as cp
import numpy as np

from optid.program.program import Program
from optid.program.view import View
from optid.structures.group_sparse import GroupProblem, GroupSparseStructure
from optid.structures.least_squares import RankOneStructure
from optid.structures.nuclear_norm import NuclearNormStructure, NuclearProblem
from optid.structures.rank_one import RankOne

SOLVED, INFEASIBLE, UNBOUNDED = "solved", "infeasible", "unbounded"


@dataclass(frozen=True)
class Case:
    """One programme and what is known about it.

    Attributes:
        build: makes a fresh programme.
        outcome: "solved", "infeasible" or "unbounded".
        value: optimal value (``nan`` unless solved).
        point: {variable: array}, the unique minimiser or parts of it.
        duals: {constraint: flat multipliers}, where unique.
        hard: badly scaled or degenerate: an honest "inaccurate" or "failed" is acceptable, a wrong claim is not.
    """

    build: Callable[[], Program]
    outcome: str = SOLVED
    value: float = float("nan")
    point: Mapping[str, Any] = field(default_factory=dict)
    duals: Mapping[str, Any] = field(default_factory=dict)
    hard: bool = False

    @property
    def name(self) -> str:
        """Name of the case."""
        return self.build.__name__


@cache
def cases() -> tuple[Case, ...]:
    """Return every case, classes LP, QP, SOCP, SDP, conic, NLP, rank-one, nuclear and group-sparse among them."""
    return (*_linear(), *_quadratic(), *_conic(), *_nonlinear(), *_rank_one(), *_nuclear(), *_group_sparse())


def pose(name: str, objective: Any, constraints: Mapping[str, Any], variables: list[cp.Variable],
         start: Mapping[str, Any] | None = None, expressions: Mapping[str, cp.Expression] | None = None,
         **parts: Any) -> Program:
    """Make a programme of plain parts: named constraints (or lists of them), variables under their own names.

    Args:
        name: name of the programme.
        objective: what is minimised.
        constraints: {name: constraint or list of constraints}.
        variables: the variables, each with its own name.
        start: {variable: value}.
        expressions: further named expressions that constraints may speak about.
        parts: further attributes of `Program`.
    """
    groups = {key: tuple(group) if isinstance(group, list | tuple) else (group,) for key, group in constraints.items()}
    named = {variable.name(): variable for variable in variables}
    view = View({**named, **(expressions or {})})
    return Program(name, cp.Minimize(objective), groups, named, dict(start or {}), dict, view, **parts)


def _linear() -> list[Case]:
    def lp_vertex() -> Program:
        x = cp.Variable(2, name="x")
        return pose("lp_vertex", -3 * x[0] - 5 * x[1], {
            "plants": cp.hstack([x[0], 2 * x[1], 3 * x[0] + 2 * x[1]]) <= np.array([4.0, 12.0, 18.0]), "sign": x >= 0,
        }, [x])

    cost = np.array([3.0, 1.0, 2.0, 5.0])

    def lp_simplex() -> Program:
        x = cp.Variable(4, name="x")
        return pose("lp_simplex", cost @ x, {"total": cp.sum(x) == 1, "sign": x >= 0}, [x])

    def lp_bounds_as_attributes() -> Program:
        x = cp.Variable(4, name="x", nonneg=True)
        return pose("lp_bounds_as_attributes", cost @ x, {"total": cp.sum(x) == 1}, [x])

    def lp_degenerate() -> Program:
        x = cp.Variable(2, name="x")
        rows = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [2.0, 2.0], [1.0, 2.0]])
        return pose("lp_degenerate", -x[0] - x[1], {
            "rows": rows @ x <= np.array([2.0, 1.0, 1.0, 4.0, 3.0]), "sign": x >= 0}, [x])

    def lp_badly_scaled() -> Program:
        x = cp.Variable(2, name="x")
        return pose("lp_badly_scaled", -3e-3 * x[0] - 5e3 * x[1], {
            "plants": cp.hstack([x[0], 2e3 * x[1], 3e-3 * x[0] + 2e3 * x[1]]) <= np.array([4e3, 12.0, 18.0]),
            "sign": x >= 0}, [x], start={"x": np.zeros(2)})

    def lp_infeasible() -> Program:
        x = cp.Variable(2, name="x")
        return pose("lp_infeasible", cp.sum(x), {"low": x[0] + x[1] >= 3, "high": x <= 1}, [x])

    def lp_unbounded() -> Program:
        x = cp.Variable(2, name="x")
        return pose("lp_unbounded", -x[0], {"band": x[1] <= 1, "sign": x >= 0}, [x])

    simplex: dict[str, Any] = {"value": 1.0, "point": {"x": [0.0, 1.0, 0.0, 0.0]}}
    return [
        Case(lp_vertex, value=-36.0, point={"x": [2.0, 6.0]}, duals={"plants": [0.0, 1.5, 1.0], "sign": [0.0, 0.0]}),
        Case(lp_simplex, **simplex, duals={"total": [-1.0], "sign": [2.0, 0.0, 1.0, 4.0]}),
        Case(lp_bounds_as_attributes, **simplex, duals={"total": [-1.0]}),
        Case(lp_degenerate, value=-2.0, point={"x": [1.0, 1.0]}, hard=True),
        Case(lp_badly_scaled, value=-36.0, point={"x": [2e3, 6e-3]}, hard=True),
        Case(lp_infeasible, INFEASIBLE), Case(lp_unbounded, UNBOUNDED),
    ]


def _quadratic() -> list[Case]:
    target = np.array([2.0, -0.5, 0.25])

    def qp_box() -> Program:
        x = cp.Variable(3, name="x")
        return pose("qp_box", cp.sum_squares(x - target), {"upper": x <= 1, "lower": x >= 0}, [x])

    normal = np.array([1.0, 2.0, 2.0])

    def qp_equality() -> Program:
        x = cp.Variable(3, name="x")
        return pose("qp_equality", cp.sum_squares(x), {"plane": normal @ x == 1}, [x])

    data = np.array([1.0, 3.0, 2.0, 4.0])

    def qp_monotone_with_residuals() -> Program:
        x, r = cp.Variable(4, name="x"), cp.Variable(4, name="r")
        return pose("qp_monotone_with_residuals", cp.sum_squares(r) + 10.0, {
            "residual": r == x - data, "monotone": x[:-1] - x[1:] <= 0}, [x, r],
            structural=frozenset({"residual"}), derived={"r": x - data})

    def qp_badly_scaled() -> Program:
        x = cp.Variable(2, name="x")
        unit = np.array([1e-4, 1e4])
        return pose("qp_badly_scaled", cp.sum_squares(cp.multiply(unit, x) - 1), {"budget": unit @ x <= 1}, [x],
                    start={"x": np.zeros(2)})

    def qp_repeated_constraints() -> Program:
        x = cp.Variable(2, name="x")
        return pose("qp_repeated_constraints", cp.sum_squares(x - 1), {
            "once": cp.sum(x) == 1, "twice": 2 * cp.sum(x) == 2, "cap": [x[0] <= 0.5, 3 * x[0] <= 1.5]}, [x])

    def qp_infeasible() -> Program:
        x = cp.Variable(2, name="x")
        return pose("qp_infeasible", cp.sum_squares(x), {"sum": cp.sum(x) == 5, "cap": x <= 1}, [x])

    def qp_unbounded() -> Program:
        x = cp.Variable(2, name="x")
        return pose("qp_unbounded", cp.square(x[0]) - x[1], {"band": x[0] <= 1}, [x])

    return [
        Case(qp_box, value=1.25, point={"x": [1.0, 0.0, 0.25]},
             duals={"upper": [2.0, 0.0, 0.0], "lower": [0.0, 1.0, 0.0]}),
        Case(qp_equality, value=1 / 9, point={"x": normal / 9}, duals={"plane": [-2 / 9]}),
        Case(qp_monotone_with_residuals, value=10.5, point={"x": [1.0, 2.5, 2.5, 4.0]},
             duals={"residual": [0.0, 1.0, -1.0, 0.0], "monotone": [0.0, 1.0, 0.0]}),
        Case(qp_badly_scaled, value=0.5, point={"x": [5e3, 5e-5]}, duals={"budget": [1.0]}, hard=True),
        Case(qp_repeated_constraints, value=0.5, point={"x": [0.5, 0.5]}, hard=True),
        Case(qp_infeasible, INFEASIBLE), Case(qp_unbounded, UNBOUNDED),
    ]


def _conic() -> list[Case]:
    cost = np.array([3.0, -4.0])

    def socp_ball() -> Program:
        x = cp.Variable(2, name="x")
        return pose("socp_ball", cost @ x, {"ball": cp.norm(x) <= 1}, [x])

    normal, centre = np.array([2.0, -1.0, 2.0]), np.array([1.0, 1.0, 1.0])

    def socp_distance_to_plane() -> Program:
        x, t = cp.Variable(3, name="x"), cp.Variable(name="t")
        return pose("socp_distance_to_plane", t, {"cone": cp.SOC(t, x - centre), "plane": normal @ x == 0}, [x, t])

    def socp_infeasible() -> Program:
        x = cp.Variable(2, name="x")
        return pose("socp_infeasible", cost @ x, {"ball": cp.norm(x) <= 1, "far": x[0] >= 2}, [x])

    matrix = np.array([[2.0, 1.0, 0.0], [1.0, 3.0, 1.0], [0.0, 1.0, 4.0]])
    levels, vectors = np.linalg.eigh(matrix)
    first = np.outer(vectors[:, 0], vectors[:, 0])

    def sdp_smallest_eigenvalue() -> Program:
        x = cp.Variable((3, 3), name="x", symmetric=True)
        return pose("sdp_smallest_eigenvalue", cp.trace(matrix @ x), {"trace": cp.trace(x) == 1, "psd": x >> 0}, [x])

    def sdp_largest_eigenvalue() -> Program:
        t = cp.Variable(name="t")
        return pose("sdp_largest_eigenvalue", t, {"psd": t * np.eye(3) - matrix >> 0}, [t])

    def sdp_infeasible() -> Program:
        x = cp.Variable((2, 2), name="x", symmetric=True)
        return pose("sdp_infeasible", cp.trace(x), {"psd": x >> 0, "corner": x[0, 0] == -1}, [x])

    def exp_entropy() -> Program:
        x = cp.Variable(4, name="x")
        return pose("exp_entropy", -cp.sum(cp.entr(x)), {"total": cp.sum(x) == 1}, [x],
                    start={"x": np.array([0.1, 0.2, 0.3, 0.4])})

    def exp_log_sum_exp() -> Program:
        x = cp.Variable(3, name="x")
        return pose("exp_log_sum_exp", cp.log_sum_exp(x), {"total": cp.sum(x) == 3}, [x])

    return [
        Case(socp_ball, value=-5.0, point={"x": [-0.6, 0.8]}, duals={"ball": [5.0]}),
        Case(socp_distance_to_plane, value=1.0, point={"x": centre - normal / 3, "t": 1.0},
             duals={"plane": [1 / 3]}),
        Case(socp_infeasible, INFEASIBLE),
        Case(sdp_smallest_eigenvalue, value=float(levels[0]), point={"x": first},
             duals={"trace": [-levels[0]], "psd": np.ravel(matrix - levels[0] * np.eye(3), order="F")}),
        Case(sdp_largest_eigenvalue, value=float(levels[-1]), point={"t": levels[-1]},
             duals={"psd": np.ravel(np.outer(vectors[:, -1], vectors[:, -1]), order="F")}),
        Case(sdp_infeasible, INFEASIBLE),
        Case(exp_entropy, value=-np.log(4.0), point={"x": np.full(4, 0.25)}, duals={"total": [np.log(4.0) - 1]}),
        Case(exp_log_sum_exp, value=1.0 + np.log(3.0), point={"x": np.ones(3)}, duals={"total": [-1 / 3]}),
    ]


def _nonlinear() -> list[Case]:
    def nlp_rosenbrock() -> Program:
        x = cp.Variable(2, name="x")
        return pose("nlp_rosenbrock", cp.square(1 - x[0]) + 100 * cp.square(x[1] - cp.square(x[0])),
                    {"disc": cp.sum_squares(x) <= 3}, [x], start={"x": np.array([-1.2, 1.0])})

    def nlp_hs071() -> Program:
        x = cp.Variable(4, name="x")
        return pose("nlp_hs071", x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2], {
            "product": x[0] * x[1] * x[2] * x[3] >= 25, "sphere": cp.sum_squares(x) == 40,
            "lower": x >= 1, "upper": x <= 5}, [x], start={"x": np.array([1.0, 5.0, 5.0, 1.0])})

    def nlp_hyperbola() -> Program:
        x = cp.Variable(2, name="x")
        return pose("nlp_hyperbola", cp.sum(x), {"product": x[0] * x[1] >= 1, "sign": x >= 0}, [x],
                    start={"x": np.array([3.0, 1.0])})

    def nlp_elementary_functions() -> Program:
        x, y = cp.Variable(name="x"), cp.Variable(name="y")
        return pose("nlp_elementary_functions", cp.exp(x) - 2 * x + cp.square(y - cp.exp(-x)), {
            "ceiling": cp.logistic(y) <= 1}, [x, y], start={"x": 0.0, "y": 0.0})

    def nlp_matrix_factor() -> Program:
        left, right = cp.Variable((2, 1), name="left"), cp.Variable((1, 2), name="right")
        return pose("nlp_matrix_factor", cp.sum_squares(left @ right - np.diag([3.0, 1.0])), {
            "gauge": cp.sum_squares(right) == 1}, [left, right],
            start={"left": np.array([[1.0], [1.0]]), "right": np.array([[1.0, 0.2]])})

    def nlp_infeasible() -> Program:
        x = cp.Variable(2, name="x")
        return pose("nlp_infeasible", cp.sum_squares(x), {"product": x[0] * x[1] >= 4, "cap": x <= 1, "sign": x >= 0},
                    [x], start={"x": np.array([0.5, 0.4])})

    def nlp_infeasible_stationary() -> Program:
        x = cp.Variable(name="x")
        return pose("nlp_infeasible_stationary", x, {"circle": cp.square(x) == -1}, [x], start={"x": 0.3})

    def nlp_unbounded() -> Program:
        x = cp.Variable(2, name="x")
        return pose("nlp_unbounded", x[0] * x[1], {"line": cp.sum(x) == 1}, [x], start={"x": np.array([2.0, -1.0])})

    return [
        Case(nlp_rosenbrock, value=0.0, point={"x": [1.0, 1.0]}, duals={"disc": [0.0]}),
        Case(nlp_hs071, **_hs071()),
        Case(nlp_hyperbola, value=2.0, point={"x": [1.0, 1.0]}, duals={"product": [1.0], "sign": [0.0, 0.0]}),
        Case(nlp_elementary_functions, value=2 - 2 * np.log(2.0), point={"x": np.log(2.0), "y": 0.5},
             duals={"ceiling": [0.0]}),
        Case(nlp_matrix_factor, value=1.0, point={"left": [[3.0], [0.0]], "right": [[1.0, 0.0]]},
             duals={"gauge": [0.0]}),
        Case(nlp_infeasible, INFEASIBLE), Case(nlp_infeasible_stationary, INFEASIBLE), Case(nlp_unbounded, UNBOUNDED),
    ]


def _hs071() -> dict[str, Any]:
    """Problem 71 of Hock and Schittkowski (1981): x0 = 1, the rest by Newton's method on its optimality conditions."""
    y = np.array([4.743, 3.8211, 1.3794, -0.55, 0.16])  # x1, x2, x3, multipliers of product and sphere
    for _ in range(20):
        a, b, c, p, s = y
        residual = np.array([c + p * b * c + 2 * s * a, 1 + c + p * a * c + 2 * s * b,
                             1 + a + b + p * a * b + 2 * s * c, a * b * c - 25, 1 + a * a + b * b + c * c - 40])
        slope = np.array([[2 * s, p * c, 1 + p * b, b * c, 2 * a], [p * c, 2 * s, 1 + p * a, a * c, 2 * b],
                          [1 + p * b, 1 + p * a, 2 * s, a * b, 2 * c], [b * c, a * c, a * b, 0, 0],
                          [2 * a, 2 * b, 2 * c, 0, 0]])
        y = y - np.linalg.solve(slope, residual)
    a, b, c, p, s = y
    lowest = c * (2 + a + b) + p * 25 + 2 * s  # the multiplier of x0 >= 1 is the gradient in x0
    return {"value": float(c * (1 + a + b) + b), "point": {"x": [1.0, a, b, c]},
            "duals": {"product": [-p], "sphere": [s], "lower": [lowest, 0, 0, 0], "upper": [0, 0, 0, 0]}}


def planted_fit(seed: int = 0, rows: int = 60, levels: int = 4, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """Return (A, y) of ``y = A [a; vec(mu bᵀ)] + noise`` with one linear term, ``levels`` values mu and two lags b."""
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((rows, 1 + 2 * levels))
    mu = np.linspace(-1.0, 1.0, levels) ** 3
    truth = np.concatenate([[0.5], np.kron([0.8, 0.6], mu)])
    return matrix, matrix @ truth + noise * rng.standard_normal(rows)


def _rank_one() -> list[Case]:
    matrix, y = planted_fit()
    triangle = np.asarray(np.linalg.qr(np.column_stack([matrix, y]), mode="r"))
    root, target, remainder = triangle[:-1, :-1], triangle[:-1, -1], float(triangle[-1, -1] ** 2)

    rising = {"mu": np.array([-1.0, 0.0, 0.0, 1.0]), "b": np.array([0.7, 0.7])}

    def bilinear(name: str, start: Mapping[str, Any], extra: Callable[[Any], Mapping[str, Any]]) -> Program:
        a, mu, b = cp.Variable(1, name="a"), cp.Variable(4, name="mu"), cp.Variable(2, name="b")
        r = cp.Variable(root.shape[0], name="r")
        theta = cp.outer(mu, b)
        residual = root @ cp.hstack([a, cp.vec(theta, order="F")]) - target
        constraints = {"residual": r == residual, "gauge": cp.sum_squares(b) == 1, **extra(mu)}
        form = RankOneStructure(RankOne(root, target, remainder, ((4, 2),), 1, float(y @ y)), ("a",), (("mu", "b"),))
        return pose(name, cp.sum_squares(r) + remainder, constraints, [a, mu, b, r],
                    start={"a": np.zeros(1), **start},
                    structural=frozenset({"residual", "gauge"}), derived={"r": residual},
                    structure=form, expressions={"Theta": theta},
                    scale=float(y @ y))

    def rank_one_fit() -> Program:
        return bilinear("rank_one_fit", rising, lambda mu: {})

    def rank_one_convex() -> Program:
        falling = {name: -value for name, value in rising.items()}
        return bilinear("rank_one_convex", falling, lambda mu: {"convex": cp.diff(mu, 2) >= 0})

    return [Case(rank_one_fit, value=_search(matrix, y, convex=False)),
            Case(rank_one_convex, value=_search(matrix, y, convex=True))]


def _nuclear() -> list[Case]:
    """A Hankel matrix of one block row has independent entries: its singular values are reduced by half the weight."""
    y = np.random.default_rng(1).normal(size=(9, 3)) + np.outer(np.arange(9.0), [1.0, -0.5, 0.2])
    weight = 0.4
    left, values, right = np.linalg.svd(y, full_matrices=False)
    kept = np.maximum(values - 0.5 / weight, 0.0)
    best = (left * kept) @ right

    def nuclear_shrinkage() -> Program:
        yhat, inner = cp.Variable(y.shape, name="yhat"), cp.Variable(y.T.shape, name="X")
        r = cp.Variable(y.size, name="r")
        misfit = cp.vec(yhat - y, order="C")
        parameter = cp.Parameter(nonneg=True, name="weight", value=weight)
        return pose("nuclear_shrinkage", cp.normNuc(inner) + parameter * cp.sum_squares(r),
                    {"structure": inner == yhat.T, "residual": r == misfit}, [yhat, inner, r], start={"yhat": y},
                    structural=frozenset({"structure", "residual"}), derived={"X": yhat.T, "r": misfit},
                    parameters={"weight": parameter},
                    structure=NuclearNormStructure(NuclearProblem(y, np.arange(9), 1)),
                    scale=weight * float(np.sum(y**2)))

    return [Case(nuclear_shrinkage, value=float(np.sum(kept) + weight * np.sum((best - y) ** 2)),
                 point={"yhat": best}, duals={"structure": np.ravel(-2 * weight * (y - best).T, order="F")})]


def _group_sparse() -> list[Case]:
    """With an orthonormal design every group of coefficients is shrunk by itself."""
    rng = np.random.default_rng(5)
    design, target = np.linalg.qr(rng.normal(size=(12, 7)))[0], 3.0 * rng.normal(size=12)
    weights, penalty = np.array([1.0, 2.0, 0.5, 1.5]), 0.9
    free = design.T @ target
    groups = [free[:1], free[1:2], free[2:5], free[5:]]
    shrunk = [max(0.0, 1 - penalty * w / float(np.linalg.norm(z))) * z for w, z in zip(weights, groups)]
    rest = target - design @ np.concatenate(shrunk)
    value = 0.5 * float(rest @ rest) + penalty * sum(w * float(np.linalg.norm(z)) for w, z in zip(weights, shrunk))

    def group_shrinkage() -> Program:
        parts = [cp.Variable(z.size, name=f"a{i + 1}") for i, z in enumerate(groups)]
        e, parameter = cp.Variable(12, name="residual"), cp.Parameter(nonneg=True, name="lambda", value=penalty)
        misfit = target - design @ cp.hstack(parts)
        norms: Any = sum(w * cp.norm(part, 2) for w, part in zip(weights, parts))
        form = GroupSparseStructure(GroupProblem(design, target, np.array([0, 1, 2, 5, 7]), weights),
                         {part.name(): part.shape for part in parts})
        return pose("group_shrinkage", 0.5 * cp.sum_squares(e) + parameter * norms, {"residual": e == misfit},
                    [*parts, e], structural=frozenset({"residual"}), derived={"residual": misfit},
                    parameters={"lambda": parameter}, structure=form, scale=0.5 * float(target @ target))

    return [Case(group_shrinkage, value=value, point={f"a{i + 1}": z for i, z in enumerate(shrunk)},
                 duals={"residual": -rest})]


def _search(matrix: np.ndarray, y: np.ndarray, *, convex: bool) -> float:
    """Minimise over the direction of b, a single angle; for each angle the rest is (constrained) least squares."""
    from scipy.optimize import minimize_scalar, nnls

    levels = (matrix.shape[1] - 1) // 2
    # mu = free line + kinks with coefficients >= 0 is exactly "convex"; without the constraint kinks of either sign
    ramps = np.maximum(np.subtract.outer(np.arange(levels), np.arange(levels)), 0.0)
    line, kinks = np.column_stack([np.ones(levels), ramps[:, 0]]), ramps[:, 1:-1]
    shapes = np.column_stack([line, -line, kinks] if convex else [line, -line, kinks, -kinks])

    def value(angle: float) -> float:
        b = np.array([np.cos(angle), np.sin(angle)])
        wide = matrix[:, 1:].reshape(-1, levels, 2, order="F") @ b
        return nnls(np.column_stack([matrix[:, 0], -matrix[:, 0], wide @ shapes]), y)[1] ** 2

    grid = np.linspace(0.0, 2 * np.pi, 721)
    best = float(min(grid, key=value))
    found: Any = minimize_scalar(value, bounds=(best - 0.01, best + 0.01), method="bounded", options={"xatol": 1e-10})
    return float(found.fun)

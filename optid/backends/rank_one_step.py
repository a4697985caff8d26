"""The quadratic programme of one step on least squares with products under constraints.

    minimise  ‖R dz(x) + r‖² + curvature of mu bᵀ    subject to  the tangents of the constraints, and the convex ones

The exact second-order terms of the products count also where constraints multiply them; the model is made definite
first across the active constraints, where a step has no freedom anyway (Nocedal and Wright 2006, chapter 18). With
affine constraints alone it goes straight to Clarabel.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_triangular

from optid.arrays import Array
from optid.backends.back_end import Answer, Settings
from optid.backends.conic import SHARP, sizes_by_effect, solve_least_squares, tolerances
from optid.core.constraint import Constraint, join_by_name
from optid.core.judge import gauges
from optid.core.leaves import GAUGE, Product, positions
from optid.core.problem import Problem
from optid.core.terms import Values, flat
from optid.program.expressions import solve_quietly
from optid.program.limits import EQUALITIES
from optid.program.solution import Status

TINY = 1e-300


class RankOneStep:
    """Steps on one problem: one term of squares with products, under constraints that do not depend on an iterate.

    Args:
        problem: the problem.
        usual: a point at which the effect of every unknown is of its usual size.
    """

    def __init__(self, problem: Problem, usual: Values) -> None:
        self.problem, self.usual = problem, usual
        (self.squares,) = problem.bilinear_terms
        self._z = positions(problem.space.places, self.squares.z)
        self.constraints = tuple(sorted(problem.constraints(), key=lambda one: one.cone != "zero"))
        # in the order of the sides of a programme: equalities, inequalities, and what CVXPY alone states
        self.tangents = tuple(sorted((one for one in self.constraints if not _convex(one)), key=_is_below))
        self.convex = tuple(one for one in self.constraints if _convex(one))
        self.settings = Settings(accuracy=SHARP, warm=False)

    @cached_property
    def products(self) -> list[Product]:
        """The products, in the order of the blocks."""
        by_name = {product.name: product for product in self.problem.products}
        return [by_name[name] for name in self.squares.z if name in by_name]

    @cached_property
    def bent(self) -> tuple[Constraint, ...]:
        """The constraints about products, or by their tangents alone."""
        names = {product.name for product in self.products}
        return tuple(one for one in self.constraints if one.cone == "other" and not _convex(one)
                     or one.leaves(self.problem.space) & names)

    @cached_property
    def sizes(self) -> Array:
        """Units of the unknowns (unknowns,), by their effect."""
        return sizes_by_effect(self.problem, self._jacobian(self.problem.slope(self.usual)))

    def _jacobian(self, slope: Array) -> Array:
        return self.squares.root @ slope[self._z]

    def step(self, x: Values, duals: Mapping[str, Array], damping: float = 0.0, pinned: bool = False
              ) -> tuple[dict[str, Array], dict[str, Array]] | None:
        """Return the minimum of the quadratic model at x under the tangents of the constraints, and its multipliers."""
        problem, sizes, at = self.problem, self.sizes, self.problem.pack(x)
        y, slope = problem.leaf_values(x), problem.slope(x)
        residual = self.squares.residual(y)
        jacobian = self._jacobian(slope)
        hessian = jacobian.T @ jacobian
        diagonal = np.diag(hessian)
        scale = np.sqrt(np.maximum(diagonal, 1e-8 * max(float(np.max(diagonal)), TINY)))
        rows = [(one, one.slope(problem.space, y) @ slope, one.residual(problem.space, y)) for one in self.tangents]
        parts = _parts(self.tangents, duals)
        if not pinned:
            pull = np.zeros(problem.space.size)
            pull[self._z] = self.squares.root.T @ residual
            for one, dual in zip(self.tangents, parts or ()):
                pull = pull + one.rows.T @ dual / 2
            hessian = hessian + self.curvature(x, pull)
        scaled, shift = hessian / np.outer(scale, scale), max(damping, 1e-12)
        factor = _cholesky(scaled, shift)
        if factor is None:
            factor = _definite(scaled, self._active(x, rows, parts) / scale, shift)
        upper = factor.T * (scale * sizes)
        unit = max(float(np.max(np.abs(upper))), TINY)
        descent = solve_triangular(factor, jacobian.T @ residual / scale, lower=True)
        sides: dict[str, list[tuple[Array, Array]]] = {"zero": [], "below": []}
        if pinned:
            bs = positions(problem.slices, [one.b for one in self.products])
            sides["zero"].append((np.eye(problem.size)[bs], at[bs] / sizes[bs]))
        else:
            for (gauge, _), product in zip(gauges(problem, x), problem.products):
                sides["zero"].append(((gauge * sizes)[None], np.array([gauge @ at - product.level(x)[0]])))
        pins, units = sum(len(right) for _, right in sides["zero"]), []
        for one, tangent, g in rows:
            right = tangent @ at - g
            units.append(float(np.max(np.abs(tangent) @ sizes + np.abs(right), initial=0.0)) or 1.0)
            sides["below" if _is_below(one) else "zero"].append((tangent * sizes / units[-1], right / units[-1]))
        scaled_model = upper / unit, (upper @ (at / sizes) - descent) / unit
        if self.convex:
            found = self._with_convex(*scaled_model, sides, at, slope, y)
        else:
            found = solve_least_squares(*scaled_model, sides["zero"], sides["below"], self.settings)
        if not found.values:
            return None
        counts = np.cumsum([pins, *map(len, self.tangents), *map(len, self.convex)])
        multipliers = [unit**2 * found.duals["rows"][a:b] / u
                       for a, b, u in zip(counts, counts[1:], [*units, *(1 / one.sizes for one in self.convex)])]
        named = join_by_name((*self.tangents, *self.convex), multipliers)
        if not pinned:
            named[GAUGE] = unit**2 * found.duals["rows"][:pins]
        return problem.unpack(found.values["x"] * sizes), named

    def _with_convex(self, matrix: Array, target: Array, sides: Mapping[str, list[tuple[Array, Array]]], at: Array,
                     slope: Array, y: Values) -> Answer:
        """Solve a step with convex constraints of the leaves, as `solve_least_squares` does; their multipliers last."""
        space, w = self.problem.space, cp.Variable(at.size)
        leaves = slope @ (cp.multiply(self.sizes, w) - at) + space.vector(y)
        links = [cp.vec(variable, order="F") == leaves[space.places[name]]
                 for name, variable in space.variables.items()]
        rows = [part @ w == right for part, right in sides["zero"]] + [
            part @ w <= right for part, right in sides["below"]]
        members = [one.limit.member for one in self.convex]
        step = cp.Problem(cp.Minimize(cp.sum_squares(matrix @ w - target)), [*links, *rows, *members])
        try:
            solve_quietly(step, **tolerances("clarabel", self.settings))
        except cp.SolverError as error:
            return Answer(Status.FAILED, str(error))
        duals = [dual.value for one in (*rows, *members) for dual in one.dual_variables]
        if w.value is None or any(dual is None for dual in duals):
            return Answer(Status.FAILED, str(step.status))
        return Answer(Status.LOCAL, str(step.status), {"x": np.asarray(w.value)},
                      {"rows": np.concatenate([np.zeros(0), *map(flat, duals)])})

    def curvature(self, x: Values, pull: Array) -> Array:
        """Return second derivatives of ``pullᵀ leaves``, made definite along the scale between mu and b."""
        problem = self.problem
        found = np.zeros((problem.size, problem.size))
        for product in self.products:
            mu, b = problem.slices[product.mu], problem.slices[product.b]
            block = pull[problem.space.places[product.name]].reshape(mu.stop - mu.start, -1, order="F")
            found[mu, b] += block
            found[b, mu] += block.T
            if product.gauge == "norm":  # the linearised gauge fixes this direction; it only needs to be definite
                found[b, b] += np.outer(flat(x[product.b]), flat(x[product.b])) * float(np.sum(x[product.mu] ** 2))
        return found

    def _active(self, x: Values, rows: Sequence[tuple[Constraint, Array, Array]], parts: Sequence[Array] | None
                ) -> Array:
        """Return the slopes of the gauges, of equalities and of inequalities with a multiplier; none without any."""
        if parts is None:
            return np.zeros((0, self.problem.size))
        largest = max((float(np.max(np.abs(part), initial=0.0)) for part in parts), default=0.0)
        found = [tangent if one.cone == "zero" else tangent[part > 1e-6 * largest]
                 for (one, tangent, _), part in zip(rows, parts)]
        return np.vstack([*(gauge for gauge, _ in gauges(self.problem, x)), *found])


def _parts(constraints: Sequence[Constraint], duals: Mapping[str, Array]) -> list[Array] | None:
    """Return the multipliers of every constraint out of those by name; None where some are missing."""
    if any(one.name not in duals for one in constraints):
        return None
    return [duals[one.name][one.span] for one in constraints]


def _cholesky(matrix: Array, shift: float) -> Array | None:
    try:
        return np.linalg.cholesky(matrix + shift * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return None


def _definite(matrix: Array, rows: Array, shift: float) -> Array:
    """Cholesky factor of a matrix made definite: across the active rows, and where that is not enough along them."""
    size = float(np.max(np.abs(matrix)))
    rank = np.linalg.matrix_rank(rows) if len(rows) else 0
    basis = np.linalg.svd(rows, full_matrices=True)[2] if len(rows) else np.eye(len(matrix))
    across, along = basis[:rank].T @ basis[:rank], basis[rank:].T
    for weight in (1.0, 1e2, 1e4):
        factor = _cholesky(matrix + weight * size * across, shift)
        if factor is not None:
            return factor
    values, vectors = np.linalg.eigh(along.T @ matrix @ along)
    vectors, values = along @ vectors, np.maximum(np.abs(values), 1e-10 * size)
    return np.linalg.cholesky((vectors * values) @ vectors.T + size * across + shift * np.eye(len(matrix)))


def _convex(one: Constraint) -> bool:
    """Whether a constraint that is not rows is convex in the leaves, so that CVXPY states it."""
    return one.cone == "psd" or one.cone == "other" and one.limit.member.is_dcp()


def _is_below(one: Constraint) -> bool:
    """Whether rows, or the tangents of another constraint, are inequalities."""
    return one.cone == "below" or one.cone == "other" and not isinstance(one.limit.member, EQUALITIES)

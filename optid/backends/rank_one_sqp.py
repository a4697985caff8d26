"""Sequential quadratic programmes for least squares with products under constraints; with affine ones without CVXPY.

Every step minimises the quadratic model of the Lagrangian: the least squares in the tangent of ``Theta = mu bᵀ``, with
the exact second-order terms of the products, also where constraints multiply them, made definite first across the
active constraints, where a step has no freedom anyway (Nocedal and Wright 2006, chapter 18). Constraints that are
convex in the leaves, cones among them, enter a step as they are, and smooth others by their tangents. A step for which
the tangents are a poor model is corrected by solving for everything but b, which is convex.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cvxpy as cp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from optid.arrays import Array
from optid.backends.back_end import Answer, Settings
from optid.backends.conic import solve_least_squares, tolerances
from optid.core.constraint import Constraint
from optid.core.judge import ACTIVE, gauges, size_of_terms
from optid.core.problem import Problem
from optid.core.terms import Values, flat
from optid.program.expressions import solve_quietly
from optid.program.limits import EQUALITIES
from optid.program.solution import Status
from optid.structures.bilinear import starts
from optid.structures.multipliers import fit_multipliers
from optid.structures.rank_one import Point

STEPS = 100
DIRECTIONS = 4  # different directions b that are tried, each with both signs, before the full steps
SAME = 0.999  # cosine of two directions that are one
INNER = 1e-11  # accuracy of the quadratic programmes
INSIDE = 1e-14  # violation that is none
TINY = 1e-300
MOST_SIGNED = 3  # blocks whose signs are all tried
GAUGE = "gauge"  # under which the multipliers of the gauges stand beside those of the constraints


@dataclass(frozen=True, eq=False)
class DescentEnd:
    """Where a descent ended: merit, point, flat multipliers by constraint, and why."""

    merit: float
    x: dict[str, Array]
    duals: dict[str, Array]
    status: Status
    word: str
    steps: int


class RankOneSQP:
    """The method on one problem.

    Args:
        problem: one term of squares with products, under constraints that do not depend on an iterate.
        start: where to begin.
        free: the minimum without the constraints.
        is_proved: whether a point and its multipliers are quickly proved to be the global minimum.
    """

    def __init__(self, problem: Problem, start: Values, free: Point,
                 is_proved: Callable[[Values, Mapping[str, Array]], bool]) -> None:
        self.problem, self.start, self.free, self.is_proved = problem, start, free, is_proved
        (squares,) = problem.bilinear_terms
        assert squares.lifted is not None
        self.squares, self.lifted = squares, squares.lifted
        self.constraints = tuple(sorted(problem.constraints(), key=lambda one: one.cone != "zero"))
        # in the order of the sides of a programme: equalities, inequalities, and what CVXPY alone states
        self.tangents = tuple(sorted((one for one in self.constraints if not _convex(one)), key=_is_below))
        self.convex = tuple(one for one in self.constraints if _convex(one))
        self.settings = Settings(accuracy=INNER, warm=False)

    def solve(self, seed: int, directions: int, descents: int) -> DescentEnd:
        """Try directions of b, follow the best ones to their ends, and return the best end."""
        idle = self._idle()
        if idle is not None:
            return idle
        points = self._candidates(seed, directions)
        settled = [found for found in map(self._settle, points) if found is not None]
        if not settled:  # none of these directions is allowed: start from the nearest ones that are
            nearest = filter(None, map(self._allowed, points))
            settled = [found for found in map(self._settle, nearest) if found is not None]
        if not settled:
            return DescentEnd(np.inf, {}, {}, Status.FAILED, "no start satisfies the constraints", 0)
        settled.sort(key=lambda pair: pair[0])
        distinct: list[dict[str, Array]] = []
        for _, x in settled:
            z = self._lift(x)
            if not any(np.allclose(z, self._lift(kept), 1e-3, 1e-6) for kept in distinct):
                distinct.append(x)
        ends = []
        for x in distinct[:descents]:
            ends.append(self._descend(x))
            if ends[-1].status is Status.LOCAL and self.is_proved(ends[-1].x, ends[-1].duals):
                break
        return min(ends, key=lambda end: end.merit)

    # -- points

    @cached_property
    def linear(self) -> tuple[str, ...]:
        """Unknowns that stand in the squares by themselves."""
        return tuple(name for name in self.squares.z if name in self.problem.start)

    def _point(self, x: Values) -> Point:
        return to_point(self.problem, self.linear, x)

    def _values(self, point: Point) -> dict[str, Array]:
        """Return the values of a point, in the gauge."""
        found, at = {}, 0
        for name in self.linear:
            size = np.size(self.problem.start[name])
            found[name] = np.reshape(point.w[at : at + size], np.shape(self.problem.start[name]), order="F")
            at += size
        for product, mu, b in zip(self.products, point.mus, point.bs):
            found[product.mu] = np.reshape(mu, np.shape(self.problem.start[product.mu]), order="F")
            found[product.b] = np.reshape(b, np.shape(self.problem.start[product.b]), order="F")
        return self.problem.in_gauge({name: found[name] for name in self.problem.start})

    @cached_property
    def products(self) -> list:
        """The products, in the order of the blocks."""
        by_name = {product.name: product for product in self.problem.products}
        return [by_name[name] for name in self.squares.z if name in by_name]

    def _lift(self, x: Values) -> Array:
        return np.concatenate([flat(part) for part in map(self.problem.leaf_values(x).__getitem__, self.squares.z)])

    def _candidates(self, seed: int, most: int) -> list[dict[str, Array]]:
        """Points with different directions of b, each with every pattern of signs."""
        core, free = self.lifted.core, self.free
        points = [self._point(self.start)]
        if most > DIRECTIONS:  # under signs of b an optimum may lie on one lag alone, and mu vanish all around it
            points = [Point(free.w, free.mus, (*free.bs[:i], axis, *free.bs[i + 1 :]))
                      for i, b in enumerate(free.bs) for axis in np.eye(b.size)] + points
        points += [free, *(core.point(*pair) for pair in starts(core, count=max(most, DIRECTIONS), seed=seed))]
        distinct: list[Point] = []
        for point in points:
            directions = tuple(b / max(float(np.linalg.norm(b)), TINY) for b in point.bs)
            if not any(all(abs(float(d @ e)) > SAME for d, e in zip(directions, kept.bs)) for kept in distinct):
                distinct.append(Point(point.w, point.mus, directions))
        return [self._values(one) for point in distinct[:most] for one in sign_patterns(point)]

    def _idle(self) -> DescentEnd | None:
        """Return the minimum without the constraints, where it satisfies them with one of its signs."""
        for point in sign_patterns(self.free):
            x = self._values(point)
            if self.problem.violation(x, self.constraints) <= INSIDE and self._in_gauge(x):
                sizes = {one.name: 0 for one in self.constraints}
                for one in self.constraints:
                    sizes[one.name] += len(one)
                duals: dict[str, Array] = {name: np.zeros(size) for name, size in sizes.items()}
                return DescentEnd(0.0, x, duals, Status.LOCAL, "stationary; no constraint is active", 0)
        return None

    def _in_gauge(self, x: Values) -> bool:
        return all(abs(product.level(x)[0]) <= 1e-9 for product in self.products)

    def _allowed(self, x: Values) -> dict[str, Array] | None:
        """Return the point with the nearest b that the constraints on b alone admit; None where there is none."""
        names = [product.b for product in self.products]
        places = [self.problem.space.places[name] for name in names]
        other = np.ones(self.problem.space.size, dtype=bool)
        for place in places:
            other[place] = False
        sides: dict[str, list[tuple[Array, Array]]] = {"zero": [], "below": []}
        for one in self.constraints:
            if one.cone not in sides:
                continue
            alone = ~np.any(one.rows[:, other], axis=1)
            rows = np.hstack([one.rows[alone][:, place] for place in places])
            sides[one.cone].append((rows, one.right[alone]))
        wanted = np.concatenate([flat(x[name]) for name in names])
        found = solve_least_squares(np.eye(wanted.size), wanted, sides["zero"], sides["below"], self.settings)
        if not found.values:
            return None
        parts = np.split(found.values["x"], np.cumsum([np.size(x[name]) for name in names])[:-1])
        if not all(np.linalg.norm(part) > 1e-6 for part in parts):
            return None
        moved = {name: np.reshape(part, np.shape(x[name]), order="F") for name, part in zip(names, parts)}
        return self.problem.in_gauge({**x, **moved})

    # -- steps

    def _settle(self, x: Values) -> tuple[float, dict[str, Array]] | None:
        """Solve for everything but b, which keeps its direction; None where the constraints forbid it."""
        if not self._in_gauge(x):
            return None
        # with b fixed the residual is affine, so that one linearisation is exact
        found = self._step(x, {}, pinned=True)
        if found is None:
            return None
        new = self.problem.in_gauge({**found[0], **{one.b: x[one.b] for one in self.products}})
        return self._merit(new, 0.0), new

    def _merit(self, x: Values, weight: float) -> float:
        """Return the sum of squares, and the violation of what multiplies unknowns, which a step may leave."""
        residual = self.squares.residual(self.problem.leaf_values(x))
        value = float(residual @ residual)
        return value + weight * self.problem.violation(x, self.bent) if weight and self.bent else value

    @cached_property
    def bent(self) -> tuple[Constraint, ...]:
        """The constraints about products, or by their tangents alone."""
        space = self.problem.space
        places = [space.places[product.name] for product in self.products]
        thetas = {space.variables[product.name].id for product in self.products} if self.convex else set()
        return tuple(one for one in self.constraints if any(one.rows[:, place].any() for place in places)
                     or one.cone == "other" and not _convex(one)
                     or _convex(one) and thetas & {variable.id for variable in one.limit.member.variables()})

    @cached_property
    def sizes(self) -> Array:
        """How much of every unknown would account for the whole record, by its largest effect; (unknowns,).

        Solvers stop at absolute tolerances, so the programmes are written in these units and not in those of the data.
        """
        effect = np.linalg.norm(self._jacobian(self.problem.slope(self._values(self.free))), axis=0)
        reach, sizes = float(np.sqrt(self.lifted.scale)), np.ones(self.problem.size)
        for place in self.problem.slices.values():
            most = float(np.max(effect[place], initial=0.0))
            sizes[place] = reach / most if most > 0 and reach > 0 else 1.0
        return sizes

    @cached_property
    def _z(self) -> NDArray[np.intp]:
        places = self.problem.space.places
        return np.concatenate([np.arange(places[name].start, places[name].stop) for name in self.squares.z])

    def _jacobian(self, slope: Array) -> Array:
        return self.squares.root @ slope[self._z]

    def _step(self, x: Values, duals: Mapping[str, Array], damping: float = 0.0, pinned: bool = False
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
            hessian = hessian + self._curvature(x, pull)
        scaled, shift = hessian / np.outer(scale, scale), max(damping, 1e-12)
        factor = _cholesky(scaled, shift)
        if factor is None:
            factor = _definite(scaled, self._active(x, rows, parts) / scale, shift)
        upper = factor.T * (scale * sizes)
        unit = max(float(np.max(np.abs(upper))), TINY)
        descent = solve_triangular(factor, jacobian.T @ residual / scale, lower=True)
        sides: dict[str, list[tuple[Array, Array]]] = {"zero": [], "below": []}
        if pinned:
            bs = np.concatenate([np.arange(problem.slices[one.b].start, problem.slices[one.b].stop)
                                 for one in self.products])
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
                       for a, b, u in zip(counts, counts[1:], [*units, *[1.0] * len(self.convex)])]
        named = _by_name((*self.tangents, *self.convex), multipliers)
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

    def _curvature(self, x: Values, pull: Array) -> Array:
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

    def _descend(self, x: dict[str, Array]) -> DescentEnd:
        """Follow the steps from x to their end."""
        scale = self.lifted.scale
        weight, damping, floor = 1e-3 * scale + TINY, 0.0, 1e-9 * scale
        duals: dict[str, Array] = {}
        status, word, count = Status.LIMIT, "iteration limit", 0
        while status is Status.LIMIT and count < STEPS:
            count += 1
            found = self._step(x, duals, damping)
            new = None if found is None else self.problem.in_gauge(found[0])
            size, before, after, rises = np.inf, 0.0, np.inf, True
            if found is not None and new is not None and self._in_gauge(new):
                duals = found[1]
                weight = max(weight, 2.0 * max(float(np.max(np.abs(d), initial=0.0)) for d in duals.values()))
                before, after = self._merit(x, weight), self._merit(new, weight)
                slack = 1e-11 * (before + floor)
                # measured on the lifted vector: b means nothing where mu is zero
                old, reached = self._lift(x), self._lift(new)
                size = float(np.linalg.norm(reached - old) / (TINY + np.linalg.norm(reached)))
                rises = after > before + slack and size > 1e-7
                # tangents are a poor model along a curved constraint: return to it by solving for all but b
                settled = self._settle(new) if rises else None
                if settled is not None and self._merit(settled[1], weight) < before - slack:
                    after, new, rises = self._merit(settled[1], weight), settled[1], False
            if new is None or rises:
                damping = max(10.0 * damping, 1e-4)
                if damping > 1e8:
                    status, word = Status.LOCAL, "no step descends"
                continue
            x, damping = new, 0.1 * damping if damping > 1e-9 else 0.0
            if size < 1e-9 or (size < 1e-7 and before - after <= 1e-13 * (before + floor)):
                status, word = Status.LOCAL, "stationary"
        return DescentEnd(self._merit(x, weight), x, self._multipliers(x, duals), status, word, count)

    def _multipliers(self, x: Values, found: dict[str, Array]) -> dict[str, Array]:
        """Return multipliers at x: those of the last step, or fitted to the gradient where that leaves less of it.

        A step has multipliers for the point that it reaches, which differ where it moved a b that means nothing.
        """
        parts = _parts(self.constraints, found)
        if parts is None or not all(one.cone in ("zero", "below") for one in self.constraints):
            return found
        problem, y, slope = self.problem, self.problem.leaf_values(x), self.problem.slope(x)
        jacobian = self._jacobian(slope)
        gradient = 2.0 * jacobian.T @ self.squares.residual(y)
        units = 1.0 / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
        held = [gauge * units for gauge, _ in gauges(problem, x)]
        rows = np.vstack([np.zeros((0, problem.size)), *(one.rows @ slope * units for one in self.constraints)])
        equal = np.concatenate([np.full(len(one), one.cone == "zero") for one in self.constraints])
        active = np.concatenate([one.residual(problem.space, y) > -ACTIVE * size_of_terms(one, problem.space, y)
                                 for one in self.constraints]) | equal
        gauged, fitted = np.array(held).reshape(-1, problem.size), np.zeros(len(rows))
        both = np.vstack([gauged, rows[active]])
        weights, rest = fit_multipliers(both, -gradient * units, np.r_[np.full(len(gauged), True), equal[active]])
        fitted[active] = weights[len(gauged) :]
        left = rows.T @ np.concatenate(parts) + gradient * units
        left = left - gauged.T @ np.linalg.lstsq(gauged.T, left)[0]
        if rest >= np.linalg.norm(left):
            return found
        edges = np.cumsum([len(one) for one in self.constraints])[:-1]
        return _by_name(self.constraints, np.split(fitted, edges))


def to_point(problem: Problem, linear: Sequence[str], x: Values) -> Point:
    """Return the values of a problem as a point of its rank-one least squares."""
    (squares,) = problem.bilinear_terms
    products = {product.name: product for product in problem.products}
    ordered = [products[name] for name in squares.z if name in products]
    return Point(np.concatenate([*(flat(x[name]) for name in linear), np.zeros(0)]),
                 tuple(flat(x[one.mu]) for one in ordered), tuple(flat(x[one.b]) for one in ordered))


def sign_patterns(point: Point) -> Iterator[Point]:
    """Yield the same model with every pattern of signs of (mu_i, b_i)."""
    for pattern in range(2 ** min(len(point.bs), MOST_SIGNED)):
        signs = [-1.0 if pattern >> i & 1 else 1.0 for i in range(len(point.bs))]
        yield Point(point.w, tuple(s * m for s, m in zip(signs, point.mus)),
                    tuple(s * b for s, b in zip(signs, point.bs)))


def _by_name(constraints: Sequence[Constraint], parts: Sequence[Array]) -> dict[str, Array]:
    """Join the multipliers of the members of every group, in the order in which these were stated."""
    found: dict[str, list[tuple[int, Array]]] = {}
    for one, part in zip(constraints, parts):
        found.setdefault(one.name, []).append((one.position, part))
    return {name: np.concatenate([part for _, part in sorted(several, key=lambda pair: pair[0])])
            for name, several in found.items()}


def _parts(constraints: Sequence[Constraint], duals: Mapping[str, Array]) -> list[Array] | None:
    """Return the multipliers of every constraint out of those by name; None where some are missing."""
    if any(one.name not in duals for one in constraints):
        return None
    return [duals[one.name][one.first : one.first + len(one)] for one in constraints]


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

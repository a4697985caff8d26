"""Sequential quadratic programmes for least squares with products under constraints; with affine ones without CVXPY.

Constraints that are convex in the leaves, cones among them, enter a step (`RankOneStep`) as they are, and smooth others
by their tangents. A step for which the tangents are a poor model is corrected by solving for everything but b, which is
convex.
"""

from collections.abc import Iterator

import numpy as np

from optid.arrays import Array
from optid.backends.back_end import Answer
from optid.backends.conic import solve_least_squares
from optid.backends.rank_one_step import TINY, RankOneStep
from optid.certificate.lifting import certify_rank_one
from optid.core.constraint import join_by_name
from optid.core.least_squares import RankOneForm
from optid.core.problem import Problem
from optid.core.terms import Values, flat
from optid.program.solution import Status
from optid.structures.bilinear import starts
from optid.structures.rank_one import Point

STEPS = 100
DIRECTIONS = 4  # different directions b that are tried, each with both signs, before the full steps
SAME = 0.999  # cosine of two directions that are one
INSIDE = 1e-14  # violation that is none
MOST_SIGNED = 3  # blocks whose signs are all tried


class RankOneSQP:
    """The method on one problem.

    Args:
        problem: one term of squares with products, under constraints that do not depend on an iterate.
        form: its numbers.
        free: the minimum without the constraints.
    """

    def __init__(self, problem: Problem, form: RankOneForm, free: Point) -> None:
        self.problem, self.form, self.lifted, self.free = problem, form, form.problem, free
        self.model = RankOneStep(problem, self._values(free))
        self.products, self.squares, self.constraints = self.model.products, self.model.squares, self.model.constraints

    def solve(self, seed: int, directions: int, descents: int) -> Answer:
        """Try directions of b, follow the best ones to their ends, or to one that is quickly proved; return the best.

        The multipliers are flat, by constraint.
        """
        idle = self._idle()
        if idle is not None:
            return idle
        points = self._candidates(seed, directions)
        settled = [found for found in map(self._settle, points) if found is not None]
        if not settled:  # none of these directions is allowed: start from the nearest ones that are
            nearest = filter(None, map(self._allowed, points))
            settled = [found for found in map(self._settle, nearest) if found is not None]
        if not settled:
            return Answer(Status.FAILED, "no start satisfies the constraints", iterations=0)
        settled.sort(key=lambda pair: pair[0])
        distinct: list[dict[str, Array]] = []
        for _, x in settled:
            z = self._lift(x)
            if not any(np.allclose(z, self._lift(kept), 1e-3, 1e-6) for kept in distinct):
                distinct.append(x)
        ends = []
        for x in distinct[:descents]:
            ends.append(self._descend(x))
            end = ends[-1][1]
            if end.status is Status.LOCAL and certify_rank_one(self.problem, end.values, max_size=0)[0].proved:
                break
        return min(ends, key=lambda pair: pair[0])[1]

    # -- points

    def _values(self, point: Point) -> dict[str, Array]:
        return self.problem.in_gauge(self.form.unpack(point, self.problem.shapes))

    def _lift(self, x: Values) -> Array:
        return self.form.point(x).lift()

    def _candidates(self, seed: int, most: int) -> list[dict[str, Array]]:
        """Points with different directions of b, each with every pattern of signs."""
        core, free = self.lifted.core, self.free
        points = [self.form.point(self.problem.start)]
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

    def _idle(self) -> Answer | None:
        """Return the minimum without the constraints, where it satisfies them with one of its signs."""
        for point in sign_patterns(self.free):
            x = self._values(point)
            if self.problem.violation(x, self.constraints) <= INSIDE and self._in_gauge(x):
                duals = join_by_name(self.constraints, [np.zeros(len(one)) for one in self.constraints])
                return Answer(Status.LOCAL, "stationary; no constraint is active", x, duals, 0)
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
        found = solve_least_squares(np.eye(wanted.size), wanted, sides["zero"], sides["below"], self.model.settings)
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
        found = self.model.step(x, {}, pinned=True)
        if found is None:
            return None
        new = self.problem.in_gauge({**found[0], **{one.b: x[one.b] for one in self.products}})
        return self._merit(new, 0.0), new

    def _merit(self, x: Values, weight: float) -> float:
        """Return the sum of squares, and the violation of what multiplies unknowns, which a step may leave."""
        residual = self.squares.residual(self.problem.leaf_values(x))
        value = float(residual @ residual)
        return value + weight * self.problem.violation(x, self.model.bent) if weight and self.model.bent else value

    def _descend(self, x: dict[str, Array]) -> tuple[float, Answer]:
        """Follow the steps from x to their end; first its merit."""
        scale = self.lifted.scale
        weight, damping, floor = 1e-3 * scale + TINY, 0.0, 1e-9 * scale
        duals: dict[str, Array] = {}
        status, word, count = Status.LIMIT, "iteration limit", 0
        while status is Status.LIMIT and count < STEPS:
            count += 1
            found = self.model.step(x, duals, damping)
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
        return self._merit(x, weight), Answer(status, word, x, duals, count)


def sign_patterns(point: Point) -> Iterator[Point]:
    """Yield the same model with every pattern of signs of (mu_i, b_i)."""
    for pattern in range(2 ** min(len(point.bs), MOST_SIGNED)):
        signs = [-1.0 if pattern >> i & 1 else 1.0 for i in range(len(point.bs))]
        yield Point(point.w, tuple(s * m for s, m in zip(signs, point.mus)),
                    tuple(s * b for s, b in zip(signs, point.bs)))

"""Own Gauss-Newton for rank-one least squares; with constraints its steps are QPs of the same layer.

Without constraints the numbers are handled by `optid.structures.rank_one`. With constraints every step minimises the
quadratic model of the Lagrangian over the programme's own convex constraints and the tangents of the others. A
step for which the tangents are a poor model is corrected by solving for everything but b, which is convex.
"""

import cvxpy as cp
import numpy as np

from optid.backends.back_end import Answer, Settings
from optid.backends.choice import find
from optid.backends.rank_one_sqp import RankOneSQP, takes
from optid.backends.step_qp import Coordinates, StepQP
from optid.certificate.ladder import certify
from optid.certificate.lifting import certify_rank_one
from optid.core.problem import Problem
from optid.errors import StructureError
from optid.models.gauges import gauge_factor
from optid.program.expressions import flat_value
from optid.program.judging import measure_violation, term_size
from optid.program.limits import EQUALITIES, INEQUALITIES, spans
from optid.program.program import Program, Values
from optid.program.solution import Status
from optid.structures.bilinear import LocalSolution, minimise, starts
from optid.structures.least_squares import RankOneStructure, rank_one_of
from optid.structures.multipliers import fit_multipliers
from optid.structures.rank_one import Point

STEPS = 100
DIRECTIONS = 4  # different directions b that are tried, each with both signs, before the full steps
DESCENTS = 2  # how many of these are followed to the end


def run(program: Program, settings: Settings) -> Answer:
    """Solve a programme that carries a `RankOneStructure`.

    Options: ``inner`` (conic back end of the step QPs, default clarabel), ``starts`` (number of starts, default 8),
    ``seed`` of the random ones; under constraints ``directions`` (different b that are settled first, default 4) and
    ``descents`` (how many of these are then followed to their end, default 2).
    """
    form = rank_one_of(program)
    assert form is not None
    options = dict(settings.options)
    count, seed = int(options.get("starts", 8)), int(options.get("seed", 0))
    if not program.user_constraints:
        found = _minimum(program, form, count, seed)
        r = form.problem.root @ found.point.lift() - form.problem.target
        status, word = (Status.LOCAL, "stationary") if found.converged else (Status.LIMIT, "iteration limit")
        return Answer(status, word, to_values(program, form, found.point),
                      {"residual": -2.0 * r, "gauge": np.zeros(len(form.blocks))}, found.iterations)
    inner, directions = str(options.get("inner", "clarabel")), int(options.get("directions", DIRECTIONS))
    descents = int(options.get("descents", DESCENTS))
    if program.core is not None and inner == "clarabel" and takes(program.core):
        return _in_core(program, _minimum(program, form, count, seed).point, seed, directions, descents)
    return _Constrained(program, form, settings, inner).solve(count, seed, directions, descents)


def _in_core(program: Program, free: Point, seed: int, directions: int, descents: int) -> Answer:
    """Solve the problem of the core that a programme states."""
    problem: Problem = program.core

    def is_proved(x: Values, duals: Values) -> bool:
        return program.certify is not None and certify_rank_one(program, x, duals, max_size=0)[0].proved

    end = RankOneSQP(problem, program.start, free, is_proved).solve(seed, directions, descents)
    if not end.x:
        return Answer(end.status, end.word, iterations=end.steps)
    return Answer(end.status, end.word, end.x, end.duals, end.steps)


def _minimum(program: Program, form: RankOneStructure, count: int, seed: int) -> LocalSolution:
    """Descend from the programme's start, and from others where the instant proof fails there."""
    found = minimise(form.problem, form.point(program.start)) if program.start else None
    if found is not None and certify(form.problem, found.point, effort="instant").bound.proved:
        return found
    others = minimise(form.problem, count=count, seed=seed)
    return found if found is not None and found.value <= others.value else others


def to_values(program: Program, form: RankOneStructure, point: Point) -> dict[str, np.ndarray]:
    """Name the parts of a point, in the programme's gauge."""
    values = form.named(point, program.shapes)
    for (mu, b), direction in zip(form.blocks, point.bs):
        size = float(np.linalg.norm(direction)) or 1.0  # the sign stays: constraints may depend on it
        if form.gauge != "norm":
            size = gauge_factor(form.gauge, values.get("a", np.zeros(0)), np.asarray(direction, dtype=float), mu)
        values[mu], values[b] = values[mu] * size, values[b] / size
    return values


class _Constrained:
    """The constrained iteration on one programme."""

    def __init__(self, program: Program, form: RankOneStructure, settings: Settings, inner: str) -> None:
        self.program, self.form, self.problem = program, form, form.problem
        self.inner, self.settings = find(inner), Settings(accuracy=min(settings.accuracy, 1e-11), warm=False)
        self.at = Coordinates(program, form)
        point = minimise(form.problem, form.point(program.start)).point
        sizes = self.at.sizes(self.at.pack(to_values(program, form, point)))
        self.half, self.full = StepQP(self.at, sizes, pinned=True), StepQP(self.at, sizes, pinned=False)

    def solve(self, count: int, seed: int, directions: int, descents: int) -> Answer:
        free = _minimum(self.program, self.form, count, seed).point
        idle = self._idle(free)
        if idle is not None:
            return idle
        points = self._candidates(free, seed, directions)
        tried = [t for t in map(self._settle, points) if t is not None]
        if not tried:  # none of these directions is allowed: start from the nearest ones that are
            tried = [t for t in map(self._settle, self._allowed(points)) if t is not None]
        if not tried:
            return Answer(Status.FAILED, "no start satisfies the constraints")
        tried.sort(key=lambda pair: pair[0])
        distinct: list[np.ndarray] = []
        for _, x in tried:
            if not any(np.allclose(self._lift(x), self._lift(kept), 1e-3, 1e-6) for kept in distinct):
                distinct.append(x)
        found = []
        for x in distinct[:descents]:
            value, answer = self._iterate(x)
            found.append((value, answer))
            if self._is_proved(answer):
                break
        return min(found, key=lambda end: end[0])[1]

    def _is_proved(self, answer: Answer) -> bool:
        """Whether a point is the global optimum by one of the quick proofs, so that no other descent can better it."""
        if self.program.certify is None or answer.status is not Status.LOCAL:
            return False
        return certify_rank_one(self.program, answer.values, answer.duals, max_size=0)[0].proved

    def _candidates(self, free: Point, seed: int, most: int) -> list[Point]:
        """Points with different directions of b, each with every pattern of signs."""
        core = self.problem.core
        points = [self.form.point(self.program.start)] if self.program.start else []
        if most > DIRECTIONS:  # under signs of b an optimum may lie on one lag alone, and mu vanish all around it
            points = [Point(free.w, free.mus, (*free.bs[:i], axis, *free.bs[i + 1 :]))
                      for i, b in enumerate(free.bs) for axis in np.eye(b.size)] + points
        points += [free, *(core.point(*pair) for pair in starts(core, count=max(most, DIRECTIONS), seed=seed))]
        distinct: list[Point] = []
        for point in points:
            directions = [b / max(float(np.linalg.norm(b)), 1e-300) for b in point.bs]
            if not any(all(abs(float(d @ e)) > 0.999 for d, e in zip(directions, kept.bs)) for kept in distinct):
                distinct.append(Point(point.w, point.mus, tuple(directions)))
        return [signed for point in distinct[:most] for signed in _signed(point)]

    def _idle(self, free: Point) -> Answer | None:
        """The unconstrained solution, where it happens to satisfy every constraint with one of its signs."""
        for point in _signed(free):
            x = self._in_gauge(point)
            if x is None:
                continue
            self.program.assign(self.at.unpack(x))
            if measure_violation(self.program)[0] <= 1e-14:
                duals = {name: np.zeros(max((span.stop for span in spans(group)), default=0))
                         for name, group in self.program.constraints.items()}
                return Answer(Status.LOCAL, "stationary; no constraint is active", self.at.unpack(x),
                              {**duals, "residual": -2.0 * self._residual(x)}, 0)
        return None

    def _residual(self, x: np.ndarray) -> np.ndarray:
        return self.problem.root @ self._lift(x) - self.problem.target

    def _allowed(self, points: list[Point]) -> list[Point]:
        """Move every b to the nearest one that the convex constraints admit."""
        names = [name for _, name in self.form.blocks]
        wanted = [cp.Parameter(self.program.variables[name].shape) for name in names]
        distance = sum(cp.sum_squares(self.program.variables[name] - b) for name, b in zip(names, wanted))
        nearest = Program("nearest", cp.Minimize(distance),
                          {name: tuple(c for c in group if c.is_dcp())
                           for name, group in self.program.user_constraints.items()},
                          {name: self.program.variables[name] for name in names}, {}, dict, self.program.view)
        found = []
        for point in points:
            for b, value in zip(wanted, point.bs):
                b.value = np.reshape(value, b.shape, order="F")
            answer = self.inner.run(nearest, self.settings)
            if answer.values:
                bs = tuple(np.ravel(answer.values[name], order="F") for name in names)
                if all(np.linalg.norm(b) > 1e-6 for b in bs):
                    found.append(Point(point.w, point.mus, bs))
        return found

    def _settle(self, point: Point) -> tuple[float, np.ndarray] | None:
        """Solve for everything but b, which keeps its direction; None where the constraints forbid it."""
        x = self._in_gauge(point)
        if x is None:
            return None
        # with b fixed the residual is affine, so that one linearisation is exact
        self.half.set_model(x, {}, second_order=False)
        answer = self.half.run(self.inner, self.settings)
        found = self._in_gauge(self.form.point(answer.values)) if answer.values else None
        return None if found is None else (self._merit(found, 0.0), found)

    def _in_gauge(self, point: Point) -> np.ndarray | None:
        """Return a point as x, moved to the gauge along the scale between mu and b; None where it has none."""
        try:
            return self.at.pack(to_values(self.program, self.form, point))
        except StructureError:
            return None

    def _lift(self, x: np.ndarray) -> np.ndarray:
        return self.at.point(x).lift()

    def _merit(self, x: np.ndarray, weight: float) -> float:
        value = float(np.sum(self._residual(x) ** 2))
        if weight:
            self.at.assign(x)
            value += weight * sum(float(np.sum(np.abs(np.asarray(member.violation()))))
                                  for name, group in self.program.constraints.items() if name != "residual"
                                  for member in group if not member.is_dcp())
        return value

    def _iterate(self, x: np.ndarray) -> tuple[float, Answer]:
        weight, damping = 1e-3 * self.problem.scale + 1e-300, 0.0
        floor = 1e-9 * self.problem.scale
        multipliers: Values = {}
        status, word, count = Status.LIMIT, "iteration limit", 0
        while status is Status.LIMIT and count < STEPS:
            count += 1
            self.full.set_model(x, multipliers, damping=damping)
            answer = self.full.run(self.inner, self.settings)
            new = self._in_gauge(self.form.point(answer.values)) if answer.values else None
            size, before, after, rises = np.inf, 0.0, np.inf, True
            if new is not None:
                multipliers = answer.duals
                weight = max(weight, 2.0 * max(float(np.max(np.abs(d), initial=0.0)) for d in multipliers.values()))
                before, after = self._merit(x, weight), self._merit(new, weight)
                slack = 1e-11 * (before + floor)
                # measured on the lifted vector: b means nothing where mu is zero
                old, reached = self._lift(x), self._lift(new)
                size = float(np.linalg.norm(reached - old) / (1e-300 + np.linalg.norm(reached)))
                rises = after > before + slack and size > 1e-7
                # tangents are a poor model along a curved constraint: return to it by solving for all but b
                settled = self._settle(self.at.point(new)) if rises else None
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
        duals = {**self._multipliers(x, multipliers), "residual": -2.0 * self._residual(x)}
        return self._merit(x, weight), Answer(status, word, self.at.unpack(x), duals, count)

    def _multipliers(self, x: np.ndarray, found: Values) -> Values:
        """Return multipliers at x: those of the last step, or fitted to the gradient where that leaves less of it.

        A step has multipliers for the point that it reaches, which differ where it moved a b that means nothing.
        """
        self.at.assign(x)
        tangent, usual = self.at.point(x).tangent(), self.program.usual_sizes
        slope = 2.0 * tangent.T @ (self.problem.root.T @ self._residual(x))
        units = 1.0 / np.maximum(np.linalg.norm(self.problem.root @ tangent, axis=0), 1e-12)
        rows, given, equal, touched, sizes = [], [], [], [], {}
        for name, group in self.program.constraints.items():
            if name == "residual":
                continue
            if name not in found or not all(isinstance(member, EQUALITIES | INEQUALITIES) for member in group):
                return found
            for member in group:
                rows.append(self.full.slope(member.expr) * units)
                equal += [isinstance(member, EQUALITIES)] * member.size
                touched.append(flat_value(member.expr) > -1e-6 * term_size(member, usual))
            given.append(np.ravel(found[name]))
            sizes[name] = given[-1].size
        matrix, held = np.vstack(rows), np.array(equal)
        active = np.concatenate(touched) | held
        fitted = np.zeros(len(matrix))
        fitted[active], rest = fit_multipliers(matrix[active], -slope * units, held[active])
        if rest >= np.linalg.norm(matrix.T @ np.concatenate(given) + slope * units):
            return found
        return dict(zip(sizes, np.split(fitted, np.cumsum([*sizes.values()])[:-1])))


def _signed(point: Point) -> list[Point]:
    """The same model with every pattern of signs of (mu_i, b_i)."""
    found = []
    for pattern in range(2 ** min(len(point.bs), 3)):
        signs = [-1.0 if pattern >> i & 1 else 1.0 for i in range(len(point.bs))]
        found.append(Point(point.w, tuple(s * m for s, m in zip(signs, point.mus)),
                           tuple(s * b for s, b in zip(signs, point.bs))))
    return found

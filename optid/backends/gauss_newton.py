"""Own Gauss-Newton for rank-one least squares; with constraints its steps are QPs of the same layer.

Without constraints the numbers are handled by `optid.rank_one`. With constraints every step minimises the quadratic
model of the residual (with the exact second-order term of ``mu bᵀ`` where that is positive definite) subject to the
programme's own convex constraints; constraints that are bilinear are linearised. The QP is compiled once: its matrix
and right-hand side are parameters.
"""

from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from optid.backends import Answer, BackEnd, Settings, find
from optid.bilinear import minimise, starts
from optid.errors import StructureError
from optid.gauges import gauge_factor
from optid.lifting import places
from optid.program import Program, RankOneForm, Values
from optid.rank_one import Point, reduce
from optid.solution import Status

STEPS = 100
CANDIDATES = 4  # different directions b that are tried, each with both signs, before the full steps


def run(program: Program, settings: Settings) -> Answer:
    """Solve a programme that carries a `RankOneForm`.

    Options: ``inner`` (conic back end of the step QPs, default clarabel), ``starts`` (number of starts, default 8),
    ``seed`` of the random ones.
    """
    form = program.rank_one
    if form is None:
        return Answer(Status.FAILED, "the programme carries no rank-one least-squares structure")
    options = dict(settings.options)
    count, seed = int(options.get("starts", 8)), int(options.get("seed", 0))
    if not program.user_constraints:
        return _unconstrained(program, form, count, seed)
    return _Constrained(program, form, settings, str(options.get("inner", "clarabel"))).solve(count, seed)


def _unconstrained(program: Program, form: RankOneForm, count: int, seed: int) -> Answer:
    found = minimise(form.problem, count=count, seed=seed)
    if program.start:
        again = minimise(form.problem, start_point(form, program.start))
        found = again if again.value < found.value else found
    values = to_values(program, form, found.point)
    r = form.problem.root @ found.point.lift() - form.problem.target
    duals = {"residual": -2.0 * r, "gauge": np.zeros(len(form.blocks))}
    return Answer(Status.LOCAL if found.converged else Status.LIMIT,
                  "stationary" if found.converged else "iteration limit", values, duals, found.iterations)


def start_point(form: RankOneForm, start: Values) -> Point:
    """Read a point from named values."""
    w = np.concatenate([np.ravel(start[name], order="F") for name in form.linear] or [np.zeros(0)])
    return Point(w, tuple(np.asarray(start[mu], dtype=float) for mu, _ in form.blocks),
                 tuple(np.ravel(start[b], order="F") for _, b in form.blocks))


def to_values(program: Program, form: RankOneForm, point: Point) -> dict[str, np.ndarray]:
    """Name the parts of a point, in the programme's gauge."""
    values: dict[str, np.ndarray] = {}
    position = 0
    for name in form.linear:
        variable = program.variables[name]
        values[name] = np.reshape(point.w[position : position + variable.size], variable.shape, order="F")
        position += variable.size
    for (mu_name, b_name), mu, b in zip(form.blocks, point.mus, point.bs):
        size = float(np.linalg.norm(b)) or 1.0  # the sign stays: constraints may depend on it
        if form.gauge != "norm":
            size = gauge_factor(form.gauge, values.get("a", np.zeros(0)), b, mu_name)
        values[mu_name] = mu * size
        values[b_name] = np.reshape(b / size, program.variables[b_name].shape, order="F")
    return values


@dataclass(frozen=True)
class _Tangent:
    """A constraint that is not convex, linearised at every point: ``slope @ x + level <= 0`` or ``= 0``.

    Attributes:
        name: of its group.
        span: its rows in the multipliers of the group.
        expression: the left-hand side.
        slope: parameter (r, size).
        level: parameter (r,).
        rows: (E, f) where it reads ``E z <= f`` in the lifted vector, so that its curvature is known; otherwise None.
    """

    name: str
    span: slice
    expression: cp.Expression
    slope: cp.Parameter
    level: cp.Parameter
    rows: tuple[np.ndarray, np.ndarray] | None


@dataclass(frozen=True)
class _Step:
    """A compiled QP: minimise ``‖U x - t‖²`` over the programme's own variables and constraints."""

    program: Program
    matrix: cp.Parameter
    target: cp.Parameter
    pinned: tuple[cp.Parameter, ...]
    tangents: tuple[_Tangent, ...]


class _Constrained:
    """The constrained iteration on one programme."""

    def __init__(self, program: Program, form: RankOneForm, settings: Settings, inner: str) -> None:
        self.program, self.form, self.problem = program, form, form.problem
        self.inner, self.settings = find(inner), Settings(accuracy=min(settings.accuracy, 1e-11), warm=False)
        names = [*form.linear, *(name for pair in form.blocks for name in pair)]
        self.variables = [program.variables[name] for name in names]
        self.names, self.size = names, sum(v.size for v in self.variables)
        self.x = cp.hstack([v if v.ndim == 1 else cp.vec(v, order="F") for v in self.variables])
        self.linear = sum(program.variables[name].size for name in form.linear)
        self.places = places(program, form)

    def solve(self, count: int, seed: int) -> Answer:
        half, step = self._compile(pinned=True), self._compile(pinned=False)
        points = self._candidates(count, seed)
        tried = [t for t in (self._half_step(half, point) for point in points) if t is not None]
        if not tried:
            answer = self.inner.run(step.program, self.settings)
            status = answer.status if answer.status in (Status.INFEASIBLE, Status.UNBOUNDED) else Status.FAILED
            return Answer(status, f"the first step is {answer.word} (by {self.inner.name})")
        tried.sort(key=lambda pair: pair[0])
        first = tried[0][1]
        other = [x for _, x in tried[1:] if not np.allclose(self._lift(x), self._lift(first), 1e-3, 1e-6)]
        best: Answer | None = None
        value = np.inf
        for x in [first, *other[:1]]:
            answer, reached = self._iterate(step, x)
            if best is None or reached < value:
                best, value = answer, reached
        return best or Answer(Status.FAILED, f"the step QP failed (by {self.inner.name})")

    # the compiled problems

    def _compile(self, *, pinned: bool) -> _Step:
        matrix = cp.Parameter((self.size, self.size), value=np.eye(self.size))
        target = cp.Parameter(self.size, value=np.zeros(self.size))
        r = cp.Variable(self.size)
        constraints: dict[str, tuple] = {"model": (r == matrix @ self.x - target,)}
        tangents: list[_Tangent] = []
        pins: list[cp.Parameter] = []
        if pinned:
            for _, name in self.form.blocks:
                variable = self.program.variables[name]
                pin = cp.Parameter(variable.shape, value=np.zeros(variable.shape))
                pins.append(pin)
                constraints[f"pinned {name}"] = (variable == pin,)
        for name, group in self.program.constraints.items():
            if name == "residual" or (pinned and name == "gauge"):
                continue
            members, row = [], 0
            for member in group:
                span = slice(row, row + sum(dual.size for dual in member.dual_variables))
                row = span.stop
                if member.is_dcp():
                    members.append(member)
                    continue
                slope = cp.Parameter((member.size, self.size), value=np.zeros((member.size, self.size)))
                level = cp.Parameter(member.size, value=np.zeros(member.size))
                expression = slope @ self.x + level
                equal = isinstance(member, cp.constraints.Equality | cp.constraints.Zero)
                members.append(expression == 0 if equal else expression <= 0)
                tangents.append(_Tangent(name, span, member.expr, slope, level, self.places.rows(member)))
            constraints[name] = tuple(members)
        inner = Program("step", cp.Minimize(cp.sum_squares(r)), constraints,
                        {**{n: v for n, v in zip(self.names, self.variables)}, "_r": r}, {}, dict,
                        self.program.view)
        return _Step(inner, matrix, target, tuple(pins), tuple(tangents))

    def _run(self, step: _Step) -> Answer | None:
        answer = self.inner.run(step.program, self.settings)
        usable = answer.values and answer.status in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE, Status.LIMIT)
        return answer if usable else None

    # points

    def _candidates(self, count: int, seed: int) -> list[Point]:
        core = reduce(self.problem)
        points = [start_point(self.form, self.program.start)] if self.program.start else []
        points += [minimise(self.problem, count=count, seed=seed).point,
                  *(core.point(*pair) for pair in starts(core, count=CANDIDATES, seed=seed) if core.shapes)]
        distinct: list[Point] = []
        for point in points:
            directions = [b / max(float(np.linalg.norm(b)), 1e-300) for b in point.bs]
            if not any(all(abs(float(d @ e)) > 0.999 for d, e in zip(directions, kept.bs)) for kept in distinct):
                distinct.append(Point(point.w, point.mus, tuple(directions)))
        signed = []
        for point in distinct[:CANDIDATES]:
            for pattern in range(2 ** min(len(point.bs), 3)):
                signs = [-1.0 if pattern >> i & 1 else 1.0 for i in range(len(point.bs))]
                signed.append(Point(point.w, tuple(s * m for s, m in zip(signs, point.mus)),
                                    tuple(s * b for s, b in zip(signs, point.bs))))
        return signed

    def _half_step(self, half: _Step, point: Point) -> tuple[float, np.ndarray] | None:
        """Solve for everything but b, which is held in its gauge; None where the constraints forbid this b."""
        try:
            values = to_values(self.program, self.form, point)
        except StructureError:  # this direction cannot be scaled into the gauge
            return None
        for (_, name), pin in zip(self.form.blocks, half.pinned):
            pin.value = values[name]
        x = self._pack(values)
        # with b fixed the residual is affine, so that one linearisation is exact
        self._set_model(half, x, {}, second_order=False, damping=0.0)
        answer = self._run(half)
        if answer is None:
            return None
        x = self._pack(answer.values)
        return self._merit(x, 0.0), x

    def _pack(self, values: Values) -> np.ndarray:
        return np.concatenate([np.ravel(values[name], order="F") for name in self.names]).astype(float)

    def _parts(self, x: np.ndarray) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
        position, pairs = self.linear, []
        for p, q in self.problem.blocks:
            pairs.append((x[position : position + p], x[position + p : position + p + q]))
            position += p + q
        return x[: self.linear], pairs

    def _lift(self, x: np.ndarray) -> np.ndarray:
        w, pairs = self._parts(x)
        return np.concatenate([w, *(np.kron(b, mu) for mu, b in pairs)])

    def _slope_of_lift(self, x: np.ndarray) -> np.ndarray:
        """Jacobian (n, size) of the lifted vector."""
        _, pairs = self._parts(x)
        found = np.zeros((len(self.problem.target), self.size))
        found[: self.linear, : self.linear] = np.eye(self.linear)
        row = at = self.linear
        for mu, b in pairs:
            p, q = mu.size, b.size
            found[row : row + p * q, at : at + p] = np.kron(b[:, None], np.eye(p))
            found[row : row + p * q, at + p : at + p + q] = np.kron(np.eye(q), mu[:, None])
            row, at = row + p * q, at + p + q
        return found

    def _curvature(self, x: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Second derivatives of ``pullᵀ z`` at x, made definite along the scale between mu and b."""
        found = np.zeros((self.size, self.size))
        row = at = self.linear
        for mu, b in self._parts(x)[1]:
            p, q = mu.size, b.size
            own, other = slice(at, at + p), slice(at + p, at + p + q)
            found[own, other] = pull[row : row + p * q].reshape(p, q, order="F")
            found[other, own] = found[own, other].T
            if self.form.gauge == "norm":  # the linearised gauge fixes this direction; it only needs to be definite
                found[other, other] += np.outer(b, b) * float(mu @ mu)
            row, at = row + p * q, at + p + q
        return found

    def _set_model(self, step: _Step, x: np.ndarray, duals: Values, *, second_order: bool, damping: float) -> None:
        """Write the quadratic model of the Lagrangian at x into the QP's parameters."""
        z, lift = self._lift(x), self._slope_of_lift(x)
        residual = self.problem.root @ z - self.problem.target
        pull = self.problem.root.T @ residual
        for tangent in step.tangents:
            if tangent.rows is not None and tangent.name in duals:
                pull = pull + tangent.rows[0].T @ duals[tangent.name][tangent.span] / 2
        jacobian = self.problem.root @ lift
        gram = jacobian.T @ jacobian
        hessian = gram + self._curvature(x, pull) if second_order else gram
        diagonal = np.diag(gram)
        scale = np.sqrt(np.maximum(diagonal, 1e-14 * max(float(np.max(diagonal)), 1e-300)))
        shift = max(damping, 1e-12)
        factor = _cholesky(hessian / np.outer(scale, scale), shift)
        while factor is None and shift < 1e12:
            shift, hessian = (shift, gram) if hessian is not gram else (10.0 * shift, gram)
            factor = _cholesky(hessian / np.outer(scale, scale), shift)
        if factor is None:
            raise ValueError("the quadratic model cannot be made definite")
        upper = factor.T * scale
        self.unit = max(float(np.max(np.abs(upper))), 1e-300)
        step.matrix.value = upper / self.unit
        step.target.value = (upper @ x - np.linalg.solve(factor, jacobian.T @ residual / scale)) / self.unit
        self._assign(x)
        for tangent in step.tangents:
            if tangent.rows is not None:
                slope, level = tangent.rows[0] @ lift, tangent.rows[0] @ z - tangent.rows[1]
            else:
                slope, level = self._slope(tangent.expression), np.ravel(tangent.expression.value, order="F")
            tangent.slope.value = slope
            tangent.level.value = level - slope @ x

    def _slope(self, expression: cp.Expression) -> np.ndarray:
        """Jacobian of an expression at the assigned point."""
        gradients, parts = expression.grad, []
        for variable in self.variables:
            part = gradients.get(variable, np.zeros((variable.size, expression.size)))
            dense = part.toarray() if hasattr(part, "toarray") else np.asarray(part)
            parts.append(np.reshape(dense, (variable.size, expression.size)).T)
        return np.hstack(parts)

    def _retract(self, x: np.ndarray) -> np.ndarray:
        """Return to the gauge ``‖b‖ = 1`` along the scale between mu and b, on which the fit does not depend."""
        if self.form.gauge != "norm":
            return x
        found, at = x.copy(), self.linear
        for mu, b in self._parts(x)[1]:
            size = float(np.linalg.norm(b)) or 1.0
            found[at : at + mu.size] *= size
            found[at + mu.size : at + mu.size + b.size] /= size
            at += mu.size + b.size
        return found

    def _named(self, x: np.ndarray) -> dict[str, np.ndarray]:
        parts = np.split(x, np.cumsum([v.size for v in self.variables])[:-1])
        return {name: np.reshape(part, v.shape, order="F")
                for name, v, part in zip(self.names, self.variables, parts)}

    def _assign(self, x: np.ndarray) -> None:
        for name, value in self._named(x).items():
            self.program.variables[name].value = value

    def _merit(self, x: np.ndarray, weight: float) -> float:
        value = float(np.sum((self.problem.root @ self._lift(x) - self.problem.target) ** 2))
        if weight:
            self._assign(x)
            value += weight * sum(float(np.sum(np.abs(np.asarray(member.violation()))))
                                  for name, group in self.program.constraints.items() if name != "residual"
                                  for member in group if not member.is_dcp())
        return value

    def _iterate(self, step: _Step, x: np.ndarray) -> tuple[Answer, float]:
        weight, damping = 1e-3 * self.problem.scale + 1e-300, 0.0
        multipliers: Values = {}
        status, word, count = Status.LIMIT, "iteration limit", 0
        for count in range(1, STEPS + 1):
            self._set_model(step, x, multipliers, second_order=True, damping=damping)
            found = self._run(step)
            new = x if found is None else self._retract(self._pack(found.values))
            if found is not None:
                multipliers = self._duals(found)
                weight = max(weight, 2.0 * max(float(np.max(np.abs(d), initial=0.0)) for d in multipliers.values()))
            before, after = self._merit(x, weight), self._merit(new, weight)
            moved, reached = self._lift(new) - self._lift(x), self._lift(new)  # free of what b does where mu is zero
            size = float(np.linalg.norm(moved)) / (1e-300 + float(np.linalg.norm(reached)))
            if found is None or (after > before + 1e-11 * (before + 1e-9 * self.problem.scale) and size > 1e-7):
                damping = max(10.0 * damping, 1e-4)
                if damping > 1e8:
                    status, word = Status.INACCURATE, "no descent"
                    break
                continue
            x, damping = new, 0.1 * damping if damping > 1e-9 else 0.0
            if size < 1e-9 or (size < 1e-7 and before - after <= 1e-13 * (before + 1e-9 * self.problem.scale)):
                status, word = Status.LOCAL, "stationary"
                break
        duals = {**multipliers, "residual": -2.0 * (self.problem.root @ self._lift(x) - self.problem.target)}
        return Answer(status, word, self._named(x), duals, count), self._merit(x, weight)

    def _duals(self, found: Answer) -> dict[str, np.ndarray]:
        return {name: self.unit**2 * dual for name, dual in found.duals.items() if name in self.program.constraints}


def _cholesky(matrix: np.ndarray, shift: float) -> np.ndarray | None:
    try:
        return np.linalg.cholesky(matrix + shift * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return None


back_end = BackEnd("gauss_newton", frozenset({"rank-one"}), run, warm=True,
                   about="own Gauss-Newton for rank-one least squares; QPs of the same layer under constraints")


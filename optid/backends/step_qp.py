"""The quadratic programme of one Gauss-Newton step on a bilinear programme with constraints.

Convex constraints enter as they are, the others through their tangents. The model of the objective has the exact
second-order terms of ``mu bᵀ``, also where the constraints multiply it, and is made definite first across the active
constraints, where a step has no freedom anyway (Nocedal and Wright 2006, chapter 18). A programme is compiled once;
matrices and right-hand sides are parameters.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np

from optid.backends import Answer, BackEnd, Settings
from optid.certificate.lifting import places
from optid.gradients import jacobians
from optid.limits import EQUALITIES, INEQUALITIES
from optid.program import Program, RankOneForm, Values
from optid.rank_one import Point
from optid.solution import Status


@dataclass(frozen=True)
class Coordinates:
    """The unknowns of a bilinear programme as one vector x = [linear variables; mu_1; b_1; mu_2; ...].

    Attributes:
        program: the programme.
        form: its rank-one structure.
    """

    program: Program
    form: RankOneForm

    @property
    def names(self) -> list[str]:
        """Names of the variables in the order of x."""
        return [*self.form.linear, *(name for pair in self.form.blocks for name in pair)]

    @property
    def variables(self) -> list[cp.Variable]:
        """The variables in the order of x."""
        return [self.program.variables[name] for name in self.names]

    @property
    def size(self) -> int:
        """Length of x."""
        return sum(v.size for v in self.variables)

    def pack(self, values: Values) -> np.ndarray:
        """Return x for named values."""
        return np.concatenate([np.ravel(values[name], order="F") for name in self.names]).astype(float)

    def unpack(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return named values for x."""
        parts = np.split(x, np.cumsum([v.size for v in self.variables])[:-1])
        return {name: np.reshape(part, v.shape, order="F") for name, v, part in zip(self.names, self.variables, parts)}

    def assign(self, x: np.ndarray) -> None:
        """Write x into the CVXPY variables."""
        for name, value in self.unpack(x).items():
            self.program.variables[name].value = value

    def point(self, x: np.ndarray) -> Point:
        """Return x as a point of the rank-one problem."""
        position = self.form.problem.linear
        mus, bs = [], []
        for p, q in self.form.problem.blocks:
            mus.append(x[position : position + p])
            bs.append(x[position + p : position + p + q])
            position += p + q
        return Point(x[: self.form.problem.linear], tuple(mus), tuple(bs))

    def sizes(self, x: np.ndarray) -> dict[str, float]:
        """Natural size of every variable around x: how much of it would account for the whole record.

        Solvers stop at absolute tolerances, so the QPs are written in these units and not in those of the data.
        """
        problem = self.form.problem
        energy = np.linalg.norm(problem.root @ self.slope_of_lift(x), axis=0)
        reach, found, position = float(np.sqrt(problem.scale)), {}, 0
        for name, variable in zip(self.names, self.variables):
            largest = float(np.max(energy[position : position + variable.size]))
            found[name] = reach / largest if largest > 0 and reach > 0 else 1.0
            position += variable.size
        return found

    def slope_of_lift(self, x: np.ndarray) -> np.ndarray:
        """Jacobian (n, size) of the lifted vector z(x)."""
        point, linear = self.point(x), self.form.problem.linear
        found = np.zeros((len(self.form.problem.target), self.size))
        found[:linear, :linear] = np.eye(linear)
        row = at = linear
        for mu, b in zip(point.mus, point.bs):
            p, q = mu.size, b.size
            found[row : row + p * q, at : at + p] = np.kron(b[:, None], np.eye(p))
            found[row : row + p * q, at + p : at + p + q] = np.kron(np.eye(q), mu[:, None])
            row, at = row + p * q, at + p + q
        return found

    def curvature(self, x: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Second derivatives of ``pullᵀ z(x)``, made definite along the scale between mu and b."""
        point = self.point(x)
        found = np.zeros((self.size, self.size))
        row = at = self.form.problem.linear
        for mu, b in zip(point.mus, point.bs):
            p, q = mu.size, b.size
            own, other = slice(at, at + p), slice(at + p, at + p + q)
            found[own, other] = pull[row : row + p * q].reshape(p, q, order="F")
            found[other, own] = found[own, other].T
            if self.form.gauge == "norm":  # the linearised gauge fixes this direction; it only needs to be definite
                found[other, other] += np.outer(b, b) * float(mu @ mu)
            row, at = row + p * q, at + p + q
        return found


@dataclass(frozen=True)
class Tangent:
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


class StepQP:
    """``minimise ‖U x - t‖²`` over the programme's own variables and constraints, compiled once.

    Args:
        at: the programme and its coordinates.
        sizes: natural size of every variable; the QP is written in these units, and its constraints without units.
        pinned: hold every b at a parameter and drop the gauge; what is left is convex.
    """

    def __init__(self, at: Coordinates, sizes: Mapping[str, float], *, pinned: bool) -> None:
        self.at, self.tangents, self.sizes = at, [], dict(sizes)
        stand_ins = {name: cp.Variable(v.shape, name=name) for name, v in zip(at.names, at.variables)}
        self._swap = {id(v): sizes[name] * stand_ins[name] for name, v in zip(at.names, at.variables)}
        self._scale = np.concatenate([np.full(v.size, sizes[name]) for name, v in zip(at.names, at.variables)])
        self._units: dict[str, np.ndarray] = {}
        self._slopes: dict[int, np.ndarray] = {}
        self.matrix = cp.Parameter((at.size, at.size), value=np.eye(at.size))
        self.target = cp.Parameter(at.size, value=np.zeros(at.size))
        self.pins: dict[str, cp.Parameter] = {}
        self.unit = 1.0
        self._x = cp.hstack([v if v.ndim == 1 else cp.vec(v, order="F") for v in stand_ins.values()])
        r = cp.Variable(at.size)
        constraints: dict[str, tuple] = {"model": (r == self.matrix @ self._x - self.target,)}
        for _, name in at.form.blocks if pinned else ():
            variable = at.program.variables[name]
            self.pins[name] = cp.Parameter(variable.shape, value=np.zeros(variable.shape))
            constraints[f"pinned {name}"] = (stand_ins[name] == self.pins[name] / sizes[name],)
        where = places(at.program, at.form)
        for name, group in at.program.constraints.items():
            if name == "residual" or (pinned and name == "gauge"):
                continue
            spans = _spans(group)
            self._units[name] = np.ones(spans[-1].stop)
            constraints[name] = tuple(
                self._convex(name, member, span) if member.is_dcp()
                else self._tangent(name, member, span, where.rows(member)) for member, span in zip(group, spans))
        self.program = Program("step", cp.Minimize(cp.sum_squares(r)), constraints, {**stand_ins, "_r": r}, {}, dict,
                               at.program.view)

    def _convex(self, name: str, member: cp.Constraint, span: slice) -> cp.Constraint:
        """Write a convex constraint in the units of the QP; an affine one also with rows of size one."""
        if not isinstance(member, EQUALITIES | INEQUALITIES) or not member.expr.is_affine():
            return member.tree_copy(self._swap)
        slope = np.abs(self.slope(member.expr)) @ self._scale
        level = np.abs(np.ravel(member.expr.value, order="F"))
        unit = float(np.max(slope + level, initial=0.0)) or 1.0
        self._units[name][span] = unit
        expression = member.expr.tree_copy(self._swap) / unit
        return expression == 0 if isinstance(member, EQUALITIES) else expression <= 0

    def _tangent(self, name: str, member: cp.Constraint, span: slice, rows: tuple[np.ndarray, np.ndarray] | None
                 ) -> cp.Constraint:
        slope = cp.Parameter((member.size, self.at.size), value=np.zeros((member.size, self.at.size)))
        level = cp.Parameter(member.size, value=np.zeros(member.size))
        self.tangents.append(Tangent(name, span, member.expr, slope, level, rows))
        expression = slope @ cp.multiply(self._scale, self._x) + level
        return expression == 0 if isinstance(member, EQUALITIES) else expression <= 0

    def set_model(self, x: np.ndarray, duals: Values, *, second_order: bool = True, damping: float = 0.0) -> None:
        """Write the quadratic model of the Lagrangian at x into the parameters.

        Args:
            x: where.
            duals: multipliers of the step before.
            second_order: include the curvature of ``mu bᵀ``; not needed where b is pinned.
            damping: added to the diagonal of the scaled Hessian.
        """
        problem = self.at.form.problem
        z, lift = self.at.point(x).lift(), self.at.slope_of_lift(x)
        residual = problem.root @ z - problem.target
        pull = problem.root.T @ residual
        for tangent in self.tangents:
            if tangent.rows is not None and tangent.name in duals:
                pull = pull + tangent.rows[0].T @ duals[tangent.name][tangent.span] / 2
        jacobian = problem.root @ lift
        hessian = jacobian.T @ jacobian
        diagonal = np.diag(hessian)
        scale = np.sqrt(np.maximum(diagonal, 1e-8 * max(float(np.max(diagonal)), 1e-300)))
        if second_order:
            hessian = hessian + self.at.curvature(x, pull)
        scaled, shift = hessian / np.outer(scale, scale), max(damping, 1e-12)
        factor = _cholesky(scaled, shift)
        if factor is None:
            factor = _definite(scaled, self._active(duals, x) / scale, shift)
        upper = factor.T * (scale * self._scale)
        self.unit = max(float(np.max(np.abs(upper))), 1e-300)
        self.matrix.value = upper / self.unit
        descent = np.linalg.solve(factor, jacobian.T @ residual / scale)
        self.target.value = (upper @ (x / self._scale) - descent) / self.unit
        self.at.assign(x)
        for tangent in self.tangents:
            if tangent.rows is not None:
                slope, level = tangent.rows[0] @ lift, tangent.rows[0] @ z - tangent.rows[1]
            else:
                slope, level = self.slope(tangent.expression), np.ravel(tangent.expression.value, order="F")
            tangent.slope.value = slope
            tangent.level.value = level - slope @ x

    def run(self, back_end: BackEnd, settings: Settings) -> Answer:
        """Solve; the multipliers are those of the objective of the programme itself."""
        answer = back_end.run(self.program, settings)
        duals = {name: self.unit**2 * answer.duals[name] / units
                 for name, units in self._units.items() if name in answer.duals}
        values = {name: self.sizes[name] * answer.values[name] for name in self.sizes if name in answer.values}
        usable = answer.status in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE, Status.LIMIT)
        return Answer(answer.status, answer.word, values if usable else {}, duals)

    def _active(self, duals: Values, x: np.ndarray) -> np.ndarray:
        """Gradients (r, size) of the equalities and of the inequalities with a multiplier, at x."""
        self.at.assign(x)
        found = [np.zeros((0, self.at.size))]
        least = 1e-6 * max((float(np.max(np.abs(dual), initial=0.0)) for dual in duals.values()), default=0.0)
        for name, group in self.at.program.constraints.items():
            for member, span in zip(group, _spans(group)) if name in duals else ():
                if isinstance(member, EQUALITIES):
                    found.append(self.slope(member.expr))
                elif isinstance(member, INEQUALITIES):
                    found.append(self.slope(member.expr)[duals[name][span] > least])
        return np.vstack(found)

    def slope(self, expression: Any) -> np.ndarray:
        """Jacobian (r, size) of an expression at the assigned point; formed once where it is constant."""
        if expression.is_affine():
            if expression.id not in self._slopes:
                self._slopes[expression.id] = self._jacobian(expression)
            return self._slopes[expression.id]
        return self._jacobian(expression)

    def _jacobian(self, expression: cp.Expression) -> np.ndarray:
        slopes = jacobians(expression) or {}
        return np.hstack([slopes[v].toarray() if v in slopes else np.zeros((expression.size, v.size))
                          for v in self.at.variables])


def _spans(group: tuple[cp.Constraint, ...]) -> list[slice]:
    """Rows of every member in the multipliers of its group."""
    edges = np.cumsum([0, *(sum(dual.size for dual in member.dual_variables) for member in group)])
    return [slice(int(a), int(b)) for a, b in zip(edges[:-1], edges[1:])]


def _cholesky(matrix: np.ndarray, shift: float) -> np.ndarray | None:
    try:
        return np.linalg.cholesky(matrix + shift * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return None


def _definite(matrix: np.ndarray, rows: np.ndarray, shift: float) -> np.ndarray:
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

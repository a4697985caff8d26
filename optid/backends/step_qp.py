"""The quadratic programme of one Gauss-Newton step on a bilinear programme with constraints.

Convex constraints enter as they are, the others through their tangents. The model of the objective has the exact
second-order terms of ``mu bᵀ``, also where the constraints multiply it, and is made definite first across the active
constraints, where a step has no freedom anyway (Nocedal and Wright 2006, chapter 18).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from optid.backends.back_end import Answer, BackEnd, Settings
from optid.backends.conic import solve_least_squares
from optid.certificate.lifting import places
from optid.program.expressions import affine_parts, flat, flat_value, jacobians, side_by_side
from optid.program.limits import EQUALITIES, INEQUALITIES, spans
from optid.program.program import Program, Values
from optid.program.solution import Status
from optid.structures.least_squares import RankOneStructure
from optid.structures.rank_one import Point


@dataclass(frozen=True)
class Coordinates:
    """The unknowns of a bilinear programme as one vector x = [linear variables; mu_1; b_1; mu_2; ...]."""

    program: Program
    form: RankOneStructure

    @cached_property
    def variables(self) -> list[cp.Variable]:
        """The variables in the order of x."""
        return [self.program.variables[name] for name in self.form.names]

    @property
    def size(self) -> int:
        """Length of x."""
        return sum(v.size for v in self.variables)

    def pack(self, values: Values) -> np.ndarray:
        """Return x for named values."""
        return np.concatenate([np.ravel(values[name], order="F") for name in self.form.names]).astype(float)

    def unpack(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Return named values for x."""
        return self.form.named(self.point(x), self.program.shapes)

    def assign(self, x: np.ndarray) -> None:
        """Write x into the CVXPY variables."""
        for name, value in self.unpack(x).items():
            self.program.variables[name].value = value

    @cached_property
    def blocks(self) -> list[tuple[slice, slice, slice]]:
        """The places of vec(mu_i b_iᵀ) in z, and of mu_i and b_i in x."""
        found, at = [], self.form.problem.linear
        for where, (p, q) in zip(self.form.problem.slices, self.form.problem.blocks):
            found.append((where, slice(at, at + p), slice(at + p, at + p + q)))
            at += p + q
        return found

    def point(self, x: np.ndarray) -> Point:
        """Return x as a point of the rank-one problem."""
        return Point(x[: self.form.problem.linear], tuple(x[mu] for _, mu, _ in self.blocks),
                     tuple(x[b] for _, _, b in self.blocks))

    def sizes(self, x: np.ndarray) -> dict[str, float]:
        """Natural size of every variable around x: how much of it would account for the whole record.

        Solvers stop at absolute tolerances, so the QPs are written in these units and not in those of the data.
        """
        problem = self.form.problem
        energy = np.linalg.norm(problem.root @ self.point(x).tangent(), axis=0)
        reach, largest = float(np.sqrt(problem.scale)), {n: float(np.max(e)) for n, e in self.unpack(energy).items()}
        return {name: reach / one if one > 0 and reach > 0 else 1.0 for name, one in largest.items()}

    def curvature(self, x: np.ndarray, pull: np.ndarray) -> np.ndarray:
        """Second derivatives of ``pullᵀ z(x)``, made definite along the scale between mu and b."""
        found = np.zeros((self.size, self.size))
        for where, mu, b in self.blocks:
            found[mu, b] = pull[where].reshape(x[mu].size, -1, order="F")
            found[b, mu] = found[mu, b].T
            if self.form.gauge == "norm":  # the linearised gauge fixes this direction; it only needs to be definite
                found[b, b] += np.outer(x[b], x[b]) * float(x[mu] @ x[mu])
        return found


@dataclass(eq=False)
class _Rows:
    """A constraint of a step, ``slope @ x + level <= 0`` or ``= 0`` in the units of the programme."""

    name: str  # of its group
    span: slice  # its rows in the multipliers of the group
    member: cp.Constraint
    unit: float  # the rows are divided by it
    slope: np.ndarray  # (r, size)
    level: np.ndarray  # (r,)
    lifted: tuple[np.ndarray, np.ndarray] | None = None  # (E, f) where it reads E z <= f: its curvature is known

    @property
    def equality(self) -> bool:
        """Whether it is an equality."""
        return isinstance(self.member, EQUALITIES)


class StepQP:
    """``minimise ‖U x - t‖²`` over the programme's own variables and constraints, with matrices that change.

    With affine constraints and tangents alone it goes straight to Clarabel; with cones or variables of a constraint's
    own, or to another back end, it goes through CVXPY, compiled once.

    Args:
        at: the programme and its coordinates.
        sizes: natural size of every variable; the QP is written in these units, and its constraints without units.
        pinned: hold every b at its value in the model and drop the gauge; what is left is convex.
    """

    def __init__(self, at: Coordinates, sizes: Mapping[str, float], *, pinned: bool) -> None:
        self.at, self.sizes = at, dict(sizes)
        self.rows: list[_Rows] = []
        self.cones: list[tuple[str, slice, cp.Constraint]] = []
        named = list(zip(at.form.names, at.variables))
        self._scale = np.concatenate([np.full(v.size, sizes[name]) for name, v in named])
        bs = [b for _, b in at.form.blocks] if pinned else []
        self._pins = np.concatenate([np.full(v.size, name in bs) for name, v in named])
        self._slopes: dict[int, np.ndarray] = {}
        self._where = places(at.program, at.form)
        for name, group in at.program.constraints.items():
            if name != "residual" and not (pinned and name == "gauge"):
                for member, span in zip(group, spans(group)):
                    self._add(name, member, span)
        self.rows.sort(key=lambda row: not row.equality)  # stable

    def _add(self, name: str, member: cp.Constraint, span: slice) -> None:
        if isinstance(member, EQUALITIES | INEQUALITIES) and not member.is_dcp():
            empty = np.zeros((member.size, self.at.size))
            self.rows.append(_Rows(name, span, member, 1.0, empty, empty[:, 0], self._where.rows(member)))
            return
        parts = affine_parts(member.expr) if isinstance(member, EQUALITIES | INEQUALITIES) else None
        if parts is None or {v.id for v in parts[0]} - {v.id for v in self.at.variables}:
            self.cones.append((name, span, member))
            return
        slope, level = side_by_side(parts[0], self.at.variables, member.size), parts[1]
        unit = float(np.max(np.abs(slope) @ self._scale + np.abs(level), initial=0.0)) or 1.0
        self.rows.append(_Rows(name, span, member, unit, slope, level))

    def set_model(self, x: np.ndarray, duals: Values, *, second_order: bool = True, damping: float = 0.0) -> None:
        """Take the quadratic model of the Lagrangian at x, with the last step's multipliers, and the tangents there.

        The curvature of ``mu bᵀ`` is not needed where b is pinned; damping adds to the diagonal of the scaled Hessian.
        """
        problem = self.at.form.problem
        point = self.at.point(x)
        z, lift = point.lift(), point.tangent()
        residual = problem.root @ z - problem.target
        pull = problem.root.T @ residual
        for row in self.rows:
            if row.lifted is not None and row.name in duals:
                pull = pull + row.lifted[0].T @ duals[row.name][row.span] / 2
        self.at.assign(x)
        for row in self.rows:
            if row.lifted is not None:
                row.slope, value = row.lifted[0] @ lift, row.lifted[0] @ z - row.lifted[1]
            elif not row.member.is_dcp():  # its tangent
                row.slope, value = self.slope(row.member.expr), flat_value(row.member.expr)
            else:
                continue
            row.level = value - row.slope @ x
        jacobian = problem.root @ lift
        hessian = jacobian.T @ jacobian
        diagonal = np.diag(hessian)
        scale = np.sqrt(np.maximum(diagonal, 1e-8 * max(float(np.max(diagonal)), 1e-300)))
        if second_order:
            hessian = hessian + self.at.curvature(x, pull)
        scaled, shift = hessian / np.outer(scale, scale), max(damping, 1e-12)
        factor = _cholesky(scaled, shift)
        if factor is None:
            factor = _definite(scaled, self._active(duals) / scale, shift)
        upper = factor.T * (scale * self._scale)
        self._unit = max(float(np.max(np.abs(upper))), 1e-300)
        descent = np.linalg.solve(factor, jacobian.T @ residual / scale)
        self._model = upper / self._unit, (upper @ (x / self._scale) - descent) / self._unit
        self._held = x[self._pins] / self._scale[self._pins]

    def run(self, back_end: BackEnd, settings: Settings) -> Answer:
        """Solve; the multipliers are those of the objective of the programme itself."""
        if back_end.name == "clarabel" and not self.cones:
            answer = self._directly(settings)
        else:
            program, matrices = self._programme
            for parameter, value in zip(matrices, self._matrices()):
                parameter.value = value
            answer = back_end.run(program, settings)
        usable = answer.status in (Status.OPTIMAL, Status.LOCAL, Status.INACCURATE, Status.LIMIT)
        values = {name: size * answer.values[name] for name, size in self.sizes.items() if name in answer.values}
        known = self.at.program.constraints
        duals = {name: self._unit**2 * dual for name, dual in answer.duals.items() if name in known}
        for row in self.rows:
            if row.name in duals:
                duals[row.name][row.span] /= row.unit
        return replace(answer, values=values if usable else {}, duals=duals)

    def _directly(self, settings: Settings) -> Answer:
        matrix, target, held, *parts = self._matrices()
        pins = np.eye(self.at.size)[self._pins]
        sides = [(slope, -level) for slope, level in zip(parts[::2], parts[1::2])]
        equal = sum(row.equality for row in self.rows)
        found = solve_least_squares(matrix, target, [(pins, held), *sides[:equal]], sides[equal:], settings)
        if not found.values:
            return found
        edges = np.cumsum([len(pins), *(right.size for _, right in sides)])
        duals = {name: np.zeros(max(row.span.stop for row in self.rows if row.name == name))
                 for name in dict.fromkeys(row.name for row in self.rows)}
        for row, start, stop in zip(self.rows, edges, edges[1:]):
            duals[row.name][row.span] = found.duals["rows"][start:stop]
        return replace(found, values=self.at.unpack(found.values["x"]), duals=duals)

    def _matrices(self) -> list[np.ndarray]:
        """Model, target and held values, then slope and level of all rows, in the units of the QP."""
        return [*self._model, self._held, *(part for row in self.rows for part in (
            row.slope * self._scale / row.unit, row.level / row.unit))]

    @cached_property
    def _programme(self) -> tuple[Program, list[cp.Parameter]]:
        """The step in CVXPY, and its parameters in the order of `_matrices`."""
        at = self.at
        stand_ins = {name: cp.Variable(v.shape, name=name) for name, v in zip(at.form.names, at.variables)}
        swap = {id(v): self.sizes[name] * stand_ins[name] for name, v in zip(at.form.names, at.variables)}
        x = cp.hstack([flat(v) for v in stand_ins.values()])
        matrices = [cp.Parameter(value.shape, value=value) for value in self._matrices()]
        r = cp.Variable(at.size)
        groups: dict[str, list] = {"model": [r == matrices[0] @ x - matrices[1]]}
        if self._pins.any():
            groups["pins"] = [x[np.flatnonzero(self._pins)] == matrices[2]]
        members: dict[str, list[tuple[int, cp.Constraint]]] = {}
        for row, slope, level in zip(self.rows, matrices[3::2], matrices[4::2]):
            expression = slope @ x + level
            members.setdefault(row.name, []).append(
                (row.span.start, expression == 0 if row.equality else expression <= 0))
        for name, span, member in self.cones:
            members.setdefault(name, []).append((span.start, member.tree_copy(swap)))
        for name, parts in members.items():
            groups[name] = [member for _, member in sorted(parts, key=lambda part: part[0])]
        return Program("step", cp.Minimize(cp.sum_squares(r)), {name: tuple(group) for name, group in groups.items()},
                       {**stand_ins, "_r": r}, {}, dict, at.program.view), matrices

    def _active(self, duals: Values) -> np.ndarray:
        """Gradients (r, size) of the equalities and of the inequalities with a multiplier."""
        least = 1e-6 * max((float(np.max(np.abs(dual), initial=0.0)) for dual in duals.values()), default=0.0)
        found = [row.slope if row.equality else row.slope[duals[row.name][row.span] > least]
                 for row in self.rows if row.name in duals]
        return np.vstack([np.zeros((0, self.at.size)), *found])

    def slope(self, expression: Any) -> np.ndarray:
        """Jacobian (r, size) of an expression at the assigned point; formed once where it is constant."""
        if expression.id not in self._slopes or not expression.is_affine():
            self._slopes[expression.id] = side_by_side(jacobians(expression) or {}, self.at.variables, expression.size)
        return self._slopes[expression.id]


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

"""Read the user's constraints as statements about the lifted vector ``z = [w; vec Theta]``, and certify with them.

A certificate needs every constraint in one of two forms: linear in z, or a cone ``C mu >= 0`` whose sign ``b``
carries. Anything else leaves the fit without a proof, and the reason names the constraint.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cvxpy as cp
import numpy as np
from cvxpy.constraints.constraint import Constraint

from optid.certificate.ladder import certify
from optid.program.gradients import affine_parts
from optid.program.limits import EQUALITIES, INEQUALITIES
from optid.program.program import Program, Values
from optid.program.solution import Bound
from optid.structures.least_squares import RankOneStructure, rank_one_of
from optid.structures.rank_one import Point, RankOne


@dataclass
class Lifted:
    """Constraints in the two forms a certificate understands.

    Attributes:
        size: length of z.
        rows: rows E of ``E z <= f`` (or ``=``), their right-hand sides and whether they are equalities.
        cones: {block: rows C of ``C mu >= 0``}.
        directions: {block: rows B of ``B b >= 0``}.
        refused: name of the first constraint that has neither form, "" where all have.
    """

    size: int
    rows: list[np.ndarray] = field(default_factory=list)
    right: list[float] = field(default_factory=list)
    equality: list[bool] = field(default_factory=list)
    cones: dict[int, np.ndarray] = field(default_factory=dict)
    directions: dict[int, np.ndarray] = field(default_factory=dict)
    refused: str = ""

    def add(self, rows: np.ndarray, right: np.ndarray, equal: bool) -> None:
        """Append rows ``rows @ z <= right`` or ``=``."""
        self.rows += list(rows)
        self.right += [float(value) for value in right]
        self.equality += [equal] * len(rows)

    def add_products(self, problem: RankOne) -> list[int]:
        """Turn constraints on both factors of a block into rows on Theta, and return the blocks with some on b alone.

        ``B b >= 0`` and ``C mu >= 0`` imply ``C Theta Bᵀ >= 0``.
        """
        alone = []
        for i, rows in self.directions.items():
            if i not in self.cones:
                alone.append(i)
                continue
            start, (p, q) = _block_starts(problem)[i], problem.blocks[i]
            cone = self.cones[i]  # it stays: the products alone also hold where b has no component along them
            products = np.zeros((len(rows) * len(cone), self.size))
            products[:, start : start + p * q] = np.kron(-rows, cone)
            self.add(products, np.zeros(len(products)), False)
        return alone

    def linear(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return (E, f, equality mask), or None without rows."""
        if not self.rows:
            return None
        return np.array(self.rows), np.array(self.right), np.array(self.equality, dtype=bool)


def certify_rank_one(program: Program, values: Values, duals: Values, max_size: int = 700
                     ) -> tuple[Bound, Values | None]:
    """Certify a point of a rank-one programme under its user constraints.

    Args:
        program: a programme with a `RankOneStructure`.
        values: the point.
        duals: multipliers by constraint; not needed, because the certificate computes its own.
        max_size: number of multipliers above which the semidefinite relaxation is not attempted.

    Returns:
        The bound, and values to restart from where the relaxation proposes a better point.
    """
    form = rank_one_of(program)
    if form is None:
        return Bound.none(f"no proof: {program.name!r} has no rank-one structure left"), None
    lifted = lift_exact(program, form)
    if lifted.refused:
        return Bound.none(f"no proof: constraint {lifted.refused!r} is not linear in (a, Theta, offset) and not a cone "
                          "on mu"), None
    problem, point, swapped = _oriented(form.problem, _point(form, values), lifted)
    found = certify(problem, point, cones=lifted.cones or None, linear=lifted.linear(), max_size=max_size)
    if not found.better or swapped:
        return found.bound, None
    return found.bound, _named(program, form, found.better[0])


def _point(form: RankOneStructure, values: Values) -> Point:
    w = np.concatenate([np.ravel(values[name], order="F") for name in form.linear] or [np.zeros(0)])
    return Point(w, tuple(np.asarray(values[mu]) for mu, _ in form.blocks),
                 tuple(np.ravel(values[b], order="F") for _, b in form.blocks))


def _named(program: Program, form: RankOneStructure, point: Point) -> Values:
    found, position = {}, 0
    for name in form.linear:
        size = program.variables[name].size
        found[name] = np.reshape(point.w[position : position + size], program.variables[name].shape, order="F")
        position += size
    for (mu_name, b_name), mu, b in zip(form.blocks, point.mus, point.bs):
        found[mu_name], found[b_name] = mu, np.reshape(b, program.variables[b_name].shape, order="F")
    return found


def _oriented(problem: RankOne, point: Point, lifted: Lifted) -> tuple[RankOne, Point, bool]:
    """Settle constraints on b: products with those on mu are linear in Theta; alone, the block is transposed."""
    transposed, starts = lifted.add_products(problem), _block_starts(problem)
    if not transposed:
        return problem, point, False
    order, blocks = np.arange(lifted.size), list(problem.blocks)
    mus, bs = list(point.mus), list(point.bs)
    for i in transposed:
        p, q = blocks[i]
        span = slice(starts[i], starts[i] + p * q)
        order[span] = order[span].reshape(q, p).T.ravel()
        blocks[i], mus[i], bs[i] = (q, p), bs[i], mus[i]
        lifted.cones[i] = lifted.directions[i]
    lifted.rows = [row[order] for row in lifted.rows]
    triangle = np.triu(np.linalg.qr(np.column_stack([problem.root[:, order], problem.target]), mode="r"))
    turned = RankOne(triangle[: lifted.size, :-1], triangle[: lifted.size, -1], problem.remainder, tuple(blocks),
                     problem.linear, problem.scale)
    return turned, Point(point.w, tuple(mus), tuple(bs)), True


def _block_starts(problem: RankOne) -> list[int]:
    return [int(v) for v in problem.linear + np.cumsum([0, *(p * q for p, q in problem.blocks)])]


def _columns(program: Program, names: Sequence[str]) -> dict[int, int]:
    """First column of every named variable, by id, where they follow one another from column 0."""
    variables = [program.variables[name] for name in names]
    return dict(zip((v.id for v in variables), np.cumsum([0, *(v.size for v in variables)]).tolist()))


def lift_linear(program: Program, names: Sequence[str], size: int) -> Lifted:
    """Bring the user constraints of a programme in which no product is left into rows on the named variables."""
    lifted, columns = Lifted(size), _columns(program, names)
    for name, group in program.user_constraints.items():
        for member in group:
            found = _rows(member, columns, size) if isinstance(member, EQUALITIES | INEQUALITIES) else None
            if found is None:
                lifted.refused = lifted.refused or name
            else:
                lifted.add(*found, isinstance(member, EQUALITIES))
    return lifted


@dataclass(frozen=True)
class Places:
    """Where the variables of a bilinear programme stand in the lifted vector z.

    Attributes:
        size: length of z.
        columns: {id of a variable: its first column}.
        stand_in: {id of the expression mu bᵀ: the variable that stands for it}.
    """

    size: int
    columns: dict[int, int]
    stand_in: dict[int, cp.Variable]

    def rows(self, member: Constraint) -> tuple[np.ndarray, np.ndarray] | None:
        """Return (E, f) of a constraint that reads ``E z <= f`` or ``E z = f``, or None where it does not."""
        return _rows(member.tree_copy(self.stand_in), self.columns, self.size)


def places(program: Program, form: RankOneStructure) -> Places:
    """Lay the linear variables and the matrices ``mu bᵀ`` of a programme out in z."""
    problem = form.problem
    columns, stand_in = _columns(program, form.linear), {}
    for shape, start, (mu, _) in zip(problem.blocks, _block_starts(problem), form.blocks):
        theta = cp.Variable(shape)
        stand_in[id(program.view.inner["Theta" + mu[len("mu"):]])] = theta
        columns[theta.id] = start
    return Places(len(problem.target), columns, stand_in)


def lift_exact(program: Program, form: RankOneStructure) -> Lifted:
    """Bring the user constraints of a bilinear programme into lifted form."""
    problem = form.problem
    lifted, where = Lifted(len(problem.target)), places(program, form)
    starts = _block_starts(problem)
    mus = {program.variables[mu].id: i for i, (mu, _) in enumerate(form.blocks)}
    bs = {program.variables[b].id: i for i, (_, b) in enumerate(form.blocks)}
    for name, group in program.user_constraints.items():
        for member in group:
            if not isinstance(member, EQUALITIES | INEQUALITIES):
                lifted.refused = lifted.refused or name
                continue
            equal = isinstance(member, EQUALITIES)
            ids = {v.id for v in member.variables()}
            only = next(iter(ids)) if len(ids) == 1 else None
            if only in mus and member.expr.is_affine():
                fits = _lift_mu(lifted, member, problem, starts, mus[only], equal, form.gauge)
            elif only in bs and member.expr.is_affine():
                fits = _lift_b(lifted, member, problem, starts, bs[only], equal)
            else:
                found = where.rows(member)
                fits = found is not None
                if found is not None:
                    lifted.add(*found, equal)
            if not fits:
                lifted.refused = lifted.refused or name
    return lifted


def _rows(member: Constraint, columns: Mapping[int, int], size: int) -> tuple[np.ndarray, np.ndarray] | None:
    found = affine_parts(member.expr)
    if found is None or any(v.id not in columns for v in found[0]):
        return None
    slopes, constant = found
    rows = np.zeros((constant.size, size))
    for variable, slope in slopes.items():
        rows[:, columns[variable.id] : columns[variable.id] + variable.size] = slope.toarray()
    return rows, -constant


def _of_one_variable(member: Constraint) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian (rows, size) and constant of an affine constraint in one variable."""
    found = affine_parts(member.expr)
    assert found is not None
    slopes, constant = found
    (slope,) = slopes.values()
    return slope.toarray(), constant


def _lift_mu(lifted: Lifted, member: Constraint, problem: RankOne, starts: list[int], i: int, equal: bool,
             gauge: str) -> bool:
    jacobian, constant = _of_one_variable(member)
    p, q = problem.blocks[i]
    homogeneous = not np.any(constant)
    if homogeneous and not equal:
        lifted.cones[i] = np.vstack([lifted.cones.get(i, np.zeros((0, p))), -jacobian])
        return True
    if not homogeneous and gauge != "b0":
        return False
    # S mu = 0 means S Theta = 0; with b_0 = 1 the first column of Theta is mu itself
    lags = range(q) if homogeneous else range(1)
    for j in lags:
        rows = np.zeros((len(jacobian), lifted.size))
        rows[:, starts[i] + j * p : starts[i] + (j + 1) * p] = jacobian
        lifted.add(rows, -constant, equal)
    return True


def _lift_b(lifted: Lifted, member: Constraint, problem: RankOne, starts: list[int], i: int, equal: bool) -> bool:
    jacobian, constant = _of_one_variable(member)
    p, q = problem.blocks[i]
    if np.any(constant):
        return False
    if not equal:
        lifted.directions[i] = np.vstack([lifted.directions.get(i, np.zeros((0, q))), -jacobian])
        return True
    rows = np.zeros((len(jacobian) * p, lifted.size))
    rows[:, starts[i] : starts[i] + p * q] = np.kron(jacobian, np.eye(p))
    lifted.add(rows, np.zeros(len(rows)), True)
    return True


def certify_nuclear(problem: RankOne, heights: np.ndarray, program: Program, values: Values, duals: Values
                    ) -> tuple[Bound, None]:
    """Bound ``‖R z - s‖² + remainder + 2 sum tau_c ‖Theta_c‖_*`` under linear constraints by its own dual.

    For any nu with ``R_wᵀ nu + E_wᵀ lambda = 0`` and ``‖mat(R_cᵀ nu + E_cᵀ lambda)‖_2 <= 2 tau_c`` the value
    ``remainder - nuᵀ s - ‖nu‖²/4 - lambdaᵀ f`` is a lower bound; nu is the residual at the point, projected and scaled.

    Args:
        problem: R, s and the remainder.
        heights: (inputs,) tau_c per unit of the programme's parameter "weight".
        program: the programme.
        values: the point.
        duals: multipliers by constraint.
    """
    taus = heights * float(np.asarray(program.parameters["weight"].value))
    names = [name for name in program.variables if name != "residual"]
    lifted = lift_linear(program, names, len(problem.target))
    if lifted.refused:
        return Bound.none(f"no proof: constraint {lifted.refused!r} is not linear"), None
    for name in program.user_constraints:
        if name not in duals:
            return Bound.none(f"no proof: the solver gave no multiplier of {name!r}"), None
    multipliers = [duals[name] for name in program.user_constraints]
    z = np.concatenate([np.ravel(values[name], order="F") for name in names])
    nu = 2.0 * (problem.root @ z - problem.target)
    linear = lifted.linear()
    pull, cost = np.zeros(len(z)), 0.0
    lam = np.concatenate(multipliers) if multipliers else np.zeros(0)
    if linear is not None:
        lam = np.where(linear[2], lam, np.maximum(lam, 0.0))
        pull, cost = linear[0].T @ lam, float(lam @ linear[1])
    free = len(z) if not np.any(taus) else problem.linear
    nu = nu - np.linalg.lstsq(problem.root[:, :free].T, problem.root[:, :free].T @ nu + pull[:free], rcond=None)[0]
    shrink = 1.0
    position = problem.linear
    if np.any(taus):
        for (p, q), tau in zip(problem.blocks, taus):
            part = (problem.root[:, position : position + p * q].T @ nu + pull[position : position + p * q])
            shrink = min(shrink, 2.0 * tau / max(float(np.linalg.norm(part.reshape(q, p), 2)), 1e-300))
            position += p * q
    bound = problem.remainder - shrink * float(nu @ problem.target) - shrink**2 * float(nu @ nu) / 4 - shrink * cost
    matrices = [values[name] for name in names if name.startswith("Theta")]
    value = problem.value(z) + 2.0 * sum(tau * float(np.linalg.norm(matrix, "nuc"))
                                         for tau, matrix in zip(taus, matrices))
    gap = problem.gap(value, bound)
    proved = gap <= 1e-6
    kind = "the penalised convex problem, not the rank-one problem behind it"
    reason = f"optimal for {kind}: relative gap {gap:.1e}" if proved else f"not proved for {kind}: gap {gap:.1e}"
    return Bound(bound, proved, "nuclear dual", reason, multipliers=(shrink * nu, shrink * lam)), None

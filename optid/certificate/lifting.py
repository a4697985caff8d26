"""Read the user's constraints as statements about the lifted vector ``z = [w; vec Theta]``, and certify with them.

A certificate needs every constraint in one of two forms: linear in z, or a cone ``C mu >= 0`` whose sign ``b``
carries. Anything else leaves the fit without a proof, and the reason names the constraint.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from optid.certificate.ladder import certify
from optid.certificate.shape_duals import LinearRows
from optid.core.least_squares import LeastSquaresForm, RankOneForm
from optid.core.leaves import positions
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.program.solution import Bound, relative_gap
from optid.structures.rank_one import Point, RankOne

MAX_SIZE = 700  # multipliers up to which the semidefinite relaxation is tried


@dataclass
class Lifted:
    """Constraints in the two forms a certificate understands."""

    linear: LinearRows  # the rows on z
    cones: dict[int, np.ndarray] = field(default_factory=dict)  # {block: rows C of ``C mu >= 0``}
    directions: dict[int, np.ndarray] = field(default_factory=dict)  # {block: rows B of ``B b >= 0``}
    refused: str = ""  # name of the first constraint that has neither form, "" where all have

    def add(self, rows: np.ndarray, right: np.ndarray, equal: bool) -> None:
        """Append rows ``rows @ z <= right`` or ``=``."""
        old = self.linear
        self.linear = LinearRows(np.vstack([old.rows, rows]), np.append(old.right, right),
                                 np.append(old.equality, np.full(len(rows), equal)))

    def add_products(self, problem: RankOne) -> list[int]:
        """Turn constraints on both factors of a block into rows on Theta, and return the blocks with some on b alone.

        ``B b >= 0`` and ``C mu >= 0`` imply ``C Theta Bᵀ >= 0``.
        """
        alone = []
        for i, rows in self.directions.items():
            if i not in self.cones:
                alone.append(i)
                continue
            cone = self.cones[i]  # it stays: the products alone also hold where b has no component along them
            products = np.zeros((len(rows) * len(cone), len(problem.target)))
            products[:, problem.slices[i]] = np.kron(-rows, cone)
            self.add(products, np.zeros(len(products)), False)
        return alone


def certify_rank_one(problem: Problem, values: Values, max_size: int = MAX_SIZE) -> tuple[Bound, Values | None]:
    """Return the bound at a point under user constraints, and values to restart from where it proposes a better point.

    The multipliers are the certificate's own; the semidefinite relaxation is not attempted above ``max_size`` of them.
    """
    form = RankOneForm.of(problem)
    assert form is not None
    lifted = lift(problem, form)
    if lifted.refused:
        return Bound.none(f"no proof: constraint {lifted.refused!r} is not linear in (a, Theta, offset) and not a cone "
                          "on mu"), None
    numbers, point, swapped = _oriented(form.problem, form.point(values), lifted)
    found = certify(numbers, point, cones=lifted.cones, linear=lifted.linear, max_size=max_size)
    if not found.better or swapped:
        return found.bound, None
    return found.bound, form.unpack(found.better[0], {name: np.shape(one) for name, one in problem.start.items()})


def _oriented(problem: RankOne, point: Point, lifted: Lifted) -> tuple[RankOne, Point, bool]:
    """Settle constraints on b: products with those on mu are linear in Theta; alone, the block is transposed."""
    transposed = lifted.add_products(problem)
    if not transposed:
        return problem, point, False
    order, blocks = np.arange(len(problem.target)), list(problem.blocks)
    mus, bs = list(point.mus), list(point.bs)
    for i in transposed:
        (p, q), span = blocks[i], problem.slices[i]
        order[span] = order[span].reshape(q, p).T.ravel()
        blocks[i], mus[i], bs[i] = (q, p), bs[i], mus[i]
        lifted.cones[i] = lifted.directions[i]
    lifted.linear = replace(lifted.linear, rows=lifted.linear.rows[:, order])
    triangle = np.triu(np.linalg.qr(np.column_stack([problem.root[:, order], problem.target]), mode="r"))
    turned = RankOne(triangle[: len(order), :-1], triangle[: len(order), -1], problem.remainder, tuple(blocks),
                     problem.linear, problem.scale)
    return turned, Point(point.w, tuple(mus), tuple(bs)), True


def lift(problem: Problem, form: LeastSquaresForm, names: Collection[str] | None = None) -> Lifted:
    """Bring the constraints of a problem into lifted form, all of them or the named ones."""
    held = [one for one in problem.constraints() if names is None or one.name in names]
    if not held:
        return Lifted(LinearRows.none(len(form.problem.target)))
    (squares,) = (term for term in problem.terms if isinstance(term, Squares))
    space, names = problem.space, set(squares.z)
    where = positions(space.places, squares.z)
    factors = {name: (i, name == pair[0]) for i, pair in enumerate(form.blocks) for name in pair}
    lifted = Lifted(LinearRows.none(len(form.problem.target)))
    for one in held:
        used = {name for name, place in space.places.items() if one.rows[:, place].any()}
        equal, fits = one.cone == "zero", False
        if one.cone in ("zero", "below") and used <= names:
            lifted.add(one.rows[:, where], one.right, equal)
            fits = True
        elif one.cone in ("zero", "below") and len(used) == 1 and (name := next(iter(used))) in factors:
            fits = _lift_factor(lifted, form, *factors[name], one.rows[:, space.places[name]], one.right, equal)
        if not fits:
            lifted.refused = lifted.refused or one.name
    return lifted


def _lift_factor(lifted: Lifted, form: LeastSquaresForm, i: int, of_mu: bool, rows: np.ndarray, right: np.ndarray,
                 equal: bool) -> bool:
    """Lift rows on one factor of a block, mu or b; False where they have no lifted form."""
    p, q = form.problem.blocks[i]
    homogeneous = not np.any(right)
    if homogeneous and not equal:
        cones = lifted.cones if of_mu else lifted.directions
        cones[i] = np.vstack([cones.get(i, np.zeros((0, rows.shape[1]))), -rows])
        return True
    if not homogeneous and not (of_mu and form.gauge == "b0"):
        return False
    # S mu = 0 means S Theta = 0; with b_0 = 1 the first column of Theta is mu itself
    products = np.kron(np.eye(q)[: q if homogeneous else 1], rows) if of_mu else np.kron(rows, np.eye(p))
    wide = np.zeros((len(products), len(form.problem.target)))
    wide[:, form.problem.slices[i]] = products
    lifted.add(wide, np.resize(right, len(wide)), equal)
    return True


def certify_nuclear(posed: Problem, values: Values, duals: Values) -> Bound:
    """Bound ``‖R z - s‖² + remainder + 2 sum tau_c ‖Theta_c‖_*`` under linear constraints by its own dual.

    z names the unknowns, the last ones Theta; the norms have the weights 2 tau_c. For any nu with
    ``R_wᵀ nu + E_wᵀ lambda = 0`` and ``‖mat(R_cᵀ nu + E_cᵀ lambda)‖_2 <= 2 tau_c`` the value
    ``remainder - nuᵀ s - ‖nu‖²/4 - lambdaᵀ f`` is a lower bound; nu is the residual at the point, projected and scaled.
    """
    squares, norms = posed.terms
    problem, z = squares.lifted, squares.z
    taus = np.array([norms.weights[name] for name in z[-len(problem.blocks) :]]) / 2
    form = LeastSquaresForm(problem, z)
    lifted = lift(posed, form)
    if lifted.refused:
        return Bound.none(f"no proof: constraint {lifted.refused!r} is not linear")
    for name in posed.constraint_names:
        if name not in duals:
            return Bound.none(f"no proof: the solver gave no multiplier of {name!r}")
    point = form.flat(values)
    nu = 2.0 * (problem.root @ point - problem.target)
    lam = np.concatenate([np.zeros(0), *(duals[name] for name in posed.constraint_names)])
    lam = np.where(lifted.linear.equality, lam, np.maximum(lam, 0.0))
    pull, cost = lifted.linear.rows.T @ lam, float(lam @ lifted.linear.right)
    free = len(point) if not np.any(taus) else problem.linear
    nu = nu - np.linalg.lstsq(problem.root[:, :free].T, problem.root[:, :free].T @ nu + pull[:free], rcond=None)[0]
    parts = [(problem.root[:, where].T @ nu + pull[where]).reshape(q, p)
             for where, (p, q) in zip(problem.slices, problem.blocks)]
    shrink = min([1.0, *(2.0 * tau / max(float(np.linalg.norm(part, 2)), 1e-300) for part, tau in zip(parts, taus))]
                 ) if np.any(taus) else 1.0
    bound = problem.remainder - shrink * float(nu @ problem.target) - shrink**2 * float(nu @ nu) / 4 - shrink * cost
    value = problem.value(point) + norms.value(values)
    gap = relative_gap(value, bound, problem.scale)
    proved = gap <= 1e-6
    kind = "the penalised convex problem, not the rank-one problem behind it"
    reason = f"optimal for {kind}: relative gap {gap:.1e}" if proved else f"not proved for {kind}: gap {gap:.1e}"
    return Bound(bound, proved, "nuclear dual", reason, multipliers=(shrink * nu, shrink * lam))

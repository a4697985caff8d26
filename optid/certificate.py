"""Proofs of global optimality for least squares in rank-one blocks.

A ladder, cheapest first. *Instant*: the combination of 2 x 2 minors that the gradient at the point dictates, and one
Cholesky factorisation. *Ascent*: alternating projections over the remaining minors. *SDP*: all minors (and, with shape
constraints, products of constraints), whose moment matrix proposes a better point when the proof fails. Every bound is
recomputed in closed form from its multipliers after a Cholesky check; nothing is copied from a solver.
"""

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from optid.ascent import ascend, rotation
from optid.errors import StructureError
from optid.minors import Lagrangian, project_minors, tangent_minors
from optid.rank_one import Array, Core, Point, RankOne, matrices, reduce
from optid.shape_duals import Linear, Multipliers, as_cones, as_linear, kkt_multipliers, sign_free_cut
from optid.solution import Bound

TOLERANCE = 1e-8
EFFORTS = ("instant", "ascent", "sdp")


@dataclass(frozen=True, eq=False)
class Evidence:
    """Multipliers of a bound, in the whitened coordinates of ``core``.

    Attributes:
        core: coordinates; ``core.whitening.matrix()`` is the change K.
        minors: (k, k) combination of minors.
        cuts: by block, weights (r, r, nb, nb): ``cuts[j, k]`` is the matrix W >= 0 of the product of rows j and k.
        linear: (r,) multipliers of the constraints on the lifted vector.
    """

    core: Core
    minors: Array
    cuts: dict[int, Array]
    linear: Array

    def forms(self) -> Array:
        """The quadratic form of the minors in the original coordinates of the core (k, k)."""
        change = self.core.whitening.matrix()
        return change.T @ self.minors @ change


@dataclass(frozen=True, eq=False)
class Certification:
    """Outcome of an attempt to prove a point.

    Attributes:
        bound: lower bound on the global optimum.
        gap: (F - D) / max(F, 1e-9 Y^T Y).
        better: candidates for a better point, to restart a local method from; only from the SDP.
    """

    bound: Bound
    gap: float
    better: tuple[Point, ...] = ()


@dataclass(frozen=True, eq=False)
class Case:
    """What the stages share, in whitened coordinates; block indices are those of the core.

    Attributes:
        problem: the problem.
        core: its reduction.
        mus: (P_i,) each, oriented so that C mu >= 0.
        bs: (nb_i,) each, of unit length.
        lagrangian: the objective with the linear terms at the KKT multipliers.
        cones: constraint matrices by block.
        multipliers: KKT multipliers.
        linear: constraints on the lifted vector.
        began: clock at the start.
    """

    problem: RankOne
    core: Core
    mus: list[Array]
    bs: list[Array]
    lagrangian: Lagrangian
    cones: dict[int, Array]
    multipliers: Multipliers
    linear: Linear | None
    began: float

    @property
    def blocks(self) -> list[tuple[slice, tuple[int, int]]]:
        """Position and shape of every block of the core."""
        edges = np.cumsum([self.core.linear, *(p * nb for p, nb in self.core.shapes)])
        return [(slice(int(a), int(b)), shape) for a, b, shape in zip(edges[:-1], edges[1:], self.core.shapes)]

    def cut_form(self, cuts: dict[int, Array]) -> Array | None:
        """The (k, k) form of the weights ``cuts[i]`` (r, r, nb, nb) of products of cone rows."""
        if not cuts:
            return None
        form = np.zeros_like(self.lagrangian.gram)
        for i, weights in cuts.items():
            cone, where = self.cones[i], self.blocks[i][0]
            tensor = np.einsum("rsjl,rp,sq->jplq", weights, cone, cone, optimize=True)
            part = tensor.reshape(form[where, where].shape)
            form[where, where] = (part + part.T) / 2
        return form


def certify(problem: RankOne, point: Point, *, cones: Any = None, linear: Any = None, effort: str = "sdp",
            steps: int = 100, core: Core | None = None) -> Certification:
    """Bound the global optimum from below and try to prove that a local solution attains it.

    Args:
        problem: the least-squares problem.
        point: a local solution, of the constrained problem where there are constraints.
        cones: by block, None or C_i (r_i, P_i): C_i mu_i >= 0 while the sign of b_i is free.
        linear: (E, f, equality) on the lifted vector z = [w; vec Theta]: E z <= f, or = where the mask is set.
        effort: last rung of the ladder: "instant", "ascent" or "sdp".
        steps: of the ascent, one eigenvalue decomposition each.
        core: the reduced problem if at hand; used only without constraints.

    Returns:
        The bound, its gap and, after an SDP that did not prove the point, points to restart from.

    Raises:
        StructureError: constraints of a wrong shape, an unknown effort.
    """
    if effort not in EFFORTS:
        raise StructureError(f"effort must be one of {EFFORTS}, not {effort!r}")
    case = prepare(problem, point, as_cones(cones, problem), as_linear(linear, problem), core)
    if not case.core.shapes and case.linear is None:
        return conclude(case, "exact", "linear least squares", case.lagrangian.gram, {})
    minors, cuts = tangent(case)
    found = conclude(case, "instant", "one Cholesky factorisation", minors, cuts)
    if found.bound.proved or effort == "instant":
        return found
    risen, taken = rise(case, minors, cuts, steps)
    if risen is not None:
        found = conclude(case, "ascent", f"{taken} projections", risen, cuts)
    if found.bound.proved or effort == "ascent":
        return found
    return found


def prepare(problem: RankOne, point: Point, cones: dict[int, Array], linear: Linear | None,
            core: Core | None = None) -> Case:
    """Reduce, whiten, find the KKT multipliers and add the linear terms to the objective."""
    began = perf_counter()
    keep_linear = linear is not None and bool(linear.rows[:, :problem.linear].any())
    if core is None or cones or linear is not None:
        keep = tuple(cones) if linear is None else tuple(range(len(problem.blocks)))
        core = reduce(problem, keep, keep_linear)
    w, mus, bs = core.factors(point)
    white = {core.kept.index(i): core.whitening.cone(core.kept.index(i), cone) for i, cone in cones.items()}
    for i, cone in white.items():
        if (cone @ mus[i]).sum() < 0:
            mus[i], bs[i] = -mus[i], -bs[i]
    z = np.concatenate([w, *(np.kron(b, mu) for mu, b in zip(mus, bs))])
    residual = core.root @ z - core.target
    slope = core.root.T @ residual
    value = float(residual @ residual) + problem.remainder
    if linear is not None:
        rows = linear.rows if keep_linear else linear.rows[:, problem.linear:]
        linear = Linear(core.whitening.columns(rows), linear.right, linear.equality)
    multipliers = kkt_multipliers(slope, core.shapes, core.linear, mus, bs, white, linear, z)
    lagrangian = Lagrangian(core.gram, z, slope, value)
    if linear is not None:
        lagrangian = lagrangian.with_linear(linear.rows, linear.slack(z)[0], multipliers.linear)
    return Case(problem, core, mus, bs, lagrangian, white, multipliers, linear, began)


def tangent(case: Case) -> tuple[Array, dict[int, Array]]:
    """Minors and cuts that cancel the gradient at the point, block by block; none for a block that is zero."""
    minors, cuts = np.zeros_like(case.lagrangian.gram), {}
    negligible = 1e-10 * float(np.linalg.norm(case.lagrangian.z))
    gradients = matrices(case.lagrangian.slope[case.core.linear:], case.core.shapes)
    for i, ((where, _), mu, b, gradient) in enumerate(zip(case.blocks, case.mus, case.bs, gradients)):
        size = float(np.linalg.norm(mu))
        if size <= negligible:
            continue
        if i in case.cones:
            weights = sign_free_cut(case.multipliers.cones[i], case.cones[i], mu)
            cuts[i] = np.multiply.outer(weights, np.outer(b, b))
        gradient = gradient - np.outer(gradient @ b, b)
        gradient = gradient - np.outer(mu, mu @ gradient) / size**2
        minors[where, where] = tangent_minors(-gradient, mu, b)
    return minors, cuts


def rise(case: Case, minors: Array, cuts: dict[int, Array], steps: int) -> tuple[Array | None, int]:
    """Ascent from the tangent multipliers; the improved minors, or None, and the steps taken."""
    form = case.cut_form(cuts)
    matrix = case.lagrangian.gram + minors - (0.0 if form is None else form)
    turn = rotation(case.core.linear, case.mus, case.bs)
    free, taken = ascend(turn.T @ matrix @ turn, case.core.shapes, case.core.linear, steps)
    if free is None:
        return None, taken
    return minors + onto_minors(case, turn @ free @ turn.T), taken


def onto_minors(case: Case, matrix: Array) -> Array:
    """Remove the roundoff of a change of coordinates: exactly a combination of minors again."""
    clean = np.zeros_like(matrix)
    for where, shape in case.blocks:
        clean[where, where] = project_minors(matrix[where, where], shape)
    return clean


def conclude(case: Case, method: str, how: str, minors: Array, cuts: dict[int, Array],
             better: tuple[Point, ...] = ()) -> Certification:
    """Recompute the bound from its multipliers and say what it proves."""
    value = case.lagrangian.value
    bound = float(case.lagrangian.bound(minors, case.cut_form(cuts)))
    gap = float(case.problem.gap(value, bound))
    proved = gap <= TOLERANCE
    if proved:
        reason = f"globally optimal, relative gap {gap:.1e}: {how}"
    elif np.isfinite(bound):
        reason = f"not proved, relative gap {gap:.1e}: {how}"
    else:
        reason = f"not proved, no finite bound: {how}"
    evidence = Evidence(case.core, minors, cuts, case.multipliers.linear)
    return Certification(Bound(bound, proved, method, reason, perf_counter() - case.began, evidence), gap, better)

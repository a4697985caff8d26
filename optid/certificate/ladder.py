"""Proofs of global optimality for least squares in rank-one blocks.

A ladder, cheapest first. *Instant*: the combination of 2 x 2 minors that the gradient at the point dictates, and one
Cholesky factorisation. *Ascent*: alternating projections over the remaining minors. *SDP*: all minors (and, with shape
constraints, products of constraints), whose moment matrix proposes a better point when the proof fails. Every bound is
recomputed in closed form from its multipliers after a Cholesky check; nothing is copied from a solver.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optid.certificate.minors import Block, Quadratic, ascend, free_mask, project_minors, rotation, tangent_minors
from optid.certificate.sdp import relax, relaxation_size
from optid.certificate.shape_duals import ACTIVE, LinearRows, align_cuts, kkt_multipliers, sign_free_cut
from optid.errors import StructureError
from optid.program.solution import Bound, relative_gap
from optid.structures.rank_one import Array, Core, Point, RankOne, matrices, reduce
from optid.structures.whitening import block_slices, invert_triangular

TOLERANCE = 1e-8
SAME = 1e-10  # relative difference of two objectives below which a proof of one is a proof of the other
PARTS = (0.9, 0.7, 0.5, 0.25, 0.0)
SHRINKS = (0.0, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
EFFORTS = ("instant", "ascent", "sdp")


@dataclass(frozen=True, eq=False)
class Multipliers:
    """What a bound can be recomputed from, in the whitened coordinates of ``core``."""

    core: Core  # coordinates; ``core.whitening.columns`` is the change of coordinates
    minors: Array  # (k, k) combination of minors
    # by block, weights (r, r, nb, nb): ``cuts[j, k]`` is the matrix W >= 0 of the product of rows j and k
    cuts: dict[int, Array]
    linear: Array  # (r,) multipliers of the constraints on the lifted vector


@dataclass(frozen=True, eq=False)
class Certification:
    """Outcome of an attempt to prove a point."""

    bound: Bound  # lower bound on the global optimum
    better: tuple[Point, ...] = ()  # candidates for a better point, to restart a local method from; only from the SDP


@dataclass(frozen=True, eq=False)
class LadderCase:
    """What the stages share, in whitened coordinates around the point; block indices are those of the core."""

    core: Core
    mus: list[Array]  # (P_i,) each, oriented so that C mu >= 0
    bs: list[Array]  # (nb_i,) each, of unit length
    objective: Quadratic
    cones: dict[int, Array]
    nu: dict[int, Array]  # KKT multipliers (r_i,) of the cones
    lam: Array  # and (r,) of the linear constraints
    linear: LinearRows

    @cached_property
    def blocks(self) -> list[Block]:
        """Position and shape of every block of the core."""
        return list(zip(block_slices(self.core.shapes, self.core.linear), self.core.shapes))

    @cached_property
    def vanishing(self) -> list[bool]:
        """Whether a block is zero: its minors are then all free, and its gradient must vanish by itself."""
        size = float(np.linalg.norm(self.objective.z))
        return [bool(np.linalg.norm(mu) <= 1e-10 * size) for mu in self.mus]

    @cached_property
    def masks(self) -> list[np.ndarray]:
        """Entries of the minors that do not touch the gradient at the point, in rotated coordinates, by block."""
        return [np.ones((p * nb, p * nb), bool) if vanishes else free_mask((p, nb))
                for vanishes, (p, nb) in zip(self.vanishing, self.core.shapes)]

    def violation(self) -> float:
        """Largest violation of the constraints at the point, relative to the size of their terms."""
        found = [np.zeros(1)]
        for i, cone in self.cones.items():
            terms = np.abs(cone) @ np.abs(self.mus[i])
            found.append(-(cone @ self.mus[i]) / np.maximum(terms, np.finfo(float).tiny))
        slack, terms = self.linear.slack(self.objective.z)
        found.append(np.where(self.linear.equality, np.abs(slack), -slack) / np.maximum(terms, np.finfo(float).tiny))
        return float(np.concatenate(found).max())

    def lagrangian(self, multipliers: Array | None = None) -> Quadratic:
        """The objective with the linear terms, at the KKT multipliers or others."""
        chosen = self.lam if multipliers is None else multipliers
        slope = self.objective.slope + chosen @ self.linear.rows / 2
        return replace(self.objective, slope=slope, linear_terms=-float(
            chosen @ self.linear.slack(self.objective.z)[0]))

    def cut_form(self, cuts: dict[int, Array]) -> Array:
        """The (k, k) form of the weights ``cuts[i]`` (r, r, nb, nb) of products of cone rows."""
        form = np.zeros_like(self.objective.gram)
        for i, weights in cuts.items():
            cone, where = self.cones[i], self.blocks[i][0]
            tensor = np.einsum("rsjl,rp,sq->jplq", weights, cone, cone, optimize=True)
            part = tensor.reshape(form[where, where].shape)
            form[where, where] = (part + part.T) / 2
        return form


def certify(problem: RankOne, point: Point, *, cones: Mapping[int, Array] | None = None,
            linear: LinearRows | None = None, effort: str = "sdp", steps: int = 100, max_size: int = 700
            ) -> Certification:
    """Bound the global optimum from below and try to prove that a local solution attains it.

    Args:
        problem: the least-squares problem.
        point: a local solution, of the constrained problem where there are constraints.
        cones: by block C_i (r_i, P_i): C_i mu_i >= 0 while the sign of b_i is free.
        linear: constraints on the lifted vector z = [w; vec Theta].
        effort: last rung of the ladder: "instant", "ascent" or "sdp".
        steps: of the ascent, one eigenvalue decomposition each.
        max_size: number of multipliers above which the SDP is not attempted.

    Returns:
        The bound and, after an SDP that did not prove the point, points to restart from.

    Raises:
        StructureError: an unknown effort.
    """
    if effort not in EFFORTS:
        raise StructureError(f"effort must be one of {EFFORTS}, not {effort!r}")
    if not cones and (linear is None or not len(linear.right)):
        return _remembered(problem, point, effort, steps, max_size)
    return _climb(problem, point, cones or {}, linear or LinearRows.none(len(problem.target)), effort, steps, max_size)


def _remembered(problem: RankOne, point: Point, effort: str, steps: int, max_size: int) -> Certification:
    """Certify without constraints; a bound holds everywhere, and so proves every point of the same objective."""
    value = problem.value(point.lift())
    for reached, found in problem.proofs:
        if abs(value - reached) <= SAME * reached:
            return found
    found = _climb(problem, point, {}, LinearRows.none(len(problem.target)), effort, steps, max_size)
    if found.bound.proved:
        problem.proofs[:] = [(value, found)]
    return found


def _climb(problem: RankOne, point: Point, cones: Mapping[int, Array], linear: LinearRows, effort: str, steps: int,
           max_size: int) -> Certification:
    """Certify rung by rung, up to the last one requested or the first that proves the point."""
    case = prepare(problem, point, cones, linear)
    if not case.core.shapes and not len(linear.right):
        return conclude(case, "exact", "linear least squares", case.objective.gram, {})
    cuts = {i: np.multiply.outer(sign_free_cut(case.nu[i], cone, case.mus[i]), np.outer(case.bs[i], case.bs[i]))
            for i, cone in case.cones.items()}  # they cancel what the constraints leave of the gradient
    minors = tangent(case, cuts)
    found = conclude(case, "instant", "one Cholesky factorisation", minors, cuts)
    if found.bound.proved or effort == "instant":
        return found
    risen, taken = rise(case, minors, cuts, steps)
    if risen is None:
        found = max((conclude(case, "ascent", "multipliers shrunk until positive definite", part * minors,
                              {i: part * weights for i, weights in cuts.items()}, part * case.lam)
                     for part in PARTS), key=lambda attempt: attempt.bound.value)
    else:
        found = conclude(case, "ascent", f"{taken} projections", risen, cuts)
    if found.bound.proved or effort == "ascent":
        return found
    size = relaxation_size(case.blocks, case.cones)
    if size > max_size:
        reason = f"{found.bound.reason}; the relaxation with {size} multipliers exceeds the limit {max_size}"
        return replace(found, bound=replace(found.bound, reason=reason))
    return solve_relaxation(case, found, steps)


def prepare(problem: RankOne, point: Point, cones: Mapping[int, Array], linear: LinearRows) -> LadderCase:
    """Reduce, whiten, find the KKT multipliers and add the linear terms to the objective."""
    keep_linear = bool(linear.rows[:, :problem.linear].any())
    keep = tuple(range(len(problem.blocks)) if len(linear.right) else cones)
    core = reduce(problem, keep, keep_linear) if keep or keep_linear else problem.core
    w, mus, bs = core.factors(point)
    white: dict[int, Array] = {}
    for i, cone in zip(map(core.kept.index, cones), cones.values()):
        white[i] = cone @ invert_triangular(core.whitening.factors_mu[i]).T
    for i, cone in white.items():
        if (cone @ mus[i]).sum() < 0:
            mus[i], bs[i] = -mus[i], -bs[i]
    at = Point(w, tuple(mus), tuple(bs))
    z = at.lift()
    residual = core.root @ z - core.target
    slope = core.root.T @ residual
    value = float(residual @ residual) + problem.remainder
    if len(linear.right):
        linear = replace(linear, rows=core.whitening.columns(linear.rows[:, 0 if keep_linear else problem.linear:]))
    else:
        linear = LinearRows.none(len(z))
    nu, lam = kkt_multipliers(slope, at, white, linear)
    return LadderCase(core, mus, bs, Quadratic(core.gram, z, slope, value), white, nu, lam, linear)


def tangent(case: LadderCase, cuts: dict[int, Array]) -> Array:
    """Minors that cancel the rest of the gradient at the point, block by block; none for a block that is zero."""
    slope = case.lagrangian().slope - case.cut_form(cuts) @ case.objective.z
    minors = np.zeros_like(case.objective.gram)
    gradients = matrices(slope[case.core.linear:], case.core.shapes)
    for (where, _), mu, b, vanishes, gradient in zip(case.blocks, case.mus, case.bs, case.vanishing, gradients):
        if not vanishes:
            gradient = gradient - np.outer(gradient @ b, b)
            gradient = gradient - np.outer(mu, mu @ gradient) / (mu @ mu)
            minors[where, where] = tangent_minors(-gradient, mu, b)
    return minors


def rise(case: LadderCase, minors: Array, cuts: dict[int, Array], steps: int) -> tuple[Array | None, int]:
    """Ascent from given multipliers that cancel the gradient; improved minors, or None, and the steps taken."""
    matrix = case.objective.gram + minors - case.cut_form(cuts)
    turn = rotation(case.core.linear, case.mus, case.bs)
    free, taken = ascend(turn.T @ matrix @ turn, case.blocks, case.masks, steps)
    return (None if free is None else minors + onto_minors(case, turn @ free @ turn.T)), taken


def onto_minors(case: LadderCase, matrix: Array) -> Array:
    """Remove the roundoff of a change of coordinates: exactly a combination of minors again."""
    clean = np.zeros_like(matrix)
    for where, shape in case.blocks:
        clean[where, where] = project_minors(matrix[where, where], shape)
    return clean


def solve_relaxation(case: LadderCase, found: Certification, steps: int) -> Certification:
    """The SDP: its bound made valid by shrinking, then its multipliers aligned with the point for an exact proof."""
    method = "product cuts" if case.cones else "sdp"
    solved = relax(case.objective, case.blocks, case.cones, case.linear)
    if solved is None:
        return replace(found, bound=replace(found.bound, reason=f"{found.bound.reason}; the SDP solver failed"))
    raw, weights_by_block, linear, moments = solved
    better, minors = tuple(_candidate(case, moment) for moment in moments.T), onto_minors(case, raw)
    for shrink in SHRINKS:
        cuts = {i: (1 - shrink) * weights for i, weights in weights_by_block.items()}
        bound = conclude(case, method, "relaxation", (1 - shrink) * minors, cuts, linear, better)
        if np.isfinite(bound.bound.value):
            found = bound if bound.bound.value > found.bound.value else replace(found, better=better)
            break
    if found.bound.proved:
        return found
    cuts = {i: align_cuts(weights, case.cones[i], case.mus[i], case.bs[i], case.nu[i])
            for i, weights in weights_by_block.items()}
    aligned = tangent(case, cuts) + free_part(case, minors)
    risen, taken = rise(case, aligned, cuts, steps)
    if risen is not None:
        bound = conclude(case, method, f"relaxation aligned with the point, {taken} projections", risen, cuts)
        if bound.bound.value > found.bound.value:
            return replace(bound, better=() if bound.bound.proved else better)
    return found


def free_part(case: LadderCase, minors: Array) -> Array:
    """The part of a combination of minors that does not touch the gradient at the point."""
    turn = rotation(case.core.linear, case.mus, case.bs)
    turned = turn.T @ minors @ turn
    for (where, _), mask in zip(case.blocks, case.masks):
        turned[where, where] *= mask
    return onto_minors(case, turn @ turned @ turn.T)


def _candidate(case: LadderCase, moment: Array) -> Point:
    """Rank-one point nearest to a vector, in the coordinates of the problem; w follows by back substitution."""
    linear = case.core.linear
    svds = [np.linalg.svd(theta, full_matrices=False) for theta in matrices(moment[linear:], case.core.shapes)]
    return case.core.point([u[:, 0] * d[0] for u, d, _ in svds], [vt[0] for _, _, vt in svds],
                           moment[:linear] if linear else None)


def conclude(case: LadderCase, method: str, how: str, minors: Array, cuts: dict[int, Array],
             linear: Array | None = None, better: tuple[Point, ...] = ()) -> Certification:
    """Recompute the bound from its multipliers and say what it proves."""
    value = case.objective.value
    bound = float(case.lagrangian(linear).bound(minors, case.cut_form(cuts)))
    scale, broken = case.core.problem.scale, case.violation()
    gap, undercut = relative_gap(value, bound, scale), relative_gap(bound, value, scale) > TOLERANCE
    proved = gap <= TOLERANCE and not undercut and broken <= ACTIVE
    if broken > ACTIVE or undercut:
        reason = f"not proved: the point violates its constraints (relative violation {broken:.1e})"
    elif proved:
        reason = f"globally optimal, relative gap {gap:.1e}: {how}"
    elif np.isfinite(bound):
        reason = f"not proved, relative gap {gap:.1e}: {how}"
    else:
        reason = f"not proved, no finite bound: {how}"
    evidence = Multipliers(case.core, minors, cuts, case.lam if linear is None else linear)
    return Certification(Bound(bound, proved, method, reason, evidence), () if proved else better)

"""Fits in rank-one blocks without a programme: certified without constraints, and local with ``C_i mu_i >= 0``.

The matrices C_i are square and invertible, b_i is of free sign. Written in delta_i = C_i mu_i (the increments, for a
monotone function) the constraint is a sign. Alternating nonnegative least squares finds which delta vanish; on that
face the problem is unconstrained again, and Newton's method finishes with a gradient at roundoff. A face is left when a
multiplier on it is negative.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from optid.certificate.ladder import Certification, certify
from optid.errors import StructureError
from optid.structures.bilinear import LocalSolution, best_of, descend, starts
from optid.structures.rank_one import Array, Point, RankOne, matrices, reduce


def change_basis(problem: RankOne, changes: Mapping[int, Array]) -> RankOne:
    """The same problem in new coordinates ``mu_i = changes[i] @ new_i``, which may be fewer.

    Args:
        problem: the problem.
        changes: by block (P_i, new size).
    """
    parts, blocks = [problem.root[:, :problem.linear]], []
    for i, (columns, (p, nb)) in enumerate(zip(problem.slices, problem.blocks)):
        change = changes.get(i, np.eye(p))
        part = problem.root[:, columns].reshape(-1, nb, p) @ change
        parts.append(part.reshape(len(part), -1))
        blocks.append((change.shape[1], nb))
    stacked = np.column_stack([*parts, problem.target])
    triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    n = stacked.shape[1] - 1
    if len(triangle) > n:
        remainder = problem.remainder + float(triangle[n:, n] @ triangle[n:, n])
    else:
        remainder = problem.remainder
    return RankOne(np.triu(triangle[:n, :n]), triangle[:n, n], remainder, tuple(blocks), problem.linear, problem.scale)


def minimise_in_cones(problem: RankOne, cones: Mapping[int, Array], *, count: int = 8, seed: int = 0,
                      start: Point | None = None, rounds: int = 30) -> LocalSolution:
    """Best constrained local solution over several starts, or the one reached from a given start.

    Args:
        problem: the problem.
        cones: by block, C_i (P_i, P_i) invertible.
        count: number of starts.
        seed: of the random starts.
        start: descend from here only.
        rounds: alternations between the active set and Newton's method, at most.

    Raises:
        StructureError: a C_i that is not square.
    """
    for i, cone in cones.items():
        if cone.shape != (problem.blocks[i][0],) * 2:
            raise StructureError(f"cone {i} must be square ({problem.blocks[i][0]}), not {cone.shape}")
    inverses = {i: np.linalg.inv(cone) for i, cone in cones.items()}
    signed = change_basis(problem, inverses)
    if start is not None:
        points = [_changed(start, cones)]
    else:
        core = reduce(signed, keep=tuple(range(len(signed.blocks))))
        points = [core.point(mus, bs) for mus, bs in starts(core, count, seed)]
    best = min((_descend(signed, point, tuple(cones), rounds) for point in points), key=lambda found: found.value)
    point = _changed(best.point, inverses)
    return LocalSolution(point, problem.value(point.lift()), best.iterations, best.gradient, best.converged)


def _changed(point: Point, changes: Mapping[int, Array]) -> Point:
    mus = tuple(changes[i] @ mu if i in changes else mu for i, mu in enumerate(point.mus))
    return Point(point.w, mus, point.bs)


def _descend(problem: RankOne, point: Point, signed: tuple[int, ...], rounds: int) -> LocalSolution:
    """Alternate until the active set stands, finish on its face, leave the face while a multiplier is negative."""
    n = problem.linear
    reduced = RankOne(problem.root[n:, n:], problem.target[n:], problem.remainder, problem.blocks, 0, problem.scale)
    bs = list(point.bs)
    found, settled, taken = None, False, 0
    while not settled and taken < rounds:
        for _ in range(3):
            mus = _fit_mus(reduced, bs, signed)
            if not all(mu.any() for mu in mus):  # the other sign of b is open to a channel that vanished
                bs = [b if mu.any() else -b for mu, b in zip(mus, bs)]
                mus = _fit_mus(reduced, bs, signed)
            bs = _fit_bs(reduced, mus, bs)
        alternated = Point(np.empty(0), tuple(mus), tuple(bs))
        found = _finish(reduced, alternated, signed)
        if found is None:
            found = LocalSolution(alternated, reduced.value(alternated.lift()), taken, np.inf, False)
        else:
            bs = list(found.point.bs)
            settled = _multipliers_hold(reduced, found.point, signed)
        taken += 1
    assert found is not None
    theta = found.point.lift()
    w = np.linalg.solve(problem.root[:n, :n], problem.target[:n] - problem.root[:n, n:] @ theta)
    return LocalSolution(Point(w, found.point.mus, found.point.bs), found.value, taken, found.gradient,
                         settled and found.converged)


def _designs(problem: RankOne) -> list[Array]:
    return [problem.root[:, columns].reshape(-1, nb, p)
            for columns, (p, nb) in zip(problem.slices, problem.blocks)]


def _fit_mus(problem: RankOne, bs: list[Array], signed: tuple[int, ...]) -> list[Array]:
    """Least squares for all mu_i with b_i fixed; mu_i >= 0 in the signed blocks, the others are projected out."""
    designs = [np.einsum("njp,j->np", piece, b) for piece, b in zip(_designs(problem), bs)]
    free = [i for i in range(len(bs)) if i not in signed]
    mus: list[Array] = [np.empty(0)] * len(bs)
    whole = np.hstack([designs[i] for i in signed])
    target = problem.target
    if free:
        others = np.hstack([designs[i] for i in free])
        basis = np.linalg.qr(others)[0]
        solution = nnls(whole - basis @ (basis.T @ whole), target - basis @ (basis.T @ target))[0]
        rest = np.linalg.lstsq(others, target - whole @ solution, rcond=None)[0]
        for i, mu in zip(free, np.split(rest, np.cumsum([designs[i].shape[1] for i in free])[:-1])):
            mus[i] = mu
    else:
        solution = nnls(whole, target)[0]
    for i, mu in zip(signed, np.split(solution, np.cumsum([designs[i].shape[1] for i in signed])[:-1])):
        mus[i] = mu
    return mus


def _fit_bs(problem: RankOne, mus: list[Array], bs: list[Array]) -> list[Array]:
    """Least squares for all b_i of unit length with mu_i fixed; a channel that vanished keeps its direction."""
    designs = [piece @ mu for piece, mu in zip(_designs(problem), mus)]
    solution = np.linalg.lstsq(np.hstack(designs), problem.target, rcond=None)[0]
    fitted = np.split(solution, np.cumsum([len(b) for b in bs])[:-1])
    return [new / np.linalg.norm(new) if new.any() else old for new, old in zip(fitted, bs)]


def _finish(problem: RankOne, point: Point, signed: tuple[int, ...]) -> LocalSolution | None:
    """Newton on the face of the vanishing delta; None where it leaves the cone or there is no face."""
    faces = {i: np.eye(len(point.mus[i]))[:, point.mus[i] > 0] for i in signed}
    if not all(face.shape[1] for face in faces.values()):
        return None
    face = change_basis(problem, faces)
    start = Point(point.w, tuple(faces[i].T @ mu if i in faces else mu for i, mu in enumerate(point.mus)), point.bs)
    core = reduce(face, keep=tuple(range(len(face.blocks))))
    found = descend(core, core.factors(start)[2])
    mus, bs = [], []
    feasible = found.value <= problem.value(point.lift()) * (1 + 1e-12) + 1e-24 * problem.scale
    for i, (mu, b) in enumerate(zip(found.point.mus, found.point.bs)):
        if i in faces:
            if mu.sum() < 0:
                mu, b = -mu, -b
            feasible = feasible and bool((mu >= 0).all())
            mu = faces[i] @ mu
        mus.append(mu)
        bs.append(b)
    lifted = Point(np.empty(0), tuple(mus), tuple(bs))
    if not feasible:
        return None
    return LocalSolution(lifted, problem.value(lifted.lift()), found.iterations, found.gradient, found.converged)


def _multipliers_hold(problem: RankOne, point: Point, signed: tuple[int, ...]) -> bool:
    """Whether no vanishing delta would lower the objective by growing."""
    slope = problem.root.T @ (problem.root @ point.lift() - problem.target)
    reference = float(np.linalg.norm(problem.root.T @ problem.target))
    gradients = matrices(slope, problem.blocks)
    return all((gradients[i] @ point.bs[i])[point.mus[i] == 0].min(initial=0.0) >= -1e-9 * reference for i in signed)


@dataclass(frozen=True, eq=False)
class Certified:
    """A fit and what is known about it.

    Attributes:
        solution: the best local solution found.
        certification: bound, gap and proof.
        starts: number of local descents.
    """

    solution: LocalSolution
    certification: Certification
    starts: int


def solve_certified(problem: RankOne, *, effort: str = "sdp", steps: int = 100, count: int = 8, seed: int = 0,
                    max_size: int = 700) -> Certified:
    """Minimise without constraints and prove it: stop at the first proof, search on while there is none.

    The order of work: whitened SVD start and instant proof; all starts, instant proof, ascent, SDP; restarts from its
    moment matrix; four times as many random starts; the honest gap.

    Args:
        problem: the least-squares problem.
        effort: last rung of the ladder of `certify`.
        steps: of the ascent.
        count: number of starts.
        seed: of the random ones.
        max_size: largest SDP, in multipliers.
    """
    core = reduce(problem)
    if not core.shapes:
        best = descend(core, [])
        return Certified(best, certify(problem, best.point), 1)
    best = descend(core, starts(core, 1, seed)[0][1])
    proof = certify(problem, best.point, effort="instant")
    if proof.bound.proved:
        return Certified(best, proof, 1)
    best = min(best, best_of(core, count, seed, first=1), key=lambda solution: solution.value)
    proof = certify(problem, best.point, effort=effort, steps=steps, max_size=max_size)
    tried = count
    for round_ in range(2):
        if proof.bound.proved or effort == "instant":
            break
        if proof.better:
            again = [descend(core, core.factors(point)[2], alternations=1) for point in proof.better]
        else:
            again = [best_of(core, 4 * count, seed + 1 + round_, first=4)]
        tried += len(proof.better) or 4 * (count - 1)
        challenger = min(again, key=lambda solution: solution.value)
        if challenger.value < best.value * (1 - 1e-10):
            best = challenger
            proof = certify(problem, best.point, effort=effort, steps=steps, max_size=max_size)
        elif proof.better:
            proof = replace(proof, better=())
    return Certified(best, proof, tried)

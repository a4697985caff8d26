"""The shift-invariance step under constraints on the poles: its sequence of programmes, and large orders deflated.

``min_A ‖Gamma_up A - Gamma_dn‖`` has a closed form; with poles restricted to regions it is not convex in A. The fit
weighted by P, with A = Q P^-1, is a semidefinite programme. Convex steps then reduce the unweighted residual: A alone
with P fixed, and the P that gives A the largest margin. The least-squares residual is a lower bound for every A, which
certifies the suboptimality.

The programme in P and Q grows with the fourth power of the order: large orders are deflated in the Schur form of the
least-squares solution, poles that satisfy the constraints kept and the others constrained a few at a time.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.errors import StructureError
from optid.identify.arguments import violations
from optid.program.solution import Solution, Status

SINGULAR = 1e-4  # least eigenvalue of a P of trace n below which it is no point
ROUNDS = 6  # pairs of programmes in A and in P at most
ENOUGH = 1e-2  # fall of the residual, relative to the suboptimality left, below which rounds stop
TINY = 1e-9  # suboptimality relative to the size of Gamma that is none
LARGEST = 16  # states whose A is found by one programme
AT_ONCE = 8  # poles that are constrained by one programme where there are more states


@dataclass(frozen=True, eq=False)
class Shift:
    """The result of the step."""

    a: Array | None  # (n, n), or None where no programme had a point
    residual: float  # ‖Gamma_up A - Gamma_dn‖ (Frobenius) at ``a``; nan without a point
    bound: float  # the least-squares residual, below which no A can come
    applied: bool  # whether constraints were needed
    # OPTIMAL where ``a`` is the least-squares solution, else that of the programmes: LOCAL where the suboptimality is
    # positive, INACCURATE where a back end was or where a pole lies outside its region
    status: Status
    reason: str  # one sentence

    @property
    def suboptimality(self) -> float:
        """Certified: the residual exceeds the smallest possible one by at most this much."""
        return self.residual - self.bound


@dataclass(frozen=True, eq=False)
class ShiftStep:
    """The step in coordinates z, x = T z, in which Gamma_up T has orthonormal columns, with its rows compressed."""

    top: Array  # (2 n, n) compressed Gamma_up T
    low: Array  # (2 n, n) compressed Gamma_dn T
    free: Array  # (n, n) least-squares solution in z
    basis: Array  # (n, n) T
    change: Array  # (n, n) T^-1, the weight on the right that gives residuals in the original coordinates
    size: float  # norm of Gamma_dn

    @classmethod
    def of(cls, up: Array, down: Array, free: Array) -> "ShiftStep":
        """Compress Gamma_up and Gamma_dn, (r, n) each, with the least-squares solution A."""
        n = up.shape[1]
        change = np.asarray(np.linalg.qr(up, mode="r"))
        sizes = np.abs(np.diag(change))
        if np.min(sizes) <= 1e-12 * np.max(sizes):
            raise StructureError(f"the observability matrix without its last block row has rank below {n}: the order "
                                 "is too large for these data or this number of block rows")
        basis = np.linalg.inv(change)
        rows = np.asarray(np.linalg.qr(np.hstack([up @ basis, down @ basis]), mode="r"))
        return cls(rows[:, :n], rows[:, n:], change @ free @ basis, basis, change, float(np.linalg.norm(down)))

    def inner(self, a: Array) -> Array:
        """Take A from x to z."""
        return self.change @ a @ self.basis

    def recover(self, values: Mapping[str, Array]) -> Array:
        """Return A in x from A, or from P and Q = A P, in z."""
        a = values["A"] if "A" in values else np.linalg.solve(np.asarray(values["P"]), np.asarray(values["Q"]).T).T
        return self.basis @ a @ self.change


# the problems of the step: (step, rules) -> fit in P and Q = A P, its residual weighted by P, or, given (P, A)
# besides, in A alone from that A, its residual unweighted; (step, A, rules) -> the largest margin of P
Programmes = tuple[Callable[..., Problem], Callable[..., Problem]]
Shifting = Generator[Problem, Solution, Shift]


def constrained_shift(up: Array, down: Array, rules: Sequence[Any], programmes: Programmes) -> Shifting:
    """Solve ``min ‖up A - down‖`` with the poles in the regions of the rules; use as ``shift = yield from ...``.

    No programme is solved where the least-squares solution satisfies every rule. A builder that is no rule about poles
    is always imposed. ``a`` is None where the last programme is infeasible or the back end failed.

    Raises:
        StructureError: shapes that do not fit, or a rule that does not apply to a matrix A.
    """
    if up.ndim != 2 or up.shape != down.shape or up.shape[0] < up.shape[1]:
        raise StructureError(f"the shift step needs two matrices of one shape with at least as many rows as states; "
                             f"got {up.shape} and {down.shape}")
    free = np.linalg.lstsq(up, down, rcond=None)[0]
    bound = float(np.linalg.norm(up @ free - down))
    verified = all(getattr(rule, "verify", None) is not None for rule in rules)
    if not _violated(free, rules) and verified:
        return Shift(free, bound, bound, False, Status.OPTIMAL, "the least-squares solution satisfies every rule")
    if len(free) > LARGEST and verified:
        shift = yield from _deflated(up, down, free, bound, rules, programmes)
        if shift is not None:
            return shift
    step, (fitted, centred) = ShiftStep.of(up, down, free), programmes
    solution = yield fitted(step, rules)
    if not solution.has_point or not _definite(solution.values["P"]):
        status = solution.status  # a singular P is no point
        status = Status.FAILED if status in (Status.OPTIMAL, Status.LOCAL) else status
        return Shift(None, float("nan"), bound, True, status, solution.reason or solution.claimed)
    p, a, found = solution.values["P"], step.recover(solution.values), solution
    best = float(np.linalg.norm(up @ a - down))
    for last in [False] * (ROUNDS - 1) + [True]:
        solution = yield fitted(step, rules, (p, a))
        if not solution.has_point:
            break
        trial = step.recover(solution.values)
        residual, fall = float(np.linalg.norm(up @ trial - down)), 0.0
        if residual < best and not set(_violated(trial, rules)) - set(_violated(a, rules)):
            fall, a, best, found = best - residual, trial, residual, solution
        if last or fall <= ENOUGH * (best - bound) or best - bound <= TINY * step.size:
            break
        solution = yield centred(step, a, rules)
        if not solution.has_point or not _definite(solution.values["P"]):
            break
        p = solution.values["P"]
    return _judged(a, up, down, bound, found.status, found.reason, rules)


def _deflated(up: Array, down: Array, free: Array, bound: float, rules: Sequence[Any], programmes: Programmes
              ) -> Generator[Problem, Solution, Shift | None]:
    """Solve the step block by block of the real Schur form A = Z T Z': poles that satisfy the rules, then a few each.

    The columns of ``(up A - down) Z`` of a block are ``up_1 X + up_2 S - down_2``, with X free: without the range of
    up_1, a small step in S. None where no pole violates the rules by itself.
    """
    from scipy.linalg import schur

    def satisfies(re: float, im: float) -> bool:
        return not _violated(np.array([[re, im], [-im, re]]), rules)

    try:
        found: Any = schur(free, output="real", sort=satisfies)
    except np.linalg.LinAlgError:  # poles too close to be reordered: all of them are constrained
        found = (*schur(free, output="real"), 0)
    triangle, basis, kept = found
    n, ends, status, reason = len(free), [int(kept)], Status.LOCAL, ""
    if ends[0] == n:
        return None
    while ends[-1] < n:
        end = min(ends[-1] + AT_ONCE, n)
        ends.append(end - (end < n and triangle[end, end - 1] != 0))  # a pair stays together
    up_z, down_z = up @ basis, down @ basis
    t = np.zeros_like(triangle)
    t[: ends[0], : ends[0]] = triangle[: ends[0], : ends[0]]
    for first, last in zip(ends, ends[1:]):
        own, before = slice(first, last), slice(0, first)
        range_before = np.linalg.qr(up_z[:, before])[0]
        outside = [part - range_before @ (range_before.T @ part) for part in (up_z[:, own], down_z[:, own])]
        shift = yield from constrained_shift(outside[0], outside[1], rules, programmes)
        if shift.a is None:
            return replace(shift, bound=bound)
        t[own, own] = shift.a
        t[before, own] = np.linalg.lstsq(up_z[:, before], down_z[:, own] - up_z[:, own] @ shift.a, rcond=None)[0]
        if status is Status.LOCAL and shift.status not in (Status.OPTIMAL, Status.LOCAL):  # the first that went wrong
            status, reason = shift.status, shift.reason
    return _judged(basis @ t @ basis.T, up, down, bound, status, reason, rules)


def _judged(a: Array, up: Array, down: Array, bound: float, status: Status, reason: str, rules: Sequence[Any]) -> Shift:
    residual = float(np.linalg.norm(up @ a - down))
    excess = residual - bound
    reasons = [f"the constrained shift step exceeds the least-squares residual {bound:.3g} by {max(excess, 0.0):.2g}"]
    if outside := _violated(a, rules):
        status, reason = Status.INACCURATE, "; ".join(outside)
    if status in (Status.OPTIMAL, Status.LOCAL):
        status = Status.OPTIMAL if excess <= TINY * np.linalg.norm(down) else Status.LOCAL
    elif reason:
        reasons.append(reason)
    return Shift(a, residual, bound, True, status, "; ".join(reasons))


def _violated(a: Array, rules: Sequence[Any]) -> list[str]:
    return violations(SimpleNamespace(poles=np.linalg.eigvals(a)), rules)


def _definite(p: Array) -> bool:
    return bool(np.all(np.isfinite(p))) and float(np.min(np.linalg.eigvalsh((p + p.T) / 2))) > SINGULAR

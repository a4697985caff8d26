"""The shift-invariance step of subspace identification under constraints on the poles.

``min_A ‖Gamma_up A - Gamma_dn‖`` has a closed form; with poles restricted to regions it is not convex in A. With
``A = Q P^-1`` the fit weighted by P is a semidefinite programme (Lacy and Bernstein 2003), and any `Rule` about poles
that is a linear matrix inequality in (P, Q) takes part (Miller and de Callafon 2013). The weight is then undone by
convex steps that cannot raise the unweighted residual: A alone with P fixed, and the P that leaves A the largest
margin. The least-squares residual bounds what any A can reach, so that every answer carries a certified suboptimality.

The programme in P and Q grows with the fourth power of the order, so that large orders are deflated first: in the
Schur form of the least-squares solution the residual splits into columns, and with its invariant subspaces kept, the
poles that obey stay as they are and the others are constrained a few at a time. The bound is the same.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.constraints.psd import PSD

from formulations.constraints.rule import Rule
from optid.errors import StructureError
from optid.program.program import Program, Values
from optid.program.solution import Solution, Status
from optid.program.view import View

DEFINITE = 1e-3  # least eigenvalue of P where its trace is n: bounds the norm of P^-1
ROUNDS = 6  # pairs of programmes in A and in P at most
ENOUGH = 1e-2  # fall of the residual, relative to the suboptimality left, below which rounds stop
TINY = 1e-9  # suboptimality relative to the size of Gamma that is none
LARGEST = 16  # states whose A is found by one programme
AT_ONCE = 8  # poles that are constrained by one programme where there are more states


@dataclass(frozen=True, eq=False)
class Shift:
    """The answer of the step.

    Attributes:
        a: (n, n), or None where no programme had a point.
        residual: ‖Gamma_up A - Gamma_dn‖ (Frobenius) at ``a``; nan without a point.
        bound: the least-squares residual, below which no A can come.
        least_squares: (n, n) the unconstrained solution.
        applied: whether constraints were needed.
        status: OPTIMAL where ``a`` is the least-squares solution, else that of the programmes: LOCAL where the
            suboptimality is positive, INACCURATE where a back end was or where a pole lies outside its region.
        reason: one sentence for people.
        certificate: (n, n) P of the inequalities; None where no programme had a point, and after a deflation.
    """

    a: np.ndarray | None
    residual: float
    bound: float
    least_squares: np.ndarray
    applied: bool
    status: Status
    reason: str
    certificate: np.ndarray | None = None

    @property
    def suboptimality(self) -> float:
        """Certified: the residual exceeds the smallest possible one by at most this much."""
        return self.residual - self.bound


@dataclass(frozen=True, eq=False)
class _Poles:
    """What rules verify: something with poles."""

    poles: np.ndarray


def constrained_shift(up: np.ndarray, down: np.ndarray, rules: Sequence[Rule] = ()
                      ) -> Generator[Program, Solution, Shift]:
    """Solve ``min ‖up A - down‖`` with the poles where the rules want them; use as ``shift = yield from ...``.

    No programme is posed where the least-squares solution obeys every rule already: the weighted fit would contract
    poles that need no help.

    Args:
        up: (r, n) observability matrix without its last block row.
        down: (r, n) the same without its first.
        rules: constraints about the poles; a builder of another kind is always imposed.

    Returns:
        The solution; with ``a`` None where the regions are empty together or the back end failed. The last programme
        posed is then the one to explain.

    Raises:
        StructureError: shapes that do not fit, or a rule that does not apply to a matrix A.
    """
    up, down = np.asarray(up, dtype=float), np.asarray(down, dtype=float)
    if up.ndim != 2 or up.shape != down.shape or up.shape[0] < up.shape[1]:
        raise StructureError(f"the shift step needs two matrices of one shape with at least as many rows as states; "
                             f"got {up.shape} and {down.shape}")
    free = np.linalg.lstsq(up, down, rcond=None)[0]
    bound = float(np.linalg.norm(up @ free - down))
    verified = all(getattr(rule, "verify", None) is not None for rule in rules)
    if not _disobeyed(free, rules) and verified:
        return Shift(free, bound, bound, free, False, Status.OPTIMAL, "the least-squares solution obeys every rule")
    if len(free) > LARGEST and verified and (blocks := _pole_blocks(free, rules)) is not None:
        return (yield from _deflated(up, down, free, blocks, rules))
    step = _Step.of(up, down, free)
    solution = yield step.joint(rules)
    if not solution.has_point or not _definite(solution.values["P"]):
        return Shift(None, float("nan"), bound, free, True, _failed(solution), solution.reason or solution.claimed)
    p, a = solution.values["P"], step.joint_matrix(solution.values)
    best, status, reason = float(np.linalg.norm(up @ a - down)), solution.status, solution.reason
    for last in [False] * (ROUNDS - 1) + [True]:
        solution = yield step.refined(p, a, rules)
        if not solution.has_point:
            break
        trial = step.original(solution.values["A"])
        residual, fall = float(np.linalg.norm(up @ trial - down)), 0.0
        if residual < best and not set(_disobeyed(trial, rules)) - set(_disobeyed(a, rules)):
            fall, a, best = best - residual, trial, residual
            status, reason = solution.status, solution.reason
        if last or fall <= ENOUGH * (best - bound) or best - bound <= TINY * step.size:
            break
        solution = yield step.centred(a, rules)
        if not solution.has_point or not _definite(solution.values["P"]):
            break
        p = solution.values["P"]
    return _judged((best, a, p), bound, free, status, reason, rules, step.size)


def _pole_blocks(free: np.ndarray, rules: Sequence[Rule]) -> tuple[np.ndarray, np.ndarray, list[int]] | None:
    """Return the real Schur form of A, its basis, and the ends of its blocks: poles that obey, then some at a time.

    None where the rules speak of the poles together: none of them disobeys by itself.
    """
    from scipy.linalg import schur

    def obeys(re: float, im: float) -> bool:
        return not _disobeyed_by(np.array([complex(re, im), complex(re, -im)]), rules)

    try:
        found: Any = schur(free, output="real", sort=obeys)
    except np.linalg.LinAlgError:  # poles too close to be told from each other: all of them are constrained
        found = (*schur(free, output="real"), 0)
    triangle, basis, kept = found
    n, ends = len(free), [int(kept)]
    if ends[0] == n:
        return None
    while ends[-1] < n:
        end = min(ends[-1] + AT_ONCE, n)
        ends.append(end - (end < n and triangle[end, end - 1] != 0))  # a pair stays together
    return triangle, basis, ends


def _deflated(up: np.ndarray, down: np.ndarray, free: np.ndarray, blocks: tuple[np.ndarray, np.ndarray, list[int]],
              rules: Sequence[Rule]) -> Generator[Program, Solution, Shift]:
    """Solve the step block by block of a Schur form: A = Z T Z', T block upper triangular.

    The columns of ``(up A - down) Z`` that belong to a block are ``up_1 X + up_2 S - down_2``, with X free: without the
    range of up_1, a small step in S.
    """
    triangle, basis, ends = blocks
    up_z, down_z = up @ basis, down @ basis
    t = np.zeros_like(triangle)
    t[: ends[0], : ends[0]] = triangle[: ends[0], : ends[0]]
    statuses, reasons = [], []
    for first, last in zip(ends, ends[1:]):
        own, before = slice(first, last), slice(0, first)
        range_before = np.linalg.qr(up_z[:, before])[0]
        outside = [part - range_before @ (range_before.T @ part) for part in (up_z[:, own], down_z[:, own])]
        shift = yield from constrained_shift(outside[0], outside[1], rules)
        if shift.a is None:
            return replace(shift, bound=float(np.linalg.norm(up @ free - down)), least_squares=free)
        t[own, own] = shift.a
        t[before, own] = np.linalg.lstsq(up_z[:, before], down_z[:, own] - up_z[:, own] @ shift.a, rcond=None)[0]
        statuses.append(shift.status)
        reasons.append(shift.reason)
    a, bound = basis @ t @ basis.T, float(np.linalg.norm(up @ free - down))
    worst = next(((s, r) for s, r in zip(statuses, reasons) if s not in (Status.OPTIMAL, Status.LOCAL)),
                 (Status.LOCAL, ""))
    return _judged((float(np.linalg.norm(up @ a - down)), a, None), bound, free, *worst, rules,
                   float(np.linalg.norm(down)))


def _judged(best: tuple[float, np.ndarray, np.ndarray | None], bound: float, free: np.ndarray, status: Status,
            reason: str, rules: Sequence[Rule], size: float) -> Shift:
    residual, a, p = best
    excess = residual - bound
    said = f"the constrained shift step exceeds the least-squares residual {bound:.3g} by {max(excess, 0.0):.2g}"
    outside = _disobeyed(a, rules)
    if outside:
        status, reason = Status.INACCURATE, "; ".join(outside)
    if status in (Status.OPTIMAL, Status.LOCAL):
        status, reason = (Status.OPTIMAL if excess <= TINY * size else Status.LOCAL), said
    else:
        reason = f"{said}; {reason}" if reason else said
    return Shift(a, residual, bound, free, True, status, reason, p)


def _disobeyed(a: np.ndarray, rules: Sequence[Rule]) -> list[str]:
    return _disobeyed_by(np.linalg.eigvals(a), rules)


def _disobeyed_by(values: np.ndarray, rules: Sequence[Rule]) -> list[str]:
    poles = _Poles(values)
    checks = [rule.verify for rule in rules if getattr(rule, "verify", None) is not None]
    return [sentence for check in checks if check is not None and (sentence := check(poles))]


def _definite(p: np.ndarray) -> bool:
    return bool(np.all(np.isfinite(p))) and float(np.min(np.linalg.eigvalsh((p + p.T) / 2))) > DEFINITE / 10


def _failed(solution: Solution) -> Status:
    """Status of a step without an A: a singular P is no point."""
    return Status.FAILED if solution.status in (Status.OPTIMAL, Status.LOCAL) else solution.status


@dataclass(frozen=True, eq=False)
class _Step:
    """The step in coordinates z, x = T z, in which Gamma_up T has orthonormal columns, with its rows compressed.

    Attributes:
        top: (2 n, n) compressed Gamma_up T.
        low: (2 n, n) compressed Gamma_dn T.
        free: (n, n) least-squares solution in z.
        basis: (n, n) T.
        change: (n, n) T^-1, the weight on the right that gives residuals in the original coordinates.
        size: norm of Gamma_dn.
    """

    top: np.ndarray
    low: np.ndarray
    free: np.ndarray
    basis: np.ndarray
    change: np.ndarray
    size: float

    @classmethod
    def of(cls, up: np.ndarray, down: np.ndarray, free: np.ndarray) -> "_Step":
        n = up.shape[1]
        change = np.asarray(np.linalg.qr(up, mode="r"))
        sizes = np.abs(np.diag(change))
        if np.min(sizes) <= 1e-12 * np.max(sizes):
            raise StructureError(f"the observability matrix without its last block row has rank below {n}: the order "
                                 "is too large for these data or this number of block rows")
        basis = np.linalg.inv(change)
        rows = np.asarray(np.linalg.qr(np.hstack([up @ basis, down @ basis]), mode="r"))
        return cls(rows[:, :n], rows[:, n:], change @ free @ basis, basis, change, float(np.linalg.norm(down)))

    def original(self, a: np.ndarray) -> np.ndarray:
        """Bring A from z back to x."""
        return self.basis @ a @ self.change

    def joint_matrix(self, values: Values) -> np.ndarray:
        """Return A in x from P and Q in z."""
        return self.original(np.linalg.solve(np.asarray(values["P"]), np.asarray(values["Q"]).T).T)

    def joint(self, rules: Sequence[Rule]) -> Program:
        """Return the programme in P and Q: the residual weighted by P."""
        n = len(self.basis)
        p, q = cp.Variable((n, n), symmetric=True, name="P"), cp.Variable((n, n), name="Q")
        contracted = self.free * min(1.0, 0.5 / max(np.max(np.abs(np.linalg.eigvals(self.free))), 1e-12))
        fit = (self.top @ q - self.low @ p) @ self.change
        return self._programme("shift", {"P": p, "Q": q}, fit, _normalised(p), {"P": np.eye(n), "Q": contracted}, p, q,
                               self.joint_matrix, rules)

    def refined(self, p: np.ndarray, a: np.ndarray, rules: Sequence[Rule]) -> Program:
        """Return the programme in A alone, with P fixed: its residual is unweighted."""
        n = len(self.basis)
        variable = cp.Variable((n, n), name="A")
        start = {"A": self.change @ a @ self.basis}
        fit = (self.top @ variable - self.low) @ self.change
        return self._programme("shift with fixed P", {"A": variable}, fit, {}, start, cp.Constant((p + p.T) / 2),
                               variable @ p, lambda values: self.original(np.asarray(values["A"])), rules)

    def centred(self, a: np.ndarray, rules: Sequence[Rule]) -> Program:
        """Return the programme for the P that leaves a given A the largest margin in the matrix inequalities."""
        n = len(self.basis)
        inner = self.change @ a @ self.basis
        p, margin = cp.Variable((n, n), symmetric=True, name="P"), cp.Variable(name="margin")
        view = View({"P": p, "Q": inner @ p}, reference={"A": self.free})
        bare = Program("centre", cp.Minimize(-margin), _normalised(p), {"P": p, "margin": margin}, {}, dict, view,
                       structural=frozenset(_normalised(p))).subject_to(*rules)
        eased = {name: group if name in bare.structural else tuple(_eased(c, margin) for c in group)
                 for name, group in bare.constraints.items()}
        # the rules hold at A already: here they are not the user's, so that their prices stay those of the fit
        return replace(bare, constraints=eased, structural=frozenset(eased))

    def _programme(self, name: str, variables: dict[str, Any], fit: Any, structural: dict[str, Any],
                   start: Values, p: Any, q: Any, recover: Any, rules: Sequence[Rule]) -> Program:
        # the norm rather than its square: where a plant obeys almost exactly, the square would vanish in the tolerance
        residual, height = cp.Variable(fit.size, name="residual"), cp.Variable(name="height")
        constraints = {"residual": (residual == cp.vec(fit, order="F"),), "norm": (cp.SOC(height, residual),),
                       **structural}
        view = View({"P": p, "Q": q}, reference={"A": self.free})
        program = Program(name, cp.Minimize(height), constraints, {**variables, "residual": residual, "height": height},
                          start, recover, view, structural=frozenset(constraints),
                          derived={"residual": cp.vec(fit, order="F")}, scale=self.size)
        return program.subject_to(*rules)


def _normalised(p: cp.Variable) -> dict[str, tuple[Any, ...]]:
    n = p.shape[0]
    return {"positive": (p - DEFINITE * np.eye(n) >> 0,), "trace": (cp.trace(p) == n,)}


def _eased(member: Any, margin: cp.Variable) -> Any:
    if not isinstance(member, PSD):
        return member
    inner = member.args[0]
    return inner - margin * np.eye(inner.shape[0]) >> 0

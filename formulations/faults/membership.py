"""Set membership: the least factor of the bounds of the noise at which a window is possible, as linear programmes.

    min t   subject to   x(k + 1) - A x(k) = w(k),  |w| <= t w̄,   e(k) - C x(k) = v(k),  |v| <= t v̄

with x the deviation of the states from a simulation from zero, and e the readings less that simulation. t > 1 proves
that the window is not that of a healthy plant; the multipliers of the measurements approximate the parity vector of the
proof (`optid.faults.consistency.bounded_noise`). With a fault of unknown size the same programme tests a candidate. Its
onset is searched by branch and bound: a free course between two samples followed by a step includes every step with an
onset between them. Bounds of t are recomputed from parity vectors, not taken from a solver.

Named variables: ``t``; named expressions: ``x`` (N, n) and, with a candidate, ``size``.
"""

from collections.abc import Generator, Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.core.problem import Problem
from optid.core.terms import Inner, Values
from optid.data.record import Data
from optid.errors import StructureError
from optid.faults.consistency.bounded_noise import (
    SIGMAS,
    BoundedWindow,
    Membership,
    ParityProof,
    bounded_window,
    parity_proof,
)
from optid.faults.signatures import Candidate, Dictionary
from optid.program.solution import Bound, Solution, Status, relative_gap
from optid.program.view import View
from optid.solving.solve import Evidence, Procedure

Array = np.ndarray

PROVED = 1e-6
"""Relative gap below which a factor is proved to be the least."""

Signature = tuple[Array, Array]
"""Additions of a fault of unknown sizes: (N, n, c) to x(k), (N, l, c) to y(k)."""


def membership(model: Any, data: Data, *, bounds: Any = SIGMAS, faults: Dictionary | None = None,
               onsets: Sequence[int] | str = "all", candidates: bool = True, constraints: Sequence[Any] = ()
               ) -> Procedure:
    """Find the least factor of the bounds for a healthy plant and whether every candidate is possible.

    Args:
        model: the healthy model.
        data: the window; one experiment, some ten to a hundred samples.
        bounds: of the noise: a number of standard deviations, or {"process": (n,), "output": (l,)}.
        faults: the candidates; none by default.
        onsets: "all", the onsets that are tried, or "course": a fault of arbitrary course, with one programme for every
            candidate, which excludes fewer.
        candidates: whether candidates are tested although a healthy plant is possible.
        constraints: further constraints on ``x`` and ``t`` of the healthy programme.

    Returns:
        An `optid.faults.consistency.bounded_noise.Membership`.

    Raises:
        DataError, StructureError: see `optid.faults.consistency.bounded_noise.bounded_window`; onsets outside the
            window.
    """
    window = bounded_window(model, data, bounds)
    tried = _onsets(onsets, window.count)
    solution = yield _posed(window).subject_to(*constraints)
    factor, proof = _factor(solution), _proof_of(solution)
    factors: dict[str, float] = {}
    where: dict[str, int | None] = {}
    proofs: dict[str, dict[tuple[int, int], ParityProof]] = {}
    untested: dict[str, str] = {}
    for candidate in faults.candidates if faults is not None and (candidates or proof is not None) else ():
        if not (candidate.additive or candidate.columns):
            untested[candidate.label] = "it has no signature: test it as an arbitrary waveform"
            continue
        if candidate.additive:
            parts = (candidate.into_state, candidate.into_output)
            unit: Any = tuple(np.broadcast_to(part, (window.count, *part.shape)) for part in parts)
        else:
            assert faults is not None
            unit = faults.additions(candidate, window.count, 0, window.u)
        found = yield from _possible(window, candidate, unit, tried)
        factors[candidate.label], where[candidate.label], proofs[candidate.label] = found
    status = "" if solution.status in (Status.OPTIMAL, Status.LOCAL) else f"{solution.status}: {solution.reason}"
    shown = solution.bound.multipliers if solution.has_point and solution.bound is not None else None
    result = Membership(factor, shown, factors, where, proofs, untested, window, status)
    return Evidence(result, factor, solution.bound or Bound.none(solution.reason), solution.status, solution.reason,
                    {"least factor of the bounds": factor, "candidates possible": len(result.consistent)})


def _possible(window: BoundedWindow, candidate: Candidate, unit: Signature, tried: list[int] | None
              ) -> Generator[Problem, Solution, tuple[float, int | None, dict[tuple[int, int], ParityProof]]]:
    """Return a factor and onset at which a candidate is possible; or the least factor proved, with all proofs.

    The factor is NaN where the solver gave neither; `unit` is the addition of a unit course in each sample.
    """
    if tried is None:
        solution = yield _posed(window, _between(candidate, unit, 0, window.count))
        proof = _proof_of(solution)
        return (_factor(solution), None, {}) if proof is None else (proof.factor, None, {(0, window.count - 1): proof})
    proofs: dict[tuple[int, int], ParityProof] = {}
    waiting: list[tuple[float, int, int]] = [(0.0, 0, len(tried) - 1)]
    while waiting:
        waiting.sort()  # the smallest factor first
        _, first, last = waiting.pop(0)
        solution = yield _posed(window, _between(candidate, unit, tried[first], tried[last]))
        proof, middle = _proof_of(solution), (first + last) // 2
        if proof is not None:
            proofs[tried[first], tried[last]] = proof
        elif first == last:
            return _factor(solution), tried[first], {}
        else:
            value = solution.objective if solution.has_point else 0.0
            waiting += [(value, first, middle), (value, middle + 1, last)]
    return min(proof.factor for proof in proofs.values()), None, proofs


def _factor(solution: Solution) -> float:
    return solution.objective if solution.has_point else float("nan")


def _proof_of(solution: Solution) -> ParityProof | None:
    """Return the proof that the window is impossible, where there is one."""
    proof = solution.bound.multipliers if solution.has_point and solution.bound is not None else None
    return proof if proof is not None and proof.proved else None


def _between(candidate: Candidate, unit: Signature, first: int, last: int) -> Signature:
    """Basis that contains the signature for every onset in [first, last]; for last = N every time course."""
    count = len(unit[0])
    shapes = np.array(candidate.fault_kind.courses(first, last, count), dtype=float)
    state, output = (np.einsum("ck,kid->kicd", shapes, part).reshape(count, part.shape[1], -1) for part in unit)
    sizes = np.maximum(np.abs(state[1:]).max(axis=(0, 1), initial=0.0), np.abs(output).max(axis=(0, 1), initial=0.0))
    seen = sizes > 0
    return state[:, :, seen] / sizes[seen], output[:, :, seen] / sizes[seen]


def _posed(window: BoundedWindow, signature: Signature | None = None) -> Problem:
    """State the linear problem of the healthy plant, or with additions of unknown sizes."""
    n, count = window.A.shape[0], window.count
    later, earlier = (sp.diags_array(np.ones(count - 1), offsets=k, shape=(count - 1, count)) for k in (1, 0))
    steps = sp.kron(later, np.eye(n)) - sp.kron(earlier, window.A)
    matrix = sp.vstack([-steps, sp.kron(sp.eye_array(count), window.C)]).tocsr()
    level = np.concatenate([np.zeros((count - 1) * n), window.e.ravel()])
    bounds = np.concatenate([np.tile(window.process, count - 1), np.tile(window.output, count)])
    known = np.concatenate([np.repeat(window.steps[:-1], n), window.present.ravel()])
    start, added = {"t": np.zeros(()), "states": np.zeros(count * n)}, np.zeros((level.size, 0))
    if signature is not None and signature[0].shape[2]:
        d = signature[0].shape[2]
        start["size"] = np.zeros(d)
        added = np.vstack([signature[0][1:].reshape(-1, d), signature[1].reshape(-1, d)])
    bounded, exact = np.flatnonzero(known & (bounds > 0)), np.flatnonzero(known & (bounds == 0))

    def noise(v: View, rows: Array, units: Array) -> Any:
        """Return the noise in some rows, in units, as an expression of few parts, because it is evaluated often."""
        found = level[rows] / units - (sp.diags_array(1 / units) @ matrix[rows]) @ v["states"]
        return found - (added[rows] / units[:, None]) @ v["size"] if "size" in v else found

    def possible(v: View) -> dict[str, Any]:
        relative = noise(v, bounded, bounds[bounded])
        held = {"no noise": noise(v, exact, np.ones(exact.size)) == 0} if exact.size else {}
        return {"noise": [relative <= v["t"], -relative <= v["t"]], **held}

    return Problem(
        "fault.membership", start, (Inner({"t": np.array(1.0)}),),
        further=lambda v, _: {"x": cp.reshape(v["states"], (count, n), order="C")}, restrictions=(possible,),
        proof=partial(_certified, window, signature, bounded, exact, bounds))


def _certified(window: BoundedWindow, signature: Signature | None, bounded: Array, exact: Array, bounds: Array,
               problem: Problem, values: Values, duals: Values) -> tuple[Bound, None]:
    """Return the factor that the parity vector near the multipliers proves."""
    within = np.asarray(duals.get("noise", ()), dtype=float)
    if within.size != 2 * bounded.size:
        return Bound.none("the solver gave no multipliers"), None
    weights = np.zeros(bounds.size)
    upper, lower = np.split(within, 2)
    weights[bounded] = (upper - lower) / bounds[bounded]
    if exact.size and np.size(duals.get("no noise", ())) == exact.size:
        weights[exact] = np.asarray(duals["no noise"], dtype=float)
    p = weights[(window.count - 1) * window.A.shape[0] :].reshape(window.e.shape)
    proof = parity_proof(window, p, window.unseen(*(signature or (None, None))))
    gap = relative_gap(problem.value(values), proof.factor, problem.scale)
    free, words = not problem.constraint_names, f"parity vector, relative gap {gap:.1e}"
    return Bound(proof.factor, free and gap < PROVED, "parity",
                 words if free else "the bound is that without the further constraints", multipliers=proof), None


def _onsets(onsets: Sequence[int] | str, count: int) -> list[int] | None:
    if isinstance(onsets, str):
        if onsets not in ("all", "course"):
            raise StructureError(f"onsets={onsets!r}: use 'all', 'course' or integers.")
        return list(range(count)) if onsets == "all" else None
    chosen = sorted({int(k) for k in onsets})
    if not chosen or chosen[0] < 0 or chosen[-1] >= count:
        raise StructureError(f"onsets: they must be integers from 0 to {count - 1}, at least one.")
    return chosen

"""Set membership of a window, for the programmes that a formulation states: a healthy plant, then every candidate.

The onset of a candidate is searched by branch and bound: a free course between two samples followed by a step includes
every step with an onset between them.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.errors import StructureError
from optid.faults.consistency.bounded_noise import BoundedWindow, Membership, ParityProof, parity_proof
from optid.faults.signatures import Candidate, Dictionary
from optid.program.solution import Bound, Solution, relative_gap
from optid.solving.solve import Evidence, Procedure

PROVED = 1e-6
"""Relative gap below which a factor is proved to be the least."""

Signature = tuple[Array, Array]
"""Additions of a fault of unknown sizes: (N, n, c) to x(k), (N, l, c) to y(k)."""

Pose = Callable[[BoundedWindow, Signature | None], Problem]
"""States the problem of a healthy plant, or with additions of unknown sizes."""


def judge_candidates(window: BoundedWindow, pose: Pose, faults: Dictionary | None, onsets: Sequence[int] | str,
                     candidates: bool, constraints: Sequence[Any]) -> Procedure:
    """Find the factor of a healthy plant, and whether every candidate is possible.

    Arguments, result and errors are those of `formulations.faults.membership.membership`.
    """
    tried = _onsets(onsets, window.count)
    solution = yield pose(window, None).subject_to(*constraints)
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
        found = yield from _possible(window, pose, candidate, unit, tried)
        factors[candidate.label], where[candidate.label], proofs[candidate.label] = found
    status = "" if solution.status.is_optimum else f"{solution.status}: {solution.reason}"
    shown = solution.bound.multipliers if solution.has_point and solution.bound is not None else None
    result = Membership(factor, shown, factors, where, proofs, untested, window, status)
    return Evidence.of(solution, result, {"least factor of the bounds": factor,
                                          "candidates possible": len(result.consistent)})


def _possible(window: BoundedWindow, pose: Pose, candidate: Candidate, unit: Signature, tried: list[int] | None
              ) -> Generator[Problem, Solution, tuple[float, int | None, dict[tuple[int, int], ParityProof]]]:
    """Return a factor and onset at which a candidate is possible; or the least factor proved, with all proofs.

    The factor is NaN where the solver gave neither; `unit` is the addition of a unit course in each sample.
    """
    if tried is None:
        solution = yield pose(window, _between(candidate, unit, 0, window.count))
        proof = _proof_of(solution)
        return (_factor(solution), None, {}) if proof is None else (proof.factor, None, {(0, window.count - 1): proof})
    proofs: dict[tuple[int, int], ParityProof] = {}
    waiting: list[tuple[float, int, int]] = [(0.0, 0, len(tried) - 1)]
    while waiting:
        waiting.sort()  # the smallest factor first
        _, first, last = waiting.pop(0)
        solution = yield pose(window, _between(candidate, unit, tried[first], tried[last]))
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


def prove_factor(window: BoundedWindow, signature: Signature | None, weights: Array, problem: Problem, values: Values
              ) -> Bound:
    """Return the factor that the parity vector near the multipliers of the noise proves.

    Args:
        window: the window.
        signature: the additions of unknown sizes.
        weights: multipliers of the noise in the states, (N - 1) n, then in the outputs, N l.
        problem: the problem of the window.
        values: its solution.
    """
    p = weights[(window.count - 1) * window.A.shape[0] :].reshape(window.e.shape)
    proof = parity_proof(window, p, window.unseen(*(signature or (None, None))))
    gap = relative_gap(problem.value(values), proof.factor, problem.scale)
    free, words = not problem.constraint_names, f"parity vector, relative gap {gap:.1e}"
    return Bound(proof.factor, free and gap < PROVED, "parity",
                 words if free else "the bound is that without the further constraints", multipliers=proof)


def _onsets(onsets: Sequence[int] | str, count: int) -> list[int] | None:
    if isinstance(onsets, str):
        if onsets not in ("all", "course"):
            raise StructureError(f"onsets={onsets!r}: use 'all', 'course' or integers.")
        return list(range(count)) if onsets == "all" else None
    chosen = sorted({int(k) for k in onsets})
    if not chosen or chosen[0] < 0 or chosen[-1] >= count:
        raise StructureError(f"onsets: they must be integers from 0 to {count - 1}, at least one.")
    return chosen

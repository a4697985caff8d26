"""Faults as a group-sparse programme: few candidates at few onsets explain the whitened innovations of a window.

    min over a:   1/2 ‖r - sum Q_c,theta a_c,theta‖²  +  lambda sum sqrt(q_c) ‖a_c,theta‖

Q has orthonormal columns, q is the threshold of the exact search for one fault. At lambda = 1 something is active
exactly when that search raises an alarm: zero is optimal if and only if ‖Q' r‖² <= q for every candidate and onset.
The sum-of-norms form is that of Ohlsson, Gustafsson, Ljung and Boyd (Automatica 48, 2012). Its magnitudes are biased
and onsets next to one another share the work, so that the result selects onsets for an exact search.

Named variables: ``a[label]`` (onsets, d); named expressions: ``size[label]`` (onsets, d), in the units of the fault.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.core.problem import Problem
from optid.core.terms import GroupNorms, Squares, Values
from optid.errors import StructureError
from optid.faults.search.atoms import Atoms, atoms_of
from optid.faults.search.calibration import Thresholds
from optid.faults.search.scanning import Scan
from optid.faults.search.sparse import ActiveGroup, SparseResult
from optid.program.solution import Bound, Solution, Status
from optid.solving.solve import Evidence, Procedure
from optid.structures.group_sparse import GroupProblem


def signature(found: Scan, limits: Thresholds, *, penalty: float = 1.0, constraints: Sequence[Any] = ()) -> Procedure:
    """Estimate the signatures of several faults at once.

    Args:
        found: the search of the window.
        limits: its thresholds.
        penalty: lambda.
        constraints: further constraints on ``a[label]`` and ``size[label]``.

    Returns:
        An `optid.faults.search.sparse.SparseResult`.

    Raises:
        StructureError: a penalty that is not positive, thresholds that do not fit, a window that is too long.
    """
    atoms = atoms_of(found, limits)
    problem = _problem(atoms, found.whitened.r.ravel(), penalty).subject_to(*constraints)
    solution = yield problem
    result = _sparse_result(problem, solution, atoms, len(found.whitened.r))
    return Evidence(result, solution.objective, solution.bound or Bound.none(solution.reason), solution.status,
                    solution.reason,
                    {"groups active": len(result.active), "clusters": len(result.clusters),
                     "relative gap": result.gap, "smallest penalty without a fault": result.largest})


def _problem(atoms: Sequence[Atoms], r: np.ndarray, penalty: float) -> Problem:
    """State the problem of a window r (N l,)."""
    if not (np.isfinite(penalty) and penalty > 0):
        raise StructureError(f"penalty={penalty!r}; it must be a positive number.")
    if not atoms:
        raise StructureError("No candidate is tested at any onset: the programme has no groups.")
    start, parts, weights, designs = {}, {}, {}, []
    for atom in atoms:
        name, axes = f"a[{atom.label}]", np.moveaxis(atom.axes, 1, 0)  # (N l, onsets, d)
        designs.append(axes.reshape(r.size, -1))
        parts[name] = np.swapaxes(axes, 1, 2).reshape(r.size, -1)
        weights[name] = np.full(atom.onsets.size, penalty * np.sqrt(atom.threshold))
        along = np.einsum("tkd,k->td", atom.axes, r)
        best = np.argmax(np.sum(along**2, axis=1))  # the candidate alone, at its best onset
        start[name] = np.where(np.arange(len(along))[:, None] == best, along, 0.0)
    edges = np.cumsum([0, *(atom.dimension for atom in atoms for _ in atom.onsets)])
    numbers = GroupProblem(np.hstack(designs), r, edges, np.concatenate(list(weights.values())) / penalty)

    misfit = Squares.half(r, parts, numbers)  # 1/2 ‖r - sum Q a‖²
    groups = GroupNorms(weights)  # lambda sum sqrt(q) ‖a‖

    return Problem("fault.signature", start, (misfit, groups), further=partial(_sizes, atoms),
                   scale=0.5 * float(r @ r), weights={"lambda": penalty})


def _sizes(atoms: Sequence[Atoms], view: Mapping[str, Any], _: Values) -> dict[str, Any]:
    """Return the sizes in the units of the faults: size[t] = back[t] a[t]."""
    found = {}
    for atom in atoms:
        a, ones = view[f"a[{atom.label}]"], np.ones((1, atom.dimension))
        found[f"size[{atom.label}]"] = sum(
            cp.multiply(atom.back[:, :, j], a[:, [j]] @ ones) for j in range(atom.dimension))
    return found


def _sparse_result(stated: Problem, solution: Solution, atoms: Sequence[Atoms], count: int) -> SparseResult:
    """Read the solution for a window of some samples; groups that rounding has left of zeros are zeros."""
    (misfit, _), penalty, bound = stated.terms, stated.weights["lambda"], solution.bound
    problem: GroupProblem = misfit.lifted
    certified = bool(solution.has_point and solution.proof and solution.status in (Status.OPTIMAL, Status.LOCAL))
    zero = np.zeros(problem.weights.size, dtype=bool)
    if certified and not stated.constraint_names and bound is not None and bound.multipliers is not None:
        zero = problem.certainly_zero(bound.multipliers, solution.objective - bound.value, penalty)
    active: list[ActiveGroup] = []
    masks = {atom.label: np.zeros(count, dtype=bool) for atom in atoms}
    norms = np.concatenate([np.linalg.norm(solution.values[name], axis=1) for name in stated.start]
                           ) if solution.has_point else np.zeros(problem.weights.size)
    floor = 1e-6 * max(float(norms.max()), float(np.sqrt(2 * stated.scale)) * 1e-3)
    first = 0
    for atom in atoms:
        here = slice(first, first + atom.onsets.size)
        masks[atom.label][atom.onsets] = zero[here]
        for t in np.flatnonzero((norms[here] > floor) & ~zero[here]):
            size = atom.back[t] @ np.asarray(solution.values[f"a[{atom.label}]"])[t]
            active.append(ActiveGroup(atom.label, int(atom.onsets[t]), size, float(norms[here][t])))
        first += atom.onsets.size
    active.sort(key=lambda group: -group.deflection)
    return SparseResult(tuple(active), count, solution.objective,
                        -np.inf if bound is None else bound.value, solution.gap, certified,
                        problem.largest(), penalty, masks, f"{solution.status}: {solution.reason}".rstrip(": "),
                        solution.solver, stated.constraint_names)

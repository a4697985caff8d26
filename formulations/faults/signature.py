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

from optid.core.group_sparse import group_squares
from optid.core.problem import Problem
from optid.core.terms import GroupNorms
from optid.errors import StructureError
from optid.faults.false_alarms import Thresholds
from optid.faults.search.scanning import Scan
from optid.faults.search.sparse import Atoms, SparseResult, atoms_of
from optid.solving.solve import Evidence, Procedure


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
    result = SparseResult.of(problem, solution, atoms, len(found.whitened.r))
    return Evidence.of(solution, result, {
        "groups active": len(result.active), "clusters": len(result.clusters), "relative gap": result.gap,
        "smallest penalty without a fault": result.largest})


def _problem(atoms: Sequence[Atoms], r: np.ndarray, penalty: float) -> Problem:
    """State the problem of a window r (N l,)."""
    if not (np.isfinite(penalty) and penalty > 0):
        raise StructureError(f"penalty={penalty!r}; it must be a positive number.")
    if not atoms:
        raise StructureError("No candidate is tested at any onset: the programme has no groups.")
    start, axes, weights = {}, {}, {}
    for atom in atoms:
        name = f"a[{atom.label}]"
        axes[name] = np.moveaxis(atom.axes, 1, 0)  # (N l, onsets, d)
        weights[name] = np.full(atom.onsets.size, np.sqrt(atom.threshold))
        along = np.einsum("tkd,k->td", atom.axes, r)
        best = np.argmax(np.sum(along**2, axis=1))  # the candidate alone, at its best onset
        start[name] = np.where(np.arange(len(along))[:, None] == best, along, 0.0)

    misfit = group_squares(r, axes, weights)  # 1/2 ‖r - sum Q a‖²
    groups = GroupNorms({name: penalty * one for name, one in weights.items()})  # lambda sum sqrt(q) ‖a‖

    return Problem("fault.signature", start, (misfit, groups), further=partial(_sizes, atoms),
                   scale=0.5 * float(r @ r), weights={"lambda": penalty})


def _sizes(atoms: Sequence[Atoms], view: Mapping[str, Any], _: object) -> dict[str, Any]:
    """Return the sizes in the units of the faults: size[t] = back[t] a[t]."""
    found = {}
    for atom in atoms:
        a, ones = view[f"a[{atom.label}]"], np.ones((1, atom.dimension))
        found[f"size[{atom.label}]"] = sum(
            cp.multiply(atom.back[:, :, j], a[:, [j]] @ ones) for j in range(atom.dimension))
    return found

"""Set membership: the least factor of the bounds of the noise at which a window is possible, as linear programmes.

    min t   subject to   x(k + 1) - A x(k) = w(k),  |w| <= t w̄,   e(k) - C x(k) = v(k),  |v| <= t v̄

with x the deviation of the states from a simulation from zero, and e the readings less that simulation. t > 1 proves
that the window is not that of a healthy plant; the multipliers of the measurements approximate the parity vector of the
proof (`optid.faults.consistency.bounded_noise`). With a fault of unknown size the same programme tests a candidate. Its
onset is searched by branch and bound: a free course between two samples followed by a step includes every step with an
onset between them. Bounds of t are recomputed from parity vectors, not taken from a solver.

Named variables: ``t``; named expressions: ``x`` (N, n) and, with a candidate, ``size``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.core.problem import Problem
from optid.core.terms import Expressed
from optid.data.record import Data
from optid.faults.consistency.bounded_noise import SIGMAS, BoundedWindow, bounded_window
from optid.faults.consistency.candidate_tests import judge_candidates, prove_factor
from optid.faults.signatures import Dictionary
from optid.program.solution import Bound
from optid.program.view import View
from optid.solving.solve import Procedure

Array = np.ndarray


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
    return judge_candidates(bounded_window(model, data, bounds), _problem, faults, onsets, candidates, constraints)


def _problem(window: BoundedWindow, signature: Any = None) -> Problem:
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

    def proof(problem: Problem, values: Mapping[str, Array], duals: Mapping[str, Array]) -> tuple[Bound, None]:
        """Return the factor that the multipliers of the noise prove."""
        weights, within = np.zeros(bounds.size), np.asarray(duals.get("noise", ()), dtype=float)
        if within.size != 2 * bounded.size:
            return Bound.none("the solver gave no multipliers"), None
        upper, lower = np.split(within, 2)
        weights[bounded] = (upper - lower) / bounds[bounded]
        if exact.size and np.size(duals.get("no noise", ())) == exact.size:
            weights[exact] = np.asarray(duals["no noise"], dtype=float)
        return prove_factor(window, signature, weights, problem, values), None

    return Problem(
        "fault.membership", start, (Expressed(lambda v: v["t"]),),
        further=lambda v, _: {"x": cp.reshape(v["states"], (count, n), order="C")}, restrictions=(possible,),
        proof=proof)

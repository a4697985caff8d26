"""Small constrained least-squares problems straight to Clarabel: CVXPY takes longer to translate than it to solve."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
import scipy.sparse as sp

from optid.backends.back_end import Answer, Settings
from optid.backends.conic import tolerances
from optid.program.solution import Status

Side = tuple[np.ndarray, np.ndarray]
"""Rows (r, n) and right-hand sides (r,)."""

STATUS = {
    "Solved": Status.OPTIMAL, "AlmostSolved": Status.INACCURATE, "PrimalInfeasible": Status.INFEASIBLE,
    "AlmostPrimalInfeasible": Status.INFEASIBLE, "DualInfeasible": Status.UNBOUNDED,
    "AlmostDualInfeasible": Status.UNBOUNDED, "MaxIterations": Status.LIMIT, "MaxTime": Status.LIMIT,
}


def solve_least_squares(matrix: np.ndarray, target: np.ndarray, equal: Sequence[Side], below: Sequence[Side],
                        settings: Settings) -> Answer:
    """Minimise ``‖matrix x - target‖²`` subject to ``rows x = right`` and ``rows x <= right``, matrix (k, n).

    The residuals are variables, so that the matrix is not squared.

    Returns:
        "x" (n,), where there is a usable point; "rows": multipliers of the equalities, then of the inequalities, for
        ``L = f + multipliers' (rows x - right)``.
    """
    clarabel: Any = import_module("clarabel")  # compiled, without types
    k, n = matrix.shape
    rows = np.vstack([np.hstack([matrix, -np.eye(k)]),
                      *(np.hstack([part, np.zeros((len(part), k))]) for part, _ in (*equal, *below))])
    right = np.concatenate([target, *(side for _, side in (*equal, *below))])
    inequalities = sum(len(part) for part, _ in below)
    cones = [clarabel.ZeroConeT(len(rows) - inequalities), clarabel.NonnegativeConeT(inequalities)]
    options = clarabel.DefaultSettings()
    options.verbose = settings.verbose
    for key, value in tolerances("clarabel", settings).items():
        setattr(options, key, value)
    weights = sp.diags_array(np.concatenate([np.zeros(n), np.full(k, 2.0)]), format="csc")
    found = clarabel.DefaultSolver(weights, np.zeros(n + k), sp.csc_array(rows), right,
                                   cones if inequalities else cones[:1], options).solve()
    status = STATUS.get(str(found.status), Status.FAILED)
    if status not in (Status.OPTIMAL, Status.INACCURATE, Status.LIMIT):
        return Answer(status, str(found.status))
    return Answer(status, str(found.status), {"x": np.asarray(found.x)[:n]}, {"rows": np.asarray(found.z)[k:]},
                  int(found.iterations))

"""Agreement of solvers with the same verified accuracy on the objective and on the model."""

import json
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from optid.studies.verdicts.outcomes import VALUE, Results, Table

MODEL = 1e-3  # a point is known to the square root of the accuracy of its objective


@dataclass(frozen=True)
class Agreement:
    """Pairs of solvers; all arrays are (S, S) and symmetric."""

    solvers: tuple[str, ...]
    common: np.ndarray  # problems that both verified; local minima count
    objective: np.ndarray  # those of them with the same objective to `VALUE`
    compared: np.ndarray  # those of them with the same objective and a model on both sides
    model: np.ndarray  # those of them with the same model to `MODEL` (poles, and fits on the hold-out samples)
    worst_objective: np.ndarray  # largest relative difference of objectives; nan without a common problem
    worst_model: np.ndarray  # largest difference of models where the objectives agree; nan where none was compared


def agreement_matrix(found: Results, table: Table) -> Agreement:
    """Compare every pair of solvers, of results and their rows, where both reached the verified accuracy."""
    same = max(VALUE, found.tolerance)
    gaps = np.abs(found.objective[:, :, None] - found.objective[:, None, :]) / found.size[:, None, None]
    gaps[:, np.eye(len(found.solvers), dtype=bool)] = np.nan
    apart, read = np.full(gaps.shape, np.nan), {}
    for p, i, j in np.argwhere(np.triu(gaps <= same)).tolist():
        apart[p, i, j] = apart[p, j, i] = model_distance(table, int(found.row[p, i]), int(found.row[p, j]), read)
    return Agreement(found.solvers, np.isfinite(gaps).sum(axis=0), (gaps <= same).sum(axis=0),
                     (~np.isnan(apart)).sum(axis=0), (apart <= MODEL).sum(axis=0),
                     np.fmax.reduce(gaps, axis=0, initial=np.nan), np.fmax.reduce(apart, axis=0, initial=np.nan))


def model_distance(table: Table, i: int, j: int, read: dict[int, np.ndarray | None] | None = None) -> float:
    """Return the distance of the models of rows i and j of a table; `read` caches the poles by row.

    It is the larger of the distance between poles (best matching) and between fits (as a share of 100 points), ``nan``
    if both are unknown and ``inf`` for different orders.
    """
    read = {} if read is None else read
    for k in (i, j):
        if k not in read:
            try:
                read[k] = np.array([complex(*pair) for pair in json.loads(table["poles"][k])], dtype=complex)
            except (TypeError, ValueError, RecursionError):  # none to read
                read[k] = None
    one, other = read[i], read[j]
    parts = [abs(table[c][i] - table[c][j]) / 100 for c in ("one_step_fit", "simulation_fit")]
    if one is not None and other is not None:
        if one.size != other.size:
            return float("inf")
        gaps = np.abs(one[:, None] - other)
        parts.append(float(np.max(gaps[linear_sum_assignment(gaps)], initial=0.0)))
    return max((part for part in parts if not np.isnan(part)), default=float("nan"))

"""Do solvers that reached the same verified accuracy agree on the objective, and on the model?"""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from optid.studies.verdicts.outcomes import VALUE, Results

MODEL = 1e-3  # a point is known to the square root of the accuracy of its objective


@dataclass(frozen=True)
class Agreement:
    """Pairs of solvers.

    Attributes:
        solvers: labels.
        common: problems that both verified, (S, S); local minima count.
        objective: those of them with the same objective to `VALUE`, (S, S).
        compared: those of them with the same objective and a model on both sides, (S, S).
        model: those of them with the same model to `MODEL` (poles, and fits on the hold-out samples), (S, S).
        worst_objective: largest relative difference of objectives, (S, S); ``nan`` without a common problem.
        worst_model: largest difference of models where the objectives agree, (S, S); ``nan`` where none was compared.
    """

    solvers: tuple[str, ...]
    common: np.ndarray
    objective: np.ndarray
    compared: np.ndarray
    model: np.ndarray
    worst_objective: np.ndarray
    worst_model: np.ndarray


def agreement_matrix(found: Results, table: Mapping[str, np.ndarray]) -> Agreement:
    """Compare every pair of solvers on the problems where both reached the verified accuracy.

    Args:
        found: problems and solvers.
        table: the rows they come from.
    """
    s = len(found.solvers)
    counts = {name: np.zeros((s, s), dtype=int) for name in ("common", "objective", "compared", "model")}
    worst = {name: np.full((s, s), np.nan) for name in ("worst_objective", "worst_model")}
    poles: dict[int, np.ndarray | None] = {}
    for problem, (objectives, rows) in enumerate(zip(found.objective, found.row)):
        there = np.flatnonzero(np.isfinite(objectives))
        for a, i in enumerate(there):
            for j in there[a + 1 :]:
                distance = abs(objectives[i] - objectives[j]) / found.size[problem]
                same = distance <= max(VALUE, found.tolerance)
                counts["common"][i, j] += 1
                counts["objective"][i, j] += same
                worst["worst_objective"][i, j] = np.fmax(worst["worst_objective"][i, j], distance)
                if same:
                    apart = model_distance(table, rows[i], rows[j], poles)
                    if not np.isnan(apart):
                        counts["compared"][i, j] += 1
                        counts["model"][i, j] += apart <= MODEL
                        worst["worst_model"][i, j] = np.fmax(worst["worst_model"][i, j], apart)
    both = {name: np.triu(m) + np.triu(m, 1).T for name, m in counts.items()}
    mirrored = {name: np.fmax(m, m.T) for name, m in worst.items()}
    return Agreement(found.solvers, **both, **mirrored)


def model_distance(
    table: Mapping[str, np.ndarray], i: int, j: int, read: dict[int, np.ndarray | None] | None = None
) -> float:
    """Return the larger of the distance between poles (best matching) and between fits (as a share of 100 points).

    Args:
        table: rows.
        i: number of a row.
        j: number of another.
        read: poles read so far.

    Returns:
        The distance; ``nan`` where neither poles nor fits are known on both sides, ``inf`` for different orders.
    """
    read = {} if read is None else read
    for k in (i, j):
        if k not in read:
            read[k] = parse_poles(table["poles"][k])
    one, other = read[i], read[j]
    parts = [abs(table[c][i] - table[c][j]) / 100 for c in ("one_step_fit", "simulation_fit")]
    if one is not None and other is not None:
        if one.size != other.size:
            return float("inf")
        gaps = np.abs(one[:, None] - other)
        parts.append(float(np.max(gaps[linear_sum_assignment(gaps)], initial=0.0)))
    known = [part for part in parts if not np.isnan(part)]
    return max(known, default=float("nan"))


def parse_poles(text: str) -> np.ndarray | None:
    """Return the complex poles of a row, or None where there are none to read."""
    try:
        return np.array([complex(*pair) for pair in json.loads(text)], dtype=complex)
    except (TypeError, ValueError, RecursionError):
        return None

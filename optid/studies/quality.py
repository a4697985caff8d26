"""Formulations compared by their models: fits on samples not seen, and errors against the truth where it is known."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optid.studies.averages import Paired, paired_difference
from optid.studies.choice import Choice, choose
from optid.studies.outcomes import Results
from optid.studies.ranks import Ranking, rank_over_data_sets, ranks_of_problems, scores_by_data_set

MINOR = 0.1  # points of simulation fit that nobody would see in a plot
SLACK = 0.5  # share of the records by which a formulation may stay behind: fits compare on common records anyway


@dataclass(frozen=True)
class Figure:
    """One figure of the models of one formulation.

    Attributes:
        mean: over the records that this formulation solved; ``nan`` where it is never known.
        n: records with the figure.
    """

    mean: float
    n: int


@dataclass(frozen=True)
class Quality:
    """Records against formulations; on every record the model of the solver with the best verified objective.

    Attributes:
        formulations: labels.
        records: their number.
        solved: {formulation: records on which some solver reached the accuracy}.
        figures: {column: {formulation: figure}}.
        choice: by simulation fit on the hold-out samples.
        ranking: by the same over data sets.
        truth: whether the truth is known for some model.
    """

    formulations: tuple[str, ...]
    records: int
    solved: dict[str, int]
    figures: dict[str, dict[str, Figure]]
    choice: Choice
    ranking: Ranking
    truth: bool


FIGURES = ("simulation_fit", "one_step_fit", "parameter_error", "nonlinearity_error")


def _points(values: np.ndarray, reference: np.ndarray) -> Paired:
    return paired_difference(values, reference)


def compare_formulations(found: Results, table: Mapping[str, np.ndarray]) -> Quality:
    """Compare the models of the formulations record by record.

    Args:
        found: problems and solvers.
        table: the rows they come from.
    """
    names = tuple(sorted(set(found.formulation)))
    case = found.case
    records = int(case.max()) + 1 if case.size else 0
    row = np.full((records, len(names)), -1)
    for p in range(len(case)):
        if found.solved[p].any():
            best = int(np.nanargmin(np.where(found.solved[p], found.objective[p], np.nan)))
            row[case[p], names.index(found.formulation[p])] = found.row[p, best]
    values = {c: np.where(row >= 0, table[c][row] if len(table[c]) else np.nan, np.nan) for c in FIGURES}
    figures = {
        c: {name: Figure(_mean(v[:, f]), int(np.isfinite(v[:, f]).sum())) for f, name in enumerate(names)}
        for c, v in values.items()
    }
    data = np.array([""] * records, dtype=object)
    data[case] = [f"{s}\0{d}" for s, d in zip(found.study, found.data)]
    losses = 100.0 - values["simulation_fit"]
    ranking = rank_over_data_sets(scores_by_data_set(ranks_of_problems(losses), data), names)
    return Quality(
        names, records, {name: int((row[:, f] >= 0).sum()) for f, name in enumerate(names)}, figures,
        choose(losses, names, MINOR, _points, slack=SLACK), ranking, bool(np.isfinite(values["parameter_error"]).any()),
    )  # fmt: skip


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if known.size else float("nan")

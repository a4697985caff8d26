"""Formulations compared by their models: fits on samples not seen, and errors against the truth where it is known."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optid.studies.verdicts.averages import paired_difference, paired_ratio
from optid.studies.verdicts.choice import Choice, choose
from optid.studies.verdicts.outcomes import NOT_RUN, Results
from optid.studies.verdicts.ranks import Ranking, rank_over_data_sets, ranks_of_problems, scores_by_data_set

MINOR = 0.1  # points of simulation fit that nobody would see in a plot; 10 % of a parameter error
SMALLEST = 1e-12  # parameter errors below are roundoff
WORST = -100.0  # %; a simulation that runs away must not decide a mean over all records
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
        figures: {column: {formulation: figure}}; fits below `WORST` count as that.
        measure: column of the comparison: the simulation fit on the hold-out samples, or the parameter error where more
            formulations have that on most of the records they solved.
        choice: by this measure, in points of fit or as a ratio of errors.
        ranking: by the same over data sets.
        truth: whether the truth is known for some model.
    """

    formulations: tuple[str, ...]
    records: int
    solved: dict[str, int]
    figures: dict[str, dict[str, Figure]]
    measure: str
    choice: Choice
    ranking: Ranking
    truth: bool


FITS = ("simulation_fit", "one_step_fit")
FIGURES = ("simulation_fit", "one_step_fit", "parameter_error", "nonlinearity_error")


def compare_formulations(found: Results, table: Mapping[str, np.ndarray], level: float = 0.05) -> Quality:
    """Compare the models of the formulations record by record.

    Args:
        found: problems and solvers.
        table: the rows they come from.
        level: significance level of the test over data sets.
    """
    names = tuple(sorted(set(found.formulation)))
    case = found.case
    records = int(case.max()) + 1 if case.size else 0
    row = np.full((records, len(names)), -1)
    verified = found.verified  # a model without a time is a model
    for p in np.flatnonzero(verified.any(axis=1)):
        best = int(np.nanargmin(np.where(verified[p], found.objective[p], np.nan)))
        row[case[p], names.index(found.formulation[p])] = found.row[p, best]
    values = {c: np.where(row >= 0, table[c][row] if len(table[c]) else np.nan, np.nan) for c in FIGURES}
    values |= {c: np.maximum(values[c], WORST) for c in FITS}
    figures = {
        c: {name: Figure(_mean(v[:, f]), int(np.isfinite(v[:, f]).sum())) for f, name in enumerate(names)}
        for c, v in values.items()
    }
    data = np.array([""] * records, dtype=object)
    data[case] = [f"{s}\0{d}" for s, d in zip(found.study, found.data)]
    usual = {c: ((2 * np.isfinite(v).sum(axis=0) > (row >= 0).sum(axis=0)).sum(), np.isfinite(v).sum())
             for c, v in values.items()}  # fmt: skip
    if usual["parameter_error"] > usual["simulation_fit"]:
        measure, losses = "parameter_error", np.maximum(values["parameter_error"], SMALLEST)
        choice = choose(losses, names, MINOR, paired_ratio, none=1.0, slack=SLACK, noun="record")
    else:
        measure, losses = "simulation_fit", 100.0 - values["simulation_fit"]
        choice = choose(losses, names, MINOR, paired_difference, slack=SLACK, noun="record")
    solved = {name: int((row[:, f] >= 0).sum()) for f, name in enumerate(names)}
    truth = bool(np.isfinite(values["parameter_error"]).any())
    return Quality(names, records, solved, figures, measure, choice,
                   _ranking(found, case, losses, data, names, level), truth)  # fmt: skip


def _ranking(found: Results, case: np.ndarray, losses: np.ndarray, data: np.ndarray, names: tuple[str, ...],
             level: float) -> Ranking:  # fmt: skip
    """Rank the formulations that were tried on every data set; where one was not solved it is last."""
    tried = np.zeros(losses.shape, dtype=bool)
    for p, formulation in enumerate(found.formulation):
        tried[case[p], names.index(formulation)] |= bool(np.any(found.state[p] != NOT_RUN))
    labels = list(dict.fromkeys(data))
    everywhere = np.array([all(tried[data == d, f].any() for d in labels) for f in range(len(names))], dtype=bool)
    kept = tuple(name for name, there in zip(names, everywhere) if there)
    out = tuple(name for name, there in zip(names, everywhere) if not there)
    scores = scores_by_data_set(ranks_of_problems(losses[:, everywhere]), data)
    return rank_over_data_sets(scores, kept, out, level, "formulation")


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if known.size else float("nan")

"""Formulations compared by their models: fits on samples not seen, and errors against the truth where it is known."""

from dataclasses import dataclass, replace

import numpy as np

from optid.studies.verdicts.averages import MINIMUM_PAIRS, means_of_groups, paired_mean
from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, TIE, Choice, choose
from optid.studies.verdicts.outcomes import Results, Table

SMALLEST = 1e-12  # parameter errors below are roundoff
WORST = -100.0  # %; a simulation that runs away must not decide a mean over all records
FEW = MINIMUM_PAIRS  # data sets, from which on they are compared as one sample; fewer are compared one by one
SLACK = 0.5  # share of the records by which a formulation may stay behind: fits compare on common records anyway
FIGURES = ("simulation_fit", "one_step_fit", "parameter_error", "nonlinearity_error")


@dataclass(frozen=True)
class DataSet:
    """The comparison on the records of one data set (lengths, noises and seeds of a system, or a file), or on all.

    The mean of a figure is over the data sets, of the means over the records that the formulation solved.
    """

    name: str  # label of the data set; "" for all
    records: int
    solved: dict[str, int]  # {formulation: records on which some solver reached the accuracy}
    figures: dict[str, dict[str, float]]  # {column: {formulation: mean}}, nan where never known; fits from `WORST` on
    choice: Choice  # by these records alone

    @property
    def decided(self) -> bool:
        """Whether its records decide which of several formulations is the best, or that they are equal."""
        return self.choice.decided and bool(self.choice.against)


@dataclass(frozen=True)
class Quality(DataSet):
    """Records against formulations; on every record the model of the solver with the best verified objective.

    The choice is in points of fit or as a ratio of errors. One data set is compared by its records. Of fewer than `FEW`
    each is compared by its own records: first is the one that leads on all of them, and "depends" means that none does.
    From `FEW` on the data sets are the sample, each with the mean over its records.
    """

    formulations: tuple[str, ...]
    measure: str  # column: the simulation fit, or the parameter error where more formulations have that on most records
    sets: tuple[DataSet, ...]  # the comparison on every data set

    @property
    def unit(self) -> str:
        """What the intervals of the choice count as one."""
        return "data set" if len(self.sets) > 1 else "record"

    @property
    def errors(self) -> bool:
        """Whether parameter errors are compared, by their ratios; else fits, by their differences."""
        return self.measure == "parameter_error"


def compare_formulations(found: Results, table: Table) -> Quality:
    """Compare the models of the formulations, of results and the rows they come from, record by record."""
    names, number = np.unique(found.formulation, return_inverse=True)
    names, case, shape = tuple(names), found.case, (int(found.case.max(initial=-1)) + 1, len(names))
    row = np.full(shape, -1)
    verified = found.verified  # a model without a time is a model
    for p in np.flatnonzero(verified.any(axis=1)):
        best = int(np.nanargmin(np.where(verified[p], found.objective[p], np.nan)))
        row[case[p], number[p]] = found.row[p, best]
    values = {c: np.where(row >= 0, table[c][row] if len(table[c]) else np.nan, np.nan) for c in FIGURES}
    values |= {c: np.maximum(values[c], WORST) for c in FIGURES[:2]}
    data = np.full(shape[0], "", dtype=object)
    data[case] = found.data_set
    usual = {c: ((2 * np.isfinite(v).sum(axis=0) > (row >= 0).sum(axis=0)).sum(), np.isfinite(v).sum())
             for c, v in values.items()}
    errors = usual["parameter_error"] > usual["simulation_fit"]
    measure = "parameter_error" if errors else "simulation_fit"
    losses = np.maximum(values[measure], SMALLEST) if errors else 100.0 - values[measure]

    def judge(here: np.ndarray, groups: np.ndarray | None = None) -> tuple:
        return (int(here.sum()), dict(zip(names, (row[here] >= 0).sum(axis=0).tolist())),
                {c: {name: _mean(v[here, f], data[here]) for f, name in enumerate(names)} for c, v in values.items()},
                choose(losses[here], names, errors, SLACK, "record" if groups is None else "data set", groups))

    sets = tuple(DataSet(name, *judge(data == key)) for key, name in _data_sets(data).items())
    whole = DataSet("", *judge(np.ones(len(data), dtype=bool), None if len(sets) == 1 else data))
    if 1 < len(sets) < FEW:
        whole = replace(whole, choice=_of_few(sets, whole.choice, losses, names, data, errors))
    return Quality(**vars(whole), formulations=names, measure=measure, sets=sets)


def _data_sets(data: np.ndarray) -> dict[str, str]:
    """{key: name} of every data set; the study is named where two of them have data of one name."""
    keys = sorted(key.split("\0") for key in set(data))
    labels = [label for _, label in keys]
    return {f"{study}\0{label}": label if labels.count(label) == 1 else f"{study}: {label}" for study, label in keys}


def _mean(values: np.ndarray, data: np.ndarray) -> float:
    known = np.isfinite(values)
    return float(np.mean(means_of_groups(values[known], data[known]))) if known.any() else float("nan")


def _of_few(sets: tuple[DataSet, ...], choice: Choice, losses: np.ndarray, names: tuple[str, ...], data: np.ndarray,
            errors: bool) -> Choice:
    """Choose between formulations on two to five data sets, too few for a sample: the one that leads on every one.

    An undecided data set excludes no formulation that is behind by less than a notable difference.
    """
    decided = [one for one in sets if one.decided]
    if not decided:
        return choice
    leaders = [name for name in names if all(
        name in one.choice.leaders if one.decided else
        name not in one.choice.against or not one.choice.against[name].notable for one in sets)]
    if not leaders:
        return replace(choice, kind=DEPENDS, first="", tied=(), missing="depends on the data")
    first = choice.first if choice.first in leaders else leaders[0]
    lead = losses[:, names.index(first)]
    against = {name: paired_mean(loss, lead, errors, data) for name, loss in zip(names, losses.T)
               if name != first and choice.solved[name]}
    tied, kind, missing = tuple(name for name in leaders if name != first), FIRST, ""
    if len(decided) < len(sets):
        kind, missing = CANNOT_TELL, f"needs at least {FEW} data sets, or {FEW} records of each"
    elif tied:
        kind = TIE
    return replace(choice, kind=kind, first=first, tied=tied, against=against, missing=missing)

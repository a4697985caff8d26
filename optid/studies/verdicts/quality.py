"""Formulations compared by their models: fits on samples not seen, and errors against the truth where it is known."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from optid.studies.verdicts.averages import MINIMUM_PAIRS, means_of_groups, paired_difference, paired_ratio
from optid.studies.verdicts.choice import CANNOT_TELL, DEPENDS, FIRST, TIE, Choice, choose
from optid.studies.verdicts.outcomes import NOT_RUN, Results
from optid.studies.verdicts.ranks import Ranking, rank_over_data_sets, ranks_of_problems, scores_by_data_set

MINOR = 0.1  # points of simulation fit that nobody would see in a plot; 10 % of a parameter error
SMALLEST = 1e-12  # parameter errors below are roundoff
WORST = -100.0  # %; a simulation that runs away must not decide a mean over all records
FEW = MINIMUM_PAIRS  # data sets, from which on they are compared as one sample; of fewer each speaks for itself
SLACK = 0.5  # share of the records by which a formulation may stay behind: fits compare on common records anyway


@dataclass(frozen=True)
class Figure:
    """One figure of the models of one formulation.

    Attributes:
        mean: over the data sets, of the means over the records that this formulation solved; ``nan`` where it is never
            known.
        n: records with the figure.
    """

    mean: float
    n: int


@dataclass(frozen=True)
class DataSet:
    """The comparison on the records of one data set: lengths, noise levels and seeds of one system, or a file.

    Attributes:
        name: label.
        records: their number.
        solved: {formulation: records on which some solver reached the accuracy}.
        figures: {column: {formulation: figure}}.
        choice: by these records alone.
    """

    name: str
    records: int
    solved: dict[str, int]
    figures: dict[str, dict[str, Figure]]
    choice: Choice

    @property
    def decided(self) -> bool:
        """Whether its records tell which of two or more formulations is the best here, or that they are equal."""
        return self.choice.kind in (FIRST, TIE) and bool(self.choice.against)

    @property
    def leaders(self) -> tuple[str, ...]:
        """Who is the best here, or cannot be told apart from it."""
        return (self.choice.first, *self.choice.tied)


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
        sets: the comparison on every data set.
        choice: by this measure, in points of fit or as a ratio of errors. One data set is judged by its records. Of
            fewer than `FEW` each is judged by its own: first is who leads on all of them, and "depends" says that
            nobody does. From `FEW` on the data sets are the sample, each with the mean over its records: records of
            one system do not say what holds on another.
        ranking: by the same over data sets.
        truth: whether the truth is known for some model.
    """

    formulations: tuple[str, ...]
    records: int
    solved: dict[str, int]
    figures: dict[str, dict[str, Figure]]
    measure: str
    sets: tuple[DataSet, ...]
    choice: Choice
    ranking: Ranking
    truth: bool

    @property
    def unit(self) -> str:
        """What the intervals of the choice count as one."""
        return "data set" if len(self.sets) > 1 else "record"


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
    data = np.array([""] * records, dtype=object)
    data[case] = [f"{s}\0{d}" for s, d in zip(found.study, found.data)]
    usual = {c: ((2 * np.isfinite(v).sum(axis=0) > (row >= 0).sum(axis=0)).sum(), np.isfinite(v).sum())
             for c, v in values.items()}  # fmt: skip
    if usual["parameter_error"] > usual["simulation_fit"]:
        measure, losses = "parameter_error", np.maximum(values["parameter_error"], SMALLEST)
        pairs, none = paired_ratio, 1.0
    else:
        measure, losses = "simulation_fit", 100.0 - values["simulation_fit"]
        pairs, none = paired_difference, 0.0
    sets = tuple(
        DataSet(name, int(here.sum()), _solved(row[here], names), _figures({c: v[here] for c, v in values.items()},
                                                                           names, data[here]),
                choose(losses[here], names, MINOR, pairs, none=none, slack=SLACK, noun="record"))
        for name, here in _data_sets(data))  # fmt: skip
    if len(sets) == 1:
        choice = sets[0].choice
    else:
        grouped = partial(pairs, groups=data)
        choice = choose(losses, names, MINOR, grouped, none=none, slack=SLACK, noun="data set", units=len(sets))
        if 1 < len(sets) < FEW:
            choice = _of_few(sets, choice, losses, names, grouped, none)
    truth = bool(np.isfinite(values["parameter_error"]).any())
    return Quality(names, records, _solved(row, names), _figures(values, names, data), measure, sets, choice,
                   _ranking(found, case, losses, data, names, level), truth)  # fmt: skip


def _data_sets(data: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Name and records (mask) of every data set; the study is named where two of them have data of one name."""
    keys = [tuple(key.split("\0")) for key in sorted(set(data))]
    labels = [label for _, label in keys]
    return [(label if labels.count(label) == 1 else f"{study}: {label}", data == f"{study}\0{label}")
            for study, label in keys]  # fmt: skip


def _solved(row: np.ndarray, names: tuple[str, ...]) -> dict[str, int]:
    return {name: int((row[:, f] >= 0).sum()) for f, name in enumerate(names)}


def _figures(values: dict[str, np.ndarray], names: tuple[str, ...], data: np.ndarray) -> dict[str, dict[str, Figure]]:
    return {c: {name: _figure(v[:, f], data) for f, name in enumerate(names)} for c, v in values.items()}


def _figure(values: np.ndarray, data: np.ndarray) -> Figure:
    known = np.isfinite(values)
    mean = float(np.mean(means_of_groups(values[known], data[known]))) if known.any() else float("nan")
    return Figure(mean, int(known.sum()))


def _of_few(sets: tuple[DataSet, ...], choice: Choice, losses: np.ndarray, names: tuple[str, ...],
            compare: Callable, none: float) -> Choice:  # fmt: skip
    """Choose between formulations on two to five data sets, too few to be a sample: who leads on every one of them."""
    decided = [one for one in sets if one.decided]
    if not decided:
        return choice
    leaders = [name for name in names
               if all(name in one.leaders if one.decided else _close(one, name, none) for one in sets)]  # fmt: skip
    if not leaders:
        return replace(choice, kind=DEPENDS, first="", tied=(), missing="depends on the data")
    first = choice.first if choice.first in leaders else leaders[0]
    lead = names.index(first)
    against = {name: compare(losses[:, f], losses[:, lead]) for f, name in enumerate(names)
               if name != first and choice.solved[name]}  # fmt: skip
    tied = tuple(name for name in leaders if name != first)
    told = len(decided) == len(sets)
    kind = (TIE if tied else FIRST) if told else CANNOT_TELL
    missing = "" if told else f"needs at least {FEW} data sets, or {FEW} records of each"
    return replace(choice, kind=kind, first=first, tied=tied, against=against, missing=missing)


def _close(one: DataSet, name: str, none: float) -> bool:
    """Whether a data set that cannot tell says nothing against a formulation: it is behind by a trifle at most."""
    pair = one.choice.against.get(name)
    return pair is None or not pair.value > (none * (1 + MINOR) if none else MINOR)


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

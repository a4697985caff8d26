"""The solvers on the steps of procedures: a row per step and solver."""

import json
from dataclasses import dataclass

import numpy as np

from optid.studies.verdicts.averages import shifted_geometric_mean
from optid.studies.verdicts.outcomes import Table


@dataclass(frozen=True)
class StepStanding:
    """One solver on one step of a formulation, over all runs."""

    formulation: str
    step: str  # name of its programmes
    solver: str  # back end that ran
    programs: int  # that it solved or tried
    reached: int  # of them, with verified accuracy
    time: float  # shifted geometric mean over the runs of the seconds of the step
    iterations: float  # mean over the runs; nan where the solver does not count them


def compare_steps(table: Table) -> tuple[StepStanding, ...]:
    """Return the standings on every step of the formulations that have several, of rows as arrays by column."""
    runs: dict[tuple[str, str, str], list[dict[str, float]]] = {}
    several: set[str] = set()
    for formulation, text in zip(table["formulation"], table["steps"]):
        try:
            steps = json.loads(text)
        except ValueError:  # a run that got no answer, or rows of another program
            continue
        if len({step["step"] for step in steps}) > 1:
            several.add(formulation)
        for step in steps:
            runs.setdefault((formulation, step["step"], step["solver"]), []).append(step)
    return tuple(_standing(*key, found) for key, found in runs.items() if key[0] in several)


def _standing(formulation: str, step: str, solver: str, runs: list[dict[str, float]]) -> StepStanding:
    def column(name: str) -> np.ndarray:
        return np.array([np.nan if run[name] is None else run[name] for run in runs], dtype=float)

    counted = column("iterations")[np.isfinite(column("iterations"))]
    return StepStanding(
        formulation, step, solver, int(column("programs").sum()), int(column("reached").sum()),
        shifted_geometric_mean(np.maximum(column("seconds"), 1e-9)),
        float(counted.mean()) if counted.size else float("nan"))

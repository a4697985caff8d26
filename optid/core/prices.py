"""What every constraint of a problem costs: activity, slack, multiplier, and the multiplier in points of fit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.sparse import issparse

from optid.arrays import Array
from optid.core.constraint import symmetric_part
from optid.core.judge import ACTIVE, LagrangianAtPoint, RowsAtPoint, active_slopes, rows_at
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.program.limits import slope_of
from optid.structures.multipliers import exchange_multipliers

GAUGE = ""  # what the multipliers of gauges are called, which no constraint is


@dataclass(frozen=True)
class Price:
    """One user constraint at the solution.

    Multiplier and price are derivatives by the bound that the user wrote: the number in the constraint, in its units.
    Rows that share a bound move together; of several bounds the most expensive one counts. For conditions without a
    number (monotone, odd, ...) the bound is the zero in their rows: the tolerance, in units of f, by which each row
    may be violated.
    """

    name: str  # the user's name
    active: int  # how many of its rows hold with equality
    rows: int  # how many rows it has
    slack: float  # smallest slack over the rows in units of the constraint (0 for equalities)
    multiplier: float  # change of the objective per unit of the bound; ``nan`` where the solver gives no multipliers
    # points of one-step fit (%, all outputs together) gained per unit of the bound; ``nan`` where the constraint
    # belongs to a step with another objective
    fit_points: float
    step: float = float("nan")  # what 1 % is in units of the bound
    words: str = ""  # of what: of the range of f where the bound is about f, else of the size of the bounded quantity

    @property
    def binding(self) -> bool:
        """Whether at least one row is active."""
        return self.active > 0

    @property
    def points_per_step(self) -> float:
        """Points of one-step fit gained per step of the bound: the price that is printed."""
        return self.fit_points * self.step


def points_per_multiplier(objective: float, energy: float) -> float:
    """Return the points of one-step fit that a multiplier of one is worth; the energy is that of the outputs."""
    # two roots: the product of two sums of squares may leave the range of numbers
    return float(50.0 / np.sqrt(max(objective, 1e-9 * energy)) / np.sqrt(energy)) if energy > 0 else np.nan


def price_constraints(problem: Problem, x: Values, duals: Mapping[str, Array], objective: float) -> tuple[Price, ...]:
    """Return the price of every constraint of the user at a point with its multipliers, objective in its own units.

    Where the multipliers of a point are not unique, those count that say least.
    """
    if not problem.constraint_names:
        return ()
    y = problem.leaf_values(x)
    problem.space.assign(y)  # steps and shifts of bounds may be expressions of the leaves
    energy = problem.energy if np.isfinite(problem.energy) else problem.unit * problem.scale
    rows, worth = rows_at(problem, x), points_per_multiplier(problem.unit * objective, energy)
    exchange, found = least_multipliers(problem, x, rows, duals) if problem.is_measured else None, []
    for name in problem.constraint_names:
        group = [row for row in rows if row.constraint.name == name]
        gaps = [_slacks(row) for row in group]
        active = sum(int(np.count_nonzero(gap <= ACTIVE * row.size_in_words)) for row, gap in zip(group, gaps))
        limits, places = [row.constraint.limit for row in group], [row.constraint.span for row in group]
        steps = [0.01 * row.size_in_words if limit.step is None else limit.step() for row, limit in zip(group, limits)]
        choose = None if exchange is None else partial(exchange, name)
        slope, chosen = slope_of(limits, places, steps, duals[name], choose) if name in duals else (np.nan, 0)
        slope = slope if active or not np.isfinite(slope) else 0.0  # what a solver left on rows that hold nothing
        found.append(Price(
            name, active, sum(gap.size for gap in gaps),
            max(min(float(np.min(gap, initial=np.inf)) for gap in gaps), 0.0), problem.unit * slope,
            problem.unit * slope * worth, steps[chosen], limits[chosen].words or "the size of the bounded quantity"))
    return tuple(found)


def _slacks(row: RowsAtPoint) -> Array:
    """Distance of every row from its bound, in units of the constraint; zero for equalities."""
    sizes = row.constraint.sizes
    if row.constraint.is_equality:
        return np.zeros(len(row.constraint))
    if row.constraint.cone == "psd":
        return np.array([float(np.linalg.eigvalsh(-symmetric_part(row.residual * sizes))[0])])
    return -row.residual * sizes


def least_multipliers(problem: Problem, x: Values, rows: Sequence[RowsAtPoint], duals: Mapping[str, Array]
                      ) -> Callable[[str, Array], Array] | None:
    """Return, for an effect of the multipliers of a named constraint, those of all at the point that have the least.

    None where they are unique, not polyhedral, or too many (slopes are sparse).
    """
    if any(issparse(row.slope) or row.constraint.cone == "psd" for row in rows):
        return None
    lagrangian = LagrangianAtPoint.of(problem, x)
    floor = lagrangian.floor(lagrangian.magnitudes)
    columns, equality, parts = active_slopes(lagrangian, rows)
    count = len(problem.gauged)
    places = [(GAUGE, slice(k, k + 1), np.ones(1)) for k in range(count)]
    for row, stands in zip(rows, parts):
        places += [(row.constraint.name, row.constraint.span, direction) for direction in stands]
    known = [duals.get(row.constraint.name, np.zeros(0)) for row in rows]
    weights = lagrangian.gauge_multipliers(rows, [
        part[row.constraint.span] for row, part in zip(rows, known)]
    ) if all(part.size for part in known) else np.zeros(count)
    return exchange_multipliers(columns / floor, equality, places, -lagrangian.gradient / floor,
                                {**duals, GAUGE: weights})

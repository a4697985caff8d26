"""What every constraint of a problem costs: activity, slack, multiplier, and the multiplier in points of fit."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.optimize import linprog
from scipy.sparse import issparse

from optid.arrays import Array
from optid.core.constraint import symmetric_part
from optid.core.judge import ACTIVE, LagrangianAtPoint, RowsAtPoint, active_slopes, rows_at
from optid.core.problem import Problem
from optid.core.terms import Values
from optid.program.limits import EQUALITIES, INEQUALITIES

DEPENDENT = 1e-7  # singular value, of rows of length one, below which they say the same
STATIONARY = 1e-5  # relative residual up to which multipliers make a point stationary


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
        limits = [row.constraint.limit for row in group]
        steps = [0.01 * row.size_in_words if limit.step is None else limit.step() for row, limit in zip(group, limits)]
        choose = None if exchange is None else partial(exchange, name)
        slope, chosen = _dearest(group, steps, duals[name], choose) if name in duals else (np.nan, 0)
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

    None where they are unique, do not make the point stationary, are not polyhedral, or too many (slopes are sparse).
    """
    if any(issparse(row.slope) or row.constraint.cone == "psd" for row in rows):
        return None
    lagrangian = LagrangianAtPoint.of(problem, x)
    floor, count = lagrangian.floor(lagrangian.magnitudes), len(problem.gauged)
    slopes, equality, parts = active_slopes(lagrangian, rows)
    columns, target = slopes / floor, -lagrangian.gradient / floor
    lengths = np.maximum(np.linalg.norm(columns, axis=1), 1e-300)
    if np.linalg.matrix_rank(columns / lengths[:, None], tol=DEPENDENT) == len(columns):
        return None
    gauges = np.zeros(count)
    if all(row.constraint.name in duals for row in rows):
        gauges = lagrangian.gauge_multipliers(rows, [duals[row.constraint.name][row.constraint.span] for row in rows])
    # multipliers of what is active: of gauges, then the directions that one unit of each of the others stands for
    stands = [(row.constraint, direction) for row, directions in zip(rows, parts) for direction in directions]
    known = np.array([*gauges, *(
        float(duals[one.name][one.span] @ direction) if one.name in duals else 0.0 for one, direction in stands)])
    reached = columns.T @ known  # what they reach, they may be exchanged for
    if np.linalg.norm(reached - target) > STATIONARY * max(1.0, float(np.linalg.norm(columns.T * known))):
        return None

    def least(name: str, effect: Array) -> Array:
        cost = np.array([*np.zeros(count), *(
            float(effect[one.span] @ direction) if one.name == name else 0.0 for one, direction in stands)])
        found = linprog(cost / lengths, A_eq=(columns / lengths[:, None]).T, b_eq=reached,
                        bounds=[(None, None) if free else (0, None) for free in equality])
        there, chosen = known if found.status else found.x / lengths, np.zeros_like(duals[name])
        for weight, (one, direction) in zip(there[count:], stands):
            if one.name == name:
                chosen[one.span] += weight * direction
        return chosen

    return least


def _dearest(group: Sequence[RowsAtPoint], steps: Sequence[float], multipliers: Array,
             least: Callable[[Array], Array] | None) -> tuple[float, int]:
    """Return the derivative of the objective by the most expensive bound of a constraint, and its member's position.

    Bounds are compared by what a small step of each gains. The multipliers are those of the rows as they are scaled,
    flat, each member in its place, per unit of the objective; `least` returns, for an effect of them, others with the
    least.
    """
    places = [(row.constraint.limit, row.constraint.span) for row in group]
    totals, effects = {}, dict[Any, Array]()
    for limit, span in places if least is not None else ():
        if limit.bound is not None and limit.band is None and isinstance(limit.member, EQUALITIES | INEQUALITIES):
            effects.setdefault(limit.bound, np.zeros_like(multipliers))[span] = limit.speeds() / limit.sizes
    said = {name: least(effect) for name, effect in effects.items()} if least is not None else {}
    for number, (limit, span) in enumerate(places):
        part = said.get(limit.bound, multipliers)[span]
        cone = not isinstance(limit.member, EQUALITIES | INEQUALITIES)
        if cone and not isinstance(limit.shift, np.ndarray | cp.Expression):
            totals[number] = float(np.max(np.abs(part), initial=0.0)), number
            continue
        part = part if cone else part / limit.sizes
        if limit.band is not None and limit.span is not None:
            totals[number] = _band_slope(part, limit.band, limit.span), number
        elif limit.bound is None:
            totals[number] = float(np.max(np.abs(part * limit.speeds()), initial=0.0)), number
        else:
            before = totals.get(limit.bound, (0.0, number))[0]
            totals[limit.bound] = before + float(part @ limit.speeds()), number
    value, number = max(totals.values(), key=lambda one: abs(one[0]) * steps[one[1]])
    return abs(value), number


def _band_slope(multipliers: Array, band: Array, span: Array) -> float:
    """Gain per unit of t where ``span @ x = 0`` is replaced by ``|band @ x| <= t``, over the columns of x."""
    columns, weights = multipliers.reshape(-1, len(span)), band @ np.linalg.pinv(span)
    if len(band) == len(span):
        return float(np.sum(np.abs(np.linalg.solve(weights.T, columns.T))))
    total, rows = 0.0, np.vstack([weights, -weights])
    for column in columns:  # the most that the multipliers gain over all x inside the band, in coordinates span @ x
        found = linprog(-column, A_ub=rows, b_ub=np.ones(len(rows)), bounds=(None, None))
        total += -float(found.fun) if found.status == 0 else np.nan
    return total

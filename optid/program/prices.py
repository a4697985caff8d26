"""What every constraint costs: activity, slack, multiplier, and the multiplier in points of fit."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from cvxpy.constraints.constraint import Constraint
from cvxpy.constraints.psd import PSD
from cvxpy.constraints.second_order import SOC

from optid.program.expressions import flat_value
from optid.program.judging import term_size
from optid.program.limits import EQUALITIES, Limit, rows_of, slope_of
from optid.program.program import Program
from optid.program.solution import Solution

ACTIVE = 1e-6  # slack, relative to the size of the constraint's terms, below which it counts as active


@dataclass(frozen=True)
class Price:
    """One user constraint at the solution.

    Multiplier and price are derivatives by the bound that the user wrote: the number in the constraint, in its units.
    Rows that share a bound move together; of several bounds the most expensive one counts. For conditions without a
    number (monotone, odd, ...) the bound is the zero in their rows: how far, in units of f, each of them may be missed.
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
    words: str = ""  # of what: of the range of f where the bound is about f, else of the size of what it bounds

    @property
    def binding(self) -> bool:
        """Whether at least one row is active."""
        return self.active > 0

    @property
    def points_per_step(self) -> float:
        """Points of one-step fit gained per step of the bound: the price that is printed."""
        return self.fit_points * self.step


Least = Callable[[Program, Mapping[str, np.ndarray]], Callable[[str, np.ndarray], np.ndarray] | None]
"""`optid.certificate.multipliers.least_multipliers`."""


def price_constraints(program: Program, solution: Solution, least: Least | None = None) -> tuple[Price, ...]:
    """Return the price of every user constraint; empty without a point.

    Where the multipliers of a point are not unique, those count that say least (``least``).

    ``fit = 100 (1 - sqrt(F / S))`` with S the energy of the outputs about their means, so that a multiplier
    lambda = -dF/d(bound) is worth ``50 lambda / sqrt(F S)`` points.
    """
    if not solution.has_point or not program.user_constraints:
        return ()
    program.assign(solution.values)
    unit = program.unit
    energy = solution.scale if program.compressed is None else unit * float(np.sum(program.compressed.energy))
    worth = points_per_multiplier(solution.objective, energy)
    found, usual = [], program.usual_sizes
    exchanged = least(program, solution.duals) if least is not None and solution.duals else None
    for name, group in program.user_constraints.items():
        limits = program.limits.get(name) or tuple(Limit.of(member) for member in group)
        active, rows, slack = 0, 0, np.inf
        for limit in limits:
            gaps = _slacks(limit.member)
            rows += gaps.size
            active += int(np.count_nonzero(gaps <= ACTIVE * term_size(limit.member, usual)))
            slack = min(slack, float(np.min(gaps, initial=np.inf)))
        dual = solution.duals.get(name)
        steps = [0.01 * term_size(limit.member, usual) if limit.step is None else limit.step() for limit in limits]
        choose = None if exchanged is None else partial(exchanged, name)
        slope, chosen = slope_of(limits, steps, dual, choose) if dual is not None else (np.nan, 0)
        found.append(Price(name, active, rows, max(slack, 0.0), unit * slope, unit * slope * worth, steps[chosen],
                           limits[chosen].words or "the size of what it bounds"))
    return tuple(found)


def points_per_multiplier(objective: float, energy: float) -> float:
    """Return the points of one-step fit that a multiplier of one is worth; the energy is that of the outputs."""
    # two roots: the product of two sums of squares may leave the range of numbers
    return float(50.0 / np.sqrt(max(objective, 1e-9 * energy)) / np.sqrt(energy)) if energy > 0 else np.nan


def price_earlier_steps(steps: Mapping[str, tuple[Program, Solution]], last: Program) -> tuple[Price, ...]:
    """Return the prices of the constraints that are not in the last programme, from the step in which each stood.

    Their multipliers are in units of the objective of that step, so they have no price in points of fit.
    """
    found = []
    for name, (program, solution) in steps.items():
        if name not in last.user_constraints:
            found += [replace(p, fit_points=np.nan) for p in price_constraints(program, solution) if p.name == name]
    return tuple(found)


def _slacks(member: Constraint) -> np.ndarray:
    """Distance of every row from its bound; zero for equalities."""
    if isinstance(member, EQUALITIES):
        return np.zeros(member.size)
    if (rows := rows_of(member)) is not None:
        return -flat_value(rows)
    if isinstance(member, PSD):
        return np.array([float(np.linalg.eigvalsh(np.atleast_2d(member.args[0].value))[0])])
    if isinstance(member, SOC):
        return np.atleast_1d(member.args[0].value) - np.linalg.norm(np.atleast_1d(member.args[1].value))
    return np.ravel(member.args[0].value)

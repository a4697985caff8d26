"""What every constraint costs: activity, slack, multiplier, and the multiplier in points of fit."""

from dataclasses import dataclass

import numpy as np

ACTIVE = 1e-6  # slack, relative to the size of the constraint's terms, below which it counts as active


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

"""What a solve returns: why it stopped, whether there is a point, whether it is proved, what we measured ourselves."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

GRADIENT = 10.0  # gradients are less sharp than values: at a smooth minimum an error e in f is one of sqrt(e) in them


class Status(Enum):
    """Why a solve stopped, after our own residuals have judged the solver's claim."""

    OPTIMAL = "optimal"
    LOCAL = "locally optimal"
    INACCURATE = "inaccurate"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    LIMIT = "limit"
    FAILED = "failed"

    def __str__(self) -> str:
        return self.value

    @property
    def is_optimum(self) -> bool:
        """Whether the point is an optimum, globally or locally."""
        return self in (Status.OPTIMAL, Status.LOCAL)


@dataclass(frozen=True)
class Bound:
    """A lower bound on the optimal value, recomputed from multipliers, never copied from a solver.

    Attributes:
        value: the bound D, in units of the objective; ``-inf`` where none was found.
        proved: True when the bound closes the gap to its point.
        method: how it was obtained ("instant", "ascent", "sdp", "product cuts", "nuclear dual", ...).
        reason: one sentence: why it is a proof, or why there is none.
        multipliers: the evidence from which the value can be recomputed.
    """

    value: float
    proved: bool
    method: str
    reason: str = ""
    multipliers: Any = field(default=None, repr=False, compare=False)

    @classmethod
    def none(cls, reason: str) -> "Bound":
        """Return no bound, with the reason."""
        return cls(-np.inf, False, "none", reason)


@dataclass(frozen=True)
class Residuals:
    """Our own measurements at a solver's point; all relative, zero at an exact solution."""

    violation: float  # largest constraint violation, relative to the size of the constraint's terms
    worst: str  # name of the constraint that is violated most
    # largest component of the gradient of the Lagrangian, relative to the terms it is a sum of plus the objective per
    # size of the variable (so that units do not matter); multipliers of the wrong sign count as missing. ``nan`` where
    # it cannot be formed (no multipliers, or an objective with kinks: the bound judges there)
    stationarity: float
    # sum of the products of multiplier and slack, relative to the objective (where it vanishes, to a hundredth of its
    # scale)
    complementarity: float


@dataclass(frozen=True)
class Times:
    """Seconds spent building, solving, judging and proving.

    ``compile`` is the part of ``solve`` that translated the programme for the solver; nan where the back end does
    not measure it. ``late`` is the part of ``prove`` after the fit, where the solution was first asked for.
    """

    build: float = 0.0
    solve: float = 0.0
    judge: float = 0.0
    prove: float = 0.0
    compile: float = float("nan")
    late: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all phases in seconds."""
        return self.build + self.solve + self.judge + self.prove


@dataclass(frozen=True)
class Solution:
    """The outcome of one solve: three separate facts (why it stopped, a point, a proof) and the evidence.

    Attributes:
        status: why it stopped, after judgement.
        claimed: status in the solver's own word.
        reason: one sentence where the status needs one.
        values: {variable name: array} in the units of the programme, empty where there is no point; see `Fit.values`.
        duals: {constraint name: multiplier array} of the rows and the objective in units of the programme, empty
            where the solver gives none; see `optid.core.prices`.
        objective: value of the programme's objective at ``values`` in units of the record, recomputed (``nan`` without
            a point).
        bound: certified lower bound, or None where the programme has no certificate.
        residuals: our own measurements, or None without a point.
        scale: objective of the zero model (``YᵀY``), the yardstick of the gap.
        solver: name of the back end; ``chosen`` says why when it was chosen automatically.
        iterations: as counted by the solver, -1 where it does not say.
        times: seconds per phase.
        claim: status claimed by the solver; None where no solver ran.
        failed: name of the back end chosen first, which gave no usable answer; "" where it did.
    """

    status: Status
    claimed: str
    solver: str
    reason: str = ""
    chosen: str = field(default="", repr=False)
    values: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    duals: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    objective: float = float("nan")
    bound: Bound | None = field(default=None, repr=False)
    residuals: Residuals | None = field(default=None, repr=False)
    scale: float = field(default=1.0, repr=False)
    iterations: int = -1
    times: Times = field(default=Times(), repr=False)
    claim: Status | None = None
    failed: str = ""

    @property
    def has_point(self) -> bool:
        """Whether there is a point at all."""
        return bool(self.values)

    @property
    def doubt(self) -> str:
        """Status and reason in words, "" for a proved optimum."""
        certified = self.status.is_optimum and self.proof
        return "" if certified else f"{self.status}: {self.reason}".rstrip(": ")

    @property
    def false_claim(self) -> bool:
        """Whether the solver claimed a success, or that there can be none, and our measurements took it back."""
        if self.claim in (Status.OPTIMAL, Status.LOCAL):
            return self.status not in (Status.OPTIMAL, Status.LOCAL)
        return self.claim in (Status.INFEASIBLE, Status.UNBOUNDED) and self.status is Status.FAILED

    def in_units(self, unit: float) -> "Solution":
        """Return the same with objective, bound and scale multiplied by a unit."""
        if unit == 1.0:
            return self
        bound = self.bound if self.bound is None else replace(self.bound, value=unit * self.bound.value)
        return replace(self, objective=unit * self.objective, bound=bound, scale=unit * self.scale)

    @property
    def proof(self) -> bool:
        """Whether global optimality of the point is proved."""
        return self.bound is not None and self.bound.proved

    @property
    def gap(self) -> float:
        """Relative distance between objective and certified bound; ``inf`` where there is no bound."""
        if self.bound is None or not self.has_point:
            return float("inf")
        return relative_gap(self.objective, self.bound.value, self.scale)


def tolerance(accuracy: float) -> float:
    """Return the residual up to which a claim of success at a requested relative accuracy stands.

    It holds for violation and complementarity; the stationarity may be `GRADIENT` times as large.
    """
    return max(100.0 * accuracy, 1e-7)


def relative_gap(objective: float, bound: float, scale: float) -> float:
    """Return ``(F - D) / max(F, 1e-9 scale)``, never below zero, for the value F reached and the certified bound D.

    The floor, with the scale ``YᵀY``, keeps noise-free problems meaningful. Where one of them is no number, neither is
    the gap.
    """
    gap = objective - bound
    return gap if np.isnan(gap) else max(0.0, gap) / max(objective, 1e-9 * scale, np.finfo(float).tiny)

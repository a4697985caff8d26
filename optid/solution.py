"""What a solve returns: why it stopped, whether there is a point, whether it is proved, and what we measured ourselves."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any


@dataclass(frozen=True)
class Bound:
    """A lower bound on the optimal value, recomputed from multipliers, never copied from a solver.

    Attributes:
        value: the bound D, in units of the objective; ``-inf`` where none was found.
        proved: True when the bound closes the gap to the point it was asked for.
        method: how it was obtained ("instant", "ascent", "sdp", "product cuts", "nuclear dual", ...).
        reason: one sentence for people: why it is a proof, or why there is none.
        seconds: time spent.
        multipliers: the evidence from which the value can be recomputed.
    """

    value: float
    proved: bool
    method: str
    reason: str = ""
    seconds: float = 0.0
    multipliers: Any = field(default=None, repr=False, compare=False)

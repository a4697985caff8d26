"""Structure: what special methods and proofs may use of a programme beyond its statement in CVXPY."""

from typing import ClassVar

import numpy as np

from optid.arrays import Array

GAUGE = "gauge"  # of the constraints that fix the scale between the factors of products, which no objective sees
ZERO = 1e-9  # a variable without a start that is smaller than this has no size to measure by


class Structure:
    """The numbers behind a programme, with the names of the variables they belong to.

    A back end lists the structures it accepts by type (`optid.backends.BackEnd.structures`), so that a new structure
    needs its class and a back end, and no change here.

    Attributes:
        word: its name in messages and in the list of solvers.
        constrained: whether its methods accept constraints of the user.
        kind: class of a programme of this structure without them (`Program.kind`); empty where its statement decides.
    """

    word: ClassVar[str]
    constrained: ClassVar[bool] = False
    kind: ClassVar[str] = ""

    @property
    def about(self) -> str:
        """What the programme is and how large, for the reason of a choice."""
        return self.word


def relative_gradient(gradient: Array, terms: Array, yardstick: float, size: float) -> float:
    """Return the largest component relative to its terms plus the objective's size per size of the variable."""
    floor = yardstick / size + terms
    return float(np.max(gradient / np.where(floor > 0, floor, 1.0), initial=0.0))


def variable_size(value: Array, usual: float | None) -> float:
    """Return the largest entry of a value or of its start; one where there is no start and nothing but rounding."""
    size = float(np.max(np.abs(value), initial=0.0))
    if usual is not None:
        return max(size, usual)
    return size if size > ZERO else 1.0

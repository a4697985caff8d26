"""The form of group-sparse problems: squares of groups of coefficients, and the norms of these."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from optid.arrays import Array
from optid.core.form import Form
from optid.core.problem import Problem
from optid.core.terms import GroupNorms, Squares
from optid.structures.group_sparse import GroupProblem


def group_squares(target: Array, designs: Mapping[str, Array], weights: Mapping[str, Array]) -> Squares:
    """Return ``1/2 ‖target - sum designs[name] a[name]‖²``, a of shape (T, d), T groups of d coefficients.

    Args:
        target: (m,).
        designs: (m, T, d) of every name; see `GroupProblem`, as are the errors raised.
        weights: (T,), of the norms of the groups.
    """
    parts = {name: np.swapaxes(one, 1, 2).reshape(target.size, -1) for name, one in designs.items()}
    sizes = [one.shape[2] for one in designs.values() for _ in range(one.shape[1])]
    design = np.hstack([one.reshape(target.size, -1) for one in designs.values()])
    return Squares.half(target, parts, GroupProblem(
        design, target, np.cumsum([0, *sizes]), np.concatenate([weights[name] for name in designs])))


@dataclass(frozen=True, eq=False)
class GroupSparseForm(Form):
    """P(a); the multiplier of the constraint ``residual``, which defines (M a - r) / sqrt 2, is a point of the dual."""

    word: ClassVar[str] = "group-sparse"
    problem: GroupProblem  # the numbers
    penalty: float  # lambda
    # {variable: shape} in the order of a; a variable of shape (T, d) is T groups of d, row by row
    blocks: Mapping[str, tuple[int, ...]]

    @classmethod
    def of(cls, problem: Problem) -> "GroupSparseForm | None":
        """Return the form of squares of groups and the norms of these."""
        match problem.terms:
            case (Squares(lifted=GroupProblem() as numbers, z=z), GroupNorms()) if not problem.restrictions:
                shapes = {name: np.shape(problem.start[name]) for name in z}
                return cls(numbers, problem.weights["lambda"], shapes)
        return None

    @property
    def about(self) -> str:
        """What the programme is and how large."""
        return f"{self.problem.weights.size} groups"

    def flat(self, values: Mapping[str, Array]) -> Array:
        """Return a from named values."""
        return np.concatenate([np.ravel(np.asarray(values[name], dtype=float)) for name in self.blocks])

    def unpack(self, a: Array) -> dict[str, Array]:
        """Return named values from a."""
        cuts = np.cumsum([int(np.prod(shape)) for shape in self.blocks.values()])[:-1]
        return {name: part.reshape(shape) for (name, shape), part in zip(self.blocks.items(), np.split(a, cuts))}

    def duals(self, v: Array) -> dict[str, Array]:
        """Return the multipliers of the constraint that a point v (m,) of the dual stands for."""
        return {"residual": np.sqrt(2.0) * v}

    def dual_point(self, duals: Mapping[str, Array]) -> Array | None:
        """Return v of the multipliers of a solver, None without them."""
        given = np.ravel(np.asarray(duals.get("residual", ()), dtype=float))
        return given / np.sqrt(2.0) if given.size == self.problem.target.size else None

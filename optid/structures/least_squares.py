"""Least squares behind a programme, with and without products of its variables."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate, chain, pairwise
from math import prod
from typing import Any, ClassVar

import numpy as np

from optid.arrays import Array, largest
from optid.program.structure import Structure, relative_gradient, variable_size
from optid.structures.rank_one import Point, RankOne


@dataclass(frozen=True, eq=False)
class LeastSquaresStructure(Structure):
    """``F = ‖R z - s‖² + remainder`` with ``z = [linear variables; vec(mu_i b_iᵀ)]``.

    The structural constraints of its programme only fix directions that do not change F.
    """

    problem: Any  # the numbers, see `optid.program.compressed.Compressed`
    linear: tuple[str, ...]  # names of the linear variables in the order of z (each flattened column by column)
    blocks: tuple[tuple[str, str], ...] = ()  # (mu name, b name) of every rank-one block; none without products
    gauge: str = "norm"  # what fixes the scale between mu and b: "norm", "gain" or "b0"

    @property
    def names(self) -> list[str]:
        """Names of all variables: the linear ones, then mu and b of every block."""
        return [*self.linear, *chain.from_iterable(self.blocks)]

    def flat(self, values: Mapping[str, Any]) -> Array:
        """Return the linear variables among named values as they follow one another in z."""
        return np.concatenate([*(np.ravel(values[name], order="F") for name in self.linear), np.zeros(0)])

    def point(self, values: Mapping[str, Any]) -> Point:
        """Read a point from named values."""
        return Point(self.flat(values), tuple(np.asarray(values[mu], dtype=float) for mu, _ in self.blocks),
                     tuple(np.ravel(values[b], order="F") for _, b in self.blocks))

    def measure(self, program: Any, values: Mapping[str, Array]) -> tuple[float, float]:
        """Return objective and stationarity; the gauge has multiplier zero, since F does not depend on it."""
        problem, point = self.problem, self.point(values)
        r = problem.root @ point.lift() - problem.target
        value = float(r @ r) + problem.remainder
        pull, effort = 2.0 * problem.root.T @ r, 2.0 * np.abs(problem.root.T) @ np.abs(r)
        if self.blocks:
            slope = point.tangent()
            pull, effort = slope.T @ pull, np.abs(slope.T) @ effort
        yardstick, rates = max(value, program.scale), []
        edges = accumulate((np.size(values[name]) for name in self.names), initial=0)
        for name, (first, last) in zip(self.names, pairwise(edges)):
            usual = float(np.max(np.abs(program.start.get(name, 0.0)), initial=0.0)) or None
            size = variable_size(values[name], usual)
            rates.append((relative_gradient(np.abs(pull[first:last]), effort[first:last], yardstick, size), name))
        return value, largest(rates)[0]

    def named(self, point: Point, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
        """Name the parts of a point, in the shapes of the variables."""
        parts = np.split(point.w, np.cumsum([prod(shapes[name]) for name in self.linear])[:-1])
        found = dict(zip(self.linear, parts))
        for (mu, b), *pair in zip(self.blocks, point.mus, point.bs):
            found |= zip((mu, b), pair)
        return {name: np.reshape(part, shapes[name], order="F") for name, part in found.items()}

    def complete(self, program: Any, values: Mapping[str, Array]) -> tuple[dict[str, Array], float, str]:
        """Return values in the shapes of the variables, the residual ``R z - s``, and the violation of the gauge."""
        shapes, amounts = program.shapes, []
        found = {name: np.array(values[name], dtype=float).reshape(shapes[name], order="F") for name in self.names}
        a = found.get("a", np.zeros(0))
        for b in (found[name] for _, name in self.blocks):
            level = {"norm": np.sum(b**2), "b0": b.flat[0], "gain": np.sum(b) - np.sum(a)}[self.gauge]  # must be one
            size = 1.0 + float(np.sum(np.abs(b)) + np.sum(np.abs(a)))
            amounts.append((abs(float(level) - 1.0) / size, "gauge"))
        found["residual"] = self.problem.root @ self.point(found).lift() - self.problem.target
        return found, *largest(amounts)


@dataclass(frozen=True, eq=False)
class LinearStructure(LeastSquaresStructure):
    """Least squares without products, which a matrix factorisation solves."""

    word: ClassVar[str] = "linear"
    kind: ClassVar[str] = "QP"

    @property
    def about(self) -> str:
        """What the programme is and how large."""
        return f"least squares with {self.problem.root.shape[1]} unknowns and no products"


@dataclass(frozen=True, eq=False)
class RankOneStructure(LeastSquaresStructure):
    """Least squares with products ``mu_i b_iᵀ``: bilinear, for Gauss-Newton and the certificate."""

    word: ClassVar[str] = "rank-one"
    kind: ClassVar[str] = "NLP"
    constrained: ClassVar[bool] = True
    problem: RankOne

    @property
    def about(self) -> str:
        """What the programme is and how large."""
        return f"rank-one least squares with {self.problem.root.shape[0]} lifted unknowns"


def rank_one_of(program: Any) -> RankOneStructure | None:
    """Return the rank-one structure of a programme, None where it has another or none."""
    return program.structure if isinstance(program.structure, RankOneStructure) else None

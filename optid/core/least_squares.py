"""Least squares behind a programme, with and without products of its variables."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar

import numpy as np

from optid.arrays import Array
from optid.core.form import Form
from optid.core.leaves import GAUGE
from optid.core.problem import Problem
from optid.core.terms import Squares
from optid.structures.rank_one import Point, RankOne


@dataclass(frozen=True, eq=False)
class LeastSquaresForm(Form):
    """``F = ‖R z - s‖² + remainder`` with ``z = [linear variables; vec(mu_i b_iᵀ)]``.

    The structural constraints of its programme only fix directions that do not change F.
    """

    problem: Any  # the numbers, see `optid.program.compressed`
    linear: tuple[str, ...]  # names of the linear variables in the order of z (each flattened column by column)
    blocks: tuple[tuple[str, str], ...] = ()  # (mu name, b name) of every rank-one block; none without products
    gauge: str = "norm"  # what fixes the scale between mu and b: "norm", "gain" or "b0"

    def flat(self, values: Mapping[str, Any]) -> Array:
        """Return the linear variables among named values as they follow one another in z."""
        return np.concatenate([*(np.ravel(values[name], order="F") for name in self.linear), np.zeros(0)])

    def point(self, values: Mapping[str, Any]) -> Point:
        """Read a point from named values."""
        return Point(self.flat(values), tuple(np.asarray(values[mu], dtype=float) for mu, _ in self.blocks),
                     tuple(np.ravel(values[b], order="F") for _, b in self.blocks))

    def unpack(self, point: Point, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Array]:
        """Name the parts of a point, in the shapes of the variables."""
        parts = np.split(point.w, np.cumsum([prod(shapes[name]) for name in self.linear])[:-1])
        found = dict(zip(self.linear, parts))
        for (mu, b), *pair in zip(self.blocks, point.mus, point.bs):
            found |= zip((mu, b), pair)
        return {name: np.reshape(part, shapes[name], order="F") for name, part in found.items()}


@dataclass(frozen=True, eq=False)
class LinearForm(LeastSquaresForm):
    """Least squares without products, which a matrix factorisation solves."""

    word: ClassVar[str] = "linear"

    @classmethod
    def of(cls, problem: Problem) -> "LinearForm | None":
        """Return the form of one sum of squares of unknowns that nothing but gauges restricts."""
        match problem.terms:
            case (Squares(root=np.ndarray(), z=z) as squares,) if set(z) <= problem.start.keys() and not problem.bounds:
                if problem.structural <= {GAUGE}:
                    return cls(squares.lifted or squares, z)
        return None

    @property
    def about(self) -> str:
        """What the programme is and how large."""
        return f"least squares with {self.problem.root.shape[1]} unknowns and no products"


@dataclass(frozen=True, eq=False)
class RankOneForm(LeastSquaresForm):
    """Least squares with products ``mu_i b_iᵀ``: bilinear, for Gauss-Newton and the certificate."""

    word: ClassVar[str] = "rank-one"
    constrained: ClassVar[bool] = True
    problem: RankOne

    @classmethod
    def of(cls, problem: Problem) -> "RankOneForm | None":
        """Return the form of one sum of squares of unknowns and products."""
        match problem.terms:
            case (Squares(lifted=RankOne() as numbers, z=z),) if problem.gauged and not problem.restrictions:
                products = {product.name: product for product in problem.products}
                linear = tuple(name for name in z if name not in products)
                pairs = tuple((products[name].mu, products[name].b) for name in z[len(linear) :])
                return cls(numbers, linear, pairs, problem.products[0].gauge)
        return None

    @property
    def about(self) -> str:
        """What the programme is and how large."""
        return f"rank-one least squares with {self.problem.root.shape[0]} lifted unknowns"

"""Functions of an input through which any static nonlinearity shows, placed where its samples are."""

from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.data.record import Data
from optid.errors import RankError


@dataclass(frozen=True, eq=False)
class Family:
    """Functions of one input: powers, which follow its tails, and hats between quantiles, which follow its kinks.

    Attributes:
        centre, spread: mean and standard deviation of the samples.
        degree: largest power.
        nodes: (k + 2,) increasing; k hats, one for each inner node.
    """

    centre: float
    spread: float
    degree: int
    nodes: Array

    @classmethod
    def of(cls, data: Data, c: int, degree: int, hats: int) -> "Family":
        """Place the functions for input c; no more than it has levels less one.

        Raises:
            RankError: a constant input.
        """
        samples = np.concatenate([e.u[:, c] for e in data.experiments])
        samples = samples[~np.isnan(samples)]
        levels = np.unique(samples).size
        if levels < 2:
            raise RankError(f"Input {data.inputs[c]!r} is constant: nothing depends on it.")
        degree = min(degree, levels - 1)
        room = max(0, min(hats, levels - 1 - degree))
        nodes = np.unique(np.quantile(samples, np.linspace(0, 1, room + 2))) if room else np.zeros(0)
        return cls(float(samples.mean()), float(samples.std()), degree, nodes)

    @property
    def size(self) -> int:
        """Number of functions."""
        return self.degree + max(self.nodes.size - 2, 0)

    def values(self, u: Array) -> Array:
        """Evaluate the functions of complete samples, (N, size)."""
        x = (u - self.centre) / self.spread
        powers = np.asarray(np.polynomial.hermite_e.hermevander(x, self.degree)[:, 1:], dtype=float)
        if self.nodes.size < 3:
            return powers
        inside = np.clip(u, self.nodes[0], self.nodes[-1])
        cell = np.clip(np.searchsorted(self.nodes, inside, side="right") - 1, 0, self.nodes.size - 2)
        share = (inside - self.nodes[cell]) / (self.nodes[cell + 1] - self.nodes[cell])
        hats = np.zeros((len(u), self.nodes.size))
        rows = np.arange(len(u))
        hats[rows, cell], hats[rows, cell + 1] = 1 - share, share
        return np.hstack([powers, hats[:, 1:-1]])

"""A damaged nonlinearity: the nodes at which its values are estimated, and what a record says of each."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Triangular
from optid.data.record import Data

if TYPE_CHECKING:
    from optid.models import HammersteinSS


@dataclass(frozen=True, eq=False)
class Curve:
    """A nonlinearity of an input that is damaged.

    Attributes:
        name: "actuator:u1", with the number of the function where the input has several.
        column: its index among the nonlinearities of the model.
        basis: the basis of its new values.
        nodes: (P + 1,) inputs at which its values are estimated.
        to_nodes: (P + 1, P + 1) of [mu; constant] to those values.
        healthy: (P + 1,) values before the fault.
        visited: (P + 1,) how many samples after the fault lie at each node, shared between neighbours.
        seen: smallest and largest input after the fault.
        dead: whether it is held flat: the actuator no longer moves.
    """

    name: str
    column: int
    basis: Triangular
    nodes: Array
    to_nodes: Array
    healthy: Array
    visited: Array
    seen: tuple[float, float]
    dead: bool = False

    @property
    def half_range(self) -> float:
        """Half of the range of the healthy nonlinearity."""
        return max(float(np.ptp(self.healthy)) / 2, 1e-300)

    @property
    def prior_only(self) -> NDArray[np.bool_]:
        """(P + 1,) whether the record says nothing of a value: less than half a sample lies there."""
        return self.visited < 0.5


def curve_of(model: "HammersteinSS", column: int, inputs: Array, raw: Data, nodes: int) -> Curve:
    """Return the nodes of a damaged nonlinearity: those of its own hats, or even ones over its range.

    Args:
        model: the healthy model.
        column: index of the nonlinearity.
        inputs: (N, m) after the fault.
        raw: the whole record, whose range is taken where the basis has none.
        nodes: number of even nodes.
    """
    healthy, c = model.nonlinearities[column], model.input_of[column]
    u = inputs[:, c]
    basis = healthy.basis
    if not isinstance(basis, Triangular):
        interval = basis.interval
        if interval is None:
            whole = np.concatenate([part.u[:, c] for part in raw.experiments])
            interval = float(np.nanmin(whole)), float(np.nanmax(whole))
            if not interval[0] < interval[1]:
                interval = interval[0] - 0.5, interval[1] + 0.5
        outside = "clamp" if basis.outside == "error" else basis.outside
        basis = Triangular(nodes - 1, interval, outside)
    at = basis.nodes
    to_nodes = np.column_stack([basis.values(at), np.ones(at.size)])
    weights = np.maximum(1 - np.abs(np.clip(u, at[0], at[-1])[:, None] - at) / (at[1] - at[0]), 0.0)
    several = model.input_of.count(c) > 1
    number = [i for i, of in enumerate(model.input_of) if of == c].index(column) + 1
    name = model.inputs[c] + f" {number}" * several
    return Curve(
        name, column, basis, at, to_nodes, np.asarray(healthy(at), dtype=float), weights.sum(axis=0),
        (float(u.min()), float(u.max())),
    )

"""A damaged nonlinearity: the nodes of its values, the samples that support each, and the estimate."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Triangular
from optid.data.record import Data
from optid.models import HammersteinSS


@dataclass(frozen=True, eq=False)
class Curve:
    """A damaged nonlinearity of an input; printed as a table after its refit."""

    name: str  # the input, with the number of the function where it has several
    column: int  # its index among the nonlinearities of the model
    basis: Triangular  # the basis of its new values
    to_nodes: Array  # (P + 1, P + 1) of [mu; constant] to the values at its nodes
    healthy: Array  # (P + 1,) values before the fault
    visited: Array  # (P + 1,) samples after the fault at each node, shared between neighbours
    seen: tuple[float, float]  # smallest and largest input after the fault
    dead: bool  # whether it is held constant: the actuator has no effect
    values: Array  # (P + 1,) values after the refit, in the scale of the healthy one; empty before
    std: Array  # (P + 1,) their standard errors, bounds not counted
    # smallest eigenvalue of the information of the record on the values it visits, in squared deviations of the
    # innovations per half of the healthy range
    excitation: float = 0.0

    @property
    def nodes(self) -> Array:
        """(P + 1,) inputs at which its values are estimated."""
        return self.basis.nodes

    @property
    def values_open(self) -> int:
        """Number of estimated values."""
        return 1 if self.dead else self.nodes.size

    @property
    def half_range(self) -> float:
        """Half of the range of the healthy nonlinearity."""
        return max(float(np.ptp(self.healthy)) / 2, 1e-300)

    @property
    def prior_only(self) -> NDArray[np.bool_]:
        """(P + 1,) whether a value rests on the prior alone: less than half a sample lies there."""
        return self.visited < 0.5

    def __str__(self) -> str:
        head = f"  {'u':>9}{'before':>12}{'now':>12}{'+-':>10}"
        rows = [
            f"  {u:>9.3g}{old:>12.4g}{new:>12.4g}{std:>10.2g}{'  prior only' if unseen else ''}"
            for u, old, new, std, unseen in zip(self.nodes, self.healthy, self.values, self.std, self.prior_only)]
        return "\n".join([f"f of {self.name}", head, *rows])


def curve_of(model: HammersteinSS, column: int, inputs: Array, raw: Data, nodes: int, dead: bool) -> Curve:
    """Return a damaged nonlinearity at the nodes of its own triangular basis, or at even nodes over its range.

    The inputs (N, m) are those after the fault; the range of the whole record is used where the basis has none.
    """
    healthy, c = model.nonlinearities[column], model.input_of[column]
    u, basis = inputs[:, c], healthy.basis
    if not isinstance(basis, Triangular):
        interval: Any = basis.interval
        if interval is None:
            whole = np.concatenate([part.u[:, c] for part in raw.experiments])
            interval = float(np.nanmin(whole)), float(np.nanmax(whole))
            if not interval[0] < interval[1]:
                interval = interval[0] - 0.5, interval[1] + 0.5
        basis = Triangular(nodes - 1, interval, "clamp" if basis.outside == "error" else basis.outside)
    at = basis.nodes
    weights = np.maximum(1 - np.abs(np.clip(u, at[0], at[-1])[:, None] - at) / (at[1] - at[0]), 0.0)
    mine = [i for i, of in enumerate(model.input_of) if of == c]
    name = model.inputs[c] + f" {mine.index(column) + 1}" * (len(mine) > 1)
    return Curve(name, column, basis, np.column_stack([basis.values(at), np.ones(at.size)]), np.asarray(healthy(at)),
                 weights.sum(axis=0), (float(u.min()), float(u.max())), dead, np.zeros(0), np.zeros(0))

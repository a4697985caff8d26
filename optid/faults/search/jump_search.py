"""Exact search for several jumps of the whole state.

A jump of unknown size in all n states decouples the segments before and after it: the best fit of a segment depends on
its ends alone, and the best segmentation follows by dynamic programming, V_K(j) = min over i V_(K-1)(i) + cost(i, j),
in O(K N^2).
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array, check_integer
from optid.errors import StructureError
from optid.faults.search.sweeps import inverse_roots
from optid.faults.signatures import Dictionary
from optid.faults.whitening import Whitened, check_window

if TYPE_CHECKING:
    from optid.faults.search.calibration import Thresholds

LONGEST = 3000
"""Largest number of samples of a window, for which the costs of all segments are stored."""


@dataclass(frozen=True, eq=False)
class StateJumps:
    """The best segmentation of a window.

    Attributes:
        onsets: samples of the jumps.
        sizes: (K, n) jumps of the state.
        energies: (most + 1,) residual energy with the best 0, 1, ..., most jumps.
        best: for each number of jumps, the onsets.
        penalty: least energy explained by a jump.
    """

    onsets: tuple[int, ...]
    sizes: Array
    energies: Array
    best: tuple[tuple[int, ...], ...] = field(repr=False)
    penalty: float

    @property
    def gain(self) -> float:
        """Energy explained less the penalties."""
        return float(self.energies[0] - self.energies[len(self.onsets)] - self.penalty * len(self.onsets))

    @property
    def margin(self) -> float:
        """Difference to the best other number of jumps."""
        values = self.energies + self.penalty * np.arange(self.energies.size)
        others = np.delete(values, len(self.onsets))
        return float(others.min() - values[len(self.onsets)]) if others.size else np.inf

    def __str__(self) -> str:
        """Print the jumps and the residual energy of every number of jumps."""
        left = ", ".join(f"{k}: {energy:.1f}" for k, energy in enumerate(self.energies))
        lines = [f"{len(self.onsets)} jumps of the state (energy left by number {left})"[:80],
                 f"  each must explain {self.penalty:.1f}; margin {self.margin:.2f}; exhaustive"]
        for onset, size in zip(self.onsets, self.sizes):
            lines.append(f"  sample {onset:>6}: {np.array2string(size, precision=3, separator=' ')}"[:80])
        return "\n".join(lines)


def state_jumps(
    found: Dictionary, whitened: Whitened, most: int = 3, *, penalty: "float | Thresholds | None" = None,
) -> StateJumps:
    """Find up to `most` jumps of the whole state in a window, exactly.

    Args:
        found: the dictionary.
        whitened: the window; one experiment. Missing readings are left out.
        most: largest number of jumps.
        penalty: least energy explained by a jump: a number, or thresholds with a candidate "state"; by default that of
            the Bayesian information criterion, n log(N l) + 2 log N.

    Raises:
        DataError: other outputs than the model's, innovations that are not finite.
        StructureError: an uncertain model (its nuisance couples all segments), several experiments, a window
            that is too long, impossible numbers.
    """
    check_window(found.model, whitened, "state_jumps")
    count = len(whitened.r)
    if whitened.nuisance is not None:
        raise StructureError("An uncertain model ties all segments together: whiten without it for this search.")
    check_integer(most, "most", 0)
    if count > LONGEST:
        raise StructureError(f"{count} samples are too many for all segments ({LONGEST}): use a shorter window.")
    price = _price(found, whitened, penalty)
    energies, best = _segmented(segment_costs(whitened), np.sum(whitened.r**2, axis=1), int(most))
    chosen = best[int(np.argmin(energies + price * np.arange(energies.size)))]
    sizes = np.zeros((0, found.model.nx))
    if chosen:  # by least squares, all together
        flat = np.concatenate([_response(whitened, k).reshape(whitened.r.size, -1) for k in chosen], axis=1)
        sizes = np.linalg.lstsq(flat, whitened.r.ravel(), rcond=1e-10)[0].reshape(len(chosen), -1)
    return StateJumps(chosen, np.asarray(sizes, dtype=float), energies, best, price)


def segment_costs(whitened: Whitened) -> Array:
    """Return the residual energy (N, N + 1) of the samples i to j - 1 after a jump at i; inf for empty segments."""
    count = len(whitened.r)
    costs = np.full((count, count + 1), np.inf)
    energy = np.concatenate([[0.0], np.cumsum(np.sum(whitened.r**2, axis=1))])
    complete = bool(whitened.present.all())
    trace, roots = _response(whitened, 0), np.empty(0)
    for i in range(count):
        own = trace[: count - i] if complete else _response(whitened, i)[i:]
        if i == 0 or not complete:  # without gaps a later onset shifts the trace
            products = np.cumsum(np.einsum("kop,koq->kpq", own, own), axis=0)
            roots = inverse_roots(products, np.asarray(np.linalg.eigvalsh(products)[:, -1], dtype=float))
        along = np.cumsum(np.einsum("kop,ko->kp", own, whitened.r[i:]), axis=0)
        explained = np.sum(np.einsum("kqp,kp->kq", roots[: count - i], along) ** 2, axis=1)
        costs[i, i + 1 :] = np.maximum(energy[i + 1 :] - energy[i] - explained, 0.0)
    return costs


def _response(whitened: Whitened, onset: int) -> Array:
    """Signature (N, l, n) of unit jumps of the state."""
    return whitened.seen(whitened.predictor.jumps(onset, whitened.present))


def _segmented(costs: Array, squares: Array, most: int) -> tuple[Array, tuple[tuple[int, ...], ...]]:
    """Residual energies of up to `most` jumps, and the best onsets of each number, by dynamic programming."""
    count = len(costs)
    value = np.concatenate([[0.0], np.cumsum(squares)])  # up to j without a jump
    before: list[np.ndarray] = []
    energies, best = [float(value[-1])], [tuple[int, ...]()]
    for _ in range(most):
        table = value[:count, None] + costs
        before.append(table.argmin(axis=0))
        value = table[before[-1], np.arange(count + 1)]
        if not np.isfinite(value[-1]):
            break
        energies.append(float(value[-1]))
        ends = [count]
        for chosen in reversed(before):
            ends.append(int(chosen[ends[-1]]))
        best.append(tuple(reversed(ends[1:])))
    return np.array(energies), tuple(best)


def _price(found: Dictionary, whitened: Whitened, penalty: "float | Thresholds | None") -> float:
    if penalty is None:
        return float(found.model.nx * np.log(whitened.present.sum()) + 2 * np.log(len(whitened.r)))
    if isinstance(penalty, int | float | np.floating | np.integer):
        if not (np.isfinite(penalty) and penalty >= 0):
            raise StructureError(f"penalty={penalty!r}; it must be nonnegative.")
        return float(penalty)
    for label, value in zip(found.labels, penalty.of(found.labels)):
        if label.startswith("state") and np.isfinite(value):
            return float(value)
    raise StructureError("These thresholds have none for a jump of the state: give the penalty as a number.")

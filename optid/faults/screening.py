"""Checks of a record before any statistics: flat lines, swapped channels, changes of unit."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import as_list
from optid.data.record import Data
from optid.errors import DataError
from optid.faults.whitening import predictor, whiten
from optid.models.experiments import in_units_of

if TYPE_CHECKING:
    from optid.models import HammersteinSS

FLAT = 3
"""Number of identical readings that is not a coincidence with continuous noise."""

UNITS = (1000.0, 100.0, 60.0, 25.4, 10.0, 9.81, 9 / 5, np.pi / 180)
FACTORS = (*UNITS, *(1 / unit for unit in UNITS))
"""Factors between units of the same quantity."""

BETTER = 0.1
"""Share of the energy of the innovations below which another order or unit of the channels is accepted."""


@dataclass(frozen=True)
class FlatLine:
    """A sensor that repeats one reading exactly.

    Attributes:
        name: "sensor:y1".
        experiment: index of the experiment.
        first: first sample of the run of equal readings.
        count: their number.
        value: the reading.
    """

    name: str
    experiment: int
    first: int
    count: int
    value: float

    def __str__(self) -> str:
        """State sensor, reading and samples."""
        return f"{self.name}: {self.count} readings of exactly {self.value:.6g} from sample {self.first} on"


def flat_lines(data: Data, at_least: int = FLAT) -> tuple[FlatLine, ...]:
    """Find runs of identical readings; a missing reading ends a run.

    A sensor whose resolution is coarser than its noise repeats readings when healthy: an output with fewer than ten
    different readings per hundred outside its longest run is left out.

    Args:
        data: the record.
        at_least: length of the shortest run reported.
    """
    found = []
    for number, part in enumerate(data.experiments):
        for name, y in zip(data.outputs, part.y.T):
            starts, counts = _runs(y)
            if not counts.size:
                continue
            longest = int(counts.argmax())
            rest = np.delete(y, slice(starts[longest], starts[longest] + counts[longest]))
            rest = rest[~np.isnan(rest)]
            if rest.size and np.unique(rest).size < 0.1 * rest.size:
                continue
            found += [
                FlatLine(f"sensor:{name}", number, int(k), int(c), float(y[k]))
                for k, c in zip(starts, counts) if c >= at_least
            ]
    return tuple(found)


def check_channels(model: "HammersteinSS", data: Data) -> None:
    """Refuse a healthy record with swapped outputs or inputs, or with a change of unit.

    The criterion is the energy of the innovations: another order of the channels, or another factor of an output from
    some sample on (of an input in the whole record), makes it ten times smaller, and as large as the model predicts.

    Args:
        model: with noise covariances.
        data: the record.

    Raises:
        DataError: swapped outputs or inputs; a change of the unit of an output, with sample and factor; an input in
            another unit, with the factor.
    """
    raw = in_units_of(model, data)
    energy = _energy(model, raw)
    readings = sum(int(np.sum(~np.isnan(part.y))) for part in raw.experiments)
    if energy < 2 * readings:
        return
    _check_order("outputs", data.outputs, energy,
                 lambda order: _energy(model, raw.mapped(lambda u: u, lambda y: y[:, order])))
    _check_order("inputs", data.inputs, energy,
                 lambda order: _energy(model, raw.mapped(lambda u: u[:, order], lambda y: y)))
    for (c, name), factor in product(enumerate(data.inputs), FACTORS):
        scale = np.where(np.arange(data.m) == c, 1 / factor, 1.0)
        trial = _energy(model, raw.mapped(lambda u, s=scale: u * s, lambda y: y))
        if trial < BETTER * energy and trial < 2 * readings:
            raise DataError(
                f"Input {name!r} seems to be in another unit: the record fits the model when it is divided by "
                f"{factor:g}. Convert it."
            )
    for (number, part), (o, name) in product(enumerate(raw.experiments), enumerate(data.outputs)):
        found = _unit_jump(model, Data(part.u, part.y, raw.dt, raw.inputs, raw.outputs), o)
        if found is not None:
            where = f"experiment {number + 1}: " * (raw.n_experiments > 1)
            raise DataError(
                f"{where}the unit of output {name!r} seems to change at sample {found[0]}: from there on the readings "
                f"fit the model when divided by {found[1]:g}. Convert them."
            )


def _check_order(what: str, names: tuple[str, ...], energy: float, of: Callable[[list[int]], float]) -> None:
    """Refuse channels for which another order reduces the energy `of` the innovations to a tenth."""
    if not 1 < len(names) <= 5:
        return
    orders = list(permutations(range(len(names))))[1:]  # the first is that of the record
    trials = [of(list(order)) for order in orders]
    best = int(np.argmin(trials))
    if trials[best] < BETTER * energy:
        moved = [names[i] for i, j in enumerate(orders[best]) if i != j]
        raise DataError(
            f"The {what} {', '.join(moved)} look swapped: in the order {', '.join(names[j] for j in orders[best])} the "
            f"model predicts the outputs {energy / trials[best]:.0f} times better. Check the names of the columns."
        )


def _unit_jump(model: "HammersteinSS", alone: Data, o: int) -> tuple[int, float] | None:
    """First sample and factor of a change of unit that explains a record of one experiment."""
    energy, found = _energy(model, alone), whiten(model, alone)
    large = np.abs(found.innovations[:, o]) / np.sqrt(predictor(model).covariance[o, o])
    for onset, factor in product(np.flatnonzero(large > 6)[:3], FACTORS):
        divided = np.array(alone.y)
        divided[onset:, o] /= factor
        trial = _energy(model, Data(alone.u, divided, alone.dt, alone.inputs, alone.outputs))
        if trial < BETTER * energy and trial < 2 * divided.size:
            return int(onset), float(factor)
    return None


def _energy(model: "HammersteinSS", data: Data) -> float:
    """Energy of the innovations; infinite where the model is not defined for the inputs."""
    try:
        found: list[Any] = as_list(whiten(model, data))
    except DataError:
        return float("inf")
    return float(sum(np.sum(part.r**2) for part in found))


def _runs(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First samples and lengths of the runs of equal readings; missing ones are skipped."""
    edges = np.flatnonzero(np.concatenate([[True], y[1:] != y[:-1]]))
    counts = np.diff(np.append(edges, y.size))
    there = ~np.isnan(y[edges])
    return edges[there], counts[there]

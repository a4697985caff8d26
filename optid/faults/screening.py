"""Checks of a record before any statistics: flat lines, swapped channels, changes of unit, inverses of controllers."""

from collections.abc import Callable
from itertools import permutations, product
from typing import Any

import numpy as np

from optid.arrays import as_list
from optid.data.record import Data
from optid.errors import DataError
from optid.faults.readings import LostReadings, lost_readings
from optid.faults.whitening import predictor, whiten
from optid.identify.informativity import informativity
from optid.identify.informativity.feedback import TIED, outside
from optid.identify.informativity.signals import RecordSignals
from optid.models import HammersteinSS
from optid.models.experiments import in_units_of

UNITS = (1000.0, 100.0, 60.0, 25.4, 10.0, 9.81, 9 / 5, np.pi / 180)
FACTORS = (*UNITS, *(1 / unit for unit in UNITS))  # factors between units of the same quantity
BETTER = 0.1  # share of the energy of the innovations below which another order or unit of the channels is accepted


def flat_lines(data: Data) -> tuple[LostReadings, ...]:
    """Find sensors that repeat one reading more often than their resolution explains: frozen or saturated ones."""
    found = [lost_readings(part.y, data.outputs, number) for number, part in enumerate(data.experiments)]
    return tuple(line for lines in found for line in lines if not line.is_dead)


def check_channels(model: HammersteinSS, data: Data) -> None:
    """Refuse a healthy record with swapped outputs or inputs, or with a change of unit.

    The criterion is the energy of the innovations: another order of the channels, or another factor of an output from
    some sample on (of an input in the whole record), makes it ten times smaller, and as large as the model predicts.

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
                 lambda order: _energy(model, raw.map_signals(lambda u: u, lambda y: y[:, order])))
    _check_order("inputs", data.inputs, energy,
                 lambda order: _energy(model, raw.map_signals(lambda u: u[:, order], lambda y: y)))
    for (c, name), factor in product(enumerate(data.inputs), FACTORS):
        scale = np.where(np.arange(data.m) == c, 1 / factor, 1.0)
        trial = _energy(model, raw.map_signals(lambda u, s=scale: u * s, lambda y: y))
        if trial < BETTER * energy and trial < 2 * readings:
            raise DataError(f"Input {name!r} seems to be in another unit: the record fits the model when it is divided "
                            f"by {factor:g}. Convert it.")
    for (number, part), (o, name) in product(enumerate(raw.experiments), enumerate(data.outputs)):
        found = _unit_jump(model, Data(part.u, part.y, raw.dt, raw.inputs, raw.outputs), o)
        if found is not None:
            where = f"experiment {number + 1}: " * (raw.n_experiments > 1)
            raise DataError(f"{where}the unit of output {name!r} seems to change at sample {found[0]}: from there on "
                            f"the readings fit the model when divided by {found[1]:g}. Convert them.")


def check_causality(model: HammersteinSS, data: Data) -> None:
    """Refuse a model of the inverse of a controller.

    Where an input is the answer of a controller and nothing else, a model in which it acts on the outputs at once
    explains the record that it was identified from best as the inverse of the controller, and knows nothing about the
    plant: a `DataError`.
    """
    direct = {model.input_of[column] for column in np.flatnonzero(model.D.any(axis=0))}
    tied = [c for c in direct if outside(RecordSignals.of(data), c) < TIED]
    loops = informativity(data).loops if tied else ()
    for c in tied:
        if loops and loops[c].word == "regulated":
            raise DataError(
                f"In the record of the identification input {data.inputs[c]!r} is the answer of a controller to output "
                f"{loops[c].output!r}, and nothing else moved it; in the model it acts on the outputs at once: that is "
                "the inverse of the controller. Fit the plant with its noise and without feedthrough: formulation "
                "ss.exact with criterion=prediction, feedthrough=false.")


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
            f"model predicts the outputs {energy / trials[best]:.0f} times better. Check the names of the columns.")


def _unit_jump(model: HammersteinSS, alone: Data, o: int) -> tuple[int, float] | None:
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


def _energy(model: HammersteinSS, data: Data) -> float:
    """Energy of the innovations; infinite where the model is not defined for the inputs."""
    try:
        found: list[Any] = as_list(whiten(model, data))
    except DataError:
        return float("inf")
    return float(sum(np.sum(part.r**2) for part in found))

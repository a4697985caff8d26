"""What a simulation error needs of a record: whole inputs, enough outputs, excited functions, inputs that differ."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from optid.bases import Linear, fitted_bases
from optid.bases.basis import Basis
from optid.data.channels import Transform
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import RankError
from optid.identify.arguments import ROWS_PER_UNKNOWN, enough_rows, outputs_present, per_channel, whole_number
from optid.identify.equation_error import compress
from optid.program.units import in_units, inner_bases, own_units
from optid.statistics import Layout
from optid.statistics.sensitivities import CHUNK, Unknowns


def plant_record(data: Data, na: int, nb: Any, nk: Any, basis: Basis | str | Sequence[Basis | str],
                 offset: bool = True) -> tuple[Data, Layout, Transform]:
    """Return the record with whole inputs in its own units, the checked orders of the plant, and the way back.

    Where inputs are missing the record is cut into stretches, each an experiment with an initial state of its own.
    Without an offset in the model nothing is centred.

    Raises:
        StructureError: impossible orders.
        DataError: no stretch with every input is long enough.
        RankError: an experiment that its initial state would explain.
    """
    reach = plant_layout(data, na, nb, nk, fitted_bases(data, Linear())).first_row
    record = with_whole_inputs(data, 2 * reach + 1)
    record, bases, units = in_own_units(record, fitted_bases(record, basis), offset)
    return record, plant_layout(record, na, nb, nk, bases), units


def in_own_units(record: Data, bases: Sequence[Basis], offset: bool = True
                 ) -> tuple[Data, tuple[Basis, ...], Transform]:
    """Return the record and its bases in the record's own units (`optid.program.units`), and the way back."""
    units = own_units(record, [isinstance(basis, Linear) for basis in bases], bool(offset))
    return in_units(record, units), inner_bases(bases, units), units


def plant_layout(data: Data, na: int, nb: Any, nk: Any, bases: tuple[Basis, ...]) -> Layout:
    """Return the checked orders of the plant.

    Raises:
        StructureError: impossible orders.
        RankError: an experiment that its initial state would explain.
    """
    layout = Layout(whole_number("na", na, 0, "the number of poles"), per_channel("nb", nb, data.inputs, low=1),
                    per_channel("nk", nk, data.inputs, low=0), bases, data.outputs, data.inputs)
    for number, e in enumerate(data.experiments, start=1):
        label = f"experiment {number}: " if data.n_experiments > 1 else ""
        if e.n_samples <= layout.first_row:
            raise RankError(f"{label}{e.n_samples} samples, but the lags reach back {layout.first_row}: its initial "
                            "state would explain them all. Leave it out, or use fewer lags")
    return layout


def check_rows(data: Data, unknowns: Unknowns) -> None:
    """Refuse a record with fewer than 1.1 outputs per unknown (`RankError`)."""
    enough_rows(outputs_present(data), "output samples", unknowns.size, "lags")


def check_excited(data: Data, layout: Layout) -> None:
    """Refuse a basis function without energy, by name."""
    for c, (channel, basis) in enumerate(zip(layout.inputs, layout.bases)):
        energy = np.zeros(basis.size)
        for e in data.experiments:
            for k in range(0, e.n_samples, CHUNK):
                energy += np.sum(basis.values(e.u[k : k + CHUNK, c]) ** 2, axis=0)
        silent = np.flatnonzero(energy <= 1e-14 * energy.mean())
        if silent.size:
            raise RankError(f"function {silent[0] + 1} of the basis of input {channel!r} is never excited: no sample "
                            "lies in its part of the interval. Use fewer functions, or an interval that the input "
                            "visits")


def check_inputs_differ(data: Data, layout: Layout) -> None:
    """Refuse inputs that the record does not tell apart.

    Raises:
        RankError: naming two columns of the expanded inputs of which one depends on the other.
    """
    columns = 1 + sum(nb * basis.size for nb, basis in zip(layout.nb, layout.bases))
    if layout.m > 1 and sum(e.n_samples - layout.first_row for e in data.experiments) >= ROWS_PER_UNKNOWN * columns:
        complete = Data([e.u for e in data.experiments], [e.u[:, :1] for e in data.experiments], data.dt,
                        list(data.inputs), list(data.outputs))
        compress(complete, na=0, nb=layout.nb, nk=layout.nk, basis=layout.bases, own=False)

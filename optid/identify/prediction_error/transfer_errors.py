"""The sum of squared errors of a transfer-function model, and the record it is taken from, in its own units."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.bases import Linear, fitted_bases
from optid.data.channels import Transform
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.errors import RankError
from optid.identify.prediction_error.descent import Criterion
from optid.models import noise_filter, roots
from optid.models.gauges import gauge_factor
from optid.models.layout import Layout
from optid.program.units import energy_unit, in_units, inner_bases, own_units
from optid.statistics.linearised import Linearised, Method
from optid.statistics.regression import ROWS_PER_COLUMN, collect
from optid.statistics.sensitivities import CHUNK, TransferPredictor

STABLE = 1 - 1e-9
"""Radius inside which every pole of an iterate, or zero of C, lies."""


@dataclass(frozen=True, eq=False)
class TransferErrors(TransferPredictor, Criterion):
    """Simulation errors, or one-step prediction errors with a noise filter.

    Attributes:
        gauge: how the scale between mu and b is fixed; "none" for a linear model.
        units: from those of the record above (`optid.program.units`) to those of the model.
    """

    gauge: str
    units: Transform = field(default_factory=lambda: Transform.identity(1, 1))

    def __post_init__(self) -> None:
        if len(self.units.u_scale) != self.data.m:
            object.__setattr__(self, "units", Transform.identity(self.data.m, 1))

    @property
    def errors(self) -> str:
        """What they are called."""
        return "simulation errors" if self.unknowns.plain else "prediction errors"

    @property
    def unit(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What one unit of the sum of squares is in units of the record."""
        return energy_unit(self.units)

    def key(self, name: str, number: int) -> str:
        """Name a quantity of an input: plain with one input, ``name[input]`` with several."""
        return name if self.data.m == 1 else f"{name}[{self.data.inputs[number]}]"

    @cached_property
    def energy(self) -> float:
        """Sum of squares of the output about its mean."""
        y = np.concatenate([e.y[:, 0] for e in self.data.experiments])
        return float(np.nansum((y - np.nanmean(y)) ** 2))

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x."""
        return self.compress(self.unknowns.unpack(x), self.gauge_rows(x), method)

    def value(self, x: Array) -> float:
        """Return the sum of squared errors at x."""
        return float(sum(np.nansum(e**2) for e in self.innovations(x)))

    def innovations(self, x: Array) -> list[Array]:
        """Return the innovations (N,) of every experiment, NaN where there is none."""
        point = self.unknowns.unpack(x)
        found = [self.predict(point, i, y) for i, y in enumerate(self.simulate(point))]
        return [np.where(one.state == noise_filter.PRESENT, one.innovations, np.nan) for one in found]

    def admissible(self, x: Array) -> bool:
        """Whether the predictor is stable: C invertible and, unless D is A, the plant stable."""
        at = self.unknowns.slices
        if not np.all(np.isfinite(x)) or roots.radius(x[at["c"]]) >= STABLE:
            return False
        return not self.unknowns.apart or roots.radius(x[at["a"]]) < STABLE

    def scale(self, x: Array, b: str) -> float:
        """Return what a part b of x is divided by, and its mu multiplied with, to reach the gauge."""
        if self.gauge == "norm":
            return super().scale(x, b)
        at, channel = self.unknowns.slices, self.unknowns.layout.inputs[int(b[1:])]
        return 1.0 if self.gauge == "none" else gauge_factor(self.gauge, x[at["a"]], x[at[b]], channel)

    def gauge_rows(self, x: Array) -> Array:
        """Gradients (inputs, p) of the gauge: directions that a step does not take."""
        at, rows = self.unknowns.slices, []
        for _, b in self.unknowns.products:
            row = np.zeros(self.unknowns.shared)
            if self.gauge == "b0":
                row[at[b].start] = 1.0
            elif self.gauge == "gain":
                row[at[b]], row[at["a"]] = 1.0, -1.0
            else:
                row[at[b]] = x[at[b]]
            rows.append(row)
        return np.array(rows).reshape(-1, self.unknowns.shared)

    def levels_before(self, a: Any, thetas: Sequence[Any]) -> Any:
        """Return what x0 lacks in the record's own units, in which the time before the record is at the levels.

        In the units of the model it is at zero, as the definition of x0 has it.

        Args:
            a: (na,) values or expressions.
            thetas: (P, nb) of every input.
        """
        units, memory, layout = self.units, self.unknowns.memory, self.unknowns.layout
        rows, total = np.arange(memory)[:, None], np.zeros(memory)
        if layout.na and units.y_offset[0]:
            later = (np.arange(1, layout.na + 1) > rows).astype(float)
            total = total - units.y_offset[0] / units.y_scale[0] * (later @ a)
        for lags, theta, origin, scale in zip(layout.lags, thetas, units.u_offset, units.u_scale):
            if origin:
                total = total + origin / scale * ((np.asarray(lags) > rows).astype(float) @ theta[0])
        if self.unknowns.experiments == 1:
            return total
        return total[:, None] @ np.ones((1, self.unknowns.experiments))


def plant_record(data: Data, na: int, nb: Sequence[int], nk: Sequence[int], basis: Any, offset: bool, *,
                 states: bool = True) -> tuple[Data, Layout, Transform]:
    """Return the record in its own units (`optid.program.units`), the columns of the plant, and the way back.

    Args:
        data: the record; one output.
        na: number of poles.
        nb: number of coefficients of B, one per input.
        nk: delays, one per input.
        basis: one per input or one for all.
        offset: whether the model has a constant; without one nothing is centred.
        states: whether the initial states are unknown. Then the record is cut where inputs are missing: every stretch
            is an experiment with an initial state of its own.

    Raises:
        DataError: no stretch with every input is long enough.
        RankError: an experiment that its initial state would explain, a basis function that no sample excites, or
            inputs that the record does not tell apart.
    """
    def layout(bases: Sequence[Any]) -> Layout:
        return Layout(na, tuple(nb), tuple(nk), tuple(bases), tuple(data.outputs), tuple(data.inputs))

    reach = layout([Linear()] * data.m).first_row
    if states:
        _check_lengths(data, reach)
        data = with_whole_inputs(data, 2 * reach + 1)
    bases = fitted_bases(data, basis)
    units = own_units(data, [isinstance(one, Linear) for one in bases], bool(offset))
    record, found = in_units(data, units), layout(inner_bases(bases, units))
    if states:
        if not all(isinstance(one, Linear) for one in bases):
            _check_excited(record, found)
        _check_inputs_differ(record, found)
    return record, found, units


def _check_lengths(data: Data, reach: int) -> None:
    for number, e in enumerate(data.experiments, start=1):
        label = f"experiment {number}: " if data.n_experiments > 1 else ""
        if e.n_samples <= reach:
            raise RankError(f"{label}{e.n_samples} samples, but the lags reach back {reach}: its initial "
                            "state would explain them all. Leave it out, or use fewer lags")


def _check_excited(data: Data, layout: Layout) -> None:
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


def _check_inputs_differ(data: Data, layout: Layout) -> None:
    """Refuse inputs of whose expansions one column depends on another, by name."""
    columns = Layout(0, layout.nb, layout.nk, layout.bases, layout.outputs, layout.inputs)
    rows = sum(e.n_samples - layout.first_row for e in data.experiments)
    if layout.m > 1 and rows >= ROWS_PER_COLUMN * columns.n_columns:
        outputs = [e.u[:, :1] for e in data.experiments]  # any without gaps
        complete = Data([e.u for e in data.experiments], outputs, data.dt, list(data.inputs), list(data.outputs))
        _ = collect(complete, columns).root

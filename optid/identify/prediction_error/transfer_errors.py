"""The sum of squared errors of a transfer-function model, and the record it is taken from, in its own units."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from optid.arrays import Array, check_integer
from optid.bases import Linear, fitted_bases
from optid.data.channels import Transform, model_meta
from optid.data.levels import remove_levels
from optid.data.record import Data
from optid.data.stretches import with_whole_inputs
from optid.identify.arguments import check_offset, enough_rows, one_output, outputs_present, per_channel
from optid.identify.prediction_error.compressed_errors import CompressedErrors
from optid.identify.prediction_error.criterion import Criterion
from optid.models import HammersteinTF, Nonlinearity, recursions, roots
from optid.models.gauges import gauge_factor, plant_sign
from optid.models.layout import Layout
from optid.program.units import energy_unit, in_units, inner_bases, outer_bases, own_units
from optid.statistics.blocks import check_lengths
from optid.statistics.experiments import collect_by_experiment
from optid.statistics.linearised import Linearised, Method
from optid.statistics.regression import ROWS_PER_COLUMN, accumulate, collect
from optid.statistics.sensitivities import TransferPredictor
from optid.statistics.unknowns import TransferUnknowns

CONFINED = 1 - 1e-6  # radius to which zeros of C are brought that a step puts outside
STABLE = 1 - 1e-9  # radius inside which every pole of an iterate, or zero of C, lies
INTEGRATES = 1e-6  # size of A(1) that is the accuracy of a solver, where a constraint makes it zero


@dataclass(frozen=True, eq=False)
class TransferErrors(TransferPredictor, Criterion):
    """Simulation errors, or one-step prediction errors with a noise filter."""

    gauge: str  # how the scale between mu and b is fixed; "none" for a linear model
    units: Transform  # from those of the record (`optid.program.units`) to those of the model
    shifts: Array | None = None
    integrates: bool = False  # whether a constraint puts a pole of the plant at 1, where it counts as stable
    weight: ClassVar[Array] = np.eye(1)

    @property
    def unit(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What one unit of the sum of squares is in units of the record."""
        return energy_unit(self.units)

    def key(self, name: str, number: int) -> str:
        """Name a quantity of an input: plain with one input, ``name[input]`` with several."""
        return name if self.data.m == 1 else f"{name}[{self.data.inputs[number]}]"

    def facts(self) -> dict[str, Any]:
        """Return what constraints may ask besides named expressions: keyword arguments of a `View`."""
        layout = self.unknowns.layout
        return {"channels": layout.inputs, "gauge": self.gauge, "units": self.units,
                "heights": frozenset({"mu", "Theta", "offset", "x0"}), "courses": frozenset({"x"}),
                "bases": dict(zip(layout.inputs, outer_bases(layout.bases, self.units)))}

    def model(self, values: Mapping[str, Array], signed: bool = True) -> HammersteinTF:
        """Return the model of named values in the units of the record: the plant, and C/D where noise is filtered.

        The signs of f and B are those of the values; without `signed` f rises where the output rises.
        """
        layout, part = self.unknowns.layout, {name: np.asarray(value, dtype=float) for name, value in values.items()}
        mus = [part.get(self.key("mu", c), np.ones(1)) for c in range(layout.m)]
        a, levels = part.get("a", np.zeros(0)), None
        if self.unknowns.levels:
            levels = part["x0"].reshape(self.unknowns.memory, -1)[-1:].T
            part["offset"] = levels.mean(axis=0)
        model = HammersteinTF(
            a=a, b=tuple(part[self.key("b", c)] for c in range(layout.m)),
            nonlinearities=tuple(Nonlinearity(basis, mu) for basis, mu in zip(layout.bases, mus)), nk=layout.nk,
            offset=part.get("offset", np.zeros(1)), levels=levels, gauge=self.gauge, c=part.get("c", np.zeros(0)),
            d=part.get("d", np.zeros(0)) if self.unknowns.apart else None, **model_meta(self.data))
        model = model if signed else model.with_signs(model.gain_signs)
        if self.shifts is not None:
            model = model.with_output_levels(self.shifts)
        return model.with_transform(self.units)

    def compressed_near(self, at: Linearised, x: Array) -> CompressedErrors:
        """Return the compressed errors near x, ``at`` the errors there."""
        return CompressedErrors(self, at, x)

    def linearise(self, x: Array, method: Method = "auto") -> Linearised:
        """Return the errors near x."""
        return self.compress(self.unknowns.unpack(x), self.gauge_rows(x), method)

    def rows(self, x: Array) -> Callable[[int], Iterator[tuple[Array, int]]]:
        """Return a generator of the rows [x0 | shared | error] of experiment i, also where x0 is forgotten."""
        point, width = self.unknowns.unpack(x), self.unknowns.memory + self.unknowns.shared + 1

        def whole(index: int) -> Iterator[tuple[Array, int]]:
            for block, count in self.blocks(point, index):
                yield np.pad(block, ((0, 0), (width - block.shape[1], 0))), count

        return whole

    def value(self, x: Array) -> float:
        """Return the sum of squared errors at x."""
        return float(sum(np.nansum(e**2) for e in self.innovations(x)))

    def innovations(self, x: Array) -> list[Array]:
        """Return the innovations (N,) of every experiment, NaN where there is none."""
        point = self.unknowns.unpack(x)
        found = [self.predict(point, i, y) for i, y in enumerate(self.simulate(point))]
        return [np.where(one.state == recursions.PRESENT, one.innovations, np.nan) for one in found]

    def admissible(self, x: Array) -> bool:
        """Whether the predictor is stable: C invertible and, unless D is A, the plant stable but for an integrator."""
        at = self.unknowns.slices
        if not np.all(np.isfinite(x)) or roots.radius(x[at["c"]]) >= STABLE:
            return False
        a = x[at["a"]]
        if self.integrates and abs(1 + a.sum()) <= INTEGRATES:
            a = roots.without_integrator(a)
        return not self.unknowns.apart or roots.radius(a) < STABLE

    def confine(self, x: Array) -> Array:
        """Return x with the zeros of C inside the unit circle, on which those of noise without a level lie."""
        x, at = np.array(x), self.unknowns.slices["c"]
        if np.all(np.isfinite(x)) and roots.radius(x[at]) >= STABLE:
            x[at] = roots.contain_roots(x[at], CONFINED)
        return x

    def normalise(self, x: Array) -> Array:
        """Return the same model in the gauge; a pole that a constraint puts at 1 lies there to the last digit."""
        x, at = super().normalise(x), self.unknowns.slices["a"]
        rest = 1 + x[at].sum()
        if self.integrates and abs(rest) <= INTEGRATES:
            x[at.stop - 1] -= rest
        return x

    def scale(self, x: Array, b: str) -> float:
        """Return the divisor of a part b of x, and factor of its mu, to reach the gauge."""
        if self.gauge == "norm":
            return super().scale(x, b)
        at, channel = self.unknowns.slices, self.unknowns.layout.inputs[int(b[1:])]
        return 1.0 if self.gauge == "none" else gauge_factor(self.gauge, x[at["a"]], x[at[b]], channel)

    def gain_sign(self, x: Array, b: str) -> float:
        """Return the sign of the static gain from what part b of x takes in; see `plant_sign`."""
        at = self.unknowns.slices
        return plant_sign(x[at["a"]], x[at[b]])

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
        """Return the part of the initial states by the levels of the channels before the record, in the model's units.

        a (na,) and Theta (P, nb) of every input may be expressions.
        """
        units, memory, layout = self.units, self.unknowns.fading, self.unknowns.layout
        rows, total = np.arange(memory)[:, None], np.zeros(memory)
        later = (np.arange(1, layout.na + 1) > rows).astype(float)
        if layout.na and units.y_offset[0]:
            total = total - units.y_offset[0] / units.y_scale[0] * (later @ a)
        for lags, theta, origin, scale in zip(layout.lags, thetas, units.u_offset, units.u_scale):
            if origin:
                total = total + origin / scale * ((np.asarray(lags) > rows).astype(float) @ theta[0])
        if self.unknowns.experiments == 1:
            return total
        every = total[:, None] @ np.ones((1, self.unknowns.experiments))
        if self.shifts is None or not layout.na:
            return every
        return every - (later @ a)[:, None] @ self.shifts.T


class TransferOrders(NamedTuple):
    """Orders of A, of every B with its delay, and of C and D, as in `formulations.prediction_error.hammerstein_bj`."""

    na: Any
    nb: Any
    nk: Any
    nc: Any = 0
    nd: int | None = 0  # None where D is A


def transfer_errors(data: Data, orders: TransferOrders, basis: Any, gauge: str | None, offset: Any) -> TransferErrors:
    """Check the arguments of a fit, and return its criterion on the record in its own units (`optid.program.units`).

    Unless D is A the initial states are unknown, and a record with missing inputs is cut into experiments. Arguments
    and errors as in `formulations.prediction_error.hammerstein_bj`; ``gauge`` is None for a linear model. Without
    ``offset`` nothing is centred.
    """
    na, nb, nk, nc, nd = orders
    data = one_output(data, "simulation errors" if (nc, nd) == (0, 0) else "prediction errors")
    constants, shifts = check_offset(offset, data), None
    layout = Layout(check_integer(na, "na (the number of poles)", 0), per_channel("nb", nb, data.inputs, low=1),
                    per_channel("nk", nk, data.inputs, low=0), (Linear(),) * data.m, data.outputs, data.inputs)
    states = nd is not None
    if states:
        check_lengths([e.n_samples for e in data.experiments], layout)
        data = with_whole_inputs(data, 2 * layout.first_row + 1)
    if constants == "each":
        data, shifts = remove_levels(data)
    bases = fitted_bases(data, basis)
    units = own_units(data, [isinstance(one, Linear) for one in bases], bool(constants))
    record, layout = in_units(data, units), replace(layout, bases=tuple(inner_bases(bases, units)))
    if states:
        _check_inputs(record, layout, constants == "each")
    unknowns = TransferUnknowns(layout, record.n_experiments, (gauge is not None,) * layout.m, constants is True,
                                check_integer(nc, "nc", 0), None if nd is None else check_integer(nd, "nd", 0),
                                constants == "each")
    if states:
        enough_rows(outputs_present(record), "output samples", replace(unknowns, nc=0, nd=0).size, "lags")
    return TransferErrors(record, unknowns, gauge or "none", units,
                          None if shifts is None else shifts / units.y_scale[0])


def _check_inputs(data: Data, layout: Layout, levels: bool) -> None:
    """Refuse a basis function without energy, and dependent columns of the expanded inputs, by name.

    With levels columns are also dependent that are constant within every experiment.
    """
    outputs = [e.u[:, :1] for e in data.experiments]  # any without gaps
    complete = Data([e.u for e in data.experiments], outputs, data.dt, list(data.inputs), list(data.outputs))
    if not all(isinstance(basis, Linear) for basis in layout.bases):
        accumulate(complete, replace(layout, na=0, nb=(1,) * layout.m, nk=(0,) * layout.m)).check()
    columns = replace(layout, na=0)
    rows = sum(e.n_samples - layout.first_row for e in data.experiments)
    if (layout.m > 1 or levels) and rows >= ROWS_PER_COLUMN * columns.n_columns:
        _ = (collect_by_experiment(complete, columns)[0] if levels else collect(complete, columns)).root

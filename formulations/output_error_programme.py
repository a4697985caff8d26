"""Programmes in the tangent of an iterate of an output-error or prediction-error fit, and what their values mean."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.equation_error import flat, model_meta, tangent_product
from formulations.gauges import scale_fixed
from formulations.output_error import OutputError
from formulations.output_error_starts import with_poles
from formulations.prediction_error import Descent, Posed
from optid.models import HammersteinARX, Nonlinearity
from optid.models.gauges import leading_sign
from optid.models.hammerstein_tf import HammersteinTF
from optid.models.roots import contained
from optid.program.judging import measure_violation
from optid.program.program import Program, Values
from optid.program.units import energy_unit, outer_bases
from optid.program.view import View
from optid.statistics import Layout
from optid.statistics.linearised import Linearised
from optid.structures.least_squares import LeastSquaresStructure

Array = np.ndarray

PULLS = (1.0, 0.999, 0.99, 0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.3, 0.1, 0.0)
"""Radii tried to bring the poles of a start into the region of the constraints."""

ENTRIES = 3
"""Different optima from which the constrained iteration may start."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """The compressed simulation errors near an iterate, for uncertainty, prices and figures.

    Attributes:
        at: the errors near the iterate.
        names: variables in the order of the columns.
        reference: (n,) the iterate, in that order.
        energy: (1,) sum of squares of the output about its mean.
        layout: orders and bases of the plant.
        candidates: samples of the record.
    """

    at: Linearised
    names: tuple[str, ...]
    reference: Array
    energy: Array
    layout: Layout
    candidates: int

    @cached_property
    def problem(self) -> "_LeastSquares":
        """``‖root z - target‖² + remainder`` in the flattened variables z."""
        root, errors = self.at.whole
        return _LeastSquares(root, root @ self.reference - errors, self.at.remainder, float(self.energy[0]))

    @cached_property
    def statistics(self) -> "_Rows":
        """The same as the triangular factor of a regression with rows and columns."""
        size = len(self.reference)
        root = np.zeros((size + 1, size + 1))
        root[:size, :size], root[:size, size] = self.problem.root, self.problem.target
        root[size, size] = np.sqrt(self.problem.remainder)
        return _Rows(root, _Columns(size), self.at.rows, self.candidates, self.at.condition, self.at.method)

    def lifted(self, values: Mapping[str, Array]) -> Array:
        """Return z."""
        return np.concatenate([np.ravel(values[name], order="F") for name in self.names])

    def regression(self, values: Mapping[str, Array]) -> Array:
        """Return the coefficients (n, 1) of the columns."""
        return self.lifted(values)[:, None]

    def one_step_fit(self, values: Mapping[str, Array]) -> Array:
        """Return the fit in % on the record: one step ahead an output-error model predicts what it simulates."""
        rest = self.problem.root @ self.lifted(values) - self.problem.target
        value = float(rest @ rest) + self.problem.remainder
        return 100.0 * (1.0 - np.sqrt(value / np.maximum(self.energy, 1e-300)))


@dataclass(frozen=True, eq=False)
class _LeastSquares:
    root: Array
    target: Array
    remainder: float
    scale: float


@dataclass(frozen=True)
class _Columns:
    n_columns: int
    outputs: tuple[str, ...] = ("y",)


@dataclass(frozen=True, eq=False)
class _Rows:
    root: Array
    layout: _Columns
    rows: int
    candidates: int
    condition: float
    method: str


@dataclass(frozen=True, eq=False)
class Posing:
    """Writes programmes in the tangent of an iterate, and reads their values.

    Attributes:
        name: of the formulation.
        criterion: the errors, in the gauge of the programmes.
        constraints: of the user.
        usual: values of usual size, of the unconstrained optimum: what violations are relative to where a constraint
            makes a variable vanish.
    """

    name: str
    criterion: OutputError
    constraints: tuple[Any, ...]
    usual: Mapping[str, Array] | None = None

    def posed(self) -> Posed:
        """Return what the constrained iteration needs."""
        return Posed(self.criterion, self.pose, self.pack, self.model, energy_unit(self.criterion.units))

    def key(self, name: str, c: int) -> str:
        """Name of a per-channel variable."""
        inputs = self.criterion.data.inputs
        return name if len(inputs) == 1 else f"{name}[{inputs[c]}]"

    @cached_property
    def places(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """{variable: (slice of x or "x0", shape)} in the order of x."""
        unknowns = self.criterion.unknowns
        layout, found = unknowns.layout, {}
        if layout.na:
            found["a"] = ("a", (layout.na,))
        for c, (basis, nb) in enumerate(zip(layout.bases, layout.nb)):
            if unknowns.free[c]:
                found[self.key("mu", c)] = (f"mu{c}", (basis.size,))
            found[self.key("b", c)] = (f"b{c}", (nb,))
        if unknowns.constant:
            found["offset"] = ("offset", (1,))
        for name in ("c", "d"):  # those of a noise filter
            part = unknowns.slices.get(name)
            if part is not None and part.stop > part.start:
                found[name] = (name, (part.stop - part.start,))
        if unknowns.memory:
            several = unknowns.experiments > 1
            found["x0"] = ("x0", (unknowns.memory, unknowns.experiments) if several else (unknowns.memory,))
        return found

    def values(self, x: Array) -> dict[str, Array]:
        """Name the parts of x."""
        unknowns = self.criterion.unknowns
        at = {**unknowns.slices, "x0": slice(unknowns.shared, unknowns.size)}
        return {name: np.reshape(x[at[where]], shape, order="F") for name, (where, shape) in self.places.items()}

    def pack(self, values: Mapping[str, Array]) -> Array:
        """Return x of named values."""
        return np.concatenate([np.ravel(values[name], order="F") for name in self.places]).astype(float)

    def pose(self, x: Array, at: Linearised, damping: float) -> Program:
        """Write the programme of one step from x."""
        values, unknowns = self.values(x), self.criterion.unknowns
        variables = {name: cp.Variable(shape, name=name) for name, (_, shape) in self.places.items()}
        expressions: dict[str, Any] = {"offset": cp.Constant(np.zeros(1)), **variables}
        gauges = []
        for c, free in enumerate(unknowns.free):
            mu, b, theta = (self.key(word, c) for word in ("mu", "b", "Theta"))
            if not free:
                expressions[theta] = cp.reshape(variables[b], (1, variables[b].size), order="F")
                continue
            expressions[theta] = tangent_product(variables[mu], variables[b], values[mu], values[b])
            gauges.append(scale_fixed(self.criterion.gauge, variables[b], variables.get("a"), values[b]))
        energy = np.array([self.criterion.energy])
        compressed = Simulated(at, tuple(self.places), x, energy, unknowns.layout, self.criterion.data.n_samples)
        stacked = cp.hstack([flat(v) for v in variables.values()])
        residual = compressed.problem.root @ stacked - compressed.problem.target
        r = cp.Variable(x.size, name="residual")
        objective = cp.sum_squares(r) + at.remainder
        if damping:
            weights = np.sqrt(damping) * np.linalg.norm(at.whole[0], axis=0)
            objective = objective + cp.sum_squares(cp.multiply(weights, stacked - x))
        structural = {"residual": (r == residual,), **({"gauge": tuple(gauges)} if gauges else {})}
        units = self.criterion.units
        if unknowns.memory:
            expressions["x0"] = variables["x0"] + self._before(expressions)
        view = View(expressions, iterate=True, channels=unknowns.layout.inputs,
                    bases=dict(zip(unknowns.layout.inputs, outer_bases(unknowns.layout.bases, units))),
                    gauge=self.criterion.gauge, reference=values, units=units)
        start = {**(self.usual or values), "residual": at.whole[1]}
        least = None if damping else LeastSquaresStructure(compressed.problem, tuple(self.places), ())
        program = Program(name=self.name, objective=cp.Minimize(objective), constraints=structural, structure=least,
                          variables={**variables, "residual": r}, start=start, recover=self.recover, view=view,
                          structural=frozenset(structural), derived={"residual": residual},
                          scale=self.criterion.energy, compressed=compressed, unit=energy_unit(units))
        return program.subject_to(*self.constraints)

    def _before(self, expressions: Mapping[str, Any]) -> Any:
        """What the initial state of the record's own units misses: there the time before the record is at the levels.

        In the units of the record it is at zero, as the definition of x0 has it.
        """
        units, unknowns = self.criterion.units, self.criterion.unknowns
        layout, rows = unknowns.layout, np.arange(unknowns.memory)[:, None]
        total: Any = np.zeros(unknowns.memory)
        if layout.na and units.y_offset[0]:
            later = (np.arange(1, layout.na + 1) > rows).astype(float)
            total = total - units.y_offset[0] / units.y_scale[0] * (later @ expressions["a"])
        for c, (origin, scale) in enumerate(zip(units.u_offset, units.u_scale)):
            if origin:
                later = (np.asarray(layout.lags[c]) > rows).astype(float)
                total = total + origin / scale * (later @ expressions[self.key("Theta", c)][0])
        if unknowns.experiments == 1:
            return total
        return cp.reshape(total, (unknowns.memory, 1), order="F") @ np.ones((1, unknowns.experiments))

    def entry(self, found: Sequence[Descent]) -> Array:
        """Return where to start under the constraints: the best of the optima whose poles are pulled into the region.

        What belongs to the pulled poles is estimated anew; without constraints on the poles alone they stay.
        """
        if not self.constraints:
            return self.signed(found[0].x)
        ends = []
        for one in found[:ENTRIES]:
            x = self.signed(one.x)
            a = x[self.criterion.unknowns.slices["a"]]
            for radius in PULLS:
                pulled = a if radius == 1.0 else contained(a, radius)
                if self._poles_obey(x, one.at, pulled):
                    again = one if radius == 1.0 else with_poles(
                        replace(self.criterion, gauge="norm"), x, pulled, one.start)
                    ends.append((again.value, again.x))
                    break
        return self.signed(min(ends, key=lambda end: end[0])[1] if ends else found[0].x)

    def _poles_obey(self, x: Array, at: Linearised, a: Array) -> bool:
        """Whether the constraints on a alone hold at a given A."""
        moved = np.array(x)
        moved[self.criterion.unknowns.slices["a"]] = a
        program = self.pose(moved, at, 0.0)
        alone = [name for name, group in program.user_constraints.items()
                 if any({v.id for v in c.variables()} != {program.variables["a"].id} for c in group)] if a.size else []
        program = program.without(*alone, "residual", "gauge")
        program.assign(program.view.reference)
        return measure_violation(program)[0] <= 1e-9

    def signed(self, x: Array) -> Array:
        """Turn the signs of mu and b to where the constraints are violated least.

        A monotone f or a sign of the gain says which of the two equal descriptions is meant; where it asks for the
        opposite characteristic, mu or b alone is turned, since no tangent step leads through zero.
        """
        x = self.criterion.normalised(x)
        at, unknowns = self.criterion.unknowns.slices, self.criterion.unknowns
        errors = self.criterion.linearise(x) if self.constraints else None
        for c, free in enumerate(unknowns.free if self.criterion.gauge == "norm" else ()):
            if not free:
                continue
            first = leading_sign(x[at[f"b{c}"]])
            best = np.inf
            for mu_sign, b_sign in ((first, first), (-first, -first), (-first, first), (first, -first)):
                turned = np.array(x)
                turned[at[f"mu{c}"]] *= mu_sign
                turned[at[f"b{c}"]] *= b_sign
                outside = 0.0
                if errors is not None:
                    program = self.pose(turned, errors, 0.0)
                    program.assign(program.view.reference)
                    outside = measure_violation(program)[0]
                if outside < (best if mu_sign == b_sign else 0.5 * best):
                    best, chosen = outside, turned
                if best <= 1e-9:
                    break
            x = chosen
        return x

    def model(self, x: Array) -> HammersteinTF:
        """Build the model of x."""
        return self.recover(self.values(x))

    def recover(self, values: Values) -> HammersteinTF:
        """Build the model of the programme's values."""
        unknowns = self.criterion.unknowns
        nonlinearities, bs = [], []
        for c, basis in enumerate(unknowns.layout.bases):
            mu = values[self.key("mu", c)] if unknowns.free[c] else np.ones(1)
            nonlinearities.append(Nonlinearity(basis, np.asarray(mu, dtype=float), None))
            bs.append(np.asarray(values[self.key("b", c)], dtype=float))
        plant = HammersteinARX(a=np.asarray(values.get("a", np.zeros(0)), dtype=float), b=tuple(bs),
                               nonlinearities=tuple(nonlinearities), nk=unknowns.layout.nk,
                               offset=np.asarray(values.get("offset", np.zeros(1)), dtype=float),
                               gauge=self.criterion.gauge, **model_meta(self.criterion.data))
        return self.criterion.with_noise(plant, values).with_transform(self.criterion.units)

"""Output error: ``y = A(q)^-1 [sum_c B_c(q) f_c(u_c) + d] + e``, the sum of squared simulation errors minimised.

`exact` is the Hammerstein model, `linear` (registered as ``oe.exact``) the linear one. Both are procedures: starts
(`formulations.output_error_starts`), Gauss-Newton descents on streamed sensitivities (`optid.regressors.sensitivities`)
and, at the optimum or under constraints, convex programmes in the tangent of the iterate
(`formulations.prediction_error`). Named variables: ``a``, ``b``, ``mu`` (not in the linear model), ``offset``, ``x0``
((n,), or (n, experiments)) and the affine expression ``Theta = mu b0ᵀ + mu0 bᵀ - mu0 b0ᵀ`` about the iterate
(mu0, b0), which is ``mu bᵀ`` there. With several inputs the per-channel names carry the input, as in ``mu[valve]``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.equation_error import flat, model_meta
from formulations.hammerstein_arx import GAUGES
from formulations.output_error_records import check_excited, check_inputs_differ, check_rows, plant_record
from formulations.output_error_starts import (
    blank,
    equation_error,
    iterated,
    perturbed,
    stable_poles,
    subspace,
    with_poles,
)
from formulations.prediction_error import Descent, Posed, agreement, best_of, descend, refine
from optid.bases import Linear
from optid.bases.basis import Basis
from optid.data import Data
from optid.errors import RankError, StructureError
from optid.judging import measure_violation
from optid.models import HammersteinARX, Nonlinearity
from optid.models.gauges import gauge_factor, leading_sign
from optid.models.hammerstein_tf import HammersteinTF
from optid.program import Program, RankOneForm, Values, View
from optid.regressors import Layout
from optid.regressors.sensitivities import Linearised, Unknowns, expanded, linearise
from optid.solving import Procedure

Array = np.ndarray

SEARCH = 5_000
"""Samples, from the middle of the record, on which starts are compared; the winner descends on the whole record."""

PULLS = (1.0, 0.999, 0.99, 0.98, 0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.3, 0.1, 0.0)
"""Radii tried to bring the poles of a start into the region of the constraints."""

SUFFICIENT = 3
"""Starts of different methods that may make further ones unnecessary, see `formulations.prediction_error.best_of`."""

ENTRIES = 3
"""Different optima from which the constrained iteration may start."""

STABLE = 1 - 1e-9


def linear(data: Data, *, na: int, nb: int | Sequence[int], nk: int | Sequence[int] = 0,
           constraints: Sequence[Any] = (), offset: bool = True, starts: int = 6, seed: int = 0) -> Procedure:
    """Minimise the simulation error of a linear model.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.stretches`.
        na: number of poles.
        nb: number of coefficients of B, one per input or one for all.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders of CVXPY constraints in ``a``, ``b``, ``offset``, ``x0``.
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared at most; three suffice where they agree on a model that explains
            nine tenths of the output.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, or inputs that the record does not tell apart.
    """
    record, layout = plant_record(data, na, nb, nk, Linear())
    check_inputs_differ(record, layout)
    return _procedure("oe.exact", record, layout, False, offset, constraints, "none", starts, seed)


def exact(data: Data, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str] = "polynomial:3",
          nk: int | Sequence[int] = 0, constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True,
          starts: int = 6, seed: int = 0) -> Procedure:
    """Minimise the simulation error of a Hammerstein model.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.stretches`.
        na: number of poles.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all; a cubic polynomial by default.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.shape.monotone("increasing")`` or ``lambda v: {...}``.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: estimate the constant of the equation; False holds it at zero, for centred data.
        starts: number of starts that are compared at most; three suffice where they agree on a model that explains
            nine tenths of the output.
        seed: of the random ones.

    Raises:
        StructureError: impossible orders, unknown gauge, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, a basis function that no sample excites, or inputs that the record
            does not tell apart.
    """
    if gauge not in GAUGES:
        raise StructureError(f"gauge must be one of {', '.join(GAUGES)}; got {gauge!r}")
    record, layout = plant_record(data, na, nb, nk, basis)
    check_excited(record, layout)
    check_inputs_differ(record, layout)
    return _procedure("hammerstein_oe.exact", record, layout, True, offset, constraints, gauge, starts, seed)


# -- the errors ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class OutputError:
    """Simulation errors as a function of the unknowns; a `formulations.prediction_error.Criterion`.

    Attributes:
        data: the record.
        unknowns: their order.
        gauge: how the scale between mu and b is fixed; "none" for a linear model.
    """

    data: Data
    unknowns: Unknowns
    gauge: str

    @property
    def errors(self) -> str:
        """What they are called."""
        return "simulation errors"

    @cached_property
    def functions(self) -> tuple[Array, ...] | None:
        """Values of the basis functions, where they are few enough to be kept."""
        return expanded(self.data, self.unknowns.layout)

    @property
    def energy(self) -> float:
        """Sum of squares of the output about its mean."""
        return self._energy

    @cached_property
    def _energy(self) -> float:
        y = np.concatenate([e.y[:, 0] for e in self.data.experiments])
        return float(np.nansum((y - np.nanmean(y)) ** 2))

    def linearise(self, x: Array) -> Linearised:
        """Return the errors near x."""
        return linearise(self.data, self.unknowns, self.unknowns.unpack(x), gauge=self.gauge_rows(x),
                         functions=self.functions)

    def admissible(self, x: Array) -> bool:
        """Whether all poles lie inside the unit circle."""
        a = x[self.unknowns.slices["a"]]
        return bool(np.all(np.isfinite(x))) and largest_pole(a) < STABLE

    def normalised(self, x: Array) -> Array:
        """Return the same model in the gauge."""
        x, at = np.array(x), self.unknowns.slices
        for c, free in enumerate(self.unknowns.free):
            if free:
                mu, b = x[at[f"mu{c}"]], x[at[f"b{c}"]]
                factor = 1.0
                if self.gauge == "norm":
                    factor = float(np.linalg.norm(b))
                elif self.gauge != "none":
                    factor = gauge_factor(self.gauge, x[at["a"]], b, self.unknowns.layout.inputs[c])
                if not factor:  # an input without effect: any direction will do
                    x[at[f"mu{c}"]], x[at[f"b{c}"]] = 0.0, 1 / np.sqrt(b.size)
                    continue
                x[at[f"mu{c}"]], x[at[f"b{c}"]] = mu * factor, b / factor
        return x

    def with_noise(self, plant: HammersteinARX, values: Values) -> HammersteinTF:
        """Give a plant the noise model of the programme's values: none."""
        return HammersteinTF(plant)

    def gauge_rows(self, x: Array) -> Array:
        """Gradients (inputs, p) of the gauge: directions that a step does not take."""
        at, rows = self.unknowns.slices, []
        for c, free in enumerate(self.unknowns.free):
            if free:
                row = np.zeros(self.unknowns.shared)
                if self.gauge == "b0":
                    row[at[f"b{c}"].start] = 1.0
                elif self.gauge == "gain":
                    row[at[f"b{c}"]], row[at["a"]] = 1.0, -1.0
                else:
                    row[at[f"b{c}"]] = x[at[f"b{c}"]]
                rows.append(row)
        return np.array(rows).reshape(-1, self.unknowns.shared)


def largest_pole(a: Array) -> float:
    """Modulus of the largest root of A, 0 without one."""
    return float(np.max(np.abs(np.roots(np.concatenate([[1.0], a]))), initial=0.0))


# -- the procedure ---------------------------------------------------------------------------------------------------


def _procedure(name: str, data: Data, layout: Layout, free: bool, offset: bool, constraints: Sequence[Any], gauge: str,
               starts: int, seed: int) -> Procedure:
    if isinstance(starts, bool) or not isinstance(starts, int | np.integer) or starts < 1:
        raise StructureError(f"starts is the number of starts, a whole number from 1; got {starts!r}")
    unknowns = Unknowns(layout, data.n_experiments, (free,) * layout.m, bool(offset))
    check_rows(data, unknowns)
    return _run(name, OutputError(data, unknowns, "norm" if free else "none"), constraints, gauge, int(starts), seed)


def _run(name: str, criterion: OutputError, constraints: Sequence[Any], gauge: str, starts: int, seed: int
         ) -> Procedure:
    found, others, figures = _searched(criterion, starts, seed)
    posing = Posing(name, replace(criterion, gauge=gauge), tuple(constraints))
    posing = replace(posing, usual=posing.values(replace(criterion, gauge=gauge).normalised(found.x)))
    x = posing.entry([found, *others])
    evidence = yield from refine(posing.posed(), replace(found, x=x), figures, x)
    return evidence


def search(criterion: OutputError, count: int, seed: int) -> tuple[Descent, dict[str, Any]]:
    """Descend from several starts and return the best optimum with what is to be said about the others.

    On long records the starts are compared on a part, and the winner descends on the whole.
    """
    found, _, figures = _searched(criterion, count, seed)
    return found, figures


def _searched(criterion: OutputError, count: int, seed: int) -> tuple[Descent, list[Descent], dict[str, Any]]:
    """Return the best optimum, the other ones, and what is to be said about them."""
    part = _part(criterion)
    found = best_of(part, _starts(part, count, seed), enough=SUFFICIENT)
    if not found:
        raise RankError("no start has a stable simulation; use other orders")
    _, sentence = agreement(found, 1e-12 * part.energy)
    best = found[0]
    x = np.zeros(criterion.unknowns.size)
    x[: criterion.unknowns.shared] = best.x[: criterion.unknowns.shared]
    final = descend(criterion, best.x if part is criterion else x, start=best.start)
    figures = {"starts": sentence,
               "simulation errors of the starts": np.array(sorted((one.value for one in found), reverse=True))}
    others = [one for one in found[1:] if abs(one.value - best.value) > 1e-3 * best.value] if part is criterion else []
    return replace(final, steps=final.steps + best.steps), others, figures


def _part(criterion: OutputError) -> OutputError:
    """The record itself, or the middle of a long one."""
    data = criterion.data
    if data.n_samples <= 2 * SEARCH:
        return criterion
    longest = int(np.argmax([e.n_samples for e in data.experiments]))
    size = data.experiments[longest].n_samples
    if size < SEARCH:  # many short experiments
        kept, total = [], 0
        for i, e in enumerate(data.experiments):
            if total < SEARCH:
                kept, total = [*kept, i], total + e.n_samples
        return replace(criterion, data=data.select(experiments=kept),
                       unknowns=replace(criterion.unknowns, experiments=len(kept)))
    first = (size - SEARCH) // 2
    cut = data.select(experiments=[longest]).window(first, first + SEARCH)
    return replace(criterion, data=cut, unknowns=replace(criterion.unknowns, experiments=1))


def _starts(criterion: OutputError, count: int, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield starts one by one, each estimated when it is asked for: those of other methods first, then moved poles."""
    data, unknowns = criterion.data, criterion.unknowns
    at = unknowns.slices["a"]
    first = equation_error(data, unknowns)
    first = blank(data, unknowns) if first is None else first
    base = with_poles(criterion, unknowns, criterion.normalised(first), stable_poles(first[at]), "ARX")
    yield "ARX", base.x
    done = 1
    for name in ("Steiglitz-McBride", "instruments", "subspace"):
        if done == count:
            return
        if name == "subspace":
            a = subspace(data, unknowns)
            one = None if a is None else with_poles(criterion, unknowns, base.x, a, name)
        else:
            one = iterated(criterion, data, unknowns, base.x, "sm" if name == "Steiglitz-McBride" else "iv")
        if one is not None:
            done += 1
            yield name, one.x
    rng = np.random.default_rng(seed)
    for i in range(1, (count - done if unknowns.layout.na else 0) + 1):
        a = perturbed(rng, base.x[at])
        yield f"perturbed {i}", with_poles(criterion, unknowns, base.x, a, "").x


# -- the programme ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Simulated:
    """The compressed simulation errors near an iterate, for uncertainty, prices and figures.

    Attributes:
        at: the errors near the iterate.
        names: variables in the order of the columns.
        reference: (n,) the iterate, in that order.
        energy: (1,) sum of squares of the output about its mean.
        layout: orders and bases of the plant.
    """

    at: Linearised
    names: tuple[str, ...]
    reference: Array
    energy: Array
    layout: Layout
    candidates: int = field(default=0)

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
        return Posed(self.criterion, self.pose, self.pack, self.model)

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
            expressions[theta] = (cp.outer(variables[mu], values[b]) + cp.outer(values[mu], variables[b])
                                  - np.outer(values[mu], values[b]))
            gauges.append(self._gauge(variables[b], values[b], variables.get("a")))
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
        view = View(expressions, kind="tangent", channels=unknowns.layout.inputs,
                    bases=dict(zip(unknowns.layout.inputs, unknowns.layout.bases)), gauge=self.criterion.gauge,
                    reference=values)
        start = {**(self.usual or values), "residual": at.whole[1]}
        least = None if damping else RankOneForm(compressed.problem, tuple(self.places), ())
        program = Program(name=self.name, objective=cp.Minimize(objective), constraints=structural, least_squares=least,
                          variables={**variables, "residual": r}, start=start, recover=self.recover, view=view,
                          structural=frozenset(structural), derived={"residual": residual},
                          scale=self.criterion.energy, compressed=compressed)
        return program.subject_to(*self.constraints)

    def _gauge(self, b: cp.Variable, reference: Array, a: cp.Variable | None) -> Any:
        gauge = self.criterion.gauge
        if gauge == "norm":
            return reference @ b == float(reference @ reference)
        if gauge == "b0":
            return b[0] == 1
        return cp.sum(b) == 1 + (cp.sum(a) if a is not None else 0)

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
                pulled = a if radius == 1.0 else stable_poles(a, radius)
                if self._poles_obey(x, one.at, pulled):
                    again = one if radius == 1.0 else with_poles(
                        replace(self.criterion, gauge="norm"), self.criterion.unknowns, x, pulled, one.start)
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
        return self.criterion.with_noise(plant, values)

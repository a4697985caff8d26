"""Output error with the outputs of the plant as variables: one sparse programme for NLP back ends.

``y = A(q)^-1 [sum_c B_c(q) f_c(u_c) + d] + e`` is posed as

    minimise ‖y - x‖²  subject to  x(k) + sum_i a_i x(k-i) = sum_c sum_j b_cj w_c(k - nk_c - j) + d,  w_c = eta_c mu_c,

with the noise-free output x and the values w of the nonlinearities at every sample as variables: multiple shooting with
one sample between the nodes (Bock 1981), so that the past of x is the state. A row of the constraints has at most
na + m nb + 2 unknowns in products of no more than two. The poles are kept inside the unit circle exactly: A is built up
from reflection coefficients between -1 and 1, ``A_m(q) = A_(m-1)(q) + kappa_m q^-m A_(m-1)(q^-1)`` (Levinson 1947);
without that x could satisfy the equations backwards in time. The first n outputs of an experiment, whose lags reach
before it, are free: they are its initial state. The optima are those of ``hammerstein_oe.exact``; the ways there
differ. Named variables: ``a``, ``b``, ``mu``, ``offset``, ``x`` (with several experiments ``x[1]``, ``x[2]``, ...),
and the expression ``Theta = mu bᵀ``; constraints, on x too, need not be convex. With several inputs the per-channel
names carry the input, as in ``mu[valve]``.

Work and memory grow with the samples, not with the parameters: it is the way for constraints on states and for
difficult starts. IPOPT uses the sparsity, and takes records up to the limit in seconds; Uno and fatrop factorise
without it here and are for some hundred samples. Longer records are refused; ``hammerstein_oe.exact`` takes them.
"""

from collections.abc import Sequence
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.arguments import one_output
from formulations.equation_error import model_meta
from formulations.gauges import check_gauge, scale_fixed
from formulations.output_error import OutputError
from formulations.output_error_records import check_excited, check_inputs_differ, check_rows, plant_record
from formulations.output_error_starts import RADIUS, blank, equation_error, iterated, with_poles
from optid.bases.basis import Basis
from optid.data.record import Data
from optid.errors import StructureError
from optid.models import HammersteinARX, HammersteinTF, Nonlinearity
from optid.models.gauges import leading_sign
from optid.models.roots import contained
from optid.program.program import Program, Values
from optid.program.solution import Bound
from optid.program.units import energy_unit, outer_bases
from optid.program.view import View
from optid.statistics.sensitivities import Unknowns, simulate

Array = np.ndarray

REFLECTION = 1 - 1e-7
"""Largest modulus of a reflection coefficient."""

LIMIT = 20_000
"""Samples up to which the programme is posed: beyond, factorisations and CVXPY's own work take minutes."""

NO_BOUND = "simulation errors are not convex in the poles: no lower bound is known"


def exact(data: Data, *, na: int, nb: int | Sequence[int], basis: Basis | str | Sequence[Basis | str] = "polynomial:3",
          nk: int | Sequence[int] = 0, constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True
          ) -> Program:
    """Pose the least squares of the simulation errors with the simulated outputs as variables.

    Named variables: ``Theta``, ``a``, ``b``, ``mu``, ``offset``, ``x``.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        na: number of poles.
        nb: number of coefficients of B, one per input or one for all.
        basis: basis of the nonlinearity, one per input or one for all; a cubic polynomial by default.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``shape.monotone("increasing")`` or ``lambda v: {...}``; any smooth constraint in
            the named variables.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: estimate the constant of the equation; False holds it at zero, for centred data.

    Raises:
        StructureError: impossible orders, unknown gauge, several outputs, or a record that is too long.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, or a basis function that no sample excites.
    """
    check_gauge(gauge)
    record, layout, units = plant_record(one_output(data, "simulation errors"), na, nb, nk, basis, offset)
    if record.n_samples > LIMIT:
        raise StructureError(
            f"{record.n_samples} samples: with the outputs of every sample as variables this formulation takes up to "
            f"{LIMIT}. Use 'hammerstein_oe.exact', which has the same optima, or fewer samples")
    check_excited(record, layout)
    check_inputs_differ(record, layout)
    unknowns = Unknowns(layout, record.n_experiments, (True,) * layout.m, bool(offset))
    check_rows(record, unknowns)
    return _Shooting(OutputError(record, unknowns, gauge, units)).program(constraints)


class _Shooting:
    """Writes the programme of one record."""

    def __init__(self, criterion: OutputError) -> None:
        self.criterion, self.data, self.layout = criterion, criterion.data, criterion.unknowns.layout
        several = criterion.unknowns.experiments > 1
        self.labels = [f"[{i}]" if several else "" for i in range(1, criterion.unknowns.experiments + 1)]
        self.variables: dict[str, cp.Variable] = {}
        self.tables = [[basis.values(e.u[:, c]) for c, basis in enumerate(self.layout.bases)]
                       for e in self.data.experiments]

    def key(self, name: str, c: int) -> str:
        """Name of a quantity of an input."""
        return name if self.layout.m == 1 else f"{name}[{self.layout.inputs[c]}]"

    def program(self, constraints: Sequence[Any]) -> Program:
        """Return the programme under the user's constraints."""
        layout, gauge = self.layout, self.criterion.gauge
        shapes = {"a": layout.na, "offset": int(self.criterion.unknowns.constant)}
        for c, (basis, nb) in enumerate(zip(layout.bases, layout.nb)):
            shapes |= {self.key("mu", c): basis.size, self.key("b", c): nb}
        self.variables = {name: cp.Variable(size, name=name) for name, size in shapes.items() if size}
        expressions: dict[str, Any] = dict(self.variables)
        for c in range(layout.m):
            expressions[self.key("Theta", c)] = cp.outer(self.variables[self.key("mu", c)],
                                                         self.variables[self.key("b", c)])
        structural, derived, residuals = {}, {}, []
        for i, label in enumerate(self.labels):
            dynamics, own = self._experiment(i, label)
            structural |= dynamics
            derived |= own
            expressions[f"x{label}"] = self.variables[f"x{label}"]
            residuals.append(self.variables[f"residual{label}"])
        if layout.na:
            structural["stability"] = self._stable()
        structural["gauge"] = tuple(scale_fixed(gauge, self.variables[self.key("b", c)], self.variables.get("a"))
                                    for c in range(layout.m))
        start = self._start()
        reference = {name: start[name] for name in ("a", "offset") if name in start}
        units = self.criterion.units
        view = View(expressions, channels=layout.inputs,
                    bases=dict(zip(layout.inputs, outer_bases(layout.bases, units))), gauge=gauge, reference=reference,
                    units=units)
        objective = cp.Minimize(sum(cp.sum_squares(r) for r in residuals))
        bound = Bound.none(NO_BOUND)
        program = Program(name="hammerstein_oe.shooting", objective=objective, constraints=structural,
                          variables=self.variables, start=start, recover=self.recover, view=view,
                          structural=frozenset(structural), derived=derived, scale=self.criterion.energy,
                          certify=lambda program, values, duals: (bound, None), note=NO_BOUND, unit=energy_unit(units))
        return program.subject_to(*constraints)

    def _experiment(self, i: int, label: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the structural constraints and the derived variables of one experiment."""
        e, layout, variables = self.data.experiments[i], self.layout, self.variables
        n, count = layout.first_row, self.data.experiments[i].n_samples
        x = variables[f"x{label}"] = cp.Variable(count, name=f"x{label}")
        left = x[n:]
        for lag in range(1, layout.na + 1):
            left = left + variables["a"][lag - 1] * x[n - lag : count - lag]
        right: Any = 0.0
        constraints, derived = {}, {}
        for c, lags in enumerate(layout.lags):
            name = f"{self.key('w', c)}{label}"
            w = variables[name] = cp.Variable(count, name=name)
            derived[name] = self.tables[i][c] @ variables[self.key("mu", c)]
            constraints[f"nonlinearity of {name}"] = (w == derived[name],)
            for j, lag in enumerate(lags):
                right = right + variables[self.key("b", c)][j] * w[n - lag : count - lag]
        if "offset" in variables:
            right = right + variables["offset"][0]
        constraints[f"dynamics{label}"] = (left == right,)
        there = np.flatnonzero(np.isfinite(e.y[:, 0]))
        seen = x if there.size == count else x[there]
        r = variables[f"residual{label}"] = cp.Variable(there.size, name=f"residual{label}")
        derived[f"residual{label}"] = seen - e.y[there, 0]
        constraints[f"residual{label}"] = (r == derived[f"residual{label}"],)
        return constraints, derived

    def _stable(self) -> tuple[Any, ...]:
        """Return the constraints that build A up from reflection coefficients between -1 and 1."""
        a, na = self.variables["a"], self.layout.na
        kappa = self.variables["kappa"] = cp.Variable(na, name="kappa")
        constraints: list[Any] = [kappa <= REFLECTION, kappa >= -REFLECTION]
        below = None
        for m in range(1, na + 1):
            name = f"a of order {m}"
            level = a if m == na else cp.Variable(m, name=name)
            if m < na:
                self.variables[name] = level
            constraints.append(level[m - 1] == kappa[m - 1])
            if below is not None:
                constraints += [level[i] == below[i] + kappa[m - 1] * below[m - 2 - i] for i in range(m - 1)]
            below = level
        return tuple(constraints)

    def _start(self) -> dict[str, Array]:
        """The best of equation error, Steiglitz-McBride and instruments, with its simulation: every equation holds."""
        criterion, unknowns = self.criterion, self.criterion.unknowns
        first = equation_error(self.data, unknowns)
        first = criterion.normalised(blank(unknowns) if first is None else first)
        found = [with_poles(criterion, first, contained(first[unknowns.slices["a"]], RADIUS), "ARX")]
        others = [iterated(criterion, found[0].x, method) for method in ("sm", "iv")]
        best = min([*found, *(one for one in others if one is not None)], key=lambda one: one.value)
        point = unknowns.unpack(criterion.normalised(best.x))
        start = {"a": point.a, "offset": np.array([point.offset])}
        for c, (mu, b) in enumerate(zip(point.mus, point.bs)):
            sign = leading_sign(b) if criterion.gauge == "norm" else 1.0
            start |= {self.key("mu", c): sign * mu, self.key("b", c): sign * b}
        outputs = simulate(self.data, unknowns, point)
        for e, label, x, tables in zip(self.data.experiments, self.labels, outputs, self.tables):
            start[f"x{label}"] = x
            there = np.isfinite(e.y[:, 0])
            start[f"residual{label}"] = x[there] - e.y[there, 0]
            for c, table in enumerate(tables):
                start[f"{self.key('w', c)}{label}"] = table @ start[self.key("mu", c)]
        level = point.a
        start["kappa"] = np.zeros(self.layout.na)
        for m in range(self.layout.na, 0, -1):  # the recursion backwards
            start[f"a of order {m}"], start["kappa"][m - 1] = level, level[-1]
            level = (level[:-1] - level[-1] * level[-2::-1]) / (1 - level[-1] ** 2)
        return {name: start[name] for name in self.variables}

    def recover(self, values: Values) -> HammersteinTF:
        """Build the model."""
        pairs = [(np.asarray(values[self.key("mu", c)]), np.asarray(values[self.key("b", c)]))
                 for c in range(self.layout.m)]
        plant = HammersteinARX(
            a=np.asarray(values.get("a", np.zeros(0)), dtype=float), b=tuple(b for _, b in pairs),
            nonlinearities=tuple(Nonlinearity(basis, mu) for basis, (mu, _) in zip(self.layout.bases, pairs)),
            nk=self.layout.nk, offset=np.asarray(values.get("offset", np.zeros(1)), dtype=float),
            gauge=self.criterion.gauge, **model_meta(self.data))
        return HammersteinTF(plant).with_transform(self.criterion.units)

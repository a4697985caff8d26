"""Output error with the outputs of the plant as variables: one sparse programme for NLP back ends.

``y = A(q)^-1 [sum_c B_c(q) f_c(u_c) + d] + e`` is stated as

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

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import asks_for_integrator
from formulations.prediction_error import Orders, transfer_model
from optid.arrays import one_of
from optid.bases import Bases
from optid.core.leaves import Product
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.arguments import check_offset
from optid.identify.gauges import FIXED, signs_are_fixed
from optid.identify.prediction_error.search import arx_start, iterated
from optid.identify.prediction_error.tangent_fit import Places
from optid.identify.prediction_error.transfer_errors import TransferErrors, transfer_errors
from optid.program.program import Program
from optid.program.solution import Bound
from optid.program.units import outer_bases
from optid.program.view import View
from optid.solving.steps import steps

Array = np.ndarray

REFLECTION = 1 - 1e-7  # largest modulus of a reflection coefficient
LIMIT = 20_000  # samples up to which the programme is built: beyond, factorisations and CVXPY's own work take minutes
NO_BOUND = "simulation errors are not convex in the poles: no lower bound is known"


@steps(lambda given: {"hammerstein_oe.shooting": "NLP"})
def exact(data: Data, *, na: int, nb: Orders, basis: Bases = "polynomial:3", nk: Orders = 0,
          constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True) -> Program:
    """Minimise the simulation errors with the simulated outputs as variables.

    Named variables: ``Theta``, ``a``, ``b``, ``mu``, ``offset``, ``x``.

    Arguments as in `formulations.prediction_error.hammerstein_bj`, as are the errors raised; constraints may be any
    smooth ones in the named variables. A record that is too long is refused (`StructureError`).
    """
    one_of("gauge", gauge, FIXED)
    if check_offset(offset, data) == "each":
        raise StructureError("this programme has one constant for all experiments; 'hammerstein_oe.exact' takes "
                             "offset='each'")
    if asks_for_integrator(constraints):
        raise StructureError("this programme keeps all poles inside the unit circle: use 'hammerstein_oe.exact' with "
                             "'integrator'")
    criterion = transfer_errors(data, na, nb, nk, basis, 0, 0, gauge, offset)
    if criterion.data.n_samples > LIMIT:
        raise StructureError(
            f"{criterion.data.n_samples} samples: with the outputs of every sample as variables this formulation takes "
            f"up to {LIMIT}. Use 'hammerstein_oe.exact', which has the same optima, or fewer samples")
    return _Shooting(criterion).program(constraints)


class _Shooting:
    """Writes the programme of one record."""

    def __init__(self, criterion: TransferErrors) -> None:
        self.criterion, self.data, self.layout = criterion, criterion.data, criterion.unknowns.layout
        self.labels = criterion.labels
        self.key, self.places = criterion.key, Places.of(criterion)
        self.variables = self.places.variables()
        self.variables.pop("x0", None)  # the first outputs are the initial state
        self.pairs = [(self.key("mu", c), self.key("b", c)) for c in range(self.layout.m)]

    def program(self, constraints: Sequence[Any]) -> Program:
        """Return the programme under the user's constraints."""
        layout, gauge = self.layout, self.criterion.gauge
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
        structural["gauge"] = tuple(Product(self.key("mu", c), self.key("b", c), gauge).condition(self.variables)
                                    for c in range(layout.m))
        start = self._start(derived)
        reference = {name: start[name] for name in ("a", "offset") if name in start}
        units = self.criterion.units
        view = View(expressions, channels=layout.inputs,
                    bases=dict(zip(layout.inputs, outer_bases(layout.bases, units))), gauge=gauge, reference=reference,
                    units=units)
        objective = cp.Minimize(sum(cp.sum_squares(r) for r in residuals))
        bound = Bound.none(NO_BOUND)
        program = Program("hammerstein_oe.shooting", objective, structural, self.variables, start,
                          partial(transfer_model, self.criterion), view, frozenset(structural), derived=derived,
                          scale=self.criterion.energy, certify=lambda program, values, duals: (bound, None),
                          note=NO_BOUND, unit=self.criterion.unit).subject_to(*constraints)
        if gauge != "norm" or signs_are_fixed(program, self.pairs):
            return program
        return replace(program, recover=partial(transfer_model, self.criterion, signed=False))

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
            derived[name] = layout.bases[c].values(e.u[:, c]) @ variables[self.key("mu", c)]
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

    def _start(self, derived: Mapping[str, Any]) -> dict[str, Array]:
        """The best of equation error, Steiglitz-McBride and instruments, with its simulation: every equation holds."""
        criterion = self.criterion
        found = arx_start(criterion)
        others = [iterated(criterion, found.x, method) for method in ("Steiglitz-McBride", "instruments")]
        best = min([found, *(one for one in others if one is not None)], key=lambda one: one.value)
        x = criterion.normalised(best.x)
        start = self.places.values(x)
        for c, (mu, b) in enumerate(self.pairs):
            sign = criterion.gain_sign(x, f"b{c}") if criterion.gauge == "norm" else 1.0
            start |= {mu: sign * start[mu], b: sign * start[b]}
        start |= zip([f"x{label}" for label in self.labels], criterion.simulate(criterion.unknowns.unpack(x)))
        level, start["kappa"] = start.get("a", np.zeros(0)), np.zeros(self.layout.na)
        for m in range(self.layout.na, 0, -1):  # the recursion backwards
            start[f"a of order {m}"], start["kappa"][m - 1] = level, level[-1]
            level = (level[:-1] - level[-1] * level[-2::-1]) / (1 - level[-1] ** 2)
        start = {name: value for name, value in start.items() if name in self.variables}
        for name, value in start.items():
            self.variables[name].value = value
        return {**start, **{name: np.asarray(expression.value) for name, expression in derived.items()}}

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

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp

from formulations.constraints.poles import asks_for_integrator
from formulations.prediction_error import Orders, transfer_model
from optid.arrays import one_of
from optid.bases import Bases
from optid.core.leaves import Product
from optid.core.problem import Problem
from optid.core.terms import Squares
from optid.data.record import Data, Experiment
from optid.errors import StructureError
from optid.identify.arguments import check_offset
from optid.identify.gauges import FIXED
from optid.identify.prediction_error.search import arx_start, iterated
from optid.identify.prediction_error.tangent_fit import Places
from optid.identify.prediction_error.transfer_errors import TransferErrors, transfer_errors
from optid.program.units import outer_bases
from optid.program.view import View
from optid.solving.steps import steps

Array = np.ndarray

REFLECTION = 1 - 1e-7  # largest modulus of a reflection coefficient
LIMIT = 20_000  # samples up to which the programme is built: beyond, factorisations and CVXPY's own work take minutes
NO_BOUND = "simulation errors are not convex in the poles: no lower bound is known"


@steps(lambda given: {"hammerstein_oe.shooting": "NLP"})
def exact(data: Data, *, na: int, nb: Orders, basis: Bases = "polynomial:3", nk: Orders = 0,
          constraints: Sequence[Any] = (), gauge: str = "norm", offset: bool = True) -> Problem:
    """Minimise the simulation errors with the simulated outputs as variables.

    Named variables: ``Theta``, ``a``, ``b``, ``kappa``, ``mu``, ``offset``, ``w``, ``x``.

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
    problem = _posed(criterion, _start(criterion)).subject_to(*constraints)
    if gauge != "norm" or problem.fixes_signs:
        return problem
    return problem.beginning(problem.start, partial(transfer_model, criterion, signed=False))


def _posed(errors: TransferErrors, start: dict[str, Array]) -> Problem:
    """State the problem of one record, without constraints of the user."""
    layout, terms = errors.unknowns.layout, []
    equations: dict[str, Callable[[View], Any]] = {}
    products = [Product(errors.key("mu", c), errors.key("b", c), "") for c in range(layout.m)]
    for e, label in zip(errors.data.experiments, errors.labels):
        there = np.isfinite(e.y[:, 0])
        terms.append(Squares(sp.eye_array(e.n_samples).tocsr()[there], e.y[there, 0], 0.0, (f"x{label}",)))
        equations[f"dynamics{label}"] = partial(_dynamics, errors, e, label)
        for c in range(layout.m):
            equations[f"nonlinearity of {errors.key('w', c)}{label}"] = partial(_nonlinearity, errors, e, label, c)
    if layout.na:
        equations["stability"] = _stability
    equations["gauge"] = lambda v: [Product(one.mu, one.b, errors.gauge).condition(v.inner) for one in products]
    return Problem(
        "hammerstein_oe.shooting", start, tuple(terms), tuple(products), partial(transfer_model, errors),
        {"channels": layout.inputs, "bases": dict(zip(layout.inputs, outer_bases(layout.bases, errors.units))),
         "gauge": errors.gauge, "reference": {name: start[name] for name in ("a", "offset") if name in start},
         "units": errors.units},
        restrictions=(lambda v: {name: built(v) for name, built in equations.items()},), scale=errors.energy,
        unit=errors.unit, energy=errors.unit * errors.energy, proof=NO_BOUND)


def _dynamics(errors: TransferErrors, e: Experiment, label: str, v: View) -> Any:
    """Return ``A(q) x = sum_c B_c(q) w_c + offset`` from the first sample on whose lags are all in the record."""
    layout, inner, n, count = errors.unknowns.layout, v.inner, errors.unknowns.layout.first_row, e.n_samples
    x, right = inner[f"x{label}"], inner["offset"][0] if "offset" in inner else 0.0
    left = x[n:]
    for lag in range(1, layout.na + 1):
        left = left + inner["a"][lag - 1] * x[n - lag : count - lag]
    for c, lags in enumerate(layout.lags):
        w = inner[f"{errors.key('w', c)}{label}"]
        for j, lag in enumerate(lags):
            right = right + inner[errors.key("b", c)][j] * w[n - lag : count - lag]
    return left == right


def _nonlinearity(errors: TransferErrors, e: Experiment, label: str, c: int, v: View) -> Any:
    """Return ``w = eta mu`` of one input."""
    return v.inner[f"{errors.key('w', c)}{label}"] == (
        errors.unknowns.layout.bases[c].values(e.u[:, c]) @ v.inner[errors.key("mu", c)])


def _stability(v: View) -> list[Any]:
    """Return the constraints that build A up from reflection coefficients between -1 and 1."""
    kappa = v.inner["kappa"]
    found: list[Any] = [kappa <= REFLECTION, kappa >= -REFLECTION]
    below = None
    for m in range(1, kappa.size + 1):
        level = v.inner["a" if m == kappa.size else f"a of order {m}"]
        found.append(level[m - 1] == kappa[m - 1])
        if below is not None:
            found += [level[i] == below[i] + kappa[m - 1] * below[m - 2 - i] for i in range(m - 1)]
        below = level
    return found


def _start(errors: TransferErrors) -> dict[str, Array]:
    """Return the best of equation error, Steiglitz-McBride and instruments, with its simulation: all equations hold."""
    layout = errors.unknowns.layout
    found = arx_start(errors)
    others = [iterated(errors, found.x, method) for method in ("Steiglitz-McBride", "instruments")]
    best = min([found, *(one for one in others if one is not None)], key=lambda one: one.value)
    x = errors.normalised(best.x)
    start = Places.of(errors).values(x)
    start.pop("x0", None)  # the first outputs are the initial state
    for c in range(layout.m):
        mu, b = errors.key("mu", c), errors.key("b", c)
        sign = errors.gain_sign(x, f"b{c}") if errors.gauge == "norm" else 1.0
        start |= {mu: sign * start[mu], b: sign * start[b]}
        start |= {f"{errors.key('w', c)}{label}": layout.bases[c].values(e.u[:, c]) @ start[mu]
                  for e, label in zip(errors.data.experiments, errors.labels)}
    start |= zip([f"x{label}" for label in errors.labels], errors.simulate(errors.unknowns.unpack(x)))
    level, kappa = start.get("a", np.zeros(0)), np.zeros(layout.na)
    for m in range(layout.na, 0, -1):  # the recursion backwards
        if m < layout.na:
            start[f"a of order {m}"] = level
        kappa[m - 1] = level[-1]
        level = (level[:-1] - level[-1] * level[-2::-1]) / (1 - level[-1] ** 2)
    return {**start, "kappa": kappa} if layout.na else start

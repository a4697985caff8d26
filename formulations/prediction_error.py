"""Transfer-function models by prediction errors: output error, ARMAX and Box-Jenkins, linear or Hammerstein.

    A(q) x = sum_c B_c(q) f_c(u_c) + d,    y = x + C(q)/D(q) e,    f_c = mu_cᵀ eta_c

The sum of squared innovations e is minimised (Ljung 1999, section 7.2). C = D = 1 is output error, whose e are the
simulation errors; D = A is ARMAX, ``A y = sum_c B_c f_c + d + C e``; Box-Jenkins has its own D. All are
procedures: several starts, Gauss-Newton descents on streamed sensitivities (`optid.identify.prediction_error`) and, at
the optimum z0 or under constraints, convex programmes in the tangent of the iterate, for any conic or quadratic back
end,

    minimise ‖r‖² + remainder    subject to    r = R (z - z0) + e0,  the gauge,  the user's constraints,

where R (z - z0) + e0 are the errors to first order in the unknowns z, compressed. Named variables: ``a``, ``b``, ``mu``
(not in linear models), ``offset``, ``c``, ``d``, ``x0`` ((n,), or (n, experiments)), and the product ``Theta = mu bᵀ``,
which steps take to first order about the iterate. With several inputs the per-channel names carry the input, as in
``mu[valve]``.

Output error and Box-Jenkins estimate an initial state of the plant per experiment; where an input is missing the record
is cut. The first innovations of an ARMAX experiment, whose lags reach before it, count as zero (the conditional
method). So does an innovation that cannot be computed: where the output is missing its prediction takes its place, and
where a missing input leaves no prediction the recursion starts anew. This stationary predictor does not know that it is
less certain after a gap (a Kalman filter's gain would grow there): A, B and f are estimated as well as the samples
present allow, C gets a small bias when gaps are many, a few hundredths with a third of the outputs missing at random.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from formulations.constraints.poles import asks_for_integrator
from optid.bases import Bases
from optid.core.problem import Problem
from optid.core.terms import Errors
from optid.data.record import Data
from optid.identify.prediction_error.search import fit_transfer
from optid.identify.prediction_error.transfer_errors import TransferErrors, TransferOrders, transfer_errors
from optid.models.gauges import Gauge
from optid.solving.solve import Procedure
from optid.solving.steps import steps

Array = np.ndarray
Orders = int | Sequence[int]


@steps(lambda given: {"hammerstein_bj.exact": "QP" if given["constraints"] else "QP linear"})
def hammerstein_bj(data: Data, *, na: int, nb: Orders, nc: int, nd: int, basis: Bases = "polynomial:3", nk: Orders = 0,
                   constraints: Sequence[Any] = (), gauge: Gauge = "norm", offset: bool | str = True, starts: int = 4,
                   seed: int = 0) -> Procedure:
    """Minimise the innovations of a Hammerstein Box-Jenkins model.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``d``, ``mu``, ``offset``, ``x0``.

    Args:
        data: the record; one output. Samples may be missing: it is cut where inputs are, see `optid.data.stretches`.
        na: number of poles of the plant.
        nb: number of coefficients of B, one per input or one for all.
        nc: order of C.
        nd: order of D.
        basis: basis of the nonlinearity, one per input or one for all; a cubic polynomial by default.
        nk: delay of the first coefficient of B in samples, one per input or one for all.
        constraints: builders such as ``formulations.constraints.shape.monotone("increasing")`` or ``lambda v: {...}``.
        gauge: "norm" (‖b‖ = 1), "gain" (unit static gain of the linear part) or "b0" (first coefficient one).
        offset: True for one constant of the equation, "each" for one for every experiment (and stretch between missing
            inputs), where sensors have different zeros; False holds it at zero, for centred data.
        starts: number of starts that are compared. Of output error at most: three suffice where they agree on a model
            that explains nine tenths of the output.
        seed: of the random starts.

    Raises:
        StructureError: impossible orders, unknown gauge, several outputs.
        DataError: no stretch of some length in which every input is present.
        RankError: too few samples for the unknowns, a basis function that no sample excites, or inputs that the record
            does not tell apart.
    """
    errors = transfer_errors(data, TransferOrders(na, nb, nk, nc, nd), basis, gauge, offset)
    return _procedure("hammerstein_bj.exact", errors, constraints, starts, seed)


@steps(lambda given: {"bj.exact": "QP" if given["constraints"] else "QP linear"})
def bj(data: Data, *, na: int, nb: Orders, nc: int, nd: int, nk: Orders = 0, constraints: Sequence[Any] = (),
       offset: bool | str = True, starts: int = 4, seed: int = 0) -> Procedure:
    """Minimise the innovations of a linear Box-Jenkins model.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``d``, ``offset``, ``x0``. Arguments as in `hammerstein_bj`, as are
    the errors raised.
    """
    errors = transfer_errors(data, TransferOrders(na, nb, nk, nc, nd), "linear", None, offset)
    return _procedure("bj.exact", errors, constraints, starts, seed)


@steps(lambda given: {"hammerstein_oe.exact": "QP" if given["constraints"] else "QP linear"})
def hammerstein_oe(data: Data, *, na: int, nb: Orders, basis: Bases = "polynomial:3", nk: Orders = 0,
                   constraints: Sequence[Any] = (), gauge: Gauge = "norm", offset: bool | str = True, starts: int = 6,
                   seed: int = 0) -> Procedure:
    """Minimise the simulation error of a Hammerstein model.

    Named variables: ``Theta``, ``a``, ``b``, ``mu``, ``offset``, ``x0``. Arguments as in `hammerstein_bj`, as are the
    errors raised.
    """
    errors = transfer_errors(data, TransferOrders(na, nb, nk, 0, 0), basis, gauge, offset)
    return _procedure("hammerstein_oe.exact", errors, constraints, starts, seed)


@steps(lambda given: {"oe.exact": "QP" if given["constraints"] else "QP linear"})
def oe(data: Data, *, na: int, nb: Orders, nk: Orders = 0, constraints: Sequence[Any] = (), offset: bool | str = True,
       starts: int = 6, seed: int = 0) -> Procedure:
    """Minimise the simulation error of a linear model.

    Named variables: ``Theta``, ``a``, ``b``, ``offset``, ``x0``. Arguments as in `hammerstein_bj`, as are the errors
    raised.
    """
    errors = transfer_errors(data, TransferOrders(na, nb, nk, 0, 0), "linear", None, offset)
    return _procedure("oe.exact", errors, constraints, starts, seed)


@steps(lambda given: {"hammerstein_armax.exact": "QP" if given["constraints"] else "QP linear"})
def hammerstein_armax(data: Data, *, na: int, nb: Orders, nc: int, basis: Bases = "polynomial:3", nk: Orders = 0,
                      constraints: Sequence[Any] = (), gauge: Gauge = "norm", offset: bool | str = True,
                      starts: int = 3, seed: int = 0) -> Procedure:
    """Minimise the innovations of a Hammerstein ARMAX model; the record is not cut where inputs are missing.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``mu``, ``offset``. Arguments as in `hammerstein_bj`, as are the
    errors raised, except for that of a record without stretches.
    """
    errors = transfer_errors(data, TransferOrders(na, nb, nk, nc, None), basis, gauge, offset)
    return _procedure("hammerstein_armax.exact", errors, constraints, starts, seed)


@steps(lambda given: {"armax.exact": "QP" if given["constraints"] else "QP linear"})
def armax(data: Data, *, na: int, nb: Orders, nc: int, nk: Orders = 0, constraints: Sequence[Any] = (),
          offset: bool | str = True, starts: int = 3, seed: int = 0) -> Procedure:
    """Minimise the innovations of a linear ARMAX model; the record is not cut where inputs are missing.

    Named variables: ``Theta``, ``a``, ``b``, ``c``, ``offset``. Arguments as in `hammerstein_armax`, as are the errors
    raised.
    """
    errors = transfer_errors(data, TransferOrders(na, nb, nk, nc, None), "linear", None, offset)
    return _procedure("armax.exact", errors, constraints, starts, seed)


def _procedure(name: str, errors: TransferErrors, constraints: Sequence[Any], starts: int, seed: int) -> Procedure:
    errors = replace(errors, integrates=asks_for_integrator(constraints))
    return (yield from fit_transfer(errors, starts, seed, lambda x: _problem(name, errors, x).subject_to(*constraints)))


def _problem(name: str, errors: TransferErrors, optimum: Array) -> Problem:
    """Minimise ‖e‖² over the coefficients of A, B, C, D, the functions and the initial states."""
    variables = errors.variables
    return Problem(
        name,
        start=variables.values(optimum),
        terms=(Errors(variables.squares, variables.value, errors),),
        leaves=errors.factors(errors.gauge),  # Theta = mu bᵀ
        further=partial(_signals, errors), model=errors.model, facts={"iterate": True, **errors.facts()},
        **errors.common())


def _signals(errors: TransferErrors, variables: Mapping[str, Any], _: Any) -> dict[str, Any]:
    """Return what constraints may also use: Theta of linear inputs, the constant, and the initial states in the record.

    States that contain the levels of the channels are not shown.
    """
    unknowns, found = errors.unknowns, dict[str, Any](errors.linear_thetas(variables))
    if "offset" not in variables:
        found["offset"] = cp.Constant(np.zeros(1))
    states = variables.get("x0")
    if unknowns.levels and states is not None:
        states = states if states.ndim == 2 else cp.reshape(states, (unknowns.memory, 1), order="F")
        found["offset"] = cp.reshape(cp.sum(states[-1]) / unknowns.experiments, (1,), order="F")
        states = states[:-1]
    if unknowns.fading:
        thetas = [{**variables, **found}[errors.key("Theta", c)] for c in range(unknowns.layout.m)]
        found["x0"] = states + errors.levels_before(variables.get("a"), thetas)
    elif "x0" in variables:
        found["x0"] = None
    return found

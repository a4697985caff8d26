"""Processes in continuous time by simulation errors: gain, time constants, dead time and static curve of every pair.

    y(t) = sum_c G_c(s) exp(-theta_c s) f_c(u_c(t)) + level (+ drift t),    f_c = mu_cᵀ eta_c,
    G(s) = (tau_zero s + 1) / [s] prod (tau_i s + 1) (T² s² + 2 zeta T s + 1)

The sum of squared errors at the instants of the samples is minimised; between these the inputs are held, or straight.
Unknowns are the numbers ``dynamics`` of every process, logarithms of tau, T and zeta, then tau_zero and the dead time
in sampling times, and ``mu``, ``offset`` (the level), ``drift``, and ``x0``, the motion with which experiments begin.
Starts from a grid descend in the dynamics, everything linear projected out, from kink to kink of the dead time
(`optid.identify.process`). At the optimum z0, or under constraints, convex programmes in the tangent of the iterate,

    minimise ‖r‖² + remainder    subject to    r = R (z - z0) + e0,  the user's constraints,  dead times in their cells,

confirm it. For one time constant or two with dead time, and a straight f or a monotone one of few increments, branch
and bound proves that no other optimum is better. Constraints are stated in ``log tau``, ``log T``, ``log zeta``,
``tau_zero``, ``dead_time``, ``K``, ``mu`` and ``Theta`` (a column), with several inputs as in ``K[valve]``; see
`formulations.constraints.process`. Several outputs, each divided by its standard deviation, have processes of their
own, ``K[level,valve]``, and are searched one by one.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.bases import Bases
from optid.core.problem import Problem
from optid.core.terms import Errors
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.fit import fit_processes
from optid.identify.process.record import process_errors
from optid.models.process_dynamics import ProcessStructure
from optid.solving.solve import Procedure
from optid.solving.steps import steps

Array = np.ndarray


@steps(lambda given: {"process.exact": "QP"})
def process(data: Data, *, process: str | Sequence[Any] = "", poles: int = 1, zero: bool = False, delay: bool = True,
            integrator: bool = False, order: str = "", basis: Bases = "linear",
            hold: str = "zero", offset: bool | str = True, drift: bool = False, initial: str = "rest",
            constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation errors of processes with dead time.

    Named variables: ``K``, ``Theta``, ``dead_time``, ``dynamics``, ``log tau``, ``mu``, ``offset``.

    Args:
        data: the record, at any times. Outputs may be missing; it is cut where inputs are.
        process: procest's name of the type: P, the number of poles, D (dead time), I (integrator), Z (zero), U (complex
            pair), such as "P1D"; one for all pairs, one for each input, or a row of these for each output, "none" where
            an input has no effect on it. When not given, the next four arguments.
        poles: number of poles, without that of an integrator.
        zero: whether there is a zero.
        delay: whether there is a dead time.
        integrator: whether there is an integrator.
        order: "auto" compares process types by the Bayesian information criterion; the runner-up is reported.
        basis: basis of the static curve, one per input or one for all; a straight line by default.
        hold: what an input does between its samples: "zero" (stays) or "first" (goes straight to the next).
        offset: True for one level of the output, "each" for one of every experiment, False for none.
        drift: whether the level moves along a straight line.
        initial: "rest": every experiment begins at rest under its first inputs; "free": with a motion of its own.
        constraints: builders such as ``formulations.constraints.process.tau(high=60)``.

    Raises:
        StructureError: an impossible type, another number of types, words that are unknown.
        DataError: an input that never moves.
        RankError: too few samples, an output that does not respond, time constants and dead time that the record does
            not separate.
    """
    if order not in ("", "auto"):
        raise StructureError(f"order={order!r} must be 'auto', or be left out where process names a type")
    if order and process:
        raise StructureError(f"order='auto' chooses the type, which process={process!r} names: give one of both")
    named = process or ProcessStructure(poles, zero=bool(zero), delay=bool(delay), integrator=bool(integrator))
    errors = process_errors(data, named, basis, hold, offset, drift, initial)
    return (yield from fit_processes(errors, _problem, constraints, bool(order)))


process.takes_any_times = True


def _problem(errors: ProcessErrors, x: Array) -> Problem:
    """Minimise ‖e‖² over the numbers of all processes, the static curves and the levels."""
    variables, data = errors.variables, errors.data
    return Problem(
        "process.exact",
        start=variables.values(x),
        terms=(Errors(variables.squares, variables.value, errors),),
        further=partial(_signals, errors), model=errors.model,
        facts={"iterate": True, "channels": data.inputs, "outputs": data.outputs,
               "bases": dict(zip(data.inputs, errors.outer_bases))},
        **errors.common())


def _signals(errors: ProcessErrors, variables: Mapping[str, Any], _: Any) -> dict[str, Any]:
    """Return what constraints speak about in the units of the record: parameters, static curves, and levels."""
    found, unknowns, units, dt = dict[str, Any](), errors.unknowns, errors.units, errors.data.dt
    for p, ((o, c), structure) in enumerate(zip(unknowns.pairs, unknowns.structures)):
        numbers, mu = variables[errors.key("dynamics", p)], variables[errors.key("mu", p)]
        for i, name in enumerate(structure.names):
            word, entry = f"log {name}" if structure.logarithmic[i] else name, cp.hstack([numbers[i]])
            found[errors.key(word, p)] = (entry if name == "zeta" else entry + np.log(dt)
                                          if structure.logarithmic[i] else dt * entry)
        found[errors.key("mu", p)] = curve = units.y_scale[o] / units.u_scale[c] * mu
        if errors.is_line(p):
            found[errors.key("K", p)] = curve
        if not structure.integrator:
            found[errors.key("Theta", p)] = cp.reshape(curve, (mu.size, 1), order="F")
    states, level = variables.get("x0"), variables.get("offset", cp.Constant(np.zeros(unknowns.outputs)))
    if unknowns.levels and states is not None:
        level = cp.sum(states[-unknowns.outputs :], axis=1) / unknowns.experiments
    found["offset"] = cp.multiply(units.y_scale, level) + np.array(units.y_offset)
    return {**found, "x0": None} if states is not None else found

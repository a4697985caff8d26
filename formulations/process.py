"""Processes in continuous time by simulation errors: gain, time constants, dead time and static curve of every input.

    y(t) = sum_c G_c(s) exp(-theta_c s) f_c(u_c(t)) + level (+ drift t),    f_c = mu_cᵀ eta_c,
    G(s) = (tau_zero s + 1) / [s] prod (tau_i s + 1) (T² s² + 2 zeta T s + 1)

The sum of squared errors at the instants of the samples is minimised; between these the inputs are held, or straight.
Unknowns are the numbers ``dynamics`` of every process, logarithms of tau, T and zeta, then tau_zero and the dead time
in sampling times, and ``mu``, ``offset`` (the level), ``drift``, and ``x0``, the motion with which experiments begin.
Starts from a grid descend in the dynamics, everything linear projected out, from kink to kink of the dead time
(`optid.identify.process`). At the optimum z0, or under constraints, convex programmes in the tangent of the iterate,

    minimise ‖r‖² + remainder    subject to    r = R (z - z0) + e0,  the user's constraints,  dead times in their cells,

confirm it. For one time constant with dead time and a straight f branch and bound proves that no other optimum is
better. Constraints are stated in ``log tau``, ``log T``, ``log zeta``, ``tau_zero``, ``dead_time``, ``K``, ``mu`` and
``Theta`` (a column), with several inputs as in ``K[valve]``; see `formulations.constraints.process`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from optid.bases import Bases, Linear
from optid.core.problem import Problem
from optid.core.terms import Errors
from optid.data.channels import model_meta
from optid.data.record import Data
from optid.errors import StructureError
from optid.identify.prediction_error.tangent_fit import Places
from optid.identify.process.errors import ProcessErrors
from optid.identify.process.fit import fit_processes
from optid.identify.process.order import choose_type
from optid.identify.process.proof import certificate
from optid.identify.process.record import Terms, process_errors, process_type
from optid.models import Nonlinearity
from optid.models.process import ProcessModel
from optid.program.units import outer_bases
from optid.solving.solve import Procedure
from optid.solving.steps import steps

Array = np.ndarray


@steps(lambda given: {"process.exact": "QP"})
def process(data: Data, *, process: str | Sequence[str] = "", poles: int = 1, zero: bool = False, delay: bool = True,
            integrator: bool = False, order: str = "", basis: Bases = "linear",
            hold: str = "zero", offset: bool | str = True, drift: bool = False, initial: str = "rest",
            times: Any = None, constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation errors of processes with dead time.

    Named variables: ``K``, ``Theta``, ``dead_time``, ``dynamics``, ``log tau``, ``mu``, ``offset``.

    Args:
        data: the record; one output. Outputs may be missing; it is cut where inputs are.
        process: type in the notation of MATLAB's procest, one for all inputs or one for each: P, the number of poles,
            D (dead time), I (integrator), Z (zero), U (complex pair), such as "P1D". When not given, the type follows
            from the next four arguments.
        poles: number of poles, without that of an integrator.
        zero: whether there is a zero.
        delay: whether there is a dead time.
        integrator: whether there is an integrator.
        order: "auto" compares process types by the Bayesian information criterion; the runner-up is reported.
        basis: basis of the static curve, one per input or one for all; a straight line by default.
        hold: what an input does between its samples: "zero" (stays) or "first" (goes straight to the next).
        offset: True for one level of the output, "each" for one of every experiment, False for none.
        drift: whether the level moves along a straight line.
        initial: "rest": every experiment begins at rest under its first inputs; "free": in an estimated state.
        times: instants of the samples in the unit of the sampling time, (N,) or one array per experiment; regular when
            not given.
        constraints: builders such as ``formulations.constraints.process.tau(high=60)``.

    Raises:
        StructureError: an impossible type, several outputs, words that are unknown.
        DataError: an input that never moves, times that do not increase.
        RankError: too few samples, an output that does not respond, time constants and dead time that the record does
            not separate.
    """
    if order not in ("", "auto"):
        raise StructureError(f"order={order!r} must be 'auto', or be left out where process names a type")
    if order and process:
        raise StructureError(f"order='auto' chooses the type, which process={process!r} names: give one of both")
    chosen = process or process_type(poles, zero, delay, integrator)
    errors = process_errors(data, chosen, basis, Terms(hold, offset, drift, initial), times)
    errors, figures = choose_type(errors) if order else (errors, {})
    if times is not None:
        figures["instants"] = "as given; the verdict, and fits in %, count the samples as regular"
    pose = partial(_problem, errors)
    return (yield from fit_processes(errors, pose, tuple(constraints), certificate(errors), figures))


def _problem(errors: ProcessErrors, x: Array, constraints: Sequence[Any]) -> Problem:
    """Minimise ‖e‖² over the numbers of all processes, the static curves and the levels."""
    places = Places.of(errors)
    return Problem(
        "process.exact",
        start=places.values(x),
        terms=(Errors(places.squares, places.value),),
        further=partial(_signals, errors), model=partial(_model, errors),
        facts={"iterate": True, "channels": errors.data.inputs, "units": errors.units, "outputs": errors.data.outputs,
               "bases": dict(zip(errors.data.inputs, outer_bases(errors.bases, errors.units)))},
        builders=tuple(constraints), scale=errors.energy, unit=errors.unit,
        energy=errors.unit * errors.energy_of_record)


def _signals(errors: ProcessErrors, variables: Mapping[str, Any], _: Any) -> dict[str, Any]:
    """Return what constraints speak about: parameters in the units of the record, and the static curves."""
    found, dt, unknowns = dict[str, Any](), errors.data.dt, errors.unknowns
    for c, structure in enumerate(unknowns.structures):
        numbers, mu = variables[errors.key("dynamics", c)], variables[errors.key("mu", c)]
        for i, name in enumerate(structure.names):
            word = f"log {name}" if structure.logarithmic[i] else name
            entry = cp.hstack([numbers[i]])
            found[errors.key(word, c)] = (entry if name == "zeta" else entry + np.log(dt)
                                          if structure.logarithmic[i] else dt * entry)
        if isinstance(errors.bases[c], Linear):
            found[errors.key("K", c)] = errors.units.y_scale[0] / errors.units.u_scale[c] * mu
        if not structure.integrator:
            found[errors.key("Theta", c)] = cp.reshape(mu, (mu.size, 1), order="F")
    if "offset" not in variables:
        level: Any = cp.Constant(np.zeros(1))
        states = variables.get("x0")
        if unknowns.levels and states is not None:
            level = cp.reshape(cp.sum(states[-1]) / unknowns.experiments, (1,), order="F")
        found["offset"] = level
    return found


def _model(errors: ProcessErrors, values: Mapping[str, Array]) -> ProcessModel:
    """Return the model of named values in the units of the record."""
    unknowns, dt = errors.unknowns, errors.data.dt
    x = Places.of(errors).pack(values)
    curves = tuple(Nonlinearity(basis, np.atleast_1d(values[errors.key("mu", c)]))
                   for c, basis in enumerate(errors.bases))
    states = np.reshape(values.get("x0", np.zeros(0)), (-1, unknowns.experiments), order="F")
    levels = states[-1:].T if unknowns.levels else None
    level = np.asarray(values.get("offset", np.zeros(1) if levels is None else levels.mean(axis=0)))
    drift = float(np.sum(values.get("drift", 0.0))) / (errors.length * dt)
    model = ProcessModel(tuple(one.in_unit(1 / dt) for one in errors.processes(x)), curves, level, drift,
                         "first" if errors.straight else "zero", levels=levels, **model_meta(errors.data))
    return model.with_transform(errors.units)

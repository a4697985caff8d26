"""Fits with the courses of a run as unknowns: one sparse programme for NLP back ends, whatever the model.

    minimise    sum ‖W (y - output)‖²
    subject to  x(k+1) = f(x(k), u(k), p)  at every sample,  every other course as the states determine it

(multiple shooting with one sample between the nodes, Bock 1981; direct collocation, Hargraves and Paris 1987). The step
functions f are those of `optid.identify.simultaneous`:

* `hammerstein_oe`: the state is the past of the output, poles stay inside the unit circle exactly. The optima are those
  of ``hammerstein_oe.exact``.
* `ss`, `hammerstein_ss`, `lfr`: the optima of the ``.exact`` formulations. A start is found as there; the programme is
  posed at the end of its descent, with the weights W found on the way, or at the best start itself with
  ``iterations=0``. Constraints that the start violates by much may lead to states that satisfy the equations backwards
  in time; a result whose run is unstable, or is not the run of its model, says so in its status. The states are those
  of the start up to a small change: constraints on single states suit models given as ``initial``, constraints on
  ``output`` every model.
* `physical`: equations of the user with named parameters. W is the inverse of the spread of every output at first and,
  with several outputs, of their errors then.

Another way to known optima, a cross-check of descents, and the way for constraints on courses, which need not be
convex, and for difficult starts. Work and memory grow with the samples, not with the parameters. IPOPT uses the
sparsity, and takes records up to the limits in seconds; Uno and fatrop factorise without it and are for some hundred
samples. With several experiments the names of their courses end in ``[1]``, ``[2]``, ...; with several inputs the
per-channel names carry the input, as in ``mu[valve]``.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

from formulations.constraints.poles import refuse_integrator
from formulations.prediction_error import Orders
from formulations.state_space import state_space_fit
from optid.bases import Bases
from optid.core.problem import Problem
from optid.core.terms import Squares, Values
from optid.data.record import Data
from optid.identify.prediction_error.latent_search import latent_channels
from optid.identify.simultaneous import Courses, TransferCourses, check_states, fit_equations, shoot
from optid.identify.subspace.procedure import subspace_steps
from optid.models import HammersteinSS
from optid.models.equations import Equations
from optid.models.gauges import Gauge
from optid.solving.solve import Procedure
from optid.solving.steps import steps

NO_BOUND = "simulation errors are not convex: no lower bound is known"


def _problem(name: str, courses: Courses, start: Values, constraints: Sequence[Any]) -> Problem:
    """Minimise the squares of what outputs miss, over unknowns and courses that are those of a run."""
    errors: Any = courses.criterion
    runs, names = range(len(errors.labels)), frozenset(start) - frozenset(errors.variables.names)
    outputs = [one for i in runs for one in courses.readings(i)]

    def equations(view: Any) -> dict[str, Any]:
        v, found = view.inner, courses.confining(view.inner)
        for i in runs:
            found |= courses.following(i, v)  # x(k+1) = f(x(k), u(k), p)
            found |= {name: v[name] == formula(v) for name, formula in courses.formulas(i).items()}
        return found

    return Problem(
        name, start, tuple(Squares(weights, measured, 0.0, (course,)) for course, weights, measured in outputs),
        leaves=errors.factors(),  # Theta = mu bᵀ
        restrictions=(equations,), builders=tuple(constraints), bounds=courses.limits(start),
        courses=names if courses.determined else frozenset(), further=courses.further, model=errors.model,
        facts={"reference": start, **errors.facts()}, compressed=courses.compressed, proof=NO_BOUND, **errors.common())


@steps(lambda given: {"hammerstein_oe.shooting": "NLP"})
def hammerstein_oe(data: Data, *, na: int, nb: Orders, basis: Bases = "polynomial:3", nk: Orders = 0,
                   constraints: Sequence[Any] = (), gauge: Gauge = "norm", offset: bool = True) -> Problem:
    """Minimise the simulation errors with the simulated outputs as variables.

    Named variables: ``Theta``, ``a``, ``b``, ``kappa``, ``mu``, ``offset``, ``w``, ``x``.

    Arguments as in `formulations.prediction_error.hammerstein_bj`, as are the errors raised; constraints may be any
    smooth ones in the named variables. A record that is too long is refused (`StructureError`).
    """
    refuse_integrator(constraints, "this programme keeps all poles inside the unit circle: use 'hammerstein_oe.exact' "
                                   "with 'integrator'")
    courses = TransferCourses.of(data, (na, nb, nk), basis, gauge, offset)
    problem = _problem("hammerstein_oe.shooting", courses, courses.start(), constraints)
    signed = gauge != "norm" or problem.fixes_signs
    return problem if signed else problem.beginning(problem.start, partial(courses.criterion.model, signed=False))


def _of_states(name: str, data: Data, nx: int | str, constraints: Sequence[Any], **settings: Any) -> Procedure:
    check_states(name, data, constraints)
    return state_space_fit(f"{name}.shooting", data, nx=nx, criterion="simulation", constraints=constraints,
                           finish=partial(shoot, _problem), **settings)


@subspace_steps({"ss.shooting": "NLP"})
def ss(data: Data, *, nx: int | str, block_rows: int | Sequence[int] | None = None, weighting: str = "auto",
       offset: bool = True, feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
       initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100, constraints: Sequence[Any] = ()
       ) -> Procedure:
    """Minimise the simulation error of a linear model with its states as variables.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``offset``, ``output``, ``states``, ``x0``.
    Arguments as in `hammerstein_ss`, as are the errors raised.
    """
    return _of_states("ss", data, nx, constraints, block_rows=block_rows, weighting=weighting, offset=offset,
                      feedthrough=feedthrough, stability=stability, initial=initial, iterations=iterations)


@subspace_steps({"hammerstein_ss.shooting": "NLP"})
def hammerstein_ss(data: Data, *, nx: int | str, basis: Bases = "polynomial:3", feedback_basis: Any = None,
                   block_rows: int | Sequence[int] | None = None, weighting: str = "auto", offset: bool = True,
                   feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
                   initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
                   constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a Hammerstein model, with output feedback or without, its states as variables.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``mu``, ``offset``, ``output``, ``states``,
    ``x0``. Other arguments as in `formulations.state_space.hammerstein_ss`.

    Args:
        feedback_basis: polynomials or trigonometric functions, which the programme continues beyond their interval.
        iterations: Gauss-Newton steps per descent at most; 0 starts from the best subspace fit.
        constraints: builders of smooth constraints in the named variables.

    Raises:
        StructureError: as there, and too many samples, a rule about poles, a basis of the feedback without a formula.
        DataError, RankError: as there.
    """
    return _of_states("hammerstein_ss", data, nx, constraints, basis=basis, feedback_basis=feedback_basis,
                      block_rows=block_rows, weighting=weighting, offset=offset, feedthrough=feedthrough,
                      stability=stability, initial=initial, iterations=iterations)


@subspace_steps({"lfr.shooting": "NLP"})
def lfr(data: Data, *, nx: int | str, channels: int = 1, latent_basis: Any = "polynomial:3",
        latent: str = "states+inputs", direct: bool = False, basis: Bases = "linear",
        block_rows: int | Sequence[int] | None = None, weighting: str = "auto", offset: bool = True,
        feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
        initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100, seed: int = 0,
        tries: int = 2, constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a model with functions of latent signals, its states as variables.

    Named variables: ``A``, ``C``, ``Theta``, ``b``, ``b latent``, ``mu``, ``mu latent``, ``offset``, ``output``,
    ``signal of z``, ``states``, ``x0``, ``z``. Other arguments as in `formulations.latent_signals.lfr`,
    errors raised as in `hammerstein_ss`.

    Args:
        latent_basis: polynomials or trigonometric functions.
    """
    extend = latent_channels(channels, latent_basis, latent, direct, seed, iterations, tries)
    return _of_states("lfr", data, nx, constraints, basis=basis, block_rows=block_rows, weighting=weighting,
                      offset=offset, feedthrough=feedthrough, stability=stability, initial=initial,
                      iterations=iterations, extend=extend)


@steps(lambda given: {"physical": "NLP"})
def physical(data: Data, *, equations: Equations | str, starts: int = 6, seed: int = 0, constraints: Sequence[Any] = ()
             ) -> Procedure:
    """Fit the parameters of state equations by least squares of the simulation errors.

    Named variables: the parameters and states of the equations.

    Args:
        data: the record. Outputs may be missing; it is cut where inputs are.
        equations: `optid.Equations`, or their place in a file: "plant.py:name".
        starts: how many starts descend, random but for the first; fewer where two agree on a model that explains nine
            tenths of the output.
        seed: of the random starts.
        constraints: builders such as ``lambda v: v["k1"] <= v["k2"]``.

    Raises:
        StructureError: equations that do not fit the record, have no value at the start, or whose run explodes; too
            many samples.
        DataError: no stretch of some length in which every input is present.
        RankError: parameters that the record does not determine, by name.
    """
    return fit_equations(_problem, data, equations, constraints, starts, seed)

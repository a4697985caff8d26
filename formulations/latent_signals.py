"""State-space models with static functions of latent signals, or of the outputs of a linear or Hammerstein system.

* `lfr`, linear fractional representation: ``x(k+1) = A x + B f(u) + Ez h(z) + K e``,
  ``y(k) = C x + D f(u) + Fz h(z) + d + e``, ``z = Cz x + Dz u + const`` with z scalar for every h. What is affine in z
  belongs to A, B, C and D; h is orthogonal to it. The latent signals are added one after another to the optimum of the
  model without them (`optid.identify.prediction_error.latent_search`).
* `wiener_ss`, `hammerstein_wiener_ss`: ``x(k+1) = A x + B f(u)``, ``y_o(k) = h_o(z_o) + d_o + e_o``,
  ``z_o = Cz_o x + Dz_o u + const``, from the optimum of the model with h the identity; f is the identity for Wiener
  models.

Rules about the shape of h (`shape.convex`, `shape.odd`, ...) name the latent signal as their channel, "z1", "z2", ...;
``mu latent[z1]`` are the coefficients of h in its basis.

The errors are minimised over all parts, z included, by steps as in `formulations.state_space`.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from formulations.state_space import signals, state_space_fit
from optid.bases import Bases
from optid.core.problem import Problem
from optid.core.terms import Errors
from optid.data.record import Data
from optid.identify.arguments import in_memory
from optid.identify.prediction_error.latent_search import latent_channels, output_functions
from optid.identify.prediction_error.state_errors import StateErrors
from optid.identify.subspace.procedure import subspace_steps
from optid.models import HammersteinSS
from optid.solving.solve import Procedure


@subspace_steps(tangent="lfr.exact")
def lfr(data: Data, *, nx: int | str, channels: int = 1, latent_basis: Any = "polynomial:3",
        latent: str = "states+inputs", direct: bool = False, basis: Bases = "linear", criterion: str = "simulation",
        block_rows: int | Sequence[int] | None = None, weighting: str = "auto", offset: bool = True,
        feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
        initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100, seed: int = 0,
        tries: int = 2, constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the error of a model with functions of latent signals.

    Named variables: ``A``, ``C``, ``P``, ``Q``, ``Theta``, ``b``, ``b latent``, ``mu``, ``mu latent``,
    ``mu latent[z1]``, ``offset``, ``x0``, ``z``. Other arguments as in `formulations.state_space.hammerstein_ss`.

    Args:
        channels: number of latent signals.
        latent_basis: basis of every h, on z in [-1, 1]; beyond, polynomials continue, splines go straight on.
        latent: signals that z combines, "states+inputs" or "states".
        direct: whether h also acts on the outputs directly.
        criterion: "simulation" (the free run) or "prediction" (K estimated).
        initial: models without latent signals, or with the same, as additional starting points.
        seed: of the directions of z that are tried.
        tries: searches for every latent signal, those after the first beside the others; with 1, which is quick,
            a search that seems to have failed is not repeated either; with 0 initial models alone are starts.

    Raises:
        StructureError: words, orders or starts that do not fit, a basis of affine functions alone.
        RankError: too few samples, or no direction of z whose run stays finite.
    """
    extend = latent_channels(channels, latent_basis, latent, direct, seed, iterations, tries)
    return state_space_fit(
        "lfr.exact", data, nx=nx, basis=basis, criterion=criterion, block_rows=block_rows,
        weighting=weighting, offset=offset, feedthrough=feedthrough, stability=stability, initial=initial,
        iterations=iterations, constraints=constraints, extend=extend, pose=_problem)


@subspace_steps(tangent="wiener_ss.exact")
def wiener_ss(data: Data, *, nx: int | str, output_basis: Any = "polynomial:3",
              block_rows: int | Sequence[int] | None = None, weighting: str = "auto", feedthrough: bool = True,
              stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
              constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a Wiener model.

    Named variables: ``A``, ``P``, ``Q``, ``Theta``, ``b``, ``mu latent``, ``mu latent[z1]``, ``offset``, ``x0``, ``z``.
    Other arguments as in `formulations.state_space.hammerstein_ss`, as are the errors raised.

    Args:
        output_basis: basis of every h, on z in [-1, 1].
        feedthrough: whether the inputs act on z at once.
        initial: linear models, or models of this structure, as additional starting points.
    """
    return _of_outputs(
        "wiener_ss.exact", data, nx, output_basis, feedthrough, iterations, block_rows=block_rows,
        weighting=weighting, stability=stability, initial=initial, constraints=constraints)


@subspace_steps(tangent="hammerstein_wiener_ss.exact")
def hammerstein_wiener_ss(data: Data, *, nx: int | str, basis: Bases = "polynomial:3",
                          output_basis: Any = "polynomial:3", block_rows: int | Sequence[int] | None = None,
                          weighting: str = "auto", stability: str = "stable",
                          initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
                          constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a Hammerstein-Wiener model whose inputs act on the outputs a sample later.

    Named variables: ``A``, ``P``, ``Q``, ``Theta``, ``b``, ``mu``, ``mu latent``, ``mu latent[z1]``, ``offset``,
    ``x0``, ``z``. Other arguments as in `formulations.state_space.hammerstein_ss`, as are the errors raised.

    Args:
        output_basis: basis of every h, on z in [-1, 1].
        initial: Hammerstein models, or models of this structure, as additional starting points.
    """
    return _of_outputs(
        "hammerstein_wiener_ss.exact", data, nx, output_basis, False, iterations, basis=basis,
        block_rows=block_rows, weighting=weighting, stability=stability, initial=initial, constraints=constraints)


def _of_outputs(name: str, data: Data, nx: int | str, output_basis: Any, feedthrough: bool, iterations: int,
                **settings: Any) -> Procedure:
    extend = output_functions(output_basis, in_memory(data, "simulation errors").l, feedthrough, iterations)
    return state_space_fit(name, data, nx=nx, criterion="simulation", feedthrough=feedthrough, iterations=iterations,
                           extend=extend, pose=_problem, **settings)


def _problem(name: str, errors: StateErrors, x: np.ndarray, constraints: Sequence[Any]) -> Problem:
    """Minimise ‖e‖² over A, [B; D] and f of every input, C, z, h and [Ez; Fz] of every latent signal, x0, from x."""
    variables, facts = errors.variables, errors.facts()
    latent = {f"z{i}": one for i, one in enumerate(errors.unknowns.latent, start=1)}
    return Problem(
        name,
        start=variables.values(x),
        terms=(Errors(variables.squares, variables.value, errors),),
        leaves=errors.factors(), further=partial(_signals, errors), about=frozenset({"P", "Q"}),
        model=partial(errors.model, constrained=bool(constraints)),
        facts={**facts, "iterate": True, "bases": facts["bases"] | {z: one.basis for z, one in latent.items()},
               "spans": {z: one.vectors for z, one in latent.items()}},
        builders=tuple(constraints), **errors.common())


def _signals(errors: StateErrors, variables: Mapping[str, Any], x: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return what constraints may also use: that of `formulations.state_space`, the functions of latent signals."""
    return signals(errors, variables, x) | {
        f"mu latent[z{i}]": one.vectors @ variables[errors.key("c", i - 1)]
        for i, one in enumerate(errors.unknowns.latent, start=1) if one.row is None}

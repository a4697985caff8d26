"""State-space models with static functions of latent signals (linear fractional representation).

    x(k+1) = A x + B f(u) + Ez h(z) + K e,    y(k) = C x + D f(u) + Fz h(z) + d + e,    z = Cz x + Dz u + const

with z scalar for every h. The simulation or prediction error is minimised over all parts, z included, by the programmes
of `formulations.state_space`. What is affine in z belongs to A, B, C and D; h is orthogonal to it. The latent signals
are added one after another to the optimum of the model without them (`optid.identify.prediction_error.latent_search`).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from formulations.state_space import StateSpaceFit
from formulations.state_space_procedure import state_space_fit
from optid.arrays import check_integer, one_of
from optid.bases import Bases, Basis, Polynomial, parse
from optid.data.record import Data
from optid.identify.prediction_error.latent_search import add_channels
from optid.models import HammersteinSS
from optid.solving.solve import Procedure
from optid.statistics.state_unknowns import Latent, beyond_affine


def lfr(data: Data, *, nx: int | str, channels: int = 1, latent_basis: Any = "polynomial:3",
        latent: str = "states+inputs", direct: bool = False, basis: Bases = "linear", criterion: str = "simulation",
        block_rows: int | Sequence[int] | None = None, weighting: str = "auto", offset: bool = True,
        feedthrough: bool | Sequence[bool] = True, stability: str = "stable",
        initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100, seed: int = 0,
        constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the error of a model with functions of latent signals.

    Named variables: ``Bu``, ``Du``, ``Theta``, ``b``, ``mu``, ``offset``, ``x0``.

    Args:
        data: the record.
        nx: number of states, or "auto".
        channels: number of latent signals.
        latent_basis: basis of every h, on z in [-1, 1]; beyond, polynomials go on as they are, splines straight.
        latent: what z is made of, "states+inputs" or "states".
        direct: whether h acts on the outputs, too.
        basis: basis of the inputs.
        criterion: "simulation" (the free run) or "prediction" (K estimated).
        block_rows: as in `formulations.state_space.hammerstein_ss`, as are the arguments below.
        weighting: of the outputs.
        offset: estimate a constant.
        feedthrough: whether the inputs act on the outputs at once.
        stability: "stable" or "free", of A.
        initial: models to start from besides, without latent signals.
        iterations: Gauss-Newton steps per descent at most.
        seed: of the directions of z that are tried.
        constraints: rules about poles, builders of CVXPY constraints in the named variables.

    Raises:
        StructureError: words, orders or starts that do not fit, a basis of affine functions alone.
        RankError: too few samples, or no direction of z whose run stays finite.
    """
    check_integer(channels, "channels")
    one_of("latent", latent, ("states+inputs", "states"))
    inner = on_latent(latent_basis)
    one = Latent(inner, beyond_affine(inner), direct=direct, moved=latent != "states")
    extend = partial(add_channels, channels=(one,) * channels, seed=seed, iterations=iterations)
    return state_space_fit(
        "lfr.exact", data, nx, StateSpaceFit, basis=basis, criterion=criterion, block_rows=block_rows,
        weighting=weighting, offset=offset, feedthrough=feedthrough, stability=stability, initial=initial,
        iterations=iterations, constraints=constraints, extend=extend)


def on_latent(given: Basis | str) -> Basis:
    """Return the basis of a latent function, on [-1, 1]."""
    basis: Any = parse(given) if isinstance(given, str) else given
    return replace(basis, interval=(-1.0, 1.0), outside="extrapolate" if isinstance(basis, Polynomial) else "linear")

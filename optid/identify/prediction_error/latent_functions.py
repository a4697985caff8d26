"""The functions of latent signals that a formulation asks for, and what adds them to an optimum without them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from optid.arrays import LARGEST_INTEGER, check_integer, one_of, short_repr
from optid.bases import Basis, Polynomial, parse
from optid.errors import StructureError
from optid.identify.prediction_error.latent_search import add_channels, add_output_functions
from optid.statistics.state_unknowns import Latent, beyond_affine

Extend = Callable[..., Any]  # see `optid.identify.prediction_error.state_fit.fit_states`


def latent_channels(channels: int, latent_basis: Any, latent: str, direct: bool, seed: int, iterations: int,
                    tries: int) -> Extend:
    """Return what adds the latent signals of `formulations.latent_signals.lfr`; arguments and errors as there."""
    check_integer(channels, "channels")
    check_integer(seed, "seed", 0, LARGEST_INTEGER)
    one_of("latent", latent, ("states+inputs", "states"))
    inner = _on_latent(latent_basis)
    one = Latent(inner, beyond_affine(inner), direct=direct, moved=latent != "states")
    return partial(add_channels, channels=(one,) * channels, seed=seed, iterations=iterations,
                   tries=check_integer(tries, "tries", 0))


def output_functions(basis: Any, outputs: int, moved: bool, iterations: int) -> Extend:
    """Return what puts a function in a basis in the place of every output, moved by inputs at once or not."""
    inner = _on_latent(basis)
    functions = tuple(Latent(inner, np.eye(inner.size), feeds=False, output=o, moved=moved) for o in range(outputs))
    return partial(add_output_functions, functions=functions, iterations=iterations)


def _on_latent(given: Basis | str) -> Basis:
    """Return the basis of a latent function, on [-1, 1]."""
    basis = parse(given) if isinstance(given, str) else given
    if not isinstance(basis, Basis):
        raise StructureError(f"the basis of a latent signal is {short_repr(given)}: give one such as Polynomial(3) or "
                             "its name, 'polynomial:3'")
    outside = "extrapolate" if isinstance(basis, Polynomial) else "linear"
    return replace(cast(Any, basis), interval=(-1.0, 1.0), outside=outside)

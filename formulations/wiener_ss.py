"""State-space models whose outputs are static functions of what a linear or Hammerstein system gives.

    x(k+1) = A x + B f(u),    y_o(k) = h_o(z_o) + d_o + e_o,    z_o = Cz_o x + Dz_o u + const

f is the identity for Wiener models. The simulation error is minimised over all parts by the programmes of
`formulations.state_space`, from the optimum of the model with h the identity.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from formulations.lfr import on_latent
from formulations.state_space import state_space_fit
from optid.bases import Bases
from optid.data.record import Data
from optid.identify.arguments import in_memory
from optid.identify.prediction_error.latent_search import add_output_functions
from optid.models import HammersteinSS
from optid.solving.solve import Procedure
from optid.statistics.state_unknowns import Latent


def wiener_ss(data: Data, *, nx: int | str, output_basis: Any = "polynomial:3",
              block_rows: int | Sequence[int] | None = None, weighting: str = "auto", feedthrough: bool = True,
              stability: str = "stable", initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
              constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a Wiener model.

    Named variables: ``B``, ``Bu``, ``D``, ``Du``, ``Theta``, ``offset``, ``x0``. Other arguments as in
    `formulations.state_space.hammerstein_ss`, as are the errors raised.

    Args:
        output_basis: basis of every h, on z in [-1, 1].
        feedthrough: whether the inputs act on z at once.
        initial: linear models to start from besides.
    """
    return _fit("wiener_ss.exact", data, nx, output_basis, feedthrough, iterations, block_rows=block_rows,
                weighting=weighting, feedthrough=feedthrough, stability=stability, initial=initial,
                constraints=constraints)


def hammerstein_wiener_ss(data: Data, *, nx: int | str, basis: Bases = "polynomial:3",
                          output_basis: Any = "polynomial:3", block_rows: int | Sequence[int] | None = None,
                          weighting: str = "auto", stability: str = "stable",
                          initial: HammersteinSS | Sequence[HammersteinSS] = (), iterations: int = 100,
                          constraints: Sequence[Any] = ()) -> Procedure:
    """Minimise the simulation error of a Hammerstein-Wiener model whose inputs act on the outputs a sample later.

    Named variables: ``Bu``, ``Du``, ``Theta``, ``offset``, ``x0``. Other arguments as in
    `formulations.state_space.hammerstein_ss`, as are the errors raised.

    Args:
        output_basis: basis of every h, on z in [-1, 1].
        initial: Hammerstein models to start from besides.
    """
    return _fit("hammerstein_wiener_ss.exact", data, nx, output_basis, False, iterations, basis=basis,
                block_rows=block_rows, weighting=weighting, feedthrough=False, stability=stability, initial=initial,
                constraints=constraints)


def _fit(name: str, data: Data, nx: int | str, output_basis: Any, moved: bool, iterations: int, **settings: Any
         ) -> Procedure:
    inner = on_latent(output_basis)
    functions = tuple(Latent(inner, np.eye(inner.size), feeds=False, output=o, moved=moved)
                      for o in range(in_memory(data, "simulation errors").l))
    extend = partial(add_output_functions, functions=functions, iterations=iterations)
    return state_space_fit(name, data, nx, criterion="simulation", iterations=iterations, extend=extend,
                           **settings)

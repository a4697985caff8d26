"""From the factors of a fit in state space to its model."""

from collections.abc import Sequence

import numpy as np

from optid.data.record import Data
from optid.identify.equation_error.compression import model_meta
from optid.models import HammersteinSS, Nonlinearity
from optid.statistics.expansion import Expansion

Array = np.ndarray


def state_model(expansion: Expansion, data: Data, matrices: Sequence[Array], mus: Sequence[Array], nus: Sequence[Array],
                e: Array, *, K: Array | None = None, offset: Array | None = None) -> HammersteinSS:
    """Build the model, its feedback functions in their own basis: what is linear in them becomes L and a constant.

    Args:
        expansion: the signals of the fit.
        data: the record, for names, units and sampling time.
        matrices: A (n, n), B (n, m), C (l, n) and D (l, m).
        mus: coefficients of the nonlinearity of every input.
        nus: coefficients of every feedback family in its orthonormal coordinates.
        e: (n, s), one column per family.
        K: (n, l), zero where None.
        offset: (l,) of the output, zero where None.
    """
    families = expansion.feedback
    parts = [np.outer(column, nu) for column, nu in zip(e.T, nus)]
    injection, constant = expansion.injection(np.hstack([np.zeros((len(e), 0)), *parts]))
    A, B, C, D = matrices
    return HammersteinSS(
        A=A, B=B, C=C, D=D, K=K, E=e if families else None, L=injection,
        nonlinearities=tuple(Nonlinearity(basis, mu) for basis, mu in zip(expansion.inputs, mus)),
        feedback=tuple(Nonlinearity(family.basis, family.vectors @ nu) for family, nu in zip(families, nus)),
        output_of=tuple(family.output for family in families), offset_x=constant, offset_y=offset, **model_meta(data))

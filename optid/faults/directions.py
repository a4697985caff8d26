"""Directions of process faults in the terms of the outputs, for models whose states mean nothing by themselves."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optid.arrays import Array
from optid.errors import LookupFailed, StructureError, nearest
from optid.faults.whitening import predictor

if TYPE_CHECKING:
    from optid.models import HammersteinSS

ROUND = 1e-6
"""Share of an isotropic covariance that is added where the process noise has no power."""


def direction_of(model: "HammersteinSS", outputs: Mapping[str, float]) -> Array:
    """Return the direction (n,) in the state equation that moves the outputs by so much within one sample.

    Several directions do where the model has more states than outputs. Taken is the one that its process noise makes
    most probable, Q C' (C Q C')^-1 d, which is the same fault in any coordinates of the state.

    Args:
        model: with noise covariances.
        outputs: {output: change by one unit of the fault}; the others do not move at once.

    Raises:
        LookupFailed: no such output.
        StructureError: a direction that is zero or not finite, no noise covariances, outputs that are not moved by the
            state.
    """
    d = np.zeros(model.l)
    for name, value in outputs.items():
        if name not in model.outputs:
            raise LookupFailed(f"direction by outputs: there is no output {name!r}. {nearest(name, model.outputs)}")
        d[model.outputs.index(name)] = value
    if not d.any() or not np.isfinite(d).all():
        raise StructureError(f"direction by outputs {dict(outputs)}: finite numbers, one of them not zero, are needed.")
    predictor(model)  # which says what is missing
    assert model.noise is not None
    steady = model.noise.Q
    P = steady + ROUND * max(float(np.trace(steady)), 1e-300) * np.eye(model.nx)
    found = P @ model.C.T @ np.linalg.lstsq(model.C @ P @ model.C.T, d, rcond=1e-10)[0]
    if not np.allclose(model.C @ found, d, rtol=1e-6, atol=1e-9 * np.abs(d).max()):
        raise StructureError(f"direction by outputs {dict(outputs)}: no disturbance of the state moves them like that.")
    return np.asarray(found)

"""Directions of disturbances, and predictors that are decoupled from declared disturbances of any course.

An unknown disturbance d is modelled as white noise of unlimited variance: the steady Kalman predictor of a model with
the noise Q + s^2 E E', R + s^2 F F', S + s^2 E F' is, for large s, the optimal filter decoupled from d (E in the state
equation, F in the output equation). Its innovations grow with s along as many axes as the outputs distinguish
disturbances; these axes are left out of the whitening. On the others thresholds and false alarm rates are those of a
plant without d, whatever its course.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import LookupFailed, StructureError, nearest
from optid.faults.places import place_of
from optid.faults.whitening import Predictor, predictor
from optid.models import HammersteinSS

UNLIMITED = 1e5  # standard deviation of a disturbance, relative to those of the innovations that it affects
ROUND = 1e-6  # isotropic covariance added to the process noise, relative to its trace

GENERIC = np.exp(0.7j) * 1.3
"""Point of the z plane at which the rank of the transfer matrix from disturbances to outputs is computed."""


def decouple(model: HammersteinSS, disturbances: Sequence[str],
             process: Mapping[str, ArrayLike] | None = None) -> tuple[HammersteinSS, Predictor]:
    """Return a model whose noise includes disturbances of any course, and the predictor decoupled from them.

    Args:
        model: with noise covariances.
        disturbances: names as in `Fault`: "actuator:u1", "sensor:y1", "process:load"; the part before the colon may be
            omitted where the name is unique.
        process: directions (n,) in the state equation by name.

    Raises:
        LookupFailed: no such channel or direction.
        StructureError: a direction of another shape, disturbances that cover all outputs, or one that affects no
            output.
    """
    steady = predictor(model)
    kinds = {"actuator": model.inputs, "sensor": model.outputs, "process": tuple(process or {})}
    parts = []
    for name in disturbances:
        here = [kind for kind, names in kinds.items() if name in names]
        if ":" not in name and len(here) != 1:
            known = ", ".join(f"{kind}:{one}" for kind, names in kinds.items() for one in names)
            raise LookupFailed(f"disturbance {name!r}: {'several' if here else 'none'} of {known} has this name.")
        parts.append(place_of(model, name if ":" in name else f"{here[0]}:{name}", None, process))
    E, F = np.hstack([part[0] for part in parts]), np.hstack([part[1] for part in parts])
    A, into = model.A + model.L @ model.C, E + model.L @ F
    transfer = model.C @ np.linalg.solve(GENERIC * np.eye(model.nx) - A, into) + F
    seen = steady.root @ transfer
    sizes = np.linalg.norm(seen, axis=0)
    if not np.all(sizes > 0):
        raise StructureError(f"One of the disturbances {', '.join(disturbances)} affects no output: leave it out.")
    silent = int(np.linalg.matrix_rank(seen / sizes, tol=1e-8))
    if silent >= model.l:
        raise StructureError(
            f"The disturbances {', '.join(disturbances)} of any course cover all outputs ({', '.join(model.outputs)}): "
            "nothing is left to judge. Declare fewer of them, or add a sensor.")
    assert model.noise is not None
    E, F, noise = UNLIMITED * E / sizes, UNLIMITED * F / sizes, model.noise
    louder = replace(model, noise=replace(noise, Q=noise.Q + E @ E.T, R=noise.R + F @ F.T, S=noise.S + E @ F.T))
    loud = predictor(louder)
    _, axes = np.linalg.eigh(steady.root @ loud.covariance @ steady.root.T)
    kept = axes[:, : model.l - silent].T @ steady.root  # combinations of the outputs decoupled from them
    white = np.linalg.solve(np.linalg.cholesky(kept @ loud.covariance @ kept.T), kept)
    r: Any = np.linalg.qr(np.vstack([white, np.zeros((silent, model.l))])[:, ::-1], mode="r")  # triangular again
    return louder, replace(loud, root=np.ascontiguousarray(r[::-1, ::-1]), silent=silent)


def direction_of(model: HammersteinSS, outputs: Mapping[str, float]) -> Array:
    """Return the direction (n,) in the state equation that changes the outputs by given amounts within one sample.

    With more states than outputs it is not unique; returned is the most probable one under the process noise,
    Q C' (C Q C')^-1 d, which is the same fault in any coordinates of the state.

    Args:
        model: with noise covariances.
        outputs: {output: change by one unit of the fault}; the others do not change at once.

    Raises:
        LookupFailed: no such output.
        StructureError: a direction that is zero or not finite, no noise covariances, changes that no state causes.
    """
    d = np.zeros(model.l)
    for name, value in outputs.items():
        if name not in model.outputs:
            raise LookupFailed(f"direction by outputs: there is no output {name!r}. {nearest(name, model.outputs)}")
        d[model.outputs.index(name)] = value
    if not d.any() or not np.isfinite(d).all():
        raise StructureError(f"direction by outputs {dict(outputs)}: it must be finite and not zero.")
    predictor(model)  # refuses a model without noise covariances
    assert model.noise is not None
    steady = model.noise.Q
    P = steady + ROUND * max(float(np.trace(steady)), 1e-300) * np.eye(model.nx)
    found = P @ model.C.T @ np.linalg.lstsq(model.C @ P @ model.C.T, d, rcond=1e-10)[0]
    if not np.allclose(model.C @ found, d, rtol=1e-6, atol=1e-9 * np.abs(d).max()):
        raise StructureError(f"direction by outputs {dict(outputs)}: no disturbance of the state has this effect.")
    return np.asarray(found)

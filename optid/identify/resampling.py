"""Intervals from refits: the residual bootstrap of an ARX model.

The outputs are simulated by the fitted model with its residuals drawn with replacement, and every such record is fitted
with the same formulation, penalties and constraints (Efron and Tibshirani, An Introduction to the Bootstrap, 1993,
chapters 8 and 13). Without a linearisation, it also applies to robust losses and curved constraints.
"""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array, check_integer, check_probability
from optid.data.record import Data
from optid.data.streams import Stream
from optid.data.stretches import interpolate_missing
from optid.errors import DataError, DataWarning, StructureError
from optid.identify.fitting import Fit
from optid.identify.fitting import fit as refit
from optid.identify.uncertainty import Refits, Uncertainty, align_signs
from optid.models import HammersteinTF
from optid.models.functions import free_parameters
from optid.models.recursions import autoregression
from optid.progress import track
from optid.threads import one_thread

FAILED = 0.1  # share of refits without a point above which a warning is given


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """The result of a residual bootstrap; its intervals are quantiles of the refits, ``percentile.source.models``.

    Attributes:
        basic: the same reflected at the estimate, which corrects a bias.
        failed: refits without a point.
    """

    percentile: Uncertainty
    basic: Uncertainty
    failed: int


@one_thread
def bootstrap(fit: Fit, runs: int = 200, seed: int = 0, level: float = 0.95, solver: str = "auto") -> Bootstrap:
    """Refit to records simulated with resampled residuals.

    Rows of residuals are drawn together for all outputs, centred and inflated by the degrees of freedom. The first
    samples of every experiment and the missing samples are those of the record; missing inputs are interpolated in the
    simulation only.

    Args:
        fit: a fit to a record in memory.
        runs: number of refits, at least 40.
        seed: seed of the draws.
        level: probability that an interval contains the truth, in (0, 1).
        solver: back end of the refits.

    Raises:
        StructureError: a fit to a stream, too few runs, an invalid level.
        DataError: the simulation of the fitted model leaves the range of numbers.

    Warns:
        DataWarning: more than a tenth of the refits gave no point.
    """
    if isinstance(fit.data, Stream):
        raise StructureError("a stream cannot be simulated again; read the record, or use fit.uncertainty")
    if fit.model is None:
        raise StructureError(f"this fit has no model to resample: {fit.solution.reason or fit.solution.status}")
    if fit.model.structure != "arx":
        raise StructureError(f"the bootstrap resamples the equation errors of ARX models; this is a {fit.model.title}")
    check_integer(runs, "runs", 40)
    check_probability(level, "level")
    models, failed = [], 0
    with warnings.catch_warnings(action="ignore", category=DataWarning):  # given at the fit
        for record in track(_records(fit, runs, seed), "bootstrap", runs):
            again = refit(record, fit.formulation, solver=solver, prove=False, raises=False, **fit.arguments)
            if again.model is None:
                failed += 1
            else:
                models.append(align_signs(again.model, fit.model))
    if failed > FAILED * runs:
        warnings.warn(f"{failed} of {runs} refits gave no point and are left out", DataWarning, stacklevel=2)
    if len(models) < 2:
        raise StructureError(f"{failed} of {runs} refits gave no point: there is no scatter to report")
    percentile, basic = (Uncertainty(fit.model, float(level), Refits(fit.model, tuple(models), kind))
                         for kind in ("percentile", "basic"))
    return Bootstrap(percentile, basic, failed)


def _records(fit: Fit, runs: int, seed: int) -> Iterator[Data]:
    """Yield the resampled records, in the units of the record fitted."""
    data: Data = fit.data  # type: ignore[assignment]
    model = fit.problem.model(fit.solution.values)
    rows = np.vstack([e.y - model.predict_record(e.u, e.y) for e in data.experiments])
    rows = rows[~np.isnan(rows).any(axis=1)]
    # centred, with the variance of the equation error
    residuals = (rows - rows.mean(axis=0)) * np.sqrt(len(rows) / max(len(rows) - free_parameters(model) / model.l, 1.0))
    models = [model] * data.n_experiments if model.levels is None else [model.at_level(one) for one in model.levels]
    rng = np.random.default_rng(seed)
    for _ in range(runs):
        outputs = iter([_simulated(own, e.u, e.y, residuals[rng.integers(len(residuals), size=len(e.y))])
                        for own, e in zip(models, data.experiments)])
        yield data.map_signals(lambda u: u, lambda _, outputs=outputs: next(outputs))


def _simulated(model: HammersteinTF, u: Array, y: Array, errors: Array) -> Array:
    """Outputs of A y = B f(u) + d + errors with the first and the missing samples of the record."""
    n = model.largest_lag
    u, start = interpolate_missing(u), interpolate_missing(y)[:n]
    right = model.forcing(u[n:]) + errors[n:]
    state = model.following(u[:n], start)
    count = min(n, len(right))
    right[:count] += state[:count]
    outputs = np.vstack([start, autoregression(model.matrices, right)])
    if not np.isfinite(outputs).all():
        raise DataError("the simulation of the fitted model leaves the range of numbers, so it cannot be resampled; "
                        "identify it with a stability constraint")
    outputs[np.isnan(y)] = np.nan
    return outputs

"""Intervals around simulated and predicted outputs, of the parameters and of the noise.

A run of the model is a function of its parameters like any other: its standard error follows from the linearised fit
(`optid.identify.uncertainty`). The noise at the outputs adds to it independently. Its variance h samples ahead is
``sum_{j<h} H_j R H_j'`` for the response H of the noise model and the covariance R of the innovations, and that of the
stationary noise for a simulation (Ljung, System Identification, 1999, section 3.2). A noise model can be wrong where
the response is right, and the record of the fit shows how far the same run was off there: the larger one counts.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from optid.arrays import Array, as_list, check_integer, check_probability, one_or_all
from optid.data.record import Data
from optid.errors import DataWarning, RankError, StructureError
from optid.identify.noise import NoiseFilter
from optid.identify.prediction_error.error_noise import ErrorNoise
from optid.identify.record_checks import list_outside
from optid.identify.tangent import Tangent
from optid.identify.uncertainty import Interval, Uncertainty
from optid.identify.validation.predictions import one_step_or_nan, simulated_or_nan
from optid.models.experiments import records_of
from optid.models.functions import has_feedback
from optid.models.model import ROUNDING
from optid.structures.whitening import symmetric_root

LONGEST = 4096  # samples of a response of the noise whose spectrum is computed, at most
Run = Callable[[Any], Sequence[Array]]  # from a model to its outputs (N, l), one array per experiment


@dataclass(frozen=True, eq=False)
class OutputInterval(Interval):
    """Outputs with intervals that contain a measured output with probability `level`; every array is (N, l), or (N,).

    The arrays are NaN where there is no prediction.

    Attributes:
        value: simulated or predicted outputs.
        error: standard deviation of a measured output about `value`: the root of the sum of the squares of both parts.
        parameters: standard error due to the parameters, that of the output without noise.
        noise: standard deviation of the noise.
        level: probability that an interval contains the measured output.
        notes: what the intervals do not account for, one sentence each.
    """

    parameters: Array = field(kw_only=True)
    noise: Array = field(kw_only=True)
    level: float = field(kw_only=True)
    notes: tuple[str, ...] = field(default=(), kw_only=True)

    def counts_inside(self, y: Array) -> tuple[Array, Array]:
        """Return how many samples (l,) of measured outputs y (N, l) are inside, and of how many, those without NaN."""
        measured = np.reshape(np.asarray(y, dtype=float), np.shape(self.value))
        known = np.isfinite(measured) & np.isfinite(self.lower)
        inside = known & (self.lower <= measured) & (measured <= self.upper)
        return np.atleast_1d(inside.sum(axis=0)), np.atleast_1d(known.sum(axis=0))


class Noise(NamedTuple):
    """The noise at the outputs of a run."""

    deviations: Array  # (l,) standard deviations, or (N, l) where they grow
    dof: Array  # (l,) degrees of freedom of their estimate


def simulation_intervals(fit: Any, data: Any, x0: Any, level: float) -> Any:
    """Return the `OutputInterval` of a simulation; a tuple for several experiments.

    The initial state "zero", or a state, counts as known; "fit" follows the parameters. The noise is stationary, or
    begins with the record where an integrator adds it up.

    Args:
        fit: a fit with an uncertainty.
        data: Data, or inputs (N,) or (N, m), or a list of such arrays, in raw units.
        x0: initial state, as of `Model.simulate`.
        level: probability that an interval contains the measured output, in (0, 1).

    Raises:
        StructureError: an impossible level, a fit without uncertainty, or the state of a state-space model, which has
            no meaning in the coordinates of another one.
        DataError: as of `Model.simulate`.
        RankError: parameters without effect on the predictions.
    """
    check_probability(level, "interval")
    model, known = fit.model, _known(fit)
    if model.structure == "ss" and not isinstance(x0, str) and any(np.any(one) for one in as_list(x0)):
        raise StructureError("x0 is given in the state coordinates of this model, which change with its parameters, so "
                             "that it has no interval. Use x0='zero', or a record and x0='fit'")
    records, flat = records_of(model, data)

    def run(one: Any) -> Sequence[Array]:
        return as_list(one.simulate(data, x0))

    counts = [len(u) for u, _, _ in records]
    return _intervals(known.at_level(level), run, output_noise(fit, known.source, None, max(counts)), counts,
                      flat and model.l == 1)


def prediction_intervals(fit: Any, data: Data, horizon: int, level: float) -> Any:
    """Return the `OutputInterval` of a prediction so many samples ahead; a tuple for several experiments.

    Arguments and errors are as of `simulation_intervals` and `Model.predict`.
    """
    check_probability(level, "interval")
    horizon, known = check_integer(horizon, "horizon"), _known(fit)
    records = records_of(fit.model, data)[0]

    def run(model: Any) -> Sequence[Array]:
        return as_list(model.predict(data, horizon))

    counts = [len(u) for u, _, _ in records]
    return _intervals(known.at_level(level), run, output_noise(fit, known.source, horizon, max(counts)), counts, False)


def with_notes(found: Any, fit: Any, data: Any) -> Any:
    """Return intervals with what they do not account for; each note is also a `DataWarning`."""
    notes = []
    misfits = fit.verdict.misfits if isinstance(fit.data, Data) else ()
    if misfits:
        listed = ", ".join(f"{part.name}: {part.value}" for part in misfits)
        notes.append(f"The intervals are optimistic: they assume that the structure of the model is right, and the "
                     f"verdict finds misfit ({listed}).")
    u = np.vstack([one for one, _, _ in records_of(fit.model, data)[0]])
    functions = getattr(fit.model, "nonlinearities", ())
    for f, place in zip(functions, getattr(fit.model, "input_of", range(len(functions)))):
        share = 0.0 if f.is_linear else float(np.mean(f.basis.is_outside(u[:, place])))
        notes += [f"The intervals do not account for extrapolation: {one}."
                  for one in list_outside("input", fit.model.inputs[place], share, f.basis)]
    if fit.model.levels is not None:
        notes.append("Every experiment of the fit has its own constant: the intervals do not account for that of "
                     "another record.")
    for note in notes:
        warnings.warn(note, DataWarning, stacklevel=3)
    intervals: list[Any] = as_list(found)
    return one_or_all([replace(one, notes=tuple(notes)) for one in intervals])


def output_noise(fit: Any, known: Tangent, horizon: int | None, count: int) -> Noise:
    """Return the noise at so many outputs of a prediction, or of a simulation where the horizon is None.

    A variance estimated from errors of the spectrum S has the degrees of freedom of ``mean(S)^2 / mean(S^2)`` times as
    many white ones (Bartlett).

    Raises:
        StructureError: neither a noise model nor a run over the record of the fit tells the variance.
    """
    model, dof = fit.model, known.local.dof
    own, raw = noise_filter(model, known), fit.data.raw() if isinstance(fit.data, Data) else None
    nearest = ROUNDING if raw is None else 1 / max(e.n_samples for e in raw.experiments)
    variances = None
    if own is not None:
        variances = own.stationary(nearest) if horizon is None else own.variances(horizon)[-1]
        if variances is None:
            return Noise(np.sqrt(own.variances(count)), np.full(model.l, dof))
    errors = None if raw is None else _errors(model, raw, horizon)
    seen = None if errors is None else np.nanmean(np.vstack(errors) ** 2, axis=0) * _inflation(known)
    if variances is None and seen is None:
        raise StructureError("the variance of the noise is unknown: the model has no noise model, and no run over the "
                             "record of the fit shows it")
    if own is not None and len(own.F):
        response = own.response(min(count, LONGEST) if horizon is None else horizon) @ symmetric_root(own.covariance)
        independent = np.array([_share_independent(response[:, o]) for o in range(model.l)])
    elif errors is not None:
        columns = [[e[:, [o]] for e in errors] for o in range(model.l)]
        independent = np.array([_share_independent(ErrorNoise(one).response[:, 0]) for one in columns])
    else:
        independent = np.ones(model.l)
    deviations = np.sqrt(np.max([one for one in (variances, seen) if one is not None], axis=0))
    return Noise(deviations, np.maximum(dof * independent, 1.0))


def _share_independent(response: Array) -> float:
    """Return ``mean(S)^2 / mean(S^2)`` for the spectrum S of a sum of responses (n, q) to white noises of one size."""
    size = np.max(np.abs(response))
    if not size > 0:
        return 1.0
    spectrum = np.sum(np.abs(np.fft.fft(response / size, 2 * len(response), axis=0)) ** 2, axis=1)
    return float(np.mean(spectrum) ** 2 / np.mean(spectrum**2))


def noise_filter(model: Any, known: Tangent) -> NoiseFilter | None:
    """Return the noise at the outputs of a free run; None of a model without noise model, or that does not filter it.

    With functions of outputs or states the noise at the outputs depends on where the model is.
    """
    if model.structure in ("process", "physical"):
        return NoiseFilter(np.zeros((0, 0)), np.zeros((0, model.l)), np.zeros((model.l, 0)), known.noise)
    if model.structure in ("arx", "armax", "bj", "oe"):
        size = model.l
        past = model.matrices if model.structure == "arx" else model.noise_denominator.reshape(-1, 1, 1)
        n = max(len(past), model.c.size)
        D, c = np.zeros((n, size, size)), np.zeros((n, size, size))
        D[: len(past)], c[: model.c.size] = past, model.c.reshape(-1, 1, 1)
        F = np.eye(n * size, k=size)
        F[:, :size] -= D.reshape(n * size, size)
        return NoiseFilter(F, (c - D).reshape(n * size, size), np.eye(size, n * size), known.noise)
    if model.structure != "ss" or model.noise is None or has_feedback(model) or model.latent:
        return None
    covariance = model.noise.innovation * _inflation(known)
    return NoiseFilter(model.A + model.L @ model.C, model.K + model.L, model.C, covariance)


def _inflation(known: Tangent) -> float:
    """Return what the mean square of residuals is multiplied with for the parameters that were fitted."""
    return 1.0 + len(known.local.centre) / len(known.noise) / known.local.dof


def _errors(model: Any, raw: Data, horizon: int | None) -> list[Array] | None:
    """Return the errors (N, l) of a simulation or prediction of every experiment; None where an output has none."""
    with warnings.catch_warnings(action="ignore", category=DataWarning), np.errstate(all="ignore"):
        runs = simulated_or_nan(model, raw) if horizon is None else one_step_or_nan(model, raw, horizon)
        errors = [e.y - run for e, run in zip(raw.experiments, runs)]
    return errors if np.isfinite(np.vstack(errors)).any(axis=0).all() else None


def _known(fit: Any) -> Any:
    if fit.model is None:
        raise StructureError(f"this fit has no model: {fit.solution.reason or fit.solution.status}")
    try:
        return fit.uncertainty
    except (StructureError, RankError) as error:
        raise type(error)(f"no standard errors of the parameters: {error}") from error


def _intervals(known: Uncertainty, run: Run, noise: Noise, counts: Sequence[int], flat: bool) -> Any:
    """Join the intervals of a run (N, l) per experiment, by the parameters, with those of the noise."""
    values = [np.reshape(one, (count, -1)) for one, count in zip(run(known.model), counts)]
    here = np.isfinite(np.vstack(values))

    def outputs(model: Any) -> Array:
        with warnings.catch_warnings(action="ignore", category=DataWarning):  # given for the model of the fit
            return np.vstack([np.reshape(one, (count, -1)) for one, count in zip(run(model), counts)])[here]

    def of_experiments(part: Array) -> list[Array]:
        whole = np.full(here.shape, np.nan)
        whole[here] = part
        return np.split(whole, np.cumsum(counts)[:-1])

    found, made = known.of(outputs), []
    quantiles = stdtrit(noise.dof, 0.5 + known.level / 2)
    for value, error, below, above in zip(values, *map(of_experiments, (
            found.error, found.value - found.lower, found.upper - found.value))):
        deviations = noise.deviations[: len(value)] if noise.deviations.ndim > 1 else noise.deviations
        own = np.where(np.isnan(value), np.nan, deviations)
        arrays = (value, np.hypot(error, own), value - np.hypot(below, quantiles * own),
                  value + np.hypot(above, quantiles * own), error, own)
        value, total, lower, upper, error, own = (one[:, 0] if flat else one for one in arrays)
        made.append(OutputInterval(value, total, lower, upper, parameters=error, noise=own, level=known.level))
    return one_or_all(made)

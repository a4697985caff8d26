"""Validation and comparison of models on a record: prediction and simulation errors, residual tests, structure."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optid.arrays import Array, check_integer
from optid.data.record import Data
from optid.errors import DataError, DataWarning, OptidError, RankError, StructureError
from optid.identify.informativity import informativity
from optid.identify.record_checks import list_outside
from optid.identify.validation.correlations import Correlation, autocorrelation, cross_correlation
from optid.identify.validation.predictions import (
    MEASURED,
    ONE_STEP,
    SIMULATION,
    HorizonCurve,
    Measures,
    common_fits,
    fit_by_horizon,
    one_step,
    predictors,
    simulate_outputs,
    simulated_or_nan,
)
from optid.identify.validation.structure import Structure, structure_test
from optid.models.functions import StaticFunction, has_feedback, static_functions
from optid.phrases import p_equals
from optid.registry import Rendered
from optid.threads import one_thread

LAGS = 25
KINDS = {"nonlinearities": "input", "feedback": "output", "latent": "latent signal"}  # arguments of static functions
SLIGHT = 0.05  # error of the response, over its spread, up to which a correlation with an input is negligible
SLIGHT_COLOUR = 0.1  # correlation of residuals with their past up to which they count as white
NOT_TESTED = "Structure of the record: not tested: "
ROUNDING = 1e-12  # an error below this share of the largest output is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Validation(Rendered):
    """The result of `validate` on the record named `data`; `print` it.

    Attributes:
        horizon: samples ahead of the prediction besides one.
        predictors: errors, by output, of every predictor: "one step", "5 steps", "measured feedback" (the simulation
            with measured outputs in the nonlinear feedback, if there is one), "simulation" (its SNR is that of the
            output noise; `notes` gives the reason where it is missing).
        experiments: {predictor: {output: errors of each experiment}}; empty with one experiment.
        autocorrelations: whiteness test of the residuals by output.
        cross_correlations: independence of residuals and inputs by (output, input).
        between: independence of residuals and the past of those of the other outputs, by (output, other output).
        structure: structure test of the record; None where there is nothing to test, or for a reason in `notes`.
        outside: share of samples outside the interval of the basis, by channel.
        notes: limitations of the result; each is also a DataWarning.
        predicted: predicted outputs (N, l) per experiment of every predictor, NaN where there is none.
        residuals: one-step residuals (N, l) per experiment, NaN = missing.
        findings: what reading the record derived, assumed or repaired.
    """

    data: str
    horizon: int
    predictors: dict[str, dict[str, Measures]]
    experiments: dict[str, dict[str, tuple[Measures, ...]]]
    autocorrelations: dict[str, Correlation]
    cross_correlations: dict[tuple[str, str], Correlation]
    between: dict[tuple[str, str], Correlation]
    structure: Structure | None
    outside: dict[str, float]
    notes: tuple[str, ...]
    predicted: dict[str, tuple[Array, ...]]
    residuals: tuple[Array, ...]
    findings: tuple[str, ...] = ()

    @property
    def one_step(self) -> dict[str, Measures]:
        """Errors of one-step prediction by output."""
        return self.predictors[ONE_STEP]

    @property
    def simulation(self) -> dict[str, Measures]:
        """Errors of simulation by output; empty where there is none."""
        return self.predictors.get(SIMULATION, {})

    @property
    def simulated(self) -> tuple[Array, ...]:
        """Simulated outputs (N, l) per experiment; empty when there is no simulation."""
        return self.predicted.get(SIMULATION, ())

    @property
    def tests(self) -> tuple[Correlation, ...]:
        """All residual tests."""
        return (*self.autocorrelations.values(), *self.cross_correlations.values(), *self.between.values())

    @property
    def passed(self) -> bool:
        """Whether the structure test passes and all residual tests do."""
        return all(test.passed for test in self.tests) and (self.structure is None or self.structure.passed)


@one_thread
def validate(model: Any, data: Data, x0: Any = "fit", lags: int = LAGS, horizon: int = 1) -> Validation:
    """Compare a model with a record, preferably one it was not estimated from.

    Args:
        model: the model.
        data: the record; detrended or scaled data are taken back to raw units first.
        x0: initial state of the simulation, as in `HammersteinTF.simulate`.
        lags: largest lag of the residual tests; fewer when the record is shorter than four times that.
        horizon: how many samples ahead to predict, besides one; see `fit_by_horizon` for a whole curve.

    Raises:
        DataError: other channels or another sampling time than the model's, or no sample that can be predicted.
        StructureError: an x0 that cannot be read, or a horizon that is not a positive integer.

    Warns:
        DataWarning: a failed or impossible structure test, an unstable model, no simulation, or inputs outside the
            interval of their basis; also in `Validation.notes`.
    """
    horizon, raw = check_integer(horizon, "horizon"), data.raw()
    predicted = {ONE_STEP: tuple(one_step(model, raw))}
    residuals = tuple(e.y - p for e, p in zip(raw.experiments, predicted[ONE_STEP]))
    present = np.sum([np.sum(~np.isnan(r), axis=0) for r in residuals], axis=0)
    if not present.all():
        name = model.outputs[int(np.argmin(present))]
        raise DataError(
            f"No sample of output {name!r} can be predicted: the model looks back {model.memory} samples, the longest "
            f"experiment has {max(e.n_samples for e in raw.experiments)}. Use a longer record, or one with fewer gaps.")
    notes: list[str] = []
    if horizon > 1:
        predicted[f"{horizon} steps"] = tuple(one_step(model, raw, horizon))
    for word in predictors(model)[1:]:
        if found := _simulated(model, raw, word, x0, notes):
            predicted[word] = found
    outside = {}
    for function, _, share in shares_outside(model, raw):
        outside[function.name] = share
        found = list_outside(KINDS[function.family], function.name, share, function.nonlinearity.basis)
        notes.extend(note for note in found if note not in notes)
    structure = record_structure(model, raw, notes)
    for note in notes:
        warnings.warn(note, DataWarning, stacklevel=2)
    y = np.vstack([e.y for e in raw.experiments])
    pairs = {word: [(y, np.vstack(arrays)), *zip((e.y for e in raw.experiments), arrays)]
             for word, arrays in predicted.items()}
    errors = {word: {name: [Measures.of(y[:, o], p[:, o]) for y, p in several] for o, name in enumerate(raw.outputs)}
              for word, several in pairs.items()}  # over all experiments, then over each
    return Validation(
        data=raw.name, horizon=horizon,
        predictors={word: {name: found[0] for name, found in table.items()} for word, table in errors.items()},
        experiments={word: {name: tuple(found[1:]) for name, found in table.items()}
                     for word, table in errors.items() if raw.n_experiments > 1},
        **tested_residuals(model, raw, predicted[ONE_STEP], lags),
        structure=structure, outside=outside, notes=tuple(notes), predicted=predicted, residuals=residuals,
        findings=raw.findings)


def _residual_tests(model: Any, data: Data, residuals: Sequence[Array], lags: int = LAGS
                   ) -> dict[str, dict[Any, Correlation]]:
    """Test the residuals (N, l) of every experiment: each with its past, with every input and with the others' past.

    Lags count samples, at irregular times too: errors that are independent are so in the order of the samples.

    Dependence on an input is negligible where it is small beside the response: see `SLIGHT`.
    """
    columns = {name: [r[:, o] for r in residuals] for o, name in enumerate(data.outputs)}
    inputs = {name: [e.u[:, c] for e in data.experiments] for c, name in enumerate(data.inputs)}
    claimed, slight = describes_noise(model), {}
    least = informativity(data).least
    for o, (name, errors) in enumerate(columns.items()):
        explained = np.nanstd(np.concatenate([e.y[:, o] - r for e, r in zip(data.experiments, errors)]))
        slight[name] = SLIGHT * float(explained / max(float(np.nanstd(np.concatenate(errors))), 1e-300))
    return {
        "autocorrelations": {name: replace(autocorrelation(r, name, lags), claimed=claimed, slight=SLIGHT_COLOUR)
                             for name, r in columns.items()},
        "cross_correlations": {(name, channel): replace(cross_correlation(r, u, name, channel, lags, least),
                                                        slight=slight[name])
                               for name, r in columns.items() for channel, u in inputs.items()},
        "between": {(name, other): replace(autocorrelation(r, name, lags, past=past, other=other), claimed=claimed,
                                           slight=SLIGHT_COLOUR)
                    for name, r in columns.items() for other, past in columns.items() if other != name}}


def describes_noise(model: Any) -> bool:
    """Whether a model says anything about the colour of the noise: an output error says that it is white, and no more.

    Its residuals may have any colour without making the response wrong; nor do those of a process.
    """
    if getattr(model, "structure", "") in ("oe", "process"):
        return False
    return not hasattr(model, "K") or model.noise is not None or bool(np.any(model.K))


def tested_residuals(model: Any, data: Data, predicted: Sequence[Array], lags: int = LAGS
                   ) -> dict[str, dict[Any, Correlation]]:
    """Return the residual tests of one-step predictions (N, l); of residuals of rounding errors they are empty."""
    residuals = [e.y - p for e, p in zip(data.experiments, predicted)]
    present = np.sum([np.sum(~np.isnan(r), axis=0) for r in residuals], axis=0)
    every, left = np.vstack([e.y for e in data.experiments]), np.vstack(residuals)
    with np.errstate(all="ignore"):
        rounding = np.nan_to_num(np.nanmean(left**2, axis=0)) <= (ROUNDING * np.nanmax(np.abs(every), axis=0)) ** 2
    tested = [np.where(rounding, 0.0, r) for r in residuals]
    return _residual_tests(model, data, tested, max(1, min(lags, int(present.min()) // 4)))


def _simulated(model: Any, data: Data, word: str, x0: Any, notes: list[str]) -> tuple[Array, ...]:
    try:
        with warnings.catch_warnings(record=True, action="always", category=DataWarning) as caught:
            outputs = tuple(simulate_outputs(model, data, word, x0))
    except DataError as error:
        notes.append(f"No simulation. {error}" if word == SIMULATION else f"No simulation with {word}. {error}")
        return ()
    notes.extend(sentence for w in caught if (sentence := str(w.message)) not in notes)
    return outputs


def shares_outside(model: Any, data: Data) -> Iterator[tuple[StaticFunction, Array, float]]:
    """Yield the functions of a model, samples of their arguments, and the share outside the intervals of the bases.

    Linear functions have no samples; functions of a latent signal that diverges are left out.
    """
    for function in static_functions(model):
        try:
            x = np.zeros(0) if function.is_linear else function.samples(data)
        except OptidError:
            continue
        outside = np.count_nonzero(function.nonlinearity.basis.is_outside(x))
        yield function, x, outside / max(int(np.sum(~np.isnan(x))), 1)


def record_structure(model: Any, data: Data, notes: list[str] | None = None) -> Structure | None:
    """Test whether a record has the structure of a model; None where nothing is tested, for a reason added to notes.

    A Hammerstein model is tested for its class, a model with feedback or latent functions by its own residuals.
    """
    beyond = has_feedback(model) or bool(getattr(model, "latent", ()))
    if not beyond and not static_functions(model):
        return None
    notes = [] if notes is None else notes
    known = informativity(data)
    runs = simulated_or_nan(model, data) if beyond else None
    reason = known.reason or known.untested
    if known.loop.word != "open":
        reason = (f"feedback: output {known.loop.output!r} acts on an input, so that functions of the inputs depend on "
                  "the noise")
    if not reason:
        try:
            with warnings.catch_warnings(action="ignore", category=DataWarning):
                found = structure_test(data, runs, known.processes)
        except RankError as error:
            reason = str(error)
    if reason:
        notes.append(f"{NOT_TESTED}{reason}.")
        return None
    if not found.passed:
        notes.append(
            f"The record is {found.finding}; modelling this would reduce the residual variance by "
            f"{100 * found.saving:.2g} % ({p_equals(found.p_value, 1)}). Consider functions of latent signals "
            "(lfr.exact), a Wiener model, or nonlinear feedback.")
    return found


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Rendered):
    """The result of `compare_models`; `print` it, or write a page with `optid.show.report.write_comparison`.

    Attributes:
        names: one per model.
        data: the record, in raw units.
        horizon: samples ahead of the prediction besides one.
        fits: {predictor: (models, l) fits in %}, over the samples that all models predict; NaN where a model has no
            such prediction.
        validations: one per model, each over the samples it predicts itself.
        curves: fit against the horizon, one per model.
    """

    names: tuple[str, ...]
    models: tuple[Any, ...] = field(repr=False)
    data: Data = field(repr=False)
    horizon: int
    fits: dict[str, Array]
    validations: tuple[Validation, ...] = field(repr=False)
    curves: tuple[HorizonCurve, ...] = field(repr=False)

    @property
    def simulated(self) -> tuple[tuple[Array, ...], ...]:
        """Simulated outputs (N, l) per experiment, one tuple per model, empty where there is no simulation."""
        return tuple(checked.simulated for checked in self.validations)

    def best(self, predictor: str = SIMULATION) -> str:
        """Return the name of the model with the largest mean fit over the outputs, by a key of `fits`.

        A predictor that no model has is a `StructureError`.
        """
        means = np.nanmean(self.fits[predictor], axis=1) if predictor in self.fits else np.array([np.nan])
        if np.isnan(means).all():
            raise StructureError(f"no model has the prediction {predictor!r}; there are {', '.join(self.fits)}")
        return self.names[int(np.nanargmax(means))]


def compare_models(models: Mapping[str, Any] | Sequence[Any], data: Data, horizon: int = 1, x0: Any = "fit"
                   ) -> Comparison:
    """Compare several models on one record, preferably one that none of them was estimated from.

    Args:
        models: {name: model}, or models, which are then named by title and orders.
        data: the record.
        horizon: samples ahead of one more prediction.
        x0: initial state of the simulations, as the models take it.

    Raises:
        StructureError: no model, or a horizon that is not a positive integer.
        DataError: the record has other channels or another sampling time than a model.
    """
    named = dict(models) if isinstance(models, Mapping) else _named(models)
    if not named:
        raise StructureError("there is no model to compare")
    raw = data.raw()
    with warnings.catch_warnings(action="ignore", category=DataWarning):  # the notes of the validations contain them
        validations = tuple(validate(model, raw, x0=x0, horizon=horizon) for model in named.values())
        curves = tuple(fit_by_horizon(model, raw) for model in named.values())
    nothing = tuple(np.full(e.y.shape, np.nan) for e in raw.experiments)
    fits = {}
    for word in (ONE_STEP, f"{horizon} steps", MEASURED, SIMULATION):
        if any(word in checked.predicted for checked in validations):
            # a model without feedback simulates alike, measured or not
            other = SIMULATION if word == MEASURED else word
            found = common_fits(raw, [checked.predicted.get(word, checked.predicted.get(other, nothing))
                                      for checked in validations])
            fits |= {} if np.isnan(found).all() else {word: found}
    return Comparison(tuple(named), tuple(named.values()), raw, horizon, fits, validations, curves)


def _named(models: Sequence[Any]) -> dict[str, Any]:
    """Name models by their titles and orders, and number those that are still alike."""
    words = []
    for model in models:
        orders = ", ".join(f"{key} {' '.join(map(str, np.ravel(value)))}" for key, value in model.orders.items())
        words.append(f"{model.title} ({orders})" if orders else model.title)
    return {word if words.count(word) == 1 else f"{word} #{words[: i + 1].count(word)}": model
            for i, (word, model) in enumerate(zip(words, models))}

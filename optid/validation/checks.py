"""How good a model is on a record: errors of one-step prediction and simulation, residual tests, structure."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.bases.basis import Array
from optid.data import Data
from optid.errors import DataError, DataWarning, RankError
from optid.models.functions import static_functions
from optid.regressors import collect
from optid.validation.correlations import LEVEL, Correlation, autocorrelation, cross_correlation
from optid.validation.predictions import one_step, simulated
from optid.validation.structure import Structure, structure_test

LAGS = 25

ROUNDING = 1e-12
"""An error below this share of the largest output is rounding."""


@dataclass(frozen=True)
class Measures:
    """Errors of one output over the samples that are present and predicted.

    Attributes:
        fit: 100 (1 - |y - yhat| / |y - mean y|), in %; 100 is perfect, the mean scores 0.
        vaf: variance accounted for, 100 (1 - var(y - yhat) / var y), in %.
        rmse: root of the mean squared error, in output units.
        e_n: mean squared error (1/N) sum (y - yhat)^2, as the source prints it; perhaps its root was lost: rmse.
        snr: sum y^2 / sum (y - yhat)^2 as the source prints it, a ratio of energies.
        snr_amplitude: the root of that, a ratio of amplitudes.
        samples: number of samples N.
    """

    fit: float
    vaf: float
    rmse: float
    e_n: float
    snr: float
    snr_amplitude: float
    samples: int

    @classmethod
    def of(cls, y: Array, predicted: Array) -> "Measures":
        """Compare y (N,) with predicted (N,); NaN in either leaves the sample out."""
        here = ~(np.isnan(y) | np.isnan(predicted))
        if not here.any():
            nan = float("nan")
            return cls(nan, nan, nan, nan, nan, nan, 0)
        y, error = y[here], (y - predicted)[here]
        mean_square, energy = float(np.mean(error**2)), float(np.mean(y**2))
        snr = energy / mean_square if mean_square > 0 else float("inf")
        return cls(
            fit=float(fit_percent(y[:, None], (y - error)[:, None])[0]),
            vaf=100 * (1 - float(np.var(error) / np.var(y))) if np.ptp(y) > 0 else float("nan"),
            rmse=float(np.sqrt(mean_square)),
            e_n=mean_square,
            snr=snr,
            snr_amplitude=float(np.sqrt(snr)),
            samples=int(here.sum()),
        )


@dataclass(frozen=True, eq=False)
class Validation:
    """What `validate` found; `print` it.

    Attributes:
        data: name of the record.
        one_step: errors of one-step prediction by output.
        simulation: errors of simulation by output; their SNR is that of the output noise. Empty when `notes` says why.
        autocorrelations: whiteness test of the residuals by output.
        cross_correlations: independence of residuals and inputs by (output, input).
        structure: structure test of the record, or None when `notes` says why.
        outside: share of samples outside the interval of the basis, by channel.
        notes: what weakens the result; each was also given as a DataWarning.
        residuals: one-step residuals (N, l) per experiment, NaN = missing.
        simulated: simulated outputs (N, l) per experiment; empty when there is no simulation.
    """

    data: str
    one_step: dict[str, Measures]
    simulation: dict[str, Measures]
    autocorrelations: dict[str, Correlation]
    cross_correlations: dict[tuple[str, str], Correlation]
    structure: Structure | None
    outside: dict[str, float]
    notes: tuple[str, ...]
    residuals: tuple[Array, ...]
    simulated: tuple[Array, ...]

    @property
    def passed(self) -> bool:
        """Whether the structure test passes and the residual tests do, together at the 1 % level (Bonferroni)."""
        tests = [*self.autocorrelations.values(), *self.cross_correlations.values()]
        white = not any(test.p_value < LEVEL / len(tests) for test in tests)
        return white and (self.structure is None or self.structure.passed)

    def __str__(self) -> str:
        """Return the tables of errors and tests."""
        lines = [f"Validation on {self.data}" if self.data else "Validation"]
        lines.append(
            f"  {'output':<12}{'':<12}{'fit %':>8}{'VAF %':>8}{'RMSE':>11}{'E_N':>11}{'SNR':>9}{'rt SNR':>8}{'N':>9}"
        )
        for name in self.one_step:
            for what, table in (("one step", self.one_step), ("simulation", self.simulation)):
                if name in table:
                    q = table[name]
                    lines.append(
                        f"  {name:<12}{what:<12}{q.fit:8.2f}{q.vaf:8.2f}{q.rmse:11.4g}{q.e_n:11.4g}"
                        f"{q.snr:9.4g}{q.snr_amplitude:8.3g}{q.samples:9d}"
                    )
        for name, test in self.autocorrelations.items():
            lines.append(f"  residual of {name}: {'white' if test.passed else 'not white'}, {_evidence(test)}")
        for (name, channel), test in self.cross_correlations.items():
            verdict = "independent of" if test.passed else "depends on"
            lines.append(f"  residual of {name}: {verdict} {channel}, {_evidence(test)}")
        if self.structure is not None:
            ratios = ", ".join(f"{name} {ratio:.3g}" for name, ratio in self.structure.ratios.items())
            verdict = "looks Hammerstein" if self.structure.passed else "does not look Hammerstein"
            lines.append(
                f"  structure: {verdict}, p = {self.structure.p_value:.2g}, free Theta saves "
                f"{100 * self.structure.saving:.2g} % of the squared error; sigma_2/sigma_1: {ratios}"
            )
        return "\n".join([*lines, *(f"  note: {note}" for note in self.notes)])


def validate(model: Any, data: Data, x0: Any = "fit", lags: int = LAGS) -> Validation:
    """Compare a model with a record, preferably one it was not estimated from.

    Args:
        model: the model.
        data: the record; detrended or scaled data are taken back to raw units first.
        x0: initial state of the simulation, as in `HammersteinARX.simulate`.
        lags: largest lag of the residual tests; fewer when the record is shorter than four times that.

    Raises:
        DataError: other channels or another sampling time than the model's, or no sample that can be predicted.
        StructureError: an x0 that cannot be read.

    Warns:
        DataWarning: the record does not look Hammerstein or does not determine a free model, the model is unstable, no
            simulation is possible, or inputs lie outside the interval of their basis; also in `Validation.notes`.
    """
    raw = data if data.transform.is_identity else data.raw()
    predicted = one_step(model, raw)
    residuals = tuple(e.y - p for e, p in zip(raw.experiments, predicted))
    present = np.sum([np.sum(~np.isnan(r), axis=0) for r in residuals], axis=0)
    if not present.all():
        name = model.outputs[int(np.argmin(present))]
        raise DataError(
            f"No sample of output {name!r} can be predicted: the model looks back {model.memory} samples, the longest "
            f"experiment has {max(e.n_samples for e in raw.experiments)}. Use a longer record, or one with fewer gaps."
        )
    lags = max(1, min(lags, int(present.min()) // 4))
    errors = _measured(raw, predicted)
    tested = [
        np.where([_negligible(errors[name], raw, o) for o, name in enumerate(raw.outputs)], 0.0, r) for r in residuals
    ]
    notes: list[str] = []
    free = _simulated(model, raw, x0, notes)
    outside = _outside(model, raw, notes)
    structure = _structure(model, raw, notes)
    for note in notes:
        warnings.warn(note, DataWarning, stacklevel=2)
    return Validation(
        data=raw.name,
        one_step=errors,
        simulation=_measured(raw, free) if free else {},
        autocorrelations={
            name: autocorrelation([r[:, o] for r in tested], name, lags) for o, name in enumerate(model.outputs)
        },
        cross_correlations={
            (name, channel): cross_correlation(
                [r[:, o] for r in tested], [e.u[:, c] for e in raw.experiments], name, channel, lags
            )
            for o, name in enumerate(model.outputs)
            for c, channel in enumerate(model.inputs)
        },
        structure=structure,
        outside=outside,
        notes=tuple(notes),
        residuals=residuals,
        simulated=tuple(free),
    )


def fit_percent(y: Array, predicted: Array) -> Array:
    """Return 100 (1 - |y - yhat| / |y - mean y|) of every output, (l,), over the samples present in both.

    Args:
        y: (N, l) measured.
        predicted: (N, l) predicted or simulated.
    """
    fits = np.full(y.shape[1], np.nan)
    for o in range(y.shape[1]):
        here = ~(np.isnan(y[:, o]) | np.isnan(predicted[:, o]))
        if here.any() and np.ptp(y[here, o]) > 0:
            spread = np.linalg.norm(y[here, o] - y[here, o].mean())
            fits[o] = 100 * (1 - np.linalg.norm(y[here, o] - predicted[here, o]) / spread)
    return fits


def _measured(data: Data, predicted: Sequence[Array]) -> dict[str, Measures]:
    y, yhat = np.vstack([e.y for e in data.experiments]), np.vstack(list(predicted))
    return {name: Measures.of(y[:, o], yhat[:, o]) for o, name in enumerate(data.outputs)}


def _negligible(measures: Measures, data: Data, o: int) -> bool:
    """Whether the residual of output o is nothing but rounding, which is neither white nor independent of anything."""
    return measures.rmse <= ROUNDING * float(np.nanmax(np.abs(np.vstack([e.y[:, [o]] for e in data.experiments]))))


def _simulated(model: Any, data: Data, x0: Any, notes: list[str]) -> list[Array]:
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", DataWarning)
            outputs = simulated(model, data, x0=x0)
    except DataError as error:
        notes.append(f"No simulation. {error}")
        return []
    notes.extend(str(w.message) for w in caught)
    return outputs


def _outside(model: Any, data: Data, notes: list[str]) -> dict[str, float]:
    shares = {}
    for function in static_functions(model):
        c, name, basis = function.channel, function.name, function.nonlinearity.basis
        samples = np.concatenate([(e.y if function.fed_back else e.u)[:, c] for e in data.experiments])
        shares[name] = basis.n_outside(samples) / max(int(np.sum(~np.isnan(samples))), 1)
        if shares[name] and basis.interval is not None:
            lo, hi = basis.interval
            channel = "output" if function.fed_back else "input"
            notes.append(
                f"{100 * shares[name]:.2g} % of {channel} {name!r} lies outside [{lo:g}, {hi:g}], where "
                f"{function.word} was identified; there it is set to {basis.outside!r}."
            )
    return shares


def _structure(model: Any, data: Data, notes: list[str]) -> Structure | None:
    if not hasattr(model, "layout"):  # the test compares regressions
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)
            found = structure_test(collect(data, model.layout))
    except RankError as error:
        notes.append(f"No structure test: this record does not determine a free model. {error}")
        return None
    if not found.passed:
        notes.append(
            f"The record does not look Hammerstein: giving up rank one saves {100 * found.saving:.2g} % of the squared "
            f"one-step error (p = {found.p_value:.1g}). Consider another structure, more lags or another basis."
        )
    return found


def _evidence(test: Correlation) -> str:
    if np.isnan(test.p_value):
        return "nothing to test (a constant signal or rounding)"
    return (
        f"p = {test.p_value:.2g}, {test.outside} of {test.lags.size - (test.input is None)} lags outside the 99 % band"
    )

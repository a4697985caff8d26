"""Innovations of the steady Kalman predictor, whitened: white with unit covariance for a healthy plant."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optid.arrays import Array, as_list, compact, one_or_all
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.models import HammersteinSS
from optid.models import state_simulation as simulation
from optid.models.experiments import in_units_of
from optid.models.kalman import kalman_gain
from optid.models.recursions import SHORT, propagate
from optid.models.roots import spectral_radius
from optid.phrases import p_value

LAGS = 20  # lags of the whiteness test
NOT_WHITE = 1e-3  # p-value of whiteness below which thresholds are refused
FORGETS = 1 - 1e-9  # largest spectral radius of A - K C

ADDED = 1e-2
"""Measurement noise, as a share of the innovations, that is added where the noise has no power at some frequency."""

OTHER_SCALE = 1.3  # ratio of the innovations to their predicted size above which thresholds are refused


@dataclass(frozen=True, eq=False)
class Predictor:
    """The steady predictor of a model, x+ = A x + ... + K (y - C x - ...)."""

    A: Array  # (n, n) of the model
    C: Array  # (l, n) of the model
    L: Array  # (n, l) output injection of the model
    K: Array  # (n, l) gain
    covariance: Array  # (l, l) of the innovations
    root: Array  # (l, l) lower triangular; root times an innovation has unit covariance
    silent: int = 0  # number of axes of the innovations left out, because declared disturbances affect them

    @property
    def F(self) -> Array:  # noqa: N802 - the field's letter
        """A - K C, the transition of the prediction error."""
        return np.asarray(self.A - self.K @ self.C)

    @property
    def settling(self) -> int:
        """Samples after which a past error has decayed to 1e-6."""
        radius = float(np.max(np.abs(np.linalg.eigvals(self.F)), initial=0.0))
        return len(self.F) if radius == 0 else len(self.F) + int(np.ceil(np.log(1e-6) / np.log(min(radius, 1 - 1e-9))))

    def respond(self, into_state: Array, into_output: Array, present: Array | None = None,
                A: Array | None = None) -> Array:
        """Return the response (N, l, d) of the innovations to additions to x(k) (N, n, d) and to y(k) (N, l, d).

        All readings are `present` (N, l) by default, and the plant does not change; else it has A (N, n, n).
        """
        if A is None and len(into_output) <= SHORT and (present is None or present.all()):
            drive = into_state.copy()
            drive[1:] -= self.K @ into_output[:-1]
            return into_output + self.C @ propagate(self.F, drive)
        from optid.faults import kernels

        shown = np.ones(into_output.shape[:2], dtype=bool) if present is None else present
        followed = self.A[None] if A is None else A
        A, C, K, L, state, output = map(compact, (followed, self.C, self.K, self.L, into_state, into_output))
        return kernels.respond(A, C, K, L, shown, state, output)

    def jumps(self, onset: int, present: Array) -> Array:
        """Return the response (N, l, n) of the innovations of readings (N, l) to unit jumps of the state at `onset`."""
        (count, l), n = present.shape, len(self.A)  # noqa: E741
        into_state = np.zeros((count, n, n))
        into_state[onset] = np.eye(n)
        return self.respond(into_state, np.zeros((count, l, n)), present)

    def whiten(self, innovations: Array, present: Array | None = None) -> Array:
        """Return whitened innovations (N, l) or (N, l, d), zero where a reading is missing.

        The remaining readings of a sample are whitened by the covariance among themselves.
        """
        if present is None or present.all():
            return np.einsum("ij,nj...->ni...", self.root, innovations)
        result = np.zeros(innovations.shape)
        patterns, which = np.unique(present, axis=0, return_inverse=True)
        for number, pattern in enumerate(patterns):
            rows, there = np.flatnonzero(which.ravel() == number), np.flatnonzero(pattern)
            if there.size:
                block = _root(self.covariance[np.ix_(there, there)])
                result[np.ix_(rows, there)] = np.einsum("ij,nj...->ni...", block, innovations[np.ix_(rows, there)])
        return result

    def whitened_columns(self, changes: Array, present: Array) -> Array:
        """Return changes (N, l, d) of the innovations, whitened, as columns (N l, d)."""
        return self.whiten(changes, present).reshape(present.size, -1)


def predictor(model: HammersteinSS) -> Predictor:
    """Return the steady Kalman predictor of a model with noise covariances.

    Raises:
        StructureError: no noise covariances, or no stabilising gain.

    Warns:
        DataWarning: a noise without power at some frequency.
    """
    if model.levels is not None:
        raise StructureError("Every record of this model has its own level, which a fault of a sensor would pass "
                             "for: choose the level of the plant by model.at_level(constant).")
    if model.noise is None:
        raise StructureError("The model has no noise covariances, which give the scale of its innovations: estimate "
                             "them with optid.noise.with_noise(model, data).")
    noise, failure = model.noise, ""
    for added in (0.0, ADDED):
        try:
            steady = kalman_gain(model.A, model.C, noise.Q, noise.R + added * noise.innovation, noise.S)
        except StructureError as error:
            failure = failure or str(error)
            continue
        if spectral_radius(model.A - steady.K @ model.C) <= FORGETS:
            if added:
                warnings.warn(
                    "The noise of the model has no power at some frequency, so that its predictor would never forget: "
                    f"measurement noise of {100 * ADDED:g} % of the innovations is added.", DataWarning, stacklevel=2)
            return Predictor(model.A, model.C, model.L, steady.K, steady.innovation, _root(steady.innovation))
        failure = failure or "The Riccati equation has no stabilising solution: a mode stays on the unit circle."
    raise StructureError(failure)


@dataclass(frozen=True, eq=False)
class Nuisance:
    """(I + M M')^(-1/2) = I - U diag(1 - 1/sqrt(1 + s^2)) U' with the singular values s of M."""

    U: Array  # (N l, q) orthonormal
    s: Array  # (q,)
    unknown: int = 0  # number of unknown axes beside the initial state

    @property
    def log_scale(self) -> float:
        """Logarithm of the determinant of (I + M M')^(1/2)."""
        return 0.5 * float(np.sum(np.log1p(self.s**2)))

    def __call__(self, r: Array) -> Array:
        """Whiten (N, l) or (N, l, d)."""
        flat = r.reshape(len(self.U), -1)
        drop = 1 - 1 / np.sqrt(1 + self.s**2)
        return np.asarray((flat - self.U @ (drop[:, None] * (self.U.T @ flat))).reshape(r.shape))


@dataclass(frozen=True, eq=False)
class Whitened:
    """Whitened innovations of one record."""

    r: Array  # (N, l), zero where a reading is missing; N(0, I) for a healthy plant
    innovations: Array  # (N, l) before whitening, NaN where a reading is missing
    present: Array  # (N, l) whether there is a reading
    predictor: Predictor  # the predictor behind them
    outputs: tuple[str, ...]  # names of the outputs
    # effect of uncertain parameters on the innovations, removed from r; None for a model taken as exact
    nuisance: Nuisance | None = None
    # (N, n) of the predictor, for faults that change the matrices; None where they are not known
    states: Array | None = None

    def whiten_signature(self, signature: Array) -> Array:
        """Return a signature (N, l, d) of the innovations, whitened like r."""
        white = self.predictor.whiten(signature, self.present)
        return white if self.nuisance is None else self.nuisance(white)


def check_window(model: HammersteinSS, whitened: Whitened, what: str, onset: int = 0, longest: float = np.inf) -> None:
    """Refuse whitened innovations that a search or a test (`what`) of at most `longest` readings cannot take.

    Raises:
        StructureError: several experiments, an onset of a change outside the window, a window that is too long.
        DataError: other outputs than the model's, innovations that are not finite.
    """
    if not isinstance(whitened, Whitened):
        raise StructureError(f"{what} takes the whitened innovations of one experiment, as returned by "
                             "optid.faults.whiten: pass the experiments of a record one by one.")
    count, outputs = whitened.r.shape
    if outputs != model.l:
        raise DataError(f"The window has {outputs} outputs; the dictionary is of {model.l}.")
    if onset != int(onset) or not 0 <= onset < count:
        raise StructureError(f"onset={onset!r} lies outside the window of {count} samples.")
    if whitened.r.size > longest:
        raise StructureError(
            f"{whitened.r.size} readings are too many for this test ({longest}): use a shorter window.")
    if not np.isfinite(whitened.r).all():
        k, o = np.argwhere(~np.isfinite(whitened.r))[0]
        raise DataError(f"The innovation of output {whitened.outputs[o]!r} at sample {k} is not finite.")


def whiten(model: HammersteinSS, data: Data, *, x0: Any = "fit", uncertainty: Any = None,
           scale: Predictor | None = None) -> Any:
    """Return the whitened innovations of a record; a tuple for several experiments.

    A missing reading is not used for correction.

    Args:
        model: a model with noise covariances.
        data: the record; detrended or scaled data are taken back to raw units.
        x0: "fit" (least squares of the innovations), "zero", or the state (n,), one for each experiment.
        uncertainty: of an identified model (`model_uncertainty`), treated as noise; its predictor is used.
        scale: a predictor whose covariance replaces that of the model, as `Health.predictor` returns.

    Raises:
        DataError: a missing input, other channels or sampling time than the model's.
        StructureError: no noise covariances.
    """
    steady = scale or (predictor(model) if uncertainty is None else uncertainty.predictor)
    gained, raw, fitted = replace(model, K=steady.K), in_units_of(model, data), isinstance(x0, str) and x0 == "fit"
    given = gained.initial_state(raw, "predict") if fitted else x0
    predictions = as_list(gained.predict(raw, x0=given))
    starts = [np.zeros(model.nx)] * len(predictions) if isinstance(given, str) else (
        [given] if len(predictions) == 1 else given)
    found = []
    for part, prediction, start in zip(raw.experiments, predictions, starts):
        present, start = ~np.isnan(part.y), np.asarray(start, dtype=float)
        states = simulation.run_states(simulation.prepare_run(gained, "predict", part.u, part.y, None, ""), start)
        innovations = part.y - prediction
        r = steady.whiten(np.where(present, innovations, 0.0), present)
        white = Whitened(r, innovations, present, steady, model.outputs, states=states)
        if uncertainty is not None:
            nuisance = uncertainty.nuisance(part, start, present, free_start=fitted)
            white = replace(white, r=nuisance(r), nuisance=nuisance)
        found.append(white)
    return one_or_all(found)


@dataclass(frozen=True, eq=False)
class Health:
    """Whiteness and size of the innovations of a healthy record, compared with the model."""

    ratios: dict[str, float]  # {output: size of its innovations over the predicted one}
    p_value: float  # of the hypothesis that the innovations are white (portmanteau test of Hosking)
    lags: int  # its lags
    samples: int  # number of complete samples
    covariance: Array  # (l, l) of the whitened innovations; the identity is expected

    @property
    def ratio(self) -> float:
        """The largest ratio, in any direction of the outputs."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))

    @property
    def white(self) -> bool:
        """Whether whiteness is not rejected."""
        return not self.p_value < NOT_WHITE

    @property
    def scaled(self) -> bool:
        """Whether the innovations have the predicted size."""
        return self.ratio <= OTHER_SCALE

    def __str__(self) -> str:
        """State the p-value and the sizes."""
        sizes = ", ".join(f"{name} {ratio:.3f}" for name, ratio in self.ratios.items())
        return (
            f"innovations over {self.samples} samples: p-value of whiteness {p_value(self.p_value, 3)} "
            f"({self.lags} lags)\n"
            f"size over the predicted one: {sizes}; largest {self.ratio:.3f}")

    def predictor(self, steady: Predictor, *, rescale: bool = False) -> Predictor:
        """Return the predictor to use for thresholds.

        Args:
            steady: the predictor that was judged.
            rescale: take the covariance of the innovations from the healthy record.

        Raises:
            DataError: innovations that are not white, or larger than predicted without `rescale`.

        Warns:
            DataWarning: innovations much smaller than predicted: thresholds are conservative.
        """
        if not self.white:
            raise DataError(
                f"The innovations of the healthy record are not white (p-value {p_value(self.p_value)}): thresholds "
                "from this model would be wrong. Fit the model again, include the uncertainty of the identified "
                "model (model_uncertainty), or watch with Monitor(..., healthy=record), which takes the noise from it.")
        if rescale:
            covariance = np.linalg.solve(steady.root, np.linalg.solve(steady.root, self.covariance).T)
            covariance = (covariance + covariance.T) / 2
            return replace(steady, covariance=covariance, root=_root(covariance))
        if not self.scaled:
            raise DataError(
                f"The innovations of the healthy record are {self.ratio:.2f} times as large as the model predicts "
                f"({', '.join(f'{name} {ratio:.2f}' for name, ratio in self.ratios.items())}): the scale of the noise "
                "is wrong. Pass rescale=True to take it from this record, or estimate the noise again.")
        if self.ratio < 1 / OTHER_SCALE:
            warnings.warn(
                f"The innovations are only {self.ratio:.2f} times as large as the model predicts: small faults will be "
                "missed. rescale=True takes the scale from the healthy record.",
                DataWarning,
                stacklevel=2,
            )
        return steady


def health(whitened: Any, lags: int = LAGS) -> Health:
    """Test the whitened innovations of a healthy record for whiteness and for the predicted size.

    Args:
        whitened: from `whiten`, one or several experiments.
        lags: of the whiteness test; fewer in a short record.

    Raises:
        DataError: fewer than 10 complete samples per output.
    """
    from scipy.special import chdtrc

    parts = [whitened] if isinstance(whitened, Whitened) else list(whitened)
    complete: list[Any] = [part.present.all(axis=1) for part in parts]
    rows = np.vstack([part.r[there] for part, there in zip(parts, complete)])
    count, outputs = rows.shape
    if count < 10 * outputs:
        raise DataError(f"{count} complete samples are too few to judge the noise; {10 * outputs} are required.")
    covariance = rows.T @ rows / count
    lags = max(1, min(lags, count // (4 * outputs)))
    root = _root(covariance + 1e-300 * np.eye(outputs))
    statistic = 0.0
    signals = [np.where(there[:, None], part.r @ root.T, 0.0) for part, there in zip(parts, complete)]
    for lag in range(1, lags + 1):
        total, pairs = np.zeros((outputs, outputs)), 0
        for signal, there in zip(signals, complete):
            if len(signal) > lag:
                total += signal[lag:].T @ signal[:-lag]
                pairs += int(np.sum(there[lag:] & there[:-lag]))
        statistic += float(np.sum(total**2)) / max(pairs, 1)
    seen = [np.where(part.present, part.innovations, 0.0) for part in parts]
    squares = np.sum([np.sum(one**2, axis=0) for one in seen], axis=0)
    readings = np.maximum(np.sum([part.present.sum(axis=0) for part in parts], axis=0), 1)
    sizes = np.sqrt(squares / readings / np.diag(parts[0].predictor.covariance)).tolist()
    p_value = float(chdtrc(outputs**2 * lags, statistic))
    return Health(dict(zip(parts[0].outputs, sizes)), p_value, lags, count, covariance)


def _root(covariance: Array) -> Array:
    """Lower triangular inverse of the Cholesky factor."""
    from scipy.linalg import solve_triangular

    return np.asarray(solve_triangular(np.linalg.cholesky(covariance), np.eye(len(covariance)), lower=True))

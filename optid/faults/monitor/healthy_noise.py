"""The noise of healthy records: its colour and its size."""

from dataclasses import replace
from typing import Any

import numpy as np

from optid.arrays import Array, as_list
from optid.data.record import Data
from optid.errors import DataError, StructureError
from optid.faults.false_alarms import blocks_of, check_rise
from optid.faults.nuisance import ModelUncertainty
from optid.faults.ranges import outside, unsure_since
from optid.faults.signatures import Dictionary
from optid.faults.whitening import OTHER_SCALE, Predictor, health, whiten
from optid.models import NoiseCovariances
from optid.models.experiments import in_units_of
from optid.phrases import p_equals

ORDERS = 1, 2, 3, 4, 6, 8  # orders of the autoregressions tried for innovations that are not white
LONGEST = 3000  # samples of the identification along which the effect of uncertain parameters is simulated
# time constant of a filter that follows slow disturbances, as a share of theirs, and their fewest samples
FOLLOWED, SLOWEST = 1 / 60, 600
BLOCK = 100  # samples of the stretches whose energies are compared


def parameter_effect(known: ModelUncertainty, data: Data, steady: Predictor) -> tuple[Array, Array]:
    """Return the effect of uncertain parameters (T, l, q + 1), and the functions of the inputs (T, r).

    The effect consists of signatures of parameters of unit variance and, last, that of their deviation from the most
    likely ones.

    The innovations are those of the record of the identification, whitened by the predictor of the uncertainty or by
    that with the colour of a healthy record, less what an initial state explains: where the predictor forgets slowly, a
    parameter that is confounded with it has a large effect that no monitor sees after its start.
    """
    raw = in_units_of(known.model, data)
    given = known.model.initial_state(raw, "predict")
    effects, inputs = [], []
    for part, x0 in zip(raw.experiments, as_list(given)):
        here = replace(part, u=part.u[:LONGEST], y=part.y[:LONGEST])
        there = ~np.isnan(here.y)
        by_parameter, by_start = (known.predictor.whitened_columns(effect, there) for effect in
                                  known.sensitivities(here, x0, there))
        by_parameter -= by_start @ np.linalg.lstsq(by_start, by_parameter, rcond=None)[0]
        raw_effect = np.linalg.pinv(known.predictor.root) @ by_parameter.reshape(*here.y.shape, -1)
        n, l = known.model.nx, here.y.shape[1]  # noqa: E741
        if steady.A.shape[0] > n:  # the last states shape the innovations of the model
            shape = Predictor(steady.A[n:, n:], steady.C[:, n:], np.zeros((len(steady.A) - n, l)), steady.K[n:],
                              steady.covariance, steady.root)
            raw_effect = shape.respond(np.zeros((len(here.y), len(shape.A), raw_effect.shape[2])), raw_effect)
        effects.append(steady.root @ raw_effect)
        inputs.append(known.model.expand_inputs(here.u))
    effect = np.concatenate(effects)
    if not known.deviation:
        effect = np.concatenate([effect, np.zeros((*effect.shape[:2], 1))], axis=2)
    return effect, np.nan_to_num(np.concatenate(inputs))


def with_noise_of(found: Dictionary, healthy: Data) -> tuple[Dictionary, str]:
    """Return a dictionary with the noise of a healthy record, and a remark on the change.

    Samples after an input left its identified range are not used. Innovations that are white and of the predicted size
    leave the dictionary unchanged. Otherwise they get an autoregression, whose order is chosen by BIC; its past
    innovations are states beside those of the plant.
    """
    steady = found.predictor
    if steady.silent:  # the innovations along declared disturbances are not judged; thresholds are raised instead
        return found, ""
    whole: list[Any] = as_list(whiten(found.model, healthy, scale=steady))
    parts = [replace(part, present=part.present & ~unsure_since(found.model, record.u, steady.settling)[:, None])
             for part, record in zip(whole, healthy.raw().experiments)]
    try:
        judged = health(parts)
    except DataError as error:
        if left := [str(one) for record in healthy.raw().experiments for one in outside(found.model, record.u)]:
            raise DataError(f"{' '.join(left)} Too little of the healthy record remains ({error}): identify the model "
                            "over the wider range, or give a record inside it.") from error
        raise
    if judged.white and judged.ratio <= OTHER_SCALE and judged.ratio >= 1 / OTHER_SCALE:
        return found, ""
    for o, name in enumerate(found.model.outputs):
        energies = [blocks_of(part.r[:, o] ** 2, BLOCK).mean(axis=1) for part in parts]
        every = np.concatenate(energies)
        if usual := float(np.median(every)) if every.size else 0.0:
            check_rise(float(every.mean()) / usual, f"the energy of the innovations of {name}", energies, usual, BLOCK)
    signals = [np.where(part.present, part.innovations, np.nan) for part in parts]
    taps, covariance = _autoregression(signals, (0,) if judged.white else ORDERS)
    said = (f"on the healthy record the innovations are not those of the model (whiteness {p_equals(judged.p_value)}, "
            f"size {judged.ratio:.2f} times the predicted one): its noise is taken from that record"
            + (f", as an autoregression of order {len(taps)}." if taps else "."))
    return _recoloured(found, taps, covariance), said


def _autoregression(signals: list[Array], orders: tuple[int, ...]) -> tuple[list[Array], Array]:
    """Taps (l, l) and covariance of the residuals, by least squares; the order by BIC."""
    l, best = signals[0].shape[1], (np.inf, [], np.eye(1))  # noqa: E741
    most = max(orders)
    for order in orders:
        rows = np.vstack([np.hstack([s[most - i : len(s) - i] for i in range(order + 1)]) for s in signals])
        now, past = np.split(rows[~np.isnan(rows).any(axis=1)], [l], axis=1)
        weights = np.linalg.lstsq(past, now, rcond=None)[0]
        left = now - past @ weights
        covariance = left.T @ left / len(left)
        score = len(left) * float(np.linalg.slogdet(covariance)[1]) + order * l * l * np.log(len(left))
        if score < best[0]:
            best = score, [part.T for part in np.split(weights, max(order, 1))][:order], covariance
    return best[1], best[2]


def _recoloured(found: Dictionary, taps: list[Array], covariance: Array) -> Dictionary:
    """Augment the state by an autoregression of the innovations."""
    l, p = found.model.l, len(taps)  # noqa: E741
    mix = np.hstack(taps) if taps else np.zeros((l, 0))
    A, K = np.eye(p * l, k=-l), np.eye(p * l, l)
    A[:l] = mix[: p * l]
    return _shaped(found, A, mix, K, covariance)


def without_drift(found: Dictionary, samples: float) -> Dictionary:
    """Return a dictionary whose predictor follows slow disturbances of the outputs.

    The innovations e of the model count as a line that changes slowly, s+ = s + v + a w, v+ = v + b w, and a white rest
    w = e - s. Both poles of the filter are 1 - 1 / (`FOLLOWED` samples): a hundredth, (2 pi `FOLLOWED`)^2, is left of a
    period of so many samples, and a constant fault is forgotten with the same poles. Fewer than `SLOWEST` samples are a
    `StructureError`.
    """
    if not samples >= SLOWEST:
        raise StructureError(f"drift={samples!r}: slow disturbances must take {SLOWEST} samples at least.")
    l, pole = found.model.l, 1 - 1 / (FOLLOWED * samples)  # noqa: E741
    A = np.kron(np.array([[1.0, 1.0], [0.0, 1.0]]), np.eye(l))
    K = np.kron([[1 - pole**2], [(1 - pole) ** 2]], np.eye(l))
    return _shaped(found, A, np.kron([[1.0, 0.0]], np.eye(l)), K, found.predictor.covariance)


def _shaped(found: Dictionary, A_s: Array, C_s: Array, K_s: Array, covariance: Array) -> Dictionary:
    """Augment the state: the innovations of the model are e = C_s s + w, s+ = A_s s + K_s w, w of this covariance."""
    model, steady = found.model, found.predictor
    n, more = model.nx, len(A_s)
    A = np.zeros((n + more, n + more))
    A[:n, :n], A[:n, n:], A[n:, n:] = model.A, steady.K @ C_s, A_s
    C, K = np.hstack([model.C, C_s]), np.vstack([steady.K, K_s])

    def padded(part: Array) -> Array:
        return np.vstack([part, np.zeros((more, part.shape[1]))])

    noise = NoiseCovariances(K @ covariance @ K.T, covariance, K @ covariance, covariance)
    wider = replace(model, A=A, B=padded(model.B), C=C, E=padded(model.E), L=padded(model.L), K=K, noise=noise,
                    offset_x=np.concatenate([model.offset_x, np.zeros(more)]))
    lower = np.linalg.inv(np.linalg.cholesky(covariance))
    predictor = Predictor(A, C, wider.L, K, covariance, np.tril(lower))
    candidates = tuple(replace(c, into_state=padded(c.into_state)) for c in found.candidates)
    return replace(found, model=wider, predictor=predictor, candidates=candidates)

"""What an excitation promises of the record that will be taken with it."""

import warnings
from dataclasses import dataclass

import numpy as np

from optid.arrays import Array
from optid.bases import Bases, FeedbackBases
from optid.data.channels import count_levels
from optid.data.record import Data
from optid.errors import DataWarning
from optid.identify.design.response import FrequencyResponse
from optid.identify.design.rules import Check, check_condition, check_feedback, check_levels, check_lines
from optid.signals import crest_factor
from optid.statistics.expansion import Expansion, expand
from optid.statistics.hankel import hankel_statistics


@dataclass(frozen=True)
class Promise:
    """What may be expected of a record taken with an excitation.

    Attributes:
        condition: expected condition number of the windows of the expanded regressor, columns scaled.
        rows: samples of a window.
        functions: signals in the expanded regressor.
        levels: distinct values of each input (counting stops at 1000).
        band: lowest and highest frequency aimed at, 1/unit of dt.
        amplitude: (low, high) of each input.
        crest: crest factor of each input.
        outputs: expected standard deviation of each output.
        checks: the rules of design, held against this excitation.
        how: how it was computed.
    """

    condition: float
    rows: int
    functions: int
    levels: tuple[int, ...]
    band: tuple[float, float]
    amplitude: tuple[tuple[float, float], ...]
    crest: tuple[float, ...]
    outputs: tuple[float, ...]
    checks: tuple[Check, ...]
    how: str

    def __str__(self) -> str:
        facts = {
            "expected condition number": f"{self.condition:.3g}  of {self.functions} functions at {self.rows} lags",
            "levels": ", ".join(map(str, self.levels)),
            "band": f"{self.band[0]:.4g} to {self.band[1]:.4g}",
            "amplitude": ", ".join(f"{low:.4g} to {high:.4g}" for low, high in self.amplitude),
            "crest factor": ", ".join(f"{c:.3g}" for c in self.crest),
            "standard deviation of y": ", ".join(f"{s:.3g}" for s in self.outputs) + " (expected)"}
        lines = [*facts.items(), *((check.rule, check) for check in self.checks), ("how", self.how)]
        return "\n".join(f"{name:<26} {value}" for name, value in lines)


def promised(u: Array, like: Data, measured: FrequencyResponse, band: tuple[float, float], basis: Bases,
             feedback_basis: FeedbackBases, rows: int, few: int, seed: int) -> Promise:
    """Predict what a record taken with u would be like and hold it against the rules.

    Without functions of the outputs the condition number is that of the designed signal itself, so it holds for every
    record taken with it. Otherwise the outputs are predicted (`predicted`).

    Args:
        u: (N, m) excitation.
        like: a record of the plant.
        measured: its frequency response.
        band: aimed at.
        basis: of the inputs.
        feedback_basis: of the outputs, or None.
        rows: lags.
        few: levels below which a curve counts as interpolation.
        seed: of the predicted disturbance.

    Raises:
        RankError: an excitation shorter than a window.
    """
    y = predicted(u, like, measured, seed)
    record = Data(u, y, like.dt, inputs=list(like.inputs), outputs=list(like.outputs))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # functions of outputs that are nearly linear: `check_feedback`
        expansion = expand(record, basis, feedback_basis)
    condition = expanded_condition(record, expansion, rows)
    checks = [check_levels(name, u[:, c], expansion.inputs[c], few) for c, name in enumerate(like.inputs)]
    checks += [check_lines(name, [u[:, c]], expansion.inputs[c], rows) for c, name in enumerate(like.inputs)]
    checks += [check_feedback(like.outputs[family.output], family.share) for family in expansion.feedback]
    checks.append(check_condition(condition))
    how = "from the designed signal itself, which the plant does not change"
    if expansion.feedback:
        how = (f"from the designed signal and outputs predicted through the frequency response of "
               f"{like.name or 'the record'} ({measured.segments} segments) with its disturbance; a plant that is far "
               "from linear will differ")
    return Promise(condition, rows, expansion.p + expansion.q, tuple(count_levels(x) for x in u.T), band,
                   tuple((float(x.min()), float(x.max())) for x in u.T), tuple(crest_factor(x) for x in u.T),
                   tuple(float(s) for s in y.std(axis=0)), tuple(checks), how)


def predicted(u: Array, like: Data, measured: FrequencyResponse, seed: int) -> Array:
    """Predict the outputs (N, l) in the steady state, linearly, with a disturbance of the measured spectrum.

    The mean of the outputs is that of the record.
    """
    n = len(u)
    frequency: Array = np.arange(1, n // 2 + 1) / (n * like.dt)
    spectrum = np.fft.rfft(u - u.mean(axis=0), axis=0)[1:]
    response = np.einsum("kij,kj->ki", measured.at(frequency), spectrum)
    density = np.column_stack([np.interp(frequency, measured.frequency, d) for d in measured.disturbance.T])
    rng = np.random.default_rng(seed)
    # A one-sided density S gives spectral lines of mean square S n / (2 dt).
    noise = rng.standard_normal((2, *density.shape)) * np.sqrt(density * n / (4 * like.dt))
    lines = np.concatenate([np.zeros((1, like.l)), response + noise[0] + 1j * noise[1]])
    mean = np.nanmean(np.concatenate([e.y for e in like.experiments]), axis=0)
    return mean + np.fft.irfft(lines, n, axis=0)


def expanded_condition(data: Data, expansion: Expansion, rows: int) -> float:
    """Return the condition number of all windows of the expanded signals about their means, columns scaled.

    Args:
        data: the record.
        expansion: of it.
        rows: block rows, the samples of a window.

    Returns:
        An estimate in the 1-norm; inf when the windows are singular.

    Raises:
        RankError: no complete window.
    """
    count = expansion.p + expansion.q
    records = [np.hstack([e.u, e.y]) for e in data.experiments]
    return hankel_statistics(records, rows, lambda raw: expansion(raw)[:, :count], names=expansion.names[:count],
                             centre="mean").condition

"""Design an excitation for a plant of which one record exists, and predict the record taken with it."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optid import signals
from optid.arrays import Array, check_integer
from optid.bases import Bases, FeedbackBases
from optid.data.channels import count_levels, interval_text
from optid.data.record import Data
from optid.errors import DataError, DataWarning, StructureError, nearest
from optid.identify.design import rules
from optid.identify.design.response import FrequencyResponse, frequency_response
from optid.statistics.expansion import Expansion, expand
from optid.statistics.hankel import hankel_statistics

KINDS = ("multisine", "chirp", "noise", "levels")
TWO_LEVELS = "two levels cannot identify a static nonlinearity: any function is a straight line there"
REFUSED = {"prbs": TWO_LEVELS, "binary": TWO_LEVELS,
           "sinusoid": "a sinusoid through a polynomial of degree p has p harmonics and excites 2 p + 1 regressors"}
SWEEPS = 4  # sweeps of a chirp
FAINT = 0.05  # a frequency belongs to the band when its measured gain is above this share of the largest
TRUSTED = 0.5  # smallest coherence of a frequency in the band
WANTED, WIDER = 1e4, 1.3  # a band that is not given grows by this factor until the condition number is no larger
BOOST = 4.0  # largest ratio of the spectral weights of shaping


@dataclass(frozen=True, eq=False)
class Excitation:
    """An excitation (N, m) of a kind, read-only, and the expected properties of a record taken with it.

    Attributes:
        condition: expected condition number of the windows of the expanded regressor, columns scaled.
        rows: samples of a window.
        functions: signals in the expanded regressor.
        band: lowest and highest frequency aimed at, 1/unit of dt.
        outputs: expected standard deviation of each output.
        checks: results of the rules of design.
        how: computation of the condition number.
        time_unit: unit of dt, "" where it is unknown.
    """

    u: Array
    dt: float
    inputs: tuple[str, ...]
    kind: str
    condition: float
    rows: int
    functions: int
    band: tuple[float, float]
    outputs: tuple[float, ...]
    checks: tuple[rules.Check, ...]
    how: str
    time_unit: str = ""

    def __str__(self) -> str:
        unit = "Hz" if self.time_unit == "s" else "cycles per sample"
        facts = {
            "expected condition number": f"{self.condition:.3g}  of {self.functions} functions at {self.rows} lags",
            "levels": ", ".join(str(count_levels(x)) for x in self.u.T),
            "band": f"{self.band[0]:.4g} to {self.band[1]:.4g} {unit}",
            "amplitude": ", ".join(f"{x.min():.4g} to {x.max():.4g}" for x in self.u.T),
            "crest factor": ", ".join(f"{signals.crest_factor(x):.3g}" for x in self.u.T),
            "standard deviation of y": ", ".join(f"{s:.3g}" for s in self.outputs) + " (expected)"}
        lines = [*facts.items(), *((check.rule, check) for check in self.checks), ("how", self.how)]
        return "\n".join([f"{self.kind}, {len(self.u)} samples every {interval_text(self.dt, self.time_unit)}",
                          *(f"{name:<26} {value}" for name, value in lines)])

    def save(self, path: Path | str) -> Path:
        """Write time (samples where its unit is unknown) and inputs as CSV with a header, as `optid.read` reads it."""
        path = Path(path)
        columns = np.column_stack([self.dt * np.arange(len(self.u)), self.u])
        names = ["time" if self.time_unit else "sample", *self.inputs]
        # 15 digits: the values read back are those written, to rounding.
        np.savetxt(path, columns, fmt="%.15g", delimiter=",", header=",".join(names), comments="")
        return path


@dataclass(frozen=True)
class Waveform:
    """A kind of input signal; its range, shape and seed make it a signal.

    Attributes:
        kind: one of `KINDS`.
        n: samples.
        dt: sampling time.
        band: lowest and highest frequency, 1/unit of dt.
        levels: number of equally spaced values; None for any value.
        hold: samples for which "levels" holds a value.
        periods: of a multisine.
    """

    kind: str
    n: int
    dt: float
    band: tuple[float, float]
    levels: int | None
    hold: int
    periods: int

    def signal(self, span: tuple[float, float], weight: Callable[[Array], Array] | None, seed: int) -> Array:
        """Return one input (n,) that fills its range, weighted over frequency."""
        (low, high), n, dt = self.band, self.n, self.dt
        if self.kind == "multisine":
            return signals.multisine(n, *span, dt=dt, band=self.band, spectrum=weight, phases="random",
                                     periods=self.periods, seed=seed)
        if self.kind == "levels":
            return signals.uniform_levels(n, *span, hold=self.hold, seed=seed)
        if self.kind == "noise":
            edge = min(high, 0.499 / dt)
            return signals.band_limited_noise(n, *span, cutoff=(low, edge) if low > 0 else edge, dt=dt, seed=seed)
        sweep = -(-n // SWEEPS)
        # From one period per sweep, so that every sweep starts where the last one ended.
        first = max(low, 1 / (sweep * dt))
        x = signals.chirp(SWEEPS * sweep, f0=first, f1=max(high, first), dt=dt, repeats=SWEEPS)[:n]
        if weight is not None:
            x = x * weight(first + (high - first) * (np.arange(n) % sweep) / sweep)
            x = x / np.max(np.abs(x))
        return sum(span) / 2 + (span[1] - span[0]) / 2 * x

    def on_levels(self, u: Array, span: tuple[float, float]) -> Array:
        """Round a signal of any shape to the levels of its range."""
        if self.levels is None:
            return u
        low, step = span[0], (span[1] - span[0]) / (self.levels - 1)
        return low + step * np.round((u - low) / step)


def design(like: Data, kind: str = "multisine", *, n: int | None = None, levels: int | None = None,
           band: tuple[float, float] | None = None, amplitude: Any = None, shaped: bool = False,
           basis: Bases = "polynomial:4", feedback_basis: FeedbackBases = None, rows: int = 10, hold: int = 5,
           periods: int = 1, candidates: int = 8, seed: int = 0) -> Excitation:
    """Design an excitation for the plant of a record.

    Of several random realisations the one is kept whose expanded regressor (functions of the inputs, and of the outputs
    predicted through the measured frequency response) has the smallest condition number.

    Args:
        like: a record of the plant: channels, sampling time, ranges, frequency response and disturbance.
        kind: "multisine" (random phases), "chirp" (linear, four sweeps), "noise" (white in the band, clipped) or
            "levels" (uniform, held).
        n: samples; as many as the longest experiment of the record when not given.
        levels: number of equally spaced values that each input takes; any value when not given.
        band: lowest and highest frequency (1/unit of dt); when not given, from the lowest line to the last one with a
            measured gain above 5 % of its largest and a coherence above one half, wider where the condition number
            would exceed 10,000.
        amplitude: (low, high) for all inputs or one pair per input; the ranges of the record when not given.
        shaped: weight the spectrum (multisine) or the envelope (chirp) by the inverse of the measured gain, so that the
            outputs move alike at every frequency.
        basis: basis of the nonlinearities to be identified.
        feedback_basis: basis of the functions of the outputs; None without feedback.
        rows: lags of every function in the expanded regressor (block rows of a subspace method, nb of an
            equation-error one).
        hold: samples for which "levels" holds a value.
        periods: periods of a multisine.
        candidates: realisations to choose from.
        seed: of the first of them.

    Raises:
        StructureError: an unknown or refused kind, an argument out of its range, or an excitation that breaks a rule
            of design (too few levels, too few lines).
        DataError: a record that shows no frequency response.

    Warns:
        DataWarning: a weak excitation.
    """
    _check(kind, band, shaped, candidates=candidates, rows=rows, levels=levels)
    n = max(e.n_samples for e in like.experiments) if n is None else n
    ranges = _ranges(like, amplitude)
    measured = frequency_response(like)
    limits = (0.0, 0.5 / (hold * like.dt)) if kind == "levels" else _band(band, measured)
    waveform = Waveform(kind, n, like.dt, limits, levels, hold, periods)
    top = 0.9 * float(measured.frequency[-1])

    def weight(c: int, frequency: Array) -> Array:
        gain = measured.gain(frequency, c)
        return 1 / np.maximum(gain / gain.max(), 1 / BOOST)

    def realise(draw: int) -> Excitation:
        columns = [waveform.signal(span, partial(weight, c) if shaped else None, seed + draw * like.m + c)
                   for c, span in enumerate(ranges)]
        if kind == "chirp":  # inputs that sweep in step could not be distinguished
            columns = [np.roll(x, c * n // (SWEEPS * like.m)) for c, x in enumerate(columns)]
        u = np.column_stack([waveform.on_levels(x, span) for x, span in zip(columns, ranges)])
        record = Data(u, _predicted(u, like, measured, seed + draw), like.dt, inputs=like.inputs, outputs=like.outputs)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # outputs that are nearly linear: `rules.check_feedback`
            expansion = expand(record, basis, feedback_basis)
        return _expected(record, expansion, rows, waveform, like, measured.segments)

    while True:
        draws = map(realise, range(1 if kind == "chirp" else candidates))
        found = min(draws, key=lambda excitation: excitation.condition)
        low, high = waveform.band
        if found.condition <= WANTED or band is not None or kind == "levels" or high >= top:
            break
        waveform = replace(waveform, band=(low, min(WIDER * high, top)))
    for check in found.checks:
        if check.severity == "error":
            raise StructureError(f"this {kind} breaks a rule of design: {check.sentence}")
        if check.severity == "warning":
            warnings.warn(check.sentence, DataWarning, stacklevel=2)
    found.u.flags.writeable = False
    return found


def _check(kind: str, band: Any, shaped: bool, **counts: int | None) -> None:
    if kind in REFUSED:
        raise StructureError(f"kind {kind!r} is refused: {REFUSED[kind]}. Use one of {', '.join(KINDS)}.")
    if kind not in KINDS:
        raise StructureError(f"no excitation {kind!r}. {nearest(kind, KINDS)}")
    if band is not None and kind == "levels":
        raise StructureError("the band of levels follows from their holding time; set hold, or use kind 'noise'.")
    if shaped and kind not in ("multisine", "chirp"):
        raise StructureError(f"shaping changes the spectrum of a multisine or the envelope of a chirp, not {kind!r}.")
    for name, value in counts.items():
        if value is not None:
            check_integer(value, name, 2 if name == "levels" else 1)


def _ranges(like: Data, amplitude: Any) -> list[tuple[float, float]]:
    try:
        given = np.transpose(like.ranges()) if amplitude is None else np.asarray(amplitude, dtype=float)
        return [(float(low), float(high)) for low, high in np.broadcast_to(given, (like.m, 2))]
    except (TypeError, ValueError):
        raise StructureError(f"amplitude = {amplitude!r} must be (low, high), or one such pair for each of the "
                             f"{like.m} inputs.") from None


def _band(band: tuple[float, float] | None, measured: FrequencyResponse) -> tuple[float, float]:
    """Return the band as given, or from zero to where the measured gain of the widest input has become faint."""
    top = float(measured.frequency[-1])
    if band is None:
        f = measured.frequency
        gains = np.stack([measured.gain(f, c) for c in range(measured.response.shape[2])])
        gain = np.max(gains / gains.max(axis=1, keepdims=True), axis=0)
        inside = (gain > FAINT) & (measured.coherence.max(axis=1) > TRUSTED)
        if not inside.any():
            raise DataError("no frequency at which the inputs explain half of the power of an output: the record shows "
                            "no band; give one (band=, --band), or a record with more excitation.")
        return 0.0, float(min(f[np.flatnonzero(inside)[-1]], 0.9 * top))
    if len(band) != 2 or not 0 <= band[0] < band[1] <= top:
        raise StructureError(f"band = {band} must be two rising frequencies from 0 to half the sampling rate, {top:g}.")
    return float(band[0]), float(band[1])


def _expected(record: Data, expansion: Expansion, rows: int, waveform: Waveform, like: Data, segments: int
              ) -> Excitation:
    """Check a predicted record by the rules."""
    condition = expanded_condition(record, expansion, rows)
    channels = list(zip(like.inputs, record.u.T, expansion.inputs))
    few = rules.FEW_LEVELS if waveform.levels is None else 0  # no warning about a given number of levels
    checks = (*(rules.check_levels(name, x, one, few) for name, x, one in channels),
              *(rules.check_lines(name, [x], one, rows) for name, x, one in channels),
              *(rules.check_feedback(like.outputs[family.output], family.share) for family in expansion.feedback),
              rules.check_condition(condition))
    how = "from the designed signal"
    if expansion.feedback:
        how = (f"from the designed signal and outputs predicted through the frequency response of "
               f"{like.name or 'the record'} ({segments} segments) with its disturbance; a plant that is far "
               "from linear will differ")
    return Excitation(record.u, like.dt, like.inputs, waveform.kind, condition, rows, expansion.p + expansion.q,
                      waveform.band, tuple(float(s) for s in record.y.std(axis=0)), checks, how, like.time_unit)


def _predicted(u: Array, like: Data, measured: FrequencyResponse, seed: int) -> Array:
    """Predict the outputs (N, l) about the mean of the record: steady state, linear, with the measured disturbance."""
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
    """Return the condition number of all windows of so many samples of the expanded signals, columns scaled.

    It is that about their means, estimated in the 1-norm; inf when the windows are singular. A record without a
    complete window is a `RankError`.
    """
    count = expansion.p + expansion.q
    return hankel_statistics(data.records, rows, lambda raw: expansion(raw)[:, :count], names=expansion.names[:count],
                             centre="mean").condition

"""Excitation signals: (n,) float64 records that stay within an amplitude range.

Each takes the number of samples n, the smallest and the largest value low and high, where it needs them the sampling
time dt, which gives frequencies their unit, and the seed of what is random, besides the further arguments that it
describes. An argument out of its range raises a `StructureError` that names it.

A static nonlinearity is identified only where the input goes: a binary signal cannot show it (it collapses to an affine
function), and one sinusoid of a polynomial of degree p has p harmonics only. Signals of many levels are the safe choice
(`multisine`, `uniform_levels`, `band_limited_noise`, `steps` with at least as many levels as basis functions).
"""

from collections.abc import Callable, Sequence

import numpy as np

from optid.arrays import check_integer, one_of
from optid.errors import StructureError
from optid.lazy import public_names

ORDER = 4  # of the filter of noise
Spectrum = Sequence[float] | np.ndarray | Callable[[np.ndarray], np.ndarray] | None


def multisine(n: int, low: float = -1.0, high: float = 1.0, *, dt: float = 1.0,
              lines: Sequence[int] | np.ndarray | None = None, band: tuple[float, float] | None = None,
              spectrum: Spectrum = None, phases: str = "schroeder", periods: int = 1, crest_steps: int = 0,
              seed: int = 0) -> np.ndarray:
    """Return a sum of cosines on chosen lines of the period, stretched to fill low to high.

    Schroeder phases (M. R. Schroeder, IEEE Trans. Inf. Theory 16, 1970) keep the crest factor low; `crest_steps`
    lowers it further by clipping and restoring the amplitudes in turn (Van der Ouderaa, Schoukens, Renneboog, IEEE
    Trans. Instrum. Meas. 37, 1988). Stretching changes the amplitudes by one common factor and the mean.

    Further arguments:
        n: samples, a multiple of `periods`.
        lines: harmonics of the period, 1 up to below half the samples of a period; all when not given.
        band: lowest and highest frequency (1/unit of dt), instead of lines.
        spectrum: relative amplitude of each line, or a function of the frequencies (k,); flat when not given.
        phases: "schroeder" or "random" (uniform, from the seed).
        periods: number of periods.
        crest_steps: rounds of crest factor reduction.
    """
    _check(n, low, high)
    size = _part(n, periods, "periods", "periods")
    k = _lines(size, dt, lines, band)
    frequencies = k / (size * dt)
    amplitudes = _amplitudes(spectrum, frequencies)
    coefficients = np.zeros(size // 2 + 1, dtype=complex)
    coefficients[k] = amplitudes * np.exp(1j * _phases(phases, amplitudes, seed))
    for _ in range(crest_steps):
        period = np.fft.irfft(coefficients, size)
        # 0.8 of the peak: lower clips too much to converge, higher moves slowly.
        peak = 0.8 * np.max(np.abs(period))
        clipped = np.fft.rfft(np.clip(period, -peak, peak))[k]
        better = coefficients.copy()
        better[k] = amplitudes * np.exp(1j * np.angle(clipped))
        if np.max(np.abs(np.fft.irfft(better, size))) >= np.max(np.abs(period)):
            break
        coefficients = better
    period = np.fft.irfft(coefficients, size)
    return np.tile(low + (high - low) * (period - period.min()) / np.ptp(period), periods)


def sinusoid(n: int, low: float = -1.0, high: float = 1.0, *, frequency: float, dt: float = 1.0, phase: float = 0.0
             ) -> np.ndarray:
    """Return a sine around the middle of low and high.

    Never a sufficient excitation by itself: a static polynomial of degree p turns it into p harmonics.

    Further arguments:
        frequency: 1/unit of dt, at most half the sampling rate.
        phase: at the first sample, rad.
    """
    _check(n, low, high)
    _check_rate(frequency, dt, "frequency")
    return _filled(np.sin(2 * np.pi * frequency * dt * np.arange(n) + phase), low, high)


def crest_factor(u: np.ndarray) -> float:
    """Return the largest deviation of u (N,) from its mean over the standard deviation; 1 for a square wave."""
    return float(np.max(np.abs(u - np.mean(u))) / np.std(u))


def prbs(n: int, low: float = -1.0, high: float = 1.0, *, hold: int = 1, bits: int | None = None, seed: int = 0
         ) -> np.ndarray:
    """Return a pseudo-random binary sequence of a maximum-length shift register.

    The register (`scipy.signal.max_len_seq`; Golomb, Shift Register Sequences, 1967) repeats after
    hold * (2**bits - 1) samples. A binary input cannot identify a static nonlinearity, only linear dynamics.

    Further arguments:
        hold: samples for which each value is held.
        bits: length of the register, 2 to 32; the shortest that does not repeat within n when not given.
    """
    from scipy.signal import max_len_seq

    _check(n, low, high)
    draws = -(-n // check_integer(hold, "hold"))
    bits = max(2, int(draws).bit_length()) if bits is None else check_integer(bits, "bits", 2, 32)
    state = np.random.default_rng(seed).integers(0, 2, bits)
    state[0] |= not state.any()  # the zero state never leaves itself
    sequence = max_len_seq(bits, state=state, length=draws)[0]
    return np.repeat(np.where(sequence == 1, high, low), hold)[:n].astype(np.float64)


def chirp(n: int, low: float = -1.0, high: float = 1.0, *, f0: float, f1: float, dt: float = 1.0,
          method: str = "linear", repeats: int = 1) -> np.ndarray:
    """Return a sine whose frequency runs from f0 to f1, several times over.

    Further arguments:
        n: samples, a multiple of `repeats`.
        f0: frequency at the start of a sweep (1/unit of dt), positive for method "logarithmic".
        f1: frequency at its end, at most half the sampling rate.
        method: "linear", "quadratic", "logarithmic" or "hyperbolic" (`scipy.signal.chirp`).
        repeats: number of sweeps.
    """
    from scipy.signal import chirp as swept

    _check(n, low, high)
    _check_rate(max(f0, f1), dt, "f0 and f1")
    t = dt * np.arange(_part(n, repeats, "sweeps", "repeats"))
    try:
        sweep = swept(t, f0=f0, t1=dt * t.size, f1=f1, method=method, phi=-90)
    except ValueError as error:
        raise StructureError(f"chirp from {f0} to {f1}, method {method!r}: {error}") from error
    return np.tile(_filled(sweep, low, high), repeats)


def band_limited_noise(n: int, low: float = -1.0, high: float = 1.0, *, cutoff: float | tuple[float, float],
                       dt: float = 1.0, clip: float = 2.5, seed: int = 0) -> np.ndarray:
    """Return white Gaussian noise through a Butterworth filter of order 4, clipped to low to high.

    The filter runs in before the record starts, so that the record is stationary.

    Further arguments:
        cutoff: edge of a low-pass, or the edges of a band-pass (1/unit of dt), below half the sampling rate.
        clip: number of standard deviations that reach from the middle to low and to high.
    """
    from scipy.signal import butter, sosfilt

    _check(n, low, high)
    edges = np.atleast_1d(np.asarray(cutoff, dtype=float))
    if edges.size > 2 or not (np.diff([0.0, *edges]) > 0).all():
        raise StructureError(f"cutoff = {cutoff}: one positive frequency, or two in rising order.")
    if edges[-1] >= 0.5 / dt:
        raise StructureError(f"cutoff = {cutoff}: it must lie below half the sampling rate, {0.5 / dt:g}.")
    if not clip > 0:
        raise StructureError(f"clip = {clip}: it must be positive.")
    kind = "lowpass" if edges.size == 1 else "bandpass"
    sections = butter(ORDER, edges if edges.size == 2 else edges[0], kind, fs=1.0 / dt, output="sos")
    # About fifty time constants of the slowest pole.
    run_in = int(np.ceil(5 * ORDER / (dt * float(np.min(np.diff([0.0, *edges]))))))
    noise = np.asarray(sosfilt(sections, np.random.default_rng(seed).standard_normal(run_in + n)))[run_in:]
    # The deviation of the process, not of this record: records of one design then share one scale.
    deviation = float(np.linalg.norm(np.asarray(sosfilt(sections, np.eye(1, run_in)[0]))))
    return _filled(np.clip(noise / (clip * deviation), -1.0, 1.0), low, high)


def uniform_levels(n: int, low: float = -1.0, high: float = 1.0, *, hold: int = 1, levels: int | None = None,
                   seed: int = 0) -> np.ndarray:
    """Return independent uniform values, each held for some samples; with hold 1 uniform white noise.

    Further arguments:
        hold: samples for which each value is held.
        levels: number of equally spaced values to draw from; any value when not given.
    """
    _check(n, low, high)
    rng = np.random.default_rng(seed)
    draws = -(-n // check_integer(hold, "hold"))
    values = rng.uniform(low, high, draws) if levels is None else rng.choice(_spaced(low, high, levels), draws)
    return np.repeat(values, hold)[:n]


def steps(n: int, low: float = -1.0, high: float = 1.0, *, levels: int = 5, hold: int | None = None) -> np.ndarray:
    """Return a staircase from low to high and back, again and again.

    Further arguments:
        levels: number of equally spaced levels, at least 2.
        hold: samples per step; one staircase up and down fills the record when not given.
    """
    _check(n, low, high)
    up = _spaced(low, high, levels)
    if hold is not None:
        return np.repeat(np.resize(np.concatenate([up, up[-2:0:-1]]), -(-n // check_integer(hold, "hold"))), hold)[:n]
    stairs = np.concatenate([up, up[-2::-1]])
    if n < stairs.size:
        raise StructureError(f"n = {n} samples cannot hold {stairs.size} steps; use fewer levels.")
    return stairs[np.arange(n) * stairs.size // n]


def _check(n: int, low: float, high: float) -> None:
    check_integer(n, "n")
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise StructureError(f"low = {low}, high = {high}: low must be below high.")


def _check_rate(frequency: float, dt: float, what: str) -> None:
    if not dt > 0 or not 0 < frequency <= 0.5 / dt:
        raise StructureError(f"{what}: {frequency:g} is not between 0 and half the sampling rate, {0.5 / dt:g}.")


def _part(n: int, count: int, what: str, argument: str) -> int:
    """Return the samples of each of several equal parts of a record."""
    if count < 1 or n % count:
        raise StructureError(f"n = {n} samples cannot hold {count} whole {what}; choose n as a multiple of {argument}.")
    return n // count


def _filled(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Map [-1, 1] to [low, high]."""
    return (low + high) / 2 + (high - low) / 2 * values


def _spaced(low: float, high: float, levels: int) -> np.ndarray:
    return np.linspace(low, high, check_integer(levels, "levels", 2))


def _lines(size: int, dt: float, lines: Sequence[int] | np.ndarray | None, band: tuple[float, float] | None
           ) -> np.ndarray:
    most = (size - 1) // 2  # the line at half the sampling rate has no free phase
    if lines is not None and band is not None:
        raise StructureError("give lines or band, not both.")
    if lines is not None:
        k = np.unique(np.asarray(lines))
        if k.dtype.kind not in "iu" or not k.size or k[0] < 1 or k[-1] > most:
            raise StructureError(f"lines: they must be integers from 1 to {most} for {size} samples per period.")
        return k
    everywhere = np.arange(1, most + 1)
    if band is not None:
        frequencies = everywhere / (size * dt)
        everywhere = everywhere[(frequencies >= band[0] - 1e-12) & (frequencies <= band[1] + 1e-12)]
    if not everywhere.size:
        raise StructureError(f"band = {band}: no line of a period of {size} samples lies in it; lines are multiples of "
                             f"{1 / (size * dt):g} up to {most / (size * dt):g}.")
    return everywhere


def _amplitudes(spectrum: Spectrum, frequencies: np.ndarray) -> np.ndarray:
    if spectrum is None:
        return np.ones(frequencies.size)
    a = np.asarray(spectrum(frequencies) if callable(spectrum) else spectrum, dtype=float)
    if a.shape != frequencies.shape or not (np.isfinite(a) & (a >= 0)).all() or not a.any():
        raise StructureError(f"spectrum: it must be {frequencies.size} amplitudes, not negative and not all zero.")
    return a


def _phases(kind: str, amplitudes: np.ndarray, seed: int) -> np.ndarray:
    one_of("phases", kind, ("schroeder", "random"))
    if kind == "random":
        return np.random.default_rng(seed).uniform(0.0, 2 * np.pi, amplitudes.size)
    power = amplitudes**2 / np.sum(amplitudes**2)
    # phi_k = -2 pi sum_{i<k} (k - i) p_i, by two cumulative sums.
    return -2 * np.pi * np.concatenate([[0.0], np.cumsum(np.cumsum(power)[:-1])])


__dir__ = public_names(__name__)

"""Whether an answer explains the record: tests of its residual against the noise of a healthy plant.

Three tests are independent of the dictionary (energy, a line in the spectrum, a burst in time); the fourth searches the
residual for a further fault of it.
"""

import numpy as np

from optid.arrays import Array
from optid.faults.diagnosis.answers import Remaining
from optid.faults.whitening import Whitened

UNFIT = 1e-3  # p-value of the residual below which an answer does not explain the record
BURSTS = 1, 3, 10, 30  # lengths, in samples, of the bursts searched for


def remainder_test(whitened: Whitened, rest: Array, magnitudes: int, further: float = 1.0) -> Remaining:
    """Return the tests of a residual (N, l), the whitened innovations less the signature of the answer.

    So many magnitudes were estimated from the window, the initial state among them; `further` is the p-value of the
    search of the residual for a further fault.
    """
    from scipy.special import chdtrc

    silent = whitened.predictor.silent * int(whitened.present.all(axis=1).sum())
    unknown = 0 if whitened.nuisance is None else whitened.nuisance.unknown
    readings = max(int(whitened.present.sum()) - silent - unknown - magnitudes, 1)
    energy = float(np.sum(rest**2))
    frequency, share, line = _spectrum(rest, whitened.present)
    tests = {"energy": float(chdtrc(readings, energy)), "period": line, "burst": _burst(rest, whitened.present),
             "candidate": further}
    worst = min(tests, key=lambda name: tests[name])
    return Remaining(
        energy, readings, min(1.0, len(tests) * tests[worst]), worst, _direction(whitened, rest), frequency, share)


def alarm_probability(gain: float, false_alarm: float) -> float:
    """Return the probability that a healthy window exceeds its thresholds, of this false-alarm rate, by a gain.

    The maximum of many statistics with exponential tails exp(-x / 2) has a Gumbel law, located by the false-alarm rate.
    Below p = 0.1 it is exact to a tenth, above it is conservative.
    """
    return float(-np.expm1(np.log1p(-false_alarm) * np.exp(-gain / 2)))


def further_fault(gains: Array, false_alarm: float) -> float:
    """Return the p-value of the largest gain (C, N) of a search of the residual."""
    return 1.0 if np.isnan(gains).all() else alarm_probability(float(np.nanmax(gains)), false_alarm)


def _spectrum(rest: Array, present: np.ndarray) -> tuple[float, float, float]:
    """Frequency of the largest line, its share of the energy, and the p-value of so large a line in white noise."""
    from scipy.special import gammaincc

    count, outputs = rest.shape
    lines = np.abs(np.fft.rfft(rest, axis=0)) ** 2
    power = np.sum(lines / np.maximum(present.sum(axis=0), 1), axis=1)
    if count < 4 or not power.any():
        return 0.0, 0.0, 1.0
    largest = int(np.argmax(power))
    twice = np.full(power.size, 2.0)  # every line but the first and, for an even length, the last counts twice
    twice[0] = 1.0
    twice[-1] -= float(count % 2 == 0)
    near = slice(max(largest - 1, 0), largest + 2)
    share = float((twice * power)[near].sum() / (twice @ power))
    inner = power[1 : (count + 1) // 2]
    exceeding = float(gammaincc(outputs, inner.max())) if inner.size else 1.0
    mean = float(gammaincc(outputs / 2, power[0] / 2))
    p_value = min(-np.expm1(inner.size * np.log1p(-exceeding)) if exceeding < 1 else 1.0, 1.0)
    return largest / count, share, float(min(1.0, 2 * min(p_value, mean)))


def _burst(rest: Array, present: np.ndarray) -> float:
    """Bound of the p-value of the largest energy of any burst."""
    from scipy.special import chdtrc

    energy = np.concatenate([[0.0], np.cumsum(np.sum(rest**2, axis=1))])
    readings = np.concatenate([[0], np.cumsum(present.sum(axis=1))])
    lowest, tried = 1.0, 0
    for length in BURSTS:
        if length >= len(rest):
            break
        window, seen = energy[length:] - energy[:-length], readings[length:] - readings[:-length]
        there = seen > 0
        if there.any():
            lowest = min(lowest, float(np.min(chdtrc(seen[there], window[there]))))
            tried += int(there.sum()) // max(length // 2, 1) + 1
    return min(1.0, tried * lowest)


def _direction(whitened: Whitened, rest: Array) -> Array:
    """Principal direction of the residual, a unit vector in units of the outputs, its largest entry positive."""
    _, _, axes = np.linalg.svd(rest, full_matrices=False)
    vector = np.linalg.pinv(whitened.predictor.root, rcond=1e-12) @ axes[0]
    vector = vector / np.linalg.norm(vector)
    return np.asarray(vector * np.sign(vector[np.argmax(np.abs(vector))]))

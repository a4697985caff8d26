"""The rules of experiment design as checks of a record or an excitation: each has the number, the limit and the remedy.

What invalidates the result is an error, a weakness a warning.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from optid.arrays import Array
from optid.bases.basis import Basis
from optid.data.channels import count_levels
from optid.statistics.expansion import LINEAR, NEARLY_LINEAR
from optid.statistics.hankel import complete_runs

Severity = Literal["fine", "warning", "error"]

FEW_LEVELS = 20  # below this many distinct values a curve between them is interpolation, not identification
HIDDEN, DOMINANT = 1e-3, 1e-2  # share of the variance beside a few sinusoids: noise on a singular record, or weak
WORST_CONDITION = 1e7  # condition number beyond which the estimates keep less than half of their digits

LONGEST = 4096  # samples of an experiment that are used
LOBE = 5  # bins of a line after a Hann window, all but a thousandth of its power
JOINT, STEPS = 6, 3  # frequencies that are refined together after each new one, and steps


@dataclass(frozen=True)
class Check:
    """The result of a rule, "levels", "lines", "feedback", "excitation" or "instruments": number, finding, remedy."""

    rule: str
    number: float
    severity: Severity
    sentence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


def check_levels(name: str, u: Array, basis: Basis, few: int = FEW_LEVELS) -> Check:
    """Compare the number of distinct values of an input (N,), none missing, with the functions of its fitted basis.

    n levels determine n - 1 functions besides the constant. With fewer than `few` the curve between them counts as
    interpolation.
    """
    severity, sentence = "fine", f"input {name!r} takes many levels"
    levels = count_levels(u[:4096])
    if basis.size > 1 and levels <= 4 * FEW_LEVELS:
        levels = count_levels(u)
        sentence = f"input {name!r} takes {levels} levels"
        if levels == 2:
            severity = "error"
            sentence = (f"input {name!r} is binary: a static nonlinearity cannot be identified from two levels "
                        "(any function is a straight line there); use the formulation 'arx' or a basis 'linear'")
        elif levels <= basis.size:
            severity = "error"
            sentence += (f", which determine at most {levels - 1} functions besides the constant; the basis has "
                         f"{basis.size}. Use a smaller basis or excite more levels")
        elif levels < few:
            severity = "warning"
            sentence = (f"too few levels: input {name!r} takes {levels} distinct values for {basis.size} basis "
                        "functions; the nonlinearity between them is interpolation")
    return Check("levels", float(levels), severity, sentence)


def check_lines(name: str, records: Sequence[Array], basis: Basis, lags: int) -> Check:
    """Compare the sinusoids in the functions of an input with the number of regressors.

    A sinusoid through a polynomial of degree p has p harmonics, and L sinusoids excite 2 L + 1 regressors for any
    number of lags; the number of the check. Noise and quantisation only hide that singularity.

    Args:
        name: of the input.
        records: (N,) samples per experiment; NaN = missing. The longest complete stretch of each is used.
        basis: the fitted basis.
        lags: regressors per function: block rows of a subspace method, coefficients of B of an equation-error one.
    """
    needed = lags * basis.size
    most = max(1, -(-(needed - 1) // 2) - 1)  # with one line more there are enough
    fine = Check("lines", float("inf"), "fine", f"the functions of input {name!r} have more than {most} spectral lines")
    lines, remaining, single = 0, 0.0, True
    for record in records:
        column = np.asarray(record, dtype=float)[:, None]
        u = max(complete_runs(column, 1), key=len, default=column[:0])[:LONGEST, 0]
        if needed <= 3 or u.size < 4 * needed or np.ptp(u) == 0 or many_lines(u, most, DOMINANT):
            return fine
        shares = remaining_shares(basis.values(u), most, HIDDEN)
        if shares[-1] > DOMINANT:
            return fine
        lines, remaining = lines + shares.size - 1, max(remaining, shares[-1])
        single = single and remaining_shares(u[:, None], 1, DOMINANT)[-1] <= DOMINANT
    excited = 2 * lines + 1
    if excited >= needed:
        return fine
    kind = "is a single sinusoid" if single else "consists of a few sinusoids"
    share = f"{100 * (1 - remaining):.2f} %"
    sentence = (
        f"input {name!r} {kind}: its functions have {lines} spectral lines ({share} of their variance), which excite "
        f"{excited} regressors; {needed} are to be determined ({lags} lags of {basis.size} functions). Add lines "
        "(optid design --kind multisine), or use fewer lags or functions")
    return Check("lines", excited, "error" if remaining <= HIDDEN else "warning", sentence)


def check_feedback(name: str, share: float) -> Check:
    """Check the share of the spread of feedback functions of an output that is orthogonal to 1 and y.

    A linear feedback is not distinguishable from the dynamics: (A, B, linear part of E g) and (A - L C, B - L D, that
    part + L y) are equivalent for every L. See `optid.statistics.expansion.Feedback.share`.
    """
    severity, remedy = "fine", ""
    if share < LINEAR:
        severity, remedy = "error", (": the feedback is not distinguishable from the dynamics. Leave the feedback "
                                     "basis out, or excite larger amplitudes")
    elif share < NEARLY_LINEAR:
        severity, remedy = "warning", ". Excite larger amplitudes, or leave the feedback basis out"
    return Check("feedback", share, severity, f"{100 * share:.2g} % of the spread of the functions of output {name!r} "
                                              f"is not linear in the outputs{remedy}")


def check_condition(number: float) -> Check:
    """Check the condition number of the expanded regressor (columns scaled), inf where it is singular."""
    return _conditioned("excitation", number, "condition number of the expanded regressor: ",
                        f"the expanded regressor is poorly excited: condition number {number:.1e}; use fewer functions "
                        "or lags, or a richer input")


def check_instruments(number: float) -> Check:
    """Check the condition number of R11, the regressors projected on the instruments."""
    return _conditioned("instruments", number, "cond(R11) = ",
                        f"the instruments hardly explain the regressors: cond(R11) = {number:.1e}. Use augmented "
                        "instruments (hammerstein_ss.asivid), fewer block rows or functions, or an input with more "
                        "lines and levels")


def _conditioned(rule: str, number: float, words: str, warning: str) -> Check:
    poor = number > WORST_CONDITION
    return Check(rule, number, "warning" if poor else "fine", warning if poor else f"{words}{number:.2g}")


def many_lines(x: Array, most: int, tolerance: float) -> bool:
    """Whether x (N,) certainly needs more sinusoids to leave this share of its variance: a quick test by frequency."""
    spectrum = np.fft.rfft((x - x.mean()) * window_of(x.size))
    energy, largest = spectrum.real**2 + spectrum.imag**2, min(most * LOBE, x.size // 2 + 1)
    # No choice of `most` lobes holds more than as many of the largest bins.
    return bool(np.partition(energy, -largest)[-largest:].sum() < (1 - tolerance) * energy.sum())


@lru_cache(maxsize=8)
def window_of(size: int) -> Array:
    """Return Hann's window, which is not to be written to."""
    window = np.hanning(size)
    window.flags.writeable = False
    return window


def remaining_shares(signals: Array, most: int, enough: float) -> Array:
    """Return the share of variance (L + 1,) that 0, 1, 2, ... common sinusoids of signals (N, s) do not explain.

    Each step adds the frequency that explains most of the rest of all standardised signals (orthogonal matching
    pursuit; Pati, Rezaiifar, Krishnaprasad, Asilomar 1993), up to L = most sinusoids or a share that is small enough.
    """
    x = signals - signals.mean(axis=0)
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    shares = [1.0]
    if not x.shape[1]:
        return np.zeros(1)
    n, total = len(x), float(x.shape[1])
    window, frequencies, residual = window_of(n)[:, None], np.zeros(0), x
    while len(shares) <= most and shares[-1] > enough and 2 * len(shares) + 1 < n:
        frequencies = np.append(frequencies, _strongest(residual * window))
        for _ in range(STEPS if frequencies.size <= JOINT else 1):
            frequencies, residual = _refined(x, frequencies)
        shares.append(min(float(np.sum(residual**2)) / total, shares[-1]))
    return np.array(shares)


def _strongest(x: Array) -> float:
    """Return the frequency (1/sample) of the highest common peak of signals (N, s), by a parabola between the bins."""
    n = 4 * len(x)
    spectrum = np.sum(np.abs(np.fft.rfft(x, n, axis=0)) ** 2, axis=1)
    spectrum[:2] = 0.0  # a fraction of a period is the mean
    peak = min(max(int(np.argmax(spectrum)), 1), spectrum.size - 2)
    left, top, right = np.log(spectrum[peak - 1 : peak + 2] + 1e-300)
    bend = left - 2 * top + right
    return (peak + (0.5 * (left - right) / bend if bend < 0 else 0.0)) / n


def _refined(x: Array, frequencies: Array) -> tuple[Array, Array]:
    """Return frequencies (L,) after a Gauss-Newton step, and what the old ones leave of x (N, s).

    The amplitudes are projected out: variable projection, Golub and Pereyra 1973, without the second-order term.
    """
    n, count = len(x), frequencies.size
    times = 2 * np.pi * (np.arange(n) - (n - 1) / 2)[:, None]  # about the middle: no phase for a frequency
    waves = np.column_stack([np.cos(times * frequencies), np.sin(times * frequencies)])
    basis, triangle = np.linalg.qr(np.column_stack([np.ones(n), waves]))
    projections = basis.T @ x
    residual = x - basis @ projections
    scale = np.abs(np.diag(triangle))
    if count > JOINT or scale.min() < 1e-6 * scale.max():  # too many to be moved, or two of them have met
        return frequencies, residual
    amplitudes, slopes = np.linalg.solve(triangle, projections)[1:], []
    for a, b in zip(amplitudes[:count].T, amplitudes[count:].T):  # signal by signal
        slope = times * (b * waves[:, :count] - a * waves[:, count:])
        slopes.append(slope - basis @ (basis.T @ slope))
    step = np.linalg.lstsq(np.vstack(slopes), residual.T.ravel(), rcond=1e-8)[0]
    moved = np.clip(frequencies + np.clip(step, -0.25 / n, 0.25 / n), 0.25 / n, 0.5)
    return moved, residual

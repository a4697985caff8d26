"""The rules of experiment design as checks of a record: each has the number, the limit and the remedy.

They hold for the record to be fitted and for the excitation to be applied alike. What makes the answer meaningless is
an error, what weakens it a warning.
"""

from collections.abc import Sequence
from dataclasses import dataclass
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

LONGEST = 4096  # samples looked at; more would tell nothing new about a few lines
LOBE = 5  # bins that hold a line: all but a thousandth of it, after a Hann window
JOINT, STEPS = 6, 3
"""The first few frequencies are refined together after each new one, so many times; later ones stay where they are."""


@dataclass(frozen=True)
class Check:
    """What one rule says of one channel or record: the number that was measured, the finding with its remedy.

    The rules are "levels", "lines", "feedback", "excitation" and "instruments".
    """

    rule: str
    number: float
    severity: Severity
    sentence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


def check_levels(name: str, u: Array, basis: Basis, few: int = FEW_LEVELS) -> Check:
    """Hold the number of distinct values of an input (N,), none missing, against the functions of its fitted basis.

    n levels determine n - 1 functions besides the constant; a binary signal shows a straight line whatever f is. With
    fewer than `few` the curve between them counts as interpolation.
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
    """Hold the sinusoids that the functions of an input consist of against the regressors they are to excite.

    A sinusoid through a polynomial of degree p has p harmonics, and L sinusoids excite 2 L + 1 regressors, however
    many lags there are. Noise and quantisation of the record hide that singularity, they do not cure it.

    Args:
        name: of the input.
        records: (N,) samples per experiment; NaN = missing. The longest stretch of each without one is looked at.
        basis: the fitted basis.
        lags: regressors per function: block rows of a subspace method, coefficients of B of an equation-error one.
            The number of the check is the regressors excited, by all experiments together at most.
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
        f"{excited} regressors; {needed} are to be determined ({lags} lags of {basis.size} functions). Noise hides "
        "this, it does not cure it: add lines (optid design --kind multisine), or use fewer lags or functions")
    return Check("lines", excited, "error" if remaining <= HIDDEN else "warning", sentence)


def check_feedback(name: str, share: float) -> Check:
    """Hold the share of the spread of feedback functions of an output that is orthogonal to 1 and y against limits.

    A linear feedback cannot be told from the dynamics: (A, B, linear part of E g) and (A - L C, B - L D, that part
    + L y) behave alike for every L. See `optid.statistics.expansion.Feedback.share`.
    """
    severity, remedy = "fine", ""
    if share < LINEAR:
        severity, remedy = "error", (": no feedback can be told from the dynamics. Leave the feedback basis out, or "
                                     "excite larger amplitudes")
    elif share < NEARLY_LINEAR:
        severity, remedy = "warning", (": little beside the noise. Excite larger amplitudes, or leave the feedback "
                                       "basis out")
    return Check("feedback", share, severity, f"{100 * share:.2g} % of the spread of the functions of output {name!r} "
                                              f"is not linear in the outputs{remedy}")


def check_condition(number: float) -> Check:
    """Hold the condition number of the expanded regressor (columns scaled) against what leaves half of the digits.

    Persistent excitation is required of the functions of inputs and outputs at all lags, not of the input. The number
    is inf where they are singular.
    """
    return _held("excitation", number, "condition number of the expanded regressor: ",
                 f"the expanded regressor is poorly excited: condition number {number:.1e}; use fewer functions or "
                 "lags, or a richer input")


def check_instruments(number: float) -> Check:
    """Hold the condition number of R11, the regressors projected on the instruments, against the same limit.

    With instruments that do not reach the regressors it grows with the root of the number of samples.
    """
    return _held("instruments", number, "cond(R11) = ",
                 f"the instruments hardly reach the regressors: cond(R11) = {number:.1e}. Use augmented instruments "
                 "(hammerstein_ss.asivid), fewer block rows or functions, or an input with more lines and levels")


def _held(rule: str, number: float, words: str, warning: str) -> Check:
    poor = number > WORST_CONDITION
    return Check(rule, number, "warning" if poor else "fine", warning if poor else f"{words}{number:.2g}")


def many_lines(x: Array, most: int, tolerance: float) -> bool:
    """Whether x (N,) certainly needs more sinusoids to leave this share of its variance: a quick test by frequency."""
    energy = np.sort(np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size))) ** 2)[::-1]
    # No choice of `most` lobes holds more than as many of the largest bins.
    return bool(energy[: most * LOBE].sum() < (1 - tolerance) * energy.sum())


def remaining_shares(signals: Array, most: int, enough: float) -> Array:
    """Return the share of variance that 0, 1, 2, ... common sinusoids leave, greedily chosen and fitted jointly.

    Each step adds the frequency that explains most of what is left of all signals (N, s) together, every one of which
    counts alike (orthogonal matching pursuit; Pati, Rezaiifar, Krishnaprasad, Asilomar 1993), and refines the first few
    between the bins. The shares (L + 1,) fall, up to L = most sinusoids or a share that is enough.
    """
    x = signals - signals.mean(axis=0)
    size = np.linalg.norm(x, axis=0)
    x = x[:, size > 0] / size[size > 0]
    shares = [1.0]
    if not x.shape[1]:
        return np.zeros(1)
    n, total = len(x), float(x.shape[1])
    window, frequencies, residual = np.hanning(n)[:, None], np.zeros(0), x
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

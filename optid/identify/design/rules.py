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
from optid.identify.design.lines import longest_run, many_lines, remaining_shares
from optid.statistics.expansion import LINEAR, NEARLY_LINEAR

Severity = Literal["fine", "warning", "error"]

FEW_LEVELS = 20  # below this many distinct values a curve between them is interpolation, not identification
HIDDEN, DOMINANT = 1e-3, 1e-2
"""Share of the variance beside a few sinusoids that is noise on a singular record, or a weak excitation."""
WORST_CONDITION = 1e7  # condition number beyond which the estimates keep less than half of their digits


@dataclass(frozen=True)
class Check:
    """What one rule says of one channel or record.

    Attributes:
        rule: "levels", "lines", "feedback", "excitation" or "instruments".
        subject: the channel, or "" for the record.
        number: what was measured.
        limit: what it is held against.
        severity: "fine", "warning" or "error".
        sentence: the finding with its remedy.
    """

    rule: str
    subject: str
    number: float
    limit: float
    severity: Severity
    sentence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"


def check_levels(name: str, u: Array, basis: Basis, few: int = FEW_LEVELS) -> Check:
    """Hold the number of distinct values of an input against the functions of its basis.

    n levels determine n - 1 functions besides the constant; a binary signal shows a straight line whatever f is.

    Args:
        name: of the input.
        u: (N,) samples without missing ones.
        basis: the fitted basis.
        few: number of values below which the curve between them counts as interpolation.
    """
    needed = basis.size + 1
    limit, severity, sentence = needed, "fine", f"input {name!r} takes many levels"
    levels = count_levels(u[:4096])
    if basis.size > 1 and levels <= 4 * FEW_LEVELS:
        levels = count_levels(u)
        sentence = f"input {name!r} takes {levels} levels"
        if levels == 2:
            severity = "error"
            sentence = (f"input {name!r} is binary: a static nonlinearity cannot be identified from two levels "
                        "(any function is a straight line there); use the formulation 'arx' or a basis 'linear'")
        elif levels < needed:
            severity = "error"
            sentence += (f", which determine at most {levels - 1} functions besides the constant; the basis has "
                         f"{basis.size}. Use a smaller basis or excite more levels")
        elif levels < few:
            limit, severity = few, "warning"
            sentence = (f"too few levels: input {name!r} takes {levels} distinct values for {basis.size} basis "
                        "functions; the nonlinearity between them is interpolation")
    return Check("levels", name, float(levels), limit, severity, sentence)


def check_lines(name: str, records: Sequence[Array], basis: Basis, lags: int) -> Check:
    """Hold the sinusoids that the functions of an input consist of against the regressors they are to excite.

    A sinusoid through a polynomial of degree p has p harmonics, and L sinusoids excite 2 L + 1 regressors, however
    many lags there are. Noise and quantisation of the record hide that singularity, they do not cure it.

    Args:
        name: of the input.
        records: (N,) samples per experiment; NaN = missing. The longest stretch of each without one is looked at.
        basis: the fitted basis.
        lags: regressors per function: block rows of a subspace method, coefficients of B of an equation-error one.

    Returns:
        The check; its number is the regressors excited, by all experiments together at most.
    """
    needed = lags * basis.size
    most = max(1, -(-(needed - 1) // 2) - 1)  # with one line more there are enough
    fine = Check("lines", name, float("inf"), needed, "fine",
                 f"the functions of input {name!r} have more than {most} spectral lines")
    lines, remaining, single = 0, 0.0, True
    for record in records:
        u = longest_run(np.asarray(record, dtype=float)[:, None])[:, 0]
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
    return Check("lines", name, excited, needed, "error" if remaining <= HIDDEN else "warning", sentence)


def check_feedback(name: str, share: float) -> Check:
    """Hold the spread of feedback functions that is orthogonal to 1 and y against their whole spread.

    A linear feedback cannot be told from the dynamics: (A, B, linear part of E g) and (A - L C, B - L D, that part
    + L y) behave alike for every L.

    Args:
        name: of the output.
        share: spread outside 1 and y over the spread of the functions (`optid.statistics.expansion.Feedback.share`).
    """
    sentence = f"{100 * share:.2g} % of the spread of the functions of output {name!r} is not linear in the outputs"
    if share >= NEARLY_LINEAR:
        return Check("feedback", name, share, NEARLY_LINEAR, "fine", sentence)
    if share >= LINEAR:
        sentence += ": little beside the noise. Excite larger amplitudes, or leave the feedback basis out"
        return Check("feedback", name, share, NEARLY_LINEAR, "warning", sentence)
    sentence += ": no feedback can be told from the dynamics. Leave the feedback basis out, or excite larger amplitudes"
    return Check("feedback", name, share, LINEAR, "error", sentence)


def check_condition(number: float) -> Check:
    """Hold the condition number of the expanded regressor (columns scaled) against what leaves half of the digits.

    Persistent excitation is required of the functions of inputs and outputs at all lags, not of the input.

    Args:
        number: condition number; inf when singular.
    """
    return _conditioning("excitation", number, f"condition number of the expanded regressor: {number:.2g}",
                         f"the expanded regressor is poorly excited: condition number {number:.1e}; "
                         "use fewer functions or lags, or a richer input")


def check_instruments(number: float) -> Check:
    """Hold the condition number of R11, the regressors projected on the instruments, against the same limit.

    With instruments that do not reach the regressors it grows with the root of the number of samples.
    """
    return _conditioning("instruments", number, f"cond(R11) = {number:.2g}",
                         f"the instruments hardly reach the regressors: cond(R11) = {number:.1e}. Use augmented "
                         "instruments (hammerstein_ss.asivid), fewer block rows or functions, or an input with more "
                         "lines and levels")


def _conditioning(rule: str, number: float, fine: str, poor: str) -> Check:
    if number > WORST_CONDITION:
        return Check(rule, "", number, WORST_CONDITION, "warning", poor)
    return Check(rule, "", number, WORST_CONDITION, "fine", fine)

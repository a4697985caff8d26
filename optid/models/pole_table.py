"""Poles as engineers read them: time constant, natural frequency and damping of every mode."""

from dataclasses import dataclass
from html import escape
from typing import Any, NamedTuple

import numpy as np

from optid.arrays import Array
from optid.models.roots import AT_ONE, AT_ZERO, in_words

ROUNDING = 1e-13  # share of the largest modulus below which a continuous pole is zero
HEAD = ("pole", "time constant", "natural frequency", "damping")


class Mode(NamedTuple):
    """One real pole, or a complex pair; NaN where a figure does not exist.

    Attributes:
        pole: in the plane of the model, z or s; of a pair the one with positive imaginary part.
        time_constant: -1 / Re s, in units of time; infinite for an integrator, negative for growth.
        natural_frequency: the modulus of s, in radians per unit of time.
        damping: -Re s over the natural frequency; 1 for a decay, NaN for an integrator.
    """

    pole: complex
    time_constant: float
    natural_frequency: float
    damping: float


@dataclass(frozen=True)
class PoleTable:
    """The modes of a model, the slowest first; printed as a table.

    A pole of a sampled model is exp(s dt). A pole at 0 is a delay of a sample, and a negative real pole alternates from
    sample to sample: both have no s.
    """

    modes: tuple[Mode, ...]
    time_unit: str

    @classmethod
    def of_continuous(cls, poles: Array, time_unit: str) -> "PoleTable":
        """Read poles in the plane of s; those that are zero beside the others integrate."""
        least = ROUNDING * np.max(np.abs(poles), initial=0.0)
        return cls._sorted(((pole, pole if abs(pole) > least else 0j) for pole in poles), time_unit)

    @classmethod
    def of_sampled(cls, poles: Array, dt: float, time_unit: str) -> "PoleTable":
        """Read poles in the plane of z; those at 1 integrate."""
        def exponent(pole: complex) -> complex:
            if abs(pole) <= AT_ZERO or (pole.imag == 0 and pole.real < 0):
                return complex(np.nan)
            return 0j if abs(pole - 1) <= AT_ONE else complex(np.log(complex(pole)) / dt)

        return cls._sorted(((pole, exponent(pole)) for pole in poles), time_unit)

    @classmethod
    def _sorted(cls, pairs: Any, time_unit: str) -> "PoleTable":
        modes = [Mode(complex(pole), *_figures(complex(s))) for pole, s in pairs if pole.imag >= 0]
        speed = [np.inf if np.isnan(mode.natural_frequency) else mode.natural_frequency for mode in modes]
        return cls(tuple(modes[k] for k in np.argsort(speed, kind="stable")), time_unit)

    def __iter__(self) -> Any:
        return iter(self.modes)

    def __len__(self) -> int:
        return len(self.modes)

    def __getitem__(self, k: int) -> Mode:
        return self.modes[k]

    def __str__(self) -> str:
        unit = self.time_unit
        units = ("", f" ({unit})", f" (rad/{unit})", "") if unit else ("",) * 4
        head = [name + more for name, more in zip(HEAD, units)]
        rows = [head, *([in_words(np.array([mode.pole])), *(f"{value:.4g}".replace("nan", "-") for value in mode[1:])]
                        for mode in self.modes)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
        return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(row, widths)) for row in rows)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def _figures(s: complex) -> tuple[float, float, float]:
    """Return time constant, natural frequency and damping of exp(s t)."""
    if np.isnan(s):
        return np.nan, np.nan, np.nan
    size = abs(s)
    return -1 / s.real if s.real else np.inf, size, -s.real / size if size else np.nan

"""The dynamics of a process: time constants, a second-order pair, a zero, an integrator and a dead time.

    G(s) exp(-theta s),    G(s) = (tau_zero s + 1) / [s] prod (tau_i s + 1) (T² s² + 2 zeta T s + 1)

The static gain of G is one, or with an integrator its slope after a step; the gain belongs to the static curve. The
system is a chain of sections in series, each of static gain one: no residues are formed, so that equal time constants
and a damping of one are no special cases. A second chain, driven by the output, has the derivatives by all parameters:
that of y by tau is -(y - l) / tau with tau l' = y - l.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array, check_integer
from optid.errors import StructureError, nearest
from optid.models.process_kernel import run

TYPES = tuple(f"P{poles}{word}" for poles in range(1, 4) for word in ("", "D", "Z", "DZ", "I", "DI", "IZ", "DIZ")) + (
    "P0I", "P0DI", *(f"P{poles}{word}U" for poles in (2, 3) for word in ("", "D", "Z", "DZ", "I", "DI", "DIZ")))
"""Names of process types as procest has them: poles, then D (dead time), I (integrator), Z (zero), U (a pair)."""


@dataclass(frozen=True)
class ProcessStructure:
    """Which parameters a process has.

    Attributes:
        real: number of real poles, each with a time constant.
        pair: whether there is a second-order factor (T, zeta).
        zero: whether there is a zero.
        delay: whether there is a dead time.
        integrator: whether there is a pole at zero.
    """

    real: int = 1
    pair: bool = False
    zero: bool = False
    delay: bool = True
    integrator: bool = False

    def __post_init__(self) -> None:
        check_integer(self.real, "the number of real poles", 0, 3)
        if self.real + 2 * self.pair > 3:
            raise StructureError(f"{self.real + 2 * self.pair} poles: a process has at most three beside an integrator")
        if not self.real + self.pair + self.integrator:
            raise StructureError("a process without poles: choose one to three, or an integrator (P0I)")
        if self.zero and not self.real + self.pair:
            raise StructureError("a zero beside an integrator alone acts at once: choose at least one pole (P1IZ)")

    @classmethod
    def read(cls, word: Any) -> "ProcessStructure":
        """Read procest's name of a type, such as "P1D", "P2DU" or "P2DIZ" (`StructureError`: none)."""
        if isinstance(word, ProcessStructure):
            return word
        found = re.fullmatch(r"P([0-3])([DIZU]*)", word.upper()) if isinstance(word, str) else None
        if found is None or len(set(found[2])) < len(found[2]):
            raise StructureError(f"process={word!r} is no process type: P, the number of poles, then D (dead time), I "
                                 f"(integrator), Z (zero), U (complex pair). {nearest(str(word), TYPES)}")
        poles, letters = int(found[1]), found[2]
        if "U" in letters and poles < 2:
            raise StructureError(f"process={word!r}: a complex pair (U) needs two poles at least (P2U)")
        return cls(poles - 2 * ("U" in letters), "U" in letters, "Z" in letters, "D" in letters, "I" in letters)

    @property
    def word(self) -> str:
        """The name that procest has for it."""
        there = {"D": self.delay, "I": self.integrator, "Z": self.zero, "U": self.pair}
        return f"P{self.real + 2 * self.pair}{''.join(letter for letter, has in there.items() if has)}"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in their order."""
        taus = ("tau",) if self.real == 1 else tuple(f"tau{i + 1}" for i in range(self.real))
        return taus + ("T", "zeta") * self.pair + ("tau_zero",) * self.zero + ("dead_time",) * self.delay

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Which parameters are positive, and estimated by their logarithm."""
        return np.array([name not in ("tau_zero", "dead_time") for name in self.names], dtype=bool)

    @cached_property
    def temporal(self) -> NDArray[np.bool_]:
        """Which parameters are times."""
        return np.array([name != "zeta" for name in self.names], dtype=bool)

    @property
    def order(self) -> int:
        """Number of poles, that of an integrator included."""
        return self.real + 2 * self.pair + self.integrator

    def parameters(self, x: Array) -> Array:
        """Return the parameters of the numbers of a fit, which are logarithms of those that are positive."""
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0.0)), x)

    def numbers(self, p: Array) -> Array:
        """Return the numbers of a fit of parameters."""
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, p, 1.0)), p)


@dataclass(frozen=True, eq=False)
class ProcessDynamics:
    """Dynamics with values: parameters (k,) in the order of the names of the structure, in any unit of time."""

    structure: ProcessStructure
    p: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "p", np.array(self.p, dtype=float))
        if self.p.shape != (len(self.structure.names),) or not np.isfinite(self.p).all():
            raise StructureError(f"{self.structure.word} has the parameters {', '.join(self.structure.names)}; got "
                                 f"{self.p.tolist()}")
        wrong = [name for name, value, positive in zip(self.structure.names, self.p, self.structure.logarithmic)
                 if value <= 0 and positive or value < 0 and name == "dead_time"]
        if wrong:
            raise StructureError(f"{wrong[0]} = {self.value(wrong[0]):g} must be positive")

    def value(self, name: str, default: float = 0.0) -> float:
        """Return a parameter by its name, a default where there is none."""
        return float(self.p[self.structure.names.index(name)]) if name in self.structure.names else default

    @property
    def dead_time(self) -> float:
        """The dead time, zero where there is none."""
        return self.value("dead_time")

    def in_unit(self, unit: float) -> "ProcessDynamics":
        """Return the same with times in multiples of a unit."""
        return replace(self, p=np.where(self.structure.temporal, self.p / unit, self.p))

    def sort(self) -> "ProcessDynamics":
        """Return the same with the largest time constant first."""
        real = self.structure.real
        return replace(self, p=np.concatenate([np.sort(self.p[:real])[::-1], self.p[real:]]))

    @property
    def poles(self) -> Array:
        """Poles in the plane of s, the slowest first."""
        found = [complex(-1 / tau) for tau in self.p[: self.structure.real]]
        if self.structure.pair:
            zeta, size = self.value("zeta"), 1 / self.value("T")
            root = np.sqrt(complex(zeta**2 - 1))
            slow = -size / (zeta + root) if zeta > 1 else size * (-zeta + root)  # without cancellation
            found += [slow, -size * (zeta + root)]
        found += [0j] * self.structure.integrator
        return np.array(sorted(found, key=lambda s: (abs(s), -s.imag)), dtype=complex)

    @cached_property
    def _chain(self) -> tuple[Array, Array]:
        """F of [input; slope; sections], and the row that reads the output."""
        n, s = self.structure.order, self.structure
        f = np.zeros((2 + n, 2 + n))
        f[0, 1] = 1.0
        row = np.zeros(2 + n)
        row[0] = 1.0
        at = 2
        for tau in self.p[: s.real]:
            at, row = _first_order(f, at, row, tau)
        if s.pair:
            at, row = _second_order(f, at, row, self.value("T"), self.value("zeta"))
        if s.integrator:
            f[at] = row
            row = np.eye(len(f))[at]
        return f, row + self.value("tau_zero") * row @ f if s.zero else row

    @property
    def equations(self) -> tuple[Array, Array, Array, float]:
        """A (n, n), b (n,), c (n,) and d of x' = A x + b w, y = c x + d w, without the dead time."""
        f, row = self._chain
        return f[2:, 2:], f[2:, 0], row[2:], float(row[0])

    @cached_property
    def sensitive(self) -> tuple[Array, Array]:
        """System (F, C) that reads the output and its derivatives by all parameters, C (1 + k, n)."""
        (small, row), s = self._chain, self.structure
        n, more = len(small), s.real + 2 * s.pair
        f = np.zeros((n + more, n + more))
        f[:n, :n] = small
        y = np.concatenate([row, np.zeros(more)])
        rows, at = [y], n
        for tau in self.p[: s.real]:
            at, filtered = _first_order(f, at, y, tau)
            rows.append((filtered - y) / tau)
        if s.pair:
            size, zeta = self.value("T"), self.value("zeta")
            at, filtered = _second_order(f, at, y, size, zeta)
            slope = np.eye(len(f))[at - 1]
            rows += [2 * (filtered - y + zeta * slope) / size, -2 * slope]
        if s.zero:
            without = ProcessDynamics(replace(s, zero=False), np.delete(self.p, s.names.index("tau_zero")))
            rows.append(np.concatenate([without._chain[1] @ small, np.zeros(more)]))
        if s.delay:
            rows.append(-y @ f)
        return f, np.array(rows)

    @property
    def weights(self) -> Array:
        """What derivatives by the parameters are multiplied with to be those by the numbers of a fit."""
        return np.where(self.structure.logarithmic, self.p, 1.0)

    def response(self, instants: Array, changes: Array, inputs: Array, *, straight: bool = False, late: bool = True,
                 sensitive: bool = False) -> Array:
        """Return the response (N, o, M) to inputs (J, M) from rest; o = 1, or with sensitivities 1 + k.

        Args:
            instants: (N,) times, not decreasing.
            changes: (J,) times at which the inputs take their values, increasing.
            inputs: (J, M) their values from there on, about the level of rest.
            straight: whether inputs go straight from value to value; else they are held.
            late: whether a delayed change of the input that falls on an instant belongs to the slope there.
            sensitive: whether the derivatives by all parameters are returned, too.
        """
        f, c = self.sensitive if sensitive else self._chain
        return run(f, np.atleast_2d(c), instants, changes + self.dead_time, np.ascontiguousarray(inputs),
                   (straight, late), np.zeros((len(f), inputs.shape[1])))

    def free_response(self, instants: Array, first: float) -> Array:
        """Return the responses (N, n) of the output to unit states of all sections at a first time, without input."""
        (f, row), n = self._chain, self.structure.order
        start = np.vstack([np.zeros((2, n)), np.eye(n)])
        return run(f, row[None], instants, np.array([first]), np.zeros((1, n)), (False, True), start)[:, 0]

    def transfer(self, s: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Return G(s) exp(-theta s) at complex s."""
        found = (self.value("tau_zero") * s + 1) * np.exp(-self.dead_time * s)
        for tau in self.p[: self.structure.real]:
            found = found / (tau * s + 1)
        if self.structure.pair:
            size, zeta = self.value("T"), self.value("zeta")
            found = found / (size**2 * s**2 + 2 * zeta * size * s + 1)
        return found / s if self.structure.integrator else found

    def equation(self) -> str:
        """Return the transfer function without its gain as text."""
        above = f"({self.value('tau_zero'):.4g} s + 1)" if self.structure.zero else ""
        parts = ["s"] * self.structure.integrator + [f"({tau:.4g} s + 1)" for tau in self.p[: self.structure.real]]
        if self.structure.pair:
            size, zeta = self.value("T"), self.value("zeta")
            parts.append(f"({size**2:.4g} s^2 + {2 * zeta * size:.4g} s + 1)")
        late = f" exp(-{self.dead_time:.4g} s)" if self.structure.delay else ""
        below = " ".join(parts)
        return f"{above or 1}/{f'[{below}]' if len(parts) > 1 else below}{late}"

    def to_dict(self) -> dict[str, Any]:
        """Describe the dynamics in JSON types."""
        return {"process": self.structure.word, **dict(zip(self.structure.names, self.p.tolist()))}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "ProcessDynamics":
        """Build what `to_dict` described."""
        structure = ProcessStructure.read(content["process"])
        return cls(structure, np.array([content[name] for name in structure.names], dtype=float))


def _first_order(f: Array, at: int, drive: Array, tau: float) -> tuple[int, Array]:
    """Enter ``tau x' = drive - x``; return the next place and the row of x."""
    f[at] = drive / tau
    f[at, at] -= 1 / tau
    return at + 1, np.eye(len(f))[at]


def _second_order(f: Array, at: int, drive: Array, size: float, zeta: float) -> tuple[int, Array]:
    """Enter ``T x1' = x2, T x2' = drive - x1 - 2 zeta x2``; return the next place and the row of x1."""
    f[at, at + 1] = 1 / size
    f[at + 1] = drive / size
    f[at + 1, at] -= 1 / size
    f[at + 1, at + 1] -= 2 * zeta / size
    return at + 2, np.eye(len(f))[at]


def read_structures(process: Any, inputs: Sequence[str], outputs: Sequence[str] = ("y",)
                    ) -> tuple[tuple[ProcessStructure | None, ...], ...]:
    """Read the types of all pairs, a row per output; None or "none" where an input has no effect on it.

    One type is that of all pairs, one per input that of every output; rows may follow one another in one list
    (`StructureError`: other numbers of them, an output without any process).
    """
    rows = [process] * len(outputs)
    if isinstance(process, list | tuple):
        if any(isinstance(row, list | tuple) for row in process):
            rows = list(process)
        elif len(process) == len(inputs) * len(outputs):
            rows = [process[i : i + len(inputs)] for i in range(0, len(process), len(inputs))]
    if len(rows) != len(outputs):
        raise StructureError(f"process has {len(rows)} rows for {len(outputs)} outputs ({', '.join(outputs)}): one row "
                             "of types per output, one type per input")
    found = []
    for row, output in zip(rows, outputs):
        words = list(row) if isinstance(row, list | tuple) else [row] * len(inputs)
        where = f"for output {output!r} " * (len(outputs) > 1)
        if len(words) != len(inputs):
            raise StructureError(f"process {where}has {len(words)} entries for {len(inputs)} inputs "
                                 f"({', '.join(inputs)})")
        found.append(tuple(None if word is None or word == "none" else ProcessStructure.read(word) for word in words))
        if not any(found[-1]):
            raise StructureError(f"process {where}names no type: leave the output out where no input has an effect")
    return tuple(found)

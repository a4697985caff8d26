"""One delayed response to one input: its structure, and the descent over its poles.

Everything linear is projected out; Gauss-Newton steps move the logarithms of the time constants and the angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optid.arrays import Array
from optid.identify.informativity.signals import Poles, WhitenedRegression, delay, respond

ROUNDING = 1e-13
STEPS, FARTHEST, NUDGE = 12, 1.0, 1e-6  # of a descent; longest step in a logarithm; step of a difference
ENOUGH = 1e-3  # fall of twice the log likelihood at which a descent ends
SURE, BEHIND = 2, 20.0  # step from which on a descent is given up that promises a criterion so far behind the best


@dataclass(frozen=True)
class Term:
    """Structure of one response: real poles and complex pairs as logarithms of time constants, and angles."""

    taus: tuple[float, ...]  # logarithms
    pairs: tuple[tuple[float, float], ...]  # (logarithm of the time constant, angle)
    lag: int
    zeros: int  # coefficients of B after the first
    integrates: bool = False

    @classmethod
    def of(cls, poles: Sequence[complex] | Poles, lag: int, zeros: int = 0) -> "Term":
        """Return the structure of poles, which come in conjugate pairs."""
        factors = np.asarray(poles, dtype=complex)
        real = [_time(float(p.real)) for p in factors if p.imag == 0]
        # equal time constants have the same derivative
        spread = [tau + 0.03 * i for i, tau in enumerate(sorted(real))]
        pairs = [(_time(abs(p)), float(abs(np.angle(p)))) for p in factors if p.imag > 0]
        return cls(tuple(spread), tuple(pairs), lag, zeros)

    @property
    def z(self) -> Array:
        """What a descent moves."""
        return np.array([*self.taus, *(x for pair in self.pairs for x in pair)])

    def at(self, z: Array) -> "Term":
        """Return the same structure with other poles."""
        n = len(self.taus)
        return replace(self, taus=tuple(z[:n].tolist()), pairs=tuple(map(tuple, z[n:].reshape(-1, 2).tolist())))

    @property
    def poles(self) -> Poles:
        """Poles (n,), conjugates beside each other."""
        real = [np.exp(-np.exp(-tau)) for tau in self.taus]
        pairs = [np.exp(-np.exp(-tau) + sign * 1j * angle) for tau, angle in self.pairs for sign in (1, -1)]
        return np.array([*([1.0] * self.integrates), *real, *pairs], dtype=complex)

    @property
    def key(self) -> tuple[int, ...]:
        """What tells structures apart, without the values of the poles."""
        return len(self.taus), len(self.pairs), self.lag, self.zeros, int(self.integrates)

    @property
    def order(self) -> int:
        """Number of poles."""
        return len(self.taus) + 2 * len(self.pairs) + self.integrates


def _time(modulus: float) -> float:
    """Logarithm of the time constant of a pole."""
    return float(np.log(-1 / np.log(np.clip(modulus, 1e-6, 1 - 1e-7))))


@dataclass(frozen=True, eq=False)
class Drive:
    """What drives a response: f(u) per experiment, and what its bends cost in parameters."""

    values: tuple[Array, ...]
    nodes: Array | None = None
    heights: Array | None = None

    @property
    def parameters(self) -> int:
        """Number of bends of f."""
        return 0 if self.nodes is None else self.nodes.size - 2


@dataclass(frozen=True, eq=False)
class FittedTerm:
    """A response fitted beside what is projected out: sum of squares and coefficients, and the criterion."""

    term: Term
    drive: Drive
    energy: float
    theta: Array
    criterion: float


def columns_of(term: Term, values: Sequence[Array]) -> list[Array]:
    """Return what each coefficient of B multiplies, (T, zeros + 1) per experiment."""
    responses = [respond(term.poles, u) for u in values]
    return [np.column_stack([delay(v, term.lag + j) for j in range(term.zeros + 1)]) for v in responses]


def slowest_of(poles: Poles) -> float:
    """Return the modulus of the slowest pole; 1 with a pole at 1."""
    return 1.0 if np.any(poles == 1) else float(np.max(np.abs(poles), initial=0.0))


def refine_poles(regression: WhitenedRegression, drive: Drive, term: Term, below: float = np.inf) -> FittedTerm:
    """Descend over the poles of one response by Gauss-Newton steps, each along coefficients and poles together.

    The descent ends early where its steps promise no criterion near `below`.
    """
    most = np.log(20 * max(len(u) for u in drive.values))
    at, rows = term, max(regression.count, 2)

    def criterion(energy: float) -> float:
        count = at.z.size + at.zeros + 2 + free + regression.noise.size - 1 + drive.parameters
        return float(rows * np.log(max(energy / rows, ROUNDING**2)) + count * np.log(rows))

    energy, theta, free, columns = solve_coefficients(regression, drive, at)
    for turn in range(STEPS if at.z.size and regression.count > at.z.size + at.zeros + 1 else 0):
        slowest, moved = slowest_of(at.poles), []
        for one in np.eye(at.z.size) * NUDGE:
            there = columns_of(at.at(at.z + one), drive.values)
            moved.append([(x - here) @ theta / NUDGE for x, here in zip(there, columns)])
        whole = [np.column_stack([x, *(m[i] for m in moved)]) for i, x in enumerate(columns)]
        promised, step, _, _ = regression.solve(whole, slowest)
        if turn >= SURE and criterion(promised) > below + BEHIND:
            break
        step = step[theta.size :]
        step *= min(1.0, FARTHEST / max(float(np.max(np.abs(step), initial=0.0)), 1e-300))
        for share in (1.0, 0.25, 0.05):
            z = np.clip(at.z + share * step, -4, most)
            found = solve_coefficients(regression, drive, at.at(z))
            if found[0] < energy:
                break
        else:
            break
        fall, at = energy - found[0], at.at(z)
        energy, theta, free, columns = found
        if regression.count * fall <= ENOUGH * energy:
            break
    return FittedTerm(at, drive, energy, theta, criterion(energy))


def solve_coefficients(regression: WhitenedRegression, drive: Drive, term: Term) -> tuple[float, Array, int,
                                                                                          list[Array]]:
    """Return sum of squares, coefficients of B, what was projected out, and the columns."""
    columns = columns_of(term, drive.values)
    energy, theta, _, free = regression.solve(columns, slowest_of(term.poles))
    return energy, theta, free, columns

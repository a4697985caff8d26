"""Errors and their sensitivities as small factors: compressed chunk by chunk, put together over experiments.

A block of rows [x0 | shared | errors] leaves a Gram matrix, or a triangular factor where that would have too few
digits. The initial states of an experiment are eliminated within it. Whose errors they are does not matter here.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from optid.arrays import Array
from optid.statistics.factors import add_to_root, any_root_of_gram, conditioning

# condition number of the scaled sensitivities beyond which the Gram matrix, which squares it, has too few digits
CONDITION_LIMIT = 1e6


# Gram matrix, QR decomposition (slower, twice the digits), or "qr" where the condition number requires it
Method = Literal["auto", "gram", "qr"]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Errors (model less record) near a point: ``|e(x + dx)|² = |root dx_s + pull|² + states + remainder``."""

    root: Array  # (p, p) upper triangular factor for the shared unknowns, initial states eliminated
    pull: Array  # (p,) compressed errors
    # (X, S, e) of every experiment: its initial state moves by ``-X^+ (S dx_s + e)``
    states: tuple[tuple[Array, Array, Array], ...]
    remainder: float  # what no step changes
    rows: int  # outputs present
    condition: float  # estimated condition number of the column-scaled factor
    method: Literal["gram", "qr"]  # "gram" or "qr"
    given: tuple[Array, Array] | None = None  # another factor and errors of all unknowns, with the same gradient

    @property
    def exact(self) -> bool:
        """Whether the factor has the digits that a Gram matrix of its condition lacks."""
        return self.method == "qr" or self.condition < CONDITION_LIMIT

    @property
    def reach(self) -> float:
        """By how much a full step of the linearised problem would lower the sum of squares."""
        return float(self.pull @ self.pull) + sum(float(e @ e) for _, _, e in self.states)

    @property
    def value(self) -> float:
        """Sum of squared errors at the point."""
        return self.reach + self.remainder

    def follow(self, step: Array) -> Array:
        """Return the steps (E n,) of the initial states that belong to a step (p,) of the shared unknowns."""
        moves = [-np.linalg.lstsq(x, s @ step + e, rcond=1e-12)[0] for x, s, e in self.states]
        return np.asarray(np.concatenate([*moves, np.zeros(0)]), dtype=float)

    def after(self, step: Array) -> float:
        """Return the sum of squares of the linear errors after a step of all unknowns."""
        matrix, errors = self.whole
        rest = matrix @ step + errors
        return self.value + float(rest @ rest - errors @ errors)

    @property
    def pulled(self) -> Array:
        """Half the gradient (p + E n,) of the sum of squares."""
        matrix, errors = self.whole
        return matrix.T @ errors

    @cached_property
    def whole(self) -> tuple[Array, Array]:
        """Factor (p + E n, p + E n) and errors of all unknowns together, initial states last."""
        if self.given is not None:
            return self.given
        p, n = len(self.pull), len(self.states[0][0])
        total = p + n * len(self.states)
        matrix, errors = np.zeros((total, total)), np.zeros(total)
        matrix[:p, :p], errors[:p] = self.root, self.pull
        for i, (x, s, e) in enumerate(self.states):
            rows = slice(p + i * n, p + (i + 1) * n)
            matrix[rows, :p], matrix[rows, rows], errors[rows] = s, x, e
        return matrix, errors


def linearise_errors(blocks: Callable[[int], Iterable[tuple[Array, int]]], experiments: int, n: int, p: int,
                     gauge: Array | None = None, method: Method = "auto") -> Linearised:
    """Compress the errors of all experiments with their sensitivities by n initial states and p shared unknowns.

    ``blocks`` yields the rows [x0 | shared | errors] of an experiment by its number, and how many errors each block
    has; it is asked again where a QR decomposition is needed. The gauge (rows, p) holds directions without effect,
    which are given weight.
    """
    use: Literal["gram", "qr"] = "qr" if method == "qr" else "gram"
    factors, rows = zip(*(compress_blocks(blocks(i), n + p + 1, use, gauge, n) for i in range(experiments)))
    states, rest = zip(*(eliminate_state(factor, n) for factor in factors))
    triangle = rest[0] if experiments == 1 else np.linalg.qr(np.vstack(rest), mode="r")
    full = np.zeros((p + 1, p + 1))
    full[: len(triangle)] = triangle
    condition = conditioning(full[:p, :p] * np.where(np.diag(full)[:p] < 0, -1.0, 1.0)[:, None]) if p else 1.0
    if method == "auto" and not condition < CONDITION_LIMIT:
        return linearise_errors(blocks, experiments, n, p, gauge, "qr")
    return Linearised(full[:p, :p], full[:p, p], states, float(full[p, p] ** 2), sum(rows), condition, use)


def compress_blocks(blocks: Iterable[tuple[Array, int]], columns: int, method: str, gauge: Array | None = None,
                    first: int = 0) -> tuple[Array, int]:
    """Return a factor of the rows [x0 | shared | (measured) | errors] of an experiment, and the number of errors.

    Columns of a state that is forgotten may be missing on the left. The gauge, as in `linearise_errors`, takes part
    before the factorisation by "gram" or "qr", which so is regular; column ``first`` is that of the first shared
    unknown.
    """
    def add(block: Array) -> None:
        used = slice(columns - block.shape[1], None)
        total[used, used] = add_to_root(total[used, used], block) if exact else total[used, used] + block.T @ block

    total, rows, exact = np.zeros((columns, columns)), 0, method == "qr"
    for block, count in blocks:
        rows += count
        add(block)
    if gauge is not None and len(gauge):
        span, extra = slice(first, first + gauge.shape[1]), np.zeros((len(gauge), columns))
        energy = (np.sum(total**2, axis=0) if exact else np.diag(total))[span]
        sizes = np.abs(gauge)  # directions without effect get a weight of the size of the others
        lengths = sizes @ np.sqrt(energy) / np.maximum(np.sum(sizes, axis=1), 1e-300)
        extra[:, span] = gauge * np.where(lengths > 0, lengths, 1.0)[:, None]
        add(extra)
    return total if exact else any_root_of_gram(total), rows


def eliminate_state(factor: Array, n: int) -> tuple[tuple[Array, Array, Array], Array]:
    """Split an upper triangular factor of [x0 | shared | errors] into the part of x0 and the rest."""
    return (factor[:n, :n], factor[:n, n:-1], factor[:n, -1]), factor[n:, n:]

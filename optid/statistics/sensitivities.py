"""Simulation errors of a Hammerstein model and their sensitivities, compressed chunk by chunk.

The model ``A(q) y = sum_c B_c(q) f_c(u_c) + d``, with an initial state that enters the first n equations, has

    dy/da_i = -q^-i y / A,   dy/dmu_c = B_c eta_c / A,   dy/db_cj = q^-(nk_c + j) f_c / A,   dy/dd = 1 / A,

so that one all-pole filter of the basis functions (na columns never, P per input) gives all of them by shifts and
weighted sums. What leaves a chunk is a Gram matrix of [sensitivities | errors] (`optid.statistics.linearised`); the
filters keep their states from one chunk to the next.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optid.arrays import Array
from optid.models.layout import Layout
from optid.statistics.linearised import CONDITION_LIMIT, Compressed, Linearised, assembled, compressed, eliminated

if TYPE_CHECKING:
    from optid.data.record import Data

CHUNK = 4096
"""Samples whose sensitivities are formed at a time: they stay in the processor's cache."""

TABLE = 1 << 18
"""Values of basis functions that are kept between linearisations: as many as stay in the processor's cache."""

FORGOTTEN = 1e-13
"""Share of its peak below which the response to the initial state no longer informs about it."""


@dataclass(frozen=True, eq=False)
class PlantPoint:
    """Values of the unknowns of a simulation.

    Attributes:
        a: (na,) coefficients of A.
        mus: (P_c,) coefficients of f_c, one array per input.
        bs: (nb_c,) coefficients of B_c, one array per input.
        offset: constant of the equation.
        x0: (E, n) what the past of every experiment adds to its first n equations.
    """

    a: Array
    mus: tuple[Array, ...]
    bs: tuple[Array, ...]
    offset: float
    x0: Array


@dataclass(frozen=True)
class Unknowns:
    """The unknowns of a simulation as one vector x = [a; mu_1; b_1; mu_2; ...; offset; x0 of every experiment].

    Attributes:
        layout: orders and bases; one output.
        experiments: number of experiments.
        free: whether the coefficients of every nonlinearity are unknown; where not, mu is one (`Linear`).
        constant: whether the offset is unknown; where not, it is zero.
    """

    layout: Layout
    experiments: int
    free: tuple[bool, ...]
    constant: bool = True

    @property
    def memory(self) -> int:
        """Size n of an initial state."""
        return self.layout.first_row

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where every part stands in x: "a", "mu0", "b0", "mu1", ..., "offset"."""
        parts = [("a", self.layout.na)]
        for c, (basis, nb) in enumerate(zip(self.layout.bases, self.layout.nb)):
            parts += [(f"mu{c}", basis.size if self.free[c] else 0), (f"b{c}", nb)]
        found, position = {}, 0
        for name, size in [*parts, ("offset", int(self.constant))]:
            found[name] = slice(position, position + size)
            position += size
        return found

    @property
    def shared(self) -> int:
        """Number of unknowns that all experiments share: the first entries of x."""
        return self.slices["offset"].stop

    @property
    def size(self) -> int:
        """Length of x."""
        return self.shared + self.experiments * self.memory

    def pack(self, point: PlantPoint) -> Array:
        """Return x of a point."""
        parts = [point.a]
        for c, (mu, b) in enumerate(zip(point.mus, point.bs)):
            parts += [mu[: len(mu) if self.free[c] else 0], b]
        return np.concatenate([*parts, [point.offset][: int(self.constant)], point.x0.ravel()])

    def unpack(self, x: Array) -> PlantPoint:
        """Return the point of x."""
        at = self.slices
        inputs = range(self.layout.m)
        return PlantPoint(x[at["a"]], tuple(x[at[f"mu{c}"]] if self.free[c] else np.ones(1) for c in inputs),
                          tuple(x[at[f"b{c}"]] for c in inputs), float(np.sum(x[at["offset"]])),
                          x[self.shared :].reshape(self.experiments, self.memory))


def expanded(data: "Data", layout: Layout, limit: int = TABLE) -> tuple[Array, ...] | None:
    """Return the basis functions (N, P) of all inputs side by side for every experiment, None beyond a limit.

    Descents on short records evaluate them once instead of at every point.

    Args:
        data: the record.
        layout: orders and bases.
        limit: numbers that are kept at most.
    """
    if data.n_samples * sum(basis.size for basis in layout.bases) > limit:
        return None
    return tuple(np.hstack([basis.values(e.u[:, c]) for c, basis in enumerate(layout.bases)]) for e in data.experiments)


def linearise(data: "Data", unknowns: Unknowns, point: PlantPoint, *, gauge: Array | None = None,
              method: Literal["auto", "gram", "qr"] = "auto", chunk: int = CHUNK,
              functions: Sequence[Array] | None = None) -> Linearised:
    """Simulate a model over all experiments and compress its errors with their sensitivities.

    Args:
        data: the record; missing outputs drop out of the sum, the state goes on.
        unknowns: their order.
        point: where; A must be stable.
        gauge: (rows, p) directions of the shared unknowns that change no simulation (the scale between mu and b).
            They are given weight in the factor, so that it is not singular; at the point they contribute nothing.
        method: "gram", "qr" (slower, twice the digits), or "auto": "qr" where the condition number asks for it.
        chunk: samples at a time.
        functions: what `expanded` returned for the record.
    """
    use: Literal["gram", "qr"] = "qr" if method == "qr" else "gram"
    alone = unknowns.experiments == 1  # then the gauge takes part before the factorisation, which so is regular
    parts = [_experiment(data, unknowns, point, i, use, chunk, gauge if alone else None, functions)
             for i in range(unknowns.experiments)]
    found = assembled(parts, unknowns.memory, unknowns.shared, None if alone else gauge, use)
    if method == "auto" and not found.condition < CONDITION_LIMIT:
        return linearise(data, unknowns, point, gauge=gauge, method="qr", chunk=chunk, functions=functions)
    return found


def instruments(data: "Data", unknowns: Unknowns, point: PlantPoint, chunk: int = CHUNK,
                functions: Sequence[Array] | None = None) -> Array:
    """Return the Gram matrix (p + na + 1) of [sensitivities | -q^-i y_measured / A | errors] without initial states.

    It holds the normal equations of Steiglitz-McBride and of the refined instrumental variable: in both the measured
    output takes the place of the simulated one in the columns of a. Missing outputs are replaced by simulated ones.
    """
    total = np.zeros((unknowns.shared + unknowns.layout.na + 1,) * 2)
    for i in range(unknowns.experiments):
        part = _experiment(data, unknowns, point, i, "gram", chunk, None, functions, measured=True)
        _, rest = eliminated(part.factor, unknowns.memory)
        total += rest.T @ rest
    return total


def simulate(data: "Data", unknowns: Unknowns, point: PlantPoint, chunk: int = CHUNK) -> list[Array]:
    """Return the simulated output (N,) of every experiment."""
    found = []
    for i, e in enumerate(data.experiments):
        run = _Run(unknowns, point, point.x0[i], chunk)
        found.append(np.concatenate([run.advance(e.u[k : k + chunk]) for k in range(0, len(e.u), chunk)]))
    return found


def _experiment(data: "Data", unknowns: Unknowns, point: PlantPoint, index: int, method: str, chunk: int,
                gauge: Array | None, functions: Sequence[Array] | None, measured: bool = False) -> Compressed:
    e = data.experiments[index]
    columns = unknowns.memory + unknowns.shared + measured * unknowns.layout.na + 1
    table = None if functions is None else functions[index]
    found = _blocks(e.u, e.y[:, 0], unknowns, point, point.x0[index], chunk, measured, table)
    return compressed(found, columns, method, gauge, unknowns.memory)


def _blocks(u: Array, y: Array, unknowns: Unknowns, point: PlantPoint, x0: Array, chunk: int, measured: bool,
            functions: Array | None) -> Iterator[tuple[Array, int]]:
    """Yield [x0 | shared | (measured) | errors] of every chunk with zeros where the output is missing, and its rows."""
    run = _Run(unknowns, point, x0, chunk)
    n, na, at = unknowns.memory, unknowns.layout.na, unknowns.slices
    history = np.zeros((na, 2))  # simulated and measured output through 1 / A
    for start in range(0, len(u), chunk):
        output = run.advance(u[start : start + chunk], None if functions is None else functions[start : start + chunk])
        target, count = y[start : start + chunk], len(output)
        missing = np.isnan(target)
        past = np.empty((na + count, 2 if measured else 1))
        past[:na], past[na:, 0] = history[:, : past.shape[1]], output
        if measured:
            past[na:, 1] = np.where(missing, output, target)
        all_pole(point.a, past, na)
        history = past[len(past) - na :] if measured else np.repeat(past[len(past) - na :], 2, axis=1)
        head = 0 if run.forgotten else n
        block = np.empty((count, head + unknowns.shared + measured * na + 1))
        for i in range(head):
            block[:, i] = run.shifted(run.impulse, i)
        for i in range(1, na + 1):
            block[:, head + i - 1] = -past[na - i : na - i + count, 0]
            if measured:
                block[:, head + unknowns.shared + i - 1] = -past[na - i : na - i + count, 1]
        for c, lags in enumerate(unknowns.layout.lags):
            if unknowns.free[c]:
                mus = slice(head + at[f"mu{c}"].start, head + at[f"mu{c}"].stop)
                block[:, mus] = run.through_numerator(c)
            for j, lag in enumerate(lags):
                block[:, head + at[f"b{c}"].start + j] = run.shifted_function(c, lag)
        if unknowns.constant:
            block[:, head + at["offset"].start] = run.shifted(run.step, 0)
        block[:, -1] = output - target
        block[missing] = 0.0
        yield block, count - int(np.count_nonzero(missing))


class _Run:
    """A simulation in chunks: basis functions, the constant and an impulse through 1 / A, with n samples of history."""

    def __init__(self, unknowns: Unknowns, point: PlantPoint, x0: Array, chunk: int) -> None:
        self.unknowns, self.point, self.x0 = unknowns, point, x0
        sizes = [basis.size for basis in unknowns.layout.bases]
        edges = np.cumsum([0, *sizes])
        self.spans = [slice(int(i), int(j)) for i, j in zip(edges[:-1], edges[1:])]
        self.step, self.impulse = int(edges[-1]), int(edges[-1]) + 1
        self.filtered = np.zeros((unknowns.memory, self.impulse + 1))
        self.functions: list[Array] = []
        self.count, self.started, self.peak, self.forgotten = 0, False, 0.0, False

    def advance(self, u: Array, functions: Array | None = None) -> Array:
        """Filter the next chunk (T, m) of the input, or its basis functions, and return the simulated output (T,)."""
        n, layout, point = self.unknowns.memory, self.unknowns.layout, self.point
        if self.started and not self.forgotten:
            tail = float(np.max(np.abs(self.filtered[len(self.filtered) - n :, self.impulse]), initial=0.0))
            self.forgotten = tail <= FORGOTTEN * self.peak
        self.count = len(u)
        table = np.empty((n + self.count, self.impulse + 1))
        table[:n] = self.filtered[len(self.filtered) - n :]
        if functions is not None:
            table[n:, : self.step] = functions
        for c, (basis, span) in enumerate(zip(layout.bases if functions is None else (), self.spans)):
            table[n:, span] = basis.values(u[:, c])
        table[n:, self.step], table[n:, self.impulse] = 1.0, 0.0
        table[n, self.impulse] += not self.started
        all_pole(point.a, table, n)
        self.filtered, self.started = table, True
        self.peak = max(self.peak, float(np.max(np.abs(table[:, self.impulse]))))
        self.functions = [table[:, span] @ mu for span, mu in zip(self.spans, point.mus)]
        output = point.offset * self.shifted(self.step, 0)
        for c, lags in enumerate(layout.lags):
            for b, lag in zip(point.bs[c], lags):
                output += b * self.shifted_function(c, lag)
        for i, value in enumerate(self.x0 if not self.forgotten else ()):
            output += value * self.shifted(self.impulse, i)
        return output

    def shifted(self, column: int, lag: int) -> Array:
        """Return a filtered signal of the chunk, delayed."""
        start = self.unknowns.memory - lag
        return self.filtered[start : start + self.count, column]

    def shifted_function(self, c: int, lag: int) -> Array:
        """Return f_c / A, delayed."""
        start = self.unknowns.memory - lag
        return self.functions[c][start : start + self.count]

    def through_numerator(self, c: int) -> Array:
        """Return B_c eta_c / A, (T, P_c)."""
        total = np.zeros((self.count, self.spans[c].stop - self.spans[c].start))
        for b, lag in zip(self.point.bs[c], self.unknowns.layout.lags[c]):
            start = self.unknowns.memory - lag
            total += b * self.filtered[start : start + self.count, self.spans[c]]
        return total


def all_pole(a: Array, table: Array, first: int) -> None:
    """Filter every column of a table (first + T, K) by 1 / A in place, given its first rows already filtered.

    Args:
        a: (na,) coefficients of A without the leading one, na <= first.
        table: C-contiguous.
        first: rows of history.
    """
    if len(a):
        _all_pole()(np.ascontiguousarray(a), table, first)


def _march(a: Array, table: Array, first: int) -> None:
    for k in range(first, table.shape[0]):
        for i in range(a.size):
            for c in range(table.shape[1]):
                table[k, c] -= a[i] * table[k - 1 - i, c]


@cache
def _all_pole() -> Any:
    from numba import njit

    return njit(cache=True, nogil=True)(_march)

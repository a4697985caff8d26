"""Simulation errors of a Hammerstein model and their sensitivities, compressed chunk by chunk.

The model ``A(q) y = sum_c B_c(q) f_c(u_c) + d``, with an initial state that enters the first n equations, has

    dy/da_i = -q^-i y / A,   dy/dmu_c = B_c eta_c / A,   dy/db_cj = q^-(nk_c + j) f_c / A,   dy/dd = 1 / A,

so that one all-pole filter of the basis functions (na columns never, P per input) gives all of them by shifts and
weighted sums. What leaves a chunk is a Gram matrix of [sensitivities | errors]; the filters keep their states from one
chunk to the next. The initial states of an experiment are eliminated within it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optid.bases.basis import Array
from optid.regressors.factors import add_to_root, conditioning
from optid.regressors.layout import Layout

if TYPE_CHECKING:
    from optid.data import Data

CHUNK = 4096
"""Samples whose sensitivities are formed at a time: they stay in the processor's cache."""

TABLE = 1 << 18
"""Values of basis functions that are kept between linearisations: as many as stay in the processor's cache."""

CONDITION_LIMIT = 1e6
"""Condition number of the scaled sensitivities beyond which the Gram matrix, which squares it, has too few digits."""

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


@dataclass(frozen=True, eq=False)
class Linearised:
    """Simulation errors (model less record) near a point: ``|e(x + dx)|² = |root dx_s + pull|² + states + remainder``.

    Attributes:
        root: (p, p) upper triangular factor for the shared unknowns, initial states eliminated.
        pull: (p,) compressed errors.
        states: (X, S, e) of every experiment: its initial state moves by ``-X^+ (S dx_s + e)``.
        remainder: what no step changes.
        rows: outputs present.
        condition: estimated condition number of the column-scaled factor.
        method: "gram" or "qr".
    """

    root: Array
    pull: Array
    states: tuple[tuple[Array, Array, Array], ...]
    remainder: float
    rows: int
    condition: float
    method: Literal["gram", "qr"]

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

    @cached_property
    def whole(self) -> tuple[Array, Array]:
        """Factor (p + E n, p + E n) and errors of all unknowns together, initial states last."""
        p, n = len(self.pull), len(self.states[0][0])
        total = p + n * len(self.states)
        matrix, errors = np.zeros((total, total)), np.zeros(total)
        matrix[:p, :p], errors[:p] = self.root, self.pull
        for i, (x, s, e) in enumerate(self.states):
            rows = slice(p + i * n, p + (i + 1) * n)
            matrix[rows, :p], matrix[rows, rows], errors[rows] = s, x, e
        return matrix, errors


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


def assembled(parts: Sequence["Compressed"], n: int, p: int, gauge: Array | None, method: Literal["gram", "qr"]
              ) -> Linearised:
    """Put the experiments together.

    Args:
        parts: one for each experiment.
        n: size of an initial state.
        p: number of shared unknowns.
        gauge: as in `linearise`.
        method: how the parts were compressed.
    """
    states, rest = zip(*(_eliminated(part.factor, n) for part in parts))
    rows_of_gauge = _weighted(gauge, np.sum([np.sum(part[:, :p] ** 2, axis=0) for part in rest], axis=0))
    together = len(rest) > 1 or len(rows_of_gauge)
    stacked = np.vstack([*rest, *rows_of_gauge])
    triangle = np.linalg.qr(stacked, mode="r") if together else stacked
    full = np.zeros((p + 1, p + 1))
    full[: len(triangle)] = triangle
    condition = conditioning(full[:p, :p] * np.where(np.diag(full)[:p] < 0, -1.0, 1.0)[:, None]) if p else 1.0
    rows = sum(part.rows for part in parts)
    return Linearised(full[:p, :p], full[:p, p], states, float(full[p, p] ** 2), rows, condition, method)


def instruments(data: "Data", unknowns: Unknowns, point: PlantPoint, chunk: int = CHUNK,
                functions: Sequence[Array] | None = None) -> Array:
    """Return the Gram matrix (p + na + 1) of [sensitivities | -q^-i y_measured / A | errors] without initial states.

    It holds the normal equations of Steiglitz-McBride and of the refined instrumental variable: in both the measured
    output takes the place of the simulated one in the columns of a. Missing outputs are replaced by simulated ones.
    """
    total = np.zeros((unknowns.shared + unknowns.layout.na + 1,) * 2)
    for i in range(unknowns.experiments):
        part = _experiment(data, unknowns, point, i, "gram", chunk, None, functions, measured=True)
        _, rest = _eliminated(part.factor, unknowns.memory)
        total += rest.T @ rest
    return total


def simulate(data: "Data", unknowns: Unknowns, point: PlantPoint, chunk: int = CHUNK) -> list[Array]:
    """Return the simulated output (N,) of every experiment."""
    found = []
    for i, e in enumerate(data.experiments):
        run = _Run(unknowns, point, point.x0[i], chunk)
        found.append(np.concatenate([run.advance(e.u[k : k + chunk]) for k in range(0, len(e.u), chunk)]))
    return found


@dataclass(frozen=True, eq=False)
class Compressed:
    """One experiment: a factor of [x0 | shared | (measured) | errors], and the number of errors in it."""

    factor: Array
    rows: int


def compressed(blocks: Iterable[tuple[Array, int]], columns: int, method: str, gauge: Array | None = None,
               first: int = 0) -> Compressed:
    """Add up the blocks of an experiment; columns of a state that is forgotten may be missing on the left.

    Args:
        blocks: (rows, columns) and the number of errors in each.
        columns: number of columns.
        method: "gram" or "qr".
        gauge: (rows, p) directions without effect, which are given weight; None for none.
        first: column of their first unknown.
    """
    total, rows = np.zeros((columns, columns)), 0
    for block, count in blocks:
        rows += count
        used = slice(columns - block.shape[1], None)
        if method == "qr":
            total[used, used] = add_to_root(total[used, used], block) if used.start else add_to_root(total, block)
        else:
            total[used, used] += block.T @ block
    if gauge is not None and len(gauge):
        span = slice(first, first + gauge.shape[1])
        energy = np.sum(total[:, span] ** 2, axis=0) if method == "qr" else np.diag(total)[span]
        extra = np.zeros((len(gauge), columns))
        extra[:, first:] = _weighted(gauge, energy)[0]
        total = add_to_root(total, extra) if method == "qr" else total + extra.T @ extra
    return Compressed(total if method == "qr" else _factor(total), rows)


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


def _factor(gram: Array) -> Array:
    """Return F (square) with F^T F = gram, whatever its rank; the columns are scaled to norm one in between."""
    size = np.sqrt(np.maximum(np.diag(gram), 0.0))
    size[size == 0] = 1.0
    scaled = gram / np.outer(size, size)
    try:
        return np.asarray(np.linalg.cholesky(scaled).T * size, dtype=float)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(scaled)
        root = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r"), dtype=float)
        return root * size


def _eliminated(factor: Array, n: int) -> tuple[tuple[Array, Array, Array], Array]:
    """Split an upper triangular factor of [x0 | shared | errors] into the part of x0 and the rest."""
    return (factor[:n, :n], factor[:n, n:-1], factor[:n, -1]), factor[n:, n:]


def _weighted(gauge: Array | None, energy: Array) -> list[Array]:
    """Rows [gauge | 0] that give the directions without effect a weight of the size of the others, of given energy."""
    if gauge is None or not len(gauge):
        return []
    sizes = np.abs(gauge)
    lengths = sizes @ np.sqrt(energy) / np.maximum(np.sum(sizes, axis=1), 1e-300)
    return [np.hstack([gauge * np.where(lengths > 0, lengths, 1.0)[:, None], np.zeros((len(gauge), 1))])]

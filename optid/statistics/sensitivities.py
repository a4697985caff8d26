"""Prediction errors of transfer-function models and their sensitivities, compressed chunk by chunk.

``y = x + (C/D) e`` with ``A x = sum_c B_c f_c(u_c) + d`` and an initial state in the first n equations. D is A (ARX,
ARMAX) or a polynomial of its own (Box-Jenkins); C = D = 1 is output error, whose e are the simulation errors. With
w = D/A (one where D is A) the predicted output has the partial derivatives

    a_i: -q^-i w x (where D is A: -q^-i y),  mu_c: B_c w eta_c,  b_cj: q^-(nk_c + j) w f_c,  d: w 1,  c_i: q^-i e,
    d_i: -q^-i (y - x),

and all of them pass through 1/C (Ljung 1999, section 10.3): one filter of the basis functions (P per input) gives all
of them by shifts and weighted sums. Filters keep their states from one chunk to the next; what leaves a chunk is a
factor of [sensitivities | errors] (`optid.statistics.linearised`).

Where an output is missing its innovation counts as zero and its prediction takes its place, so that there the recursion
runs through 1/D instead: the sensitivities stay those of the criterion. Where a missing input leaves no prediction the
innovation is zero as well, and starts anew. Where D is A the first innovations, whose lags reach before the record, are
zero; otherwise the initial state of the plant is unknown, and the noise starts from rest.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.models import noise_filter
from optid.models.layout import Layout
from optid.models.noise_filter import DEAD, PRESENT, Filtered
from optid.models.recursions import late_njit
from optid.statistics.linearised import Linearised, Method, compressed, eliminated, linearised
from optid.statistics.unknowns import TransferPoint, TransferUnknowns

if TYPE_CHECKING:
    from optid.data.record import Data

CHUNK = 4096
"""Samples whose sensitivities are formed at a time: they stay in the processor's cache."""

TABLE = 1 << 18
"""Values of basis functions that are kept between linearisations: as many as stay in the processor's cache."""

FORGOTTEN = 1e-13
"""Share of its peak below which the response to the initial state no longer informs about it."""


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


def linearise(data: "Data", unknowns: TransferUnknowns, point: TransferPoint, *, gauge: Array | None = None,
              method: Method = "auto", chunk: int = CHUNK,
              functions: Sequence[Array] | None = None) -> Linearised:
    """Predict over all experiments and compress the errors (predicted less measured) with their sensitivities.

    Args:
        data: the record; missing outputs drop out of the sum.
        unknowns: their order.
        point: where; C must be invertible, and A stable where D is not A.
        gauge: (rows, p) directions of the shared unknowns that change no prediction (the scale between mu and b).
            They are given weight in the factor, so that it is not singular; at the point they contribute nothing.
        method: see `optid.statistics.linearised.Method`.
        chunk: samples at a time.
        functions: what `expanded` returned for the record.
    """
    return linearised(lambda i: blocks(data, unknowns, point, i, functions=functions, chunk=chunk),
                      unknowns.experiments, unknowns.memory, unknowns.shared, gauge, method)


def instruments(data: "Data", unknowns: TransferUnknowns, point: TransferPoint, chunk: int = CHUNK,
                functions: Sequence[Array] | None = None) -> Array:
    """Return the Gram matrix (p + na + 1) of [sensitivities | -q^-i y_measured / A | errors] without initial states.

    It holds the normal equations of Steiglitz-McBride and of the refined instrumental variable: in both the measured
    output takes the place of the simulated one in the columns of a. Missing outputs are replaced by simulated ones.
    There must be no noise filter.
    """
    size = unknowns.shared + unknowns.layout.na + 1
    total = np.zeros((size, size))
    for i in range(unknowns.experiments):
        found = blocks(data, unknowns, point, i, functions=functions, chunk=chunk, measured=True)
        _, rest = eliminated(compressed(found, unknowns.memory + size, "gram")[0], unknowns.memory)
        total += rest.T @ rest
    return total


def simulate(data: "Data", unknowns: TransferUnknowns, point: TransferPoint, chunk: int = CHUNK) -> list[Array]:
    """Return the simulated output (N,) of every experiment; where D is A, the right-hand side of its equation."""
    return [_simulated(data, unknowns, point, i, None, chunk) for i in range(unknowns.experiments)]


def predict(data: "Data", unknowns: TransferUnknowns, point: TransferPoint, index: int, x: Array) -> Filtered:
    """Run the predictor over one experiment.

    The samples that its noise filter explains are y - x, or y where D is A.

    Args:
        data: the record.
        unknowns: their order.
        point: as in `linearise`.
        index: number of the experiment.
        x: (N,) what `simulate` returned for it.
    """
    y = data.experiments[index].y[:, 0]
    if unknowns.apart:
        return noise_filter.innovations(y - x, None, point.c, point.d)
    return noise_filter.innovations(y, x, point.c, point.a, start=unknowns.skipped)


def blocks(data: "Data", unknowns: TransferUnknowns, point: TransferPoint, index: int, *,
           functions: Sequence[Array] | None = None, chunk: int = CHUNK, measured: bool = False
           ) -> Iterator[tuple[Array, int]]:
    """Yield [x0 | shared | (measured) | errors] of every chunk of an experiment, and its number of errors.

    Rows without an error are zero. The columns of x0 are left out where the initial state is forgotten.
    """
    e, layout, at, n = data.experiments[index], unknowns.layout, unknowns.slices, unknowns.memory
    y, na, extra = e.y[:, 0], layout.na, layout.na if measured else 0
    noise, x, innovations, explained = None, np.zeros(0), np.zeros(0), np.zeros(0)
    depth = max(unknowns.nc, len(point.d))
    if not unknowns.plain:
        x = _simulated(data, unknowns, point, index, functions, chunk)
        noise = predict(data, unknowns, point, index, x)
        innovations, explained = (np.pad(signal, (depth, 0)) for signal in (noise.innovations, noise.filled))
        explained = np.nan_to_num(explained)
    history, kinds = np.zeros((depth, n + unknowns.shared + 1)), np.full(depth, DEAD, dtype=np.int8)
    head, run = n, _Run(unknowns, point, index, whitened=True)
    past = np.zeros((na + len(run.d), 1 + measured))  # outputs of the plant and measured ones through 1 / A
    for start in range(0, len(y), chunk):
        part = slice(start, min(start + chunk, len(y)))
        count = part.stop - part.start
        run.advance(e.u[part], None if functions is None else functions[index][part])
        output = run.output() if noise is None else x[part]
        if head and run.forgotten and np.max(np.abs(history[:, :n]), initial=0.0) <= FORGOTTEN * run.peak:
            head, history = 0, history[:, n:]
        block = np.empty((depth + count, head + unknowns.shared + extra + 1))
        if depth:
            block[:depth] = history
        rows = block[depth:]
        for i in range(head):
            rows[:, i] = run.shifted(run.impulse, i)
        if unknowns.apart and na:
            lines = np.empty((len(past) + count, 1 + measured))
            lines[: len(past)], lines[len(past) :, 0] = past, output
            if measured:
                lines[len(past) :, 1] = np.where(np.isnan(y[part]), output, y[part])
            all_pole(point.a, lines, len(past))
            past, lines = lines[count:], through(run.d, lines)
            for i in range(1, na + 1):
                rows[:, head + i - 1] = -lines[na - i : na - i + count, 0]
                if measured:
                    rows[:, head + unknowns.shared + i - 1] = -lines[na - i : na - i + count, 1]
        elif noise is not None:
            for i in range(1, na + 1):
                rows[:, head + i - 1] = -explained[depth + start - i :][:count]
        for c, lags in enumerate(layout.lags):
            if unknowns.free[c]:
                rows[:, head + at[f"mu{c}"].start : head + at[f"mu{c}"].stop] = run.through_numerator(c)
            for j, lag in enumerate(lags):
                rows[:, head + at[f"b{c}"].start + j] = run.shifted_function(c, lag)
        if unknowns.constant:
            rows[:, head + at["offset"].start] = run.shifted(run.step, 0)
        if noise is None:
            rows[:, -1] = output - y[part]
            present = np.isfinite(y[part])
        else:
            for name, signal, sign in (("c", innovations, 1.0), ("d", explained, -1.0)):
                for i in range(at[name].stop - at[name].start):
                    rows[:, head + at[name].start + i] = sign * signal[depth + start - i - 1 :][:count]
            rows[:, -1] = -noise.innovations[part]
            state = np.concatenate([kinds, noise.state[part]])
            late_njit(_mixed)(block, state, np.ascontiguousarray(point.c), np.ascontiguousarray(point.d), depth)
            history, kinds, present = block[count:].copy(), state[count:], state[depth:] == PRESENT
        rows[~present] = 0.0
        yield rows, int(np.count_nonzero(present))


class _Run:
    """Basis functions, the constant and an impulse through 1/A (apart) and D, chunk by chunk, with n samples before."""

    def __init__(self, unknowns: TransferUnknowns, point: TransferPoint, index: int, whitened: bool) -> None:
        self.unknowns, self.point, self.x0 = unknowns, point, point.x0[index]
        edges = np.cumsum([0, *(basis.size for basis in unknowns.layout.bases)])
        self.spans = [slice(int(i), int(j)) for i, j in zip(edges[:-1], edges[1:])]
        self.step, self.impulse = int(edges[-1]), int(edges[-1]) + 1
        self.d = point.d if whitened and unknowns.apart else np.zeros(0)
        self.n = unknowns.layout.first_row
        self.history = np.zeros((self.n + len(self.d), self.impulse + 1))
        self.table, self.functions = self.history, []
        self.count, self.started, self.peak, self.forgotten = 0, False, 0.0, False

    def advance(self, u: Array, functions: Array | None = None) -> None:
        """Filter the next chunk (T, m) of the input, or its basis functions."""
        past, self.count = len(self.history), len(u)
        if self.unknowns.apart and self.started and not self.forgotten:
            tail = float(np.max(np.abs(self.history[:, self.impulse]), initial=0.0))
            self.forgotten = tail <= FORGOTTEN * self.peak
        table = np.empty((past + self.count, self.impulse + 1))
        table[:past] = self.history
        if functions is not None:
            table[past:, : self.step] = functions
        for c, (basis, span) in enumerate(zip(self.unknowns.layout.bases if functions is None else (), self.spans)):
            table[past:, span] = basis.values(u[:, c])
        table[past:, self.step], table[past:, self.impulse] = 1.0, 0.0
        table[past, self.impulse] += not self.started
        if self.unknowns.apart:
            all_pole(self.point.a, table, past)
            self.peak = max(self.peak, float(np.max(np.abs(table[:, self.impulse]))))
        self.started, self.history, self.table = True, table[len(table) - past :], through(self.d, table)
        self.functions = [self.table[:, span] @ mu for span, mu in zip(self.spans, self.point.mus)]

    def output(self) -> Array:
        """Return the output of the plant (T,), or the right-hand side of its equation where nothing is filtered."""
        output = self.point.offset * self.shifted(self.step, 0)
        for c, lags in enumerate(self.unknowns.layout.lags):
            for b, lag in zip(self.point.bs[c], lags):
                output += b * self.shifted_function(c, lag)
        for i, value in enumerate(self.x0 if not self.forgotten else ()):
            output += value * self.shifted(self.impulse, i)
        return output

    def shifted(self, column: int, lag: int) -> Array:
        """Return a filtered signal of the chunk, delayed."""
        return self.table[self.n - lag : self.n - lag + self.count, column]

    def shifted_function(self, c: int, lag: int) -> Array:
        """Return f_c, filtered and delayed."""
        return self.functions[c][self.n - lag : self.n - lag + self.count]

    def through_numerator(self, c: int) -> Array:
        """Return B_c eta_c, filtered, (T, P_c)."""
        total = np.zeros((self.count, self.spans[c].stop - self.spans[c].start))
        for b, lag in zip(self.point.bs[c], self.unknowns.layout.lags[c]):
            total += b * self.table[self.n - lag : self.n - lag + self.count, self.spans[c]]
        return total


def _simulated(data: "Data", unknowns: TransferUnknowns, point: TransferPoint, index: int,
               functions: Sequence[Array] | None, chunk: int) -> Array:
    u, run, found = data.experiments[index].u, _Run(unknowns, point, index, whitened=False), []
    for start in range(0, len(u), chunk):
        part = slice(start, start + chunk)
        run.advance(u[part], None if functions is None else functions[index][part])
        found.append(run.output())
    return np.concatenate(found)


def through(d: Array, table: Array) -> Array:
    """Return the columns of a table (nd + T, K) through D (T, K): its first rows are history."""
    total = table[len(d) :]
    for i, value in enumerate(d, start=1):
        total = total + value * table[len(d) - i : len(table) - i]
    return total


def all_pole(a: Array, table: Array, first: int) -> None:
    """Filter every column of a table (first + T, K) by 1 / A in place, given its first rows already filtered.

    Args:
        a: (na,) coefficients of A without the leading one, na <= first.
        table: C-contiguous.
        first: rows of history.
    """
    if len(a):
        late_njit(_march)(np.ascontiguousarray(a), table, first)


def _march(a: Array, table: Array, first: int) -> None:
    for k in range(first, table.shape[0]):
        for i in range(a.size):
            for c in range(table.shape[1]):
                table[k, c] -= a[i] * table[k - 1 - i, c]


def _mixed(table: Array, state: Any, c: Array, d: Array, first: int) -> None:
    """Pass all columns but the last, the errors, through 1/C after present samples and through 1/D after others."""
    for k in range(first, table.shape[0]):
        if state[k] == 2:
            for j in range(table.shape[1] - 1):
                table[k, j] = 0.0
            continue
        for i in range(max(c.size, d.size)):
            kind = state[k - 1 - i]
            weight = 0.0
            if kind == 0 and i < c.size:
                weight = c[i]
            elif kind == 1 and i < d.size:
                weight = d[i]
            if weight != 0.0:
                for j in range(table.shape[1] - 1):
                    table[k, j] -= weight * table[k - 1 - i, j]

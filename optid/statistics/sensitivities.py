"""Prediction errors of transfer-function models and their sensitivities, compressed chunk by chunk.

``y = x + (C/D) e`` with ``A x = sum_c B_c f_c(u_c) + d`` and an initial state in the first n equations. D is A (ARX,
ARMAX) or another polynomial (Box-Jenkins); C = D = 1 is output error, whose e are the simulation errors. With
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
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from optid.arrays import Array
from optid.models import recursions
from optid.models.recursions import DEAD, PRESENT, Filtered, all_pole, late_njit, lfilter
from optid.statistics.linearised import Linearised, Method, compress_blocks, eliminate_state, linearise_errors
from optid.statistics.unknowns import TransferPoint, TransferUnknowns

if TYPE_CHECKING:
    from optid.data.record import Data

SMALL = 20_000  # entries of a table that a triangular solution filters sooner than numba is imported
CHUNK = 4096  # samples whose sensitivities are formed at a time: they stay in the processor's cache
# values of basis functions that are kept between linearisations: as many as stay in the processor's cache
TABLE = 1 << 18
FORGOTTEN = 1e-13  # share of its peak below which the response to the initial state carries no information about it


@dataclass(frozen=True, eq=False)
class TransferPredictor:
    """The predictor of a record."""

    data: "Data"  # the record; missing outputs drop out of all sums
    unknowns: TransferUnknowns  # their order

    def compress(self, point: TransferPoint, gauge: Array | None = None, method: Method = "auto") -> Linearised:
        """Predict over all experiments and compress the errors (predicted less measured) with their sensitivities.

        C must be invertible, and A stable where D is not A; gauge and method are as in
        `optid.statistics.linearised.linearise_errors`.
        """
        return linearise_errors(partial(self.blocks, point), self.unknowns.experiments, self.unknowns.memory,
                                self.unknowns.shared, gauge, method)

    def instruments(self, point: TransferPoint) -> Array:
        """Return the Gram matrix (p + na + 1) of [sensitivities | -q^-i y_measured / A | errors], x0 eliminated.

        It holds the normal equations of Steiglitz-McBride and of the refined instrumental variable: in both the
        measured output takes the place of the simulated one in the columns of a. Missing outputs are replaced by
        simulated ones. There must be no noise filter.
        """
        n, size = self.unknowns.memory, self.unknowns.shared + self.unknowns.layout.na + 1
        total = np.zeros((size, size))
        for i in range(self.unknowns.experiments):
            _, rest = eliminate_state(compress_blocks(self.blocks(point, i, measured=True), n + size, "gram")[0], n)
            total += rest.T @ rest
        return total

    def simulate(self, point: TransferPoint) -> list[Array]:
        """Return the simulated output (N,) of every experiment; where D is A, the right-hand side of its equation."""
        return [self._simulated(point, i) for i in range(self.unknowns.experiments)]

    def _simulated(self, point: TransferPoint, index: int) -> Array:
        count, right = self.data.experiments[index].n_samples, []
        for start in range(0, count, CHUNK):
            values = self._values(index, slice(start, start + CHUNK))
            right.append(np.column_stack([part @ mu for part, mu in zip(values, point.mus)]))
        fading, state = self.unknowns.fading, point.x0[index]
        functions, total = np.concatenate(right), np.full(count, point.offset + np.sum(state[fading:]))
        for f, lags, b in zip(functions.T, self.unknowns.layout.lags, point.bs):
            for lag, weight in zip(lags, b):
                total[lag:] += weight * f[: max(count - lag, 0)]
        if not self.unknowns.apart:
            return total
        total[:fading] += state[: min(fading, count)]
        return lfilter([1.0], np.concatenate([[1.0], point.a]), total)

    def predict(self, point: TransferPoint, index: int, x: Array) -> Filtered:
        """Run over one experiment of simulated x (N,) the noise filter, which explains y - x, or y where D is A."""
        y = self.data.experiments[index].y[:, 0]
        if self.unknowns.apart:
            return recursions.innovations(y - x, None, point.c, point.d)
        return recursions.innovations(y, x, point.c, point.a, start=self.unknowns.layout.first_row)

    def blocks(self, point: TransferPoint, index: int, measured: bool = False) -> Iterator[tuple[Array, int]]:
        """Yield [x0 | shared | (measured) | errors] of every chunk of an experiment, and its number of errors.

        Rows without an error are zero. The columns of x0 are left out where the initial state is forgotten.
        """
        unknowns, at, n, na = self.unknowns, self.unknowns.slices, self.unknowns.memory, self.unknowns.layout.na
        y, x = self.data.experiments[index].y[:, 0], self._simulated(point, index)
        found, depth = self.predict(point, index, x), max(unknowns.nc, len(point.d))
        innovations = np.concatenate([np.zeros(depth), found.innovations])
        explained = np.concatenate([np.zeros(depth), found.filled])
        explained[np.isnan(explained)] = 0.0
        width = n + unknowns.shared + measured * na + 1
        history, kinds = np.zeros((depth, width)), np.full(depth, DEAD, dtype=np.int8)
        head, run = unknowns.fading, _Run(unknowns, point)
        past = np.zeros((na + len(run.d), 1 + measured))  # outputs of the plant and measured ones through 1 / A
        for start in range(0, len(y), CHUNK):
            part = slice(start, min(start + CHUNK, len(y)))
            count = part.stop - part.start
            run.advance(np.hstack(self._values(index, part)))
            if head and run.forgotten and np.max(np.abs(history[:, :head]), initial=0.0) <= FORGOTTEN * run.peak:
                head, history = 0, history[:, head:]
            block = np.empty((depth + count, history.shape[1]))
            block[:depth] = history
            rows = block[depth:]
            for i in range(head):
                rows[:, i] = run.delay(run.impulse, i)
            if unknowns.levels:
                rows[:, head] = run.delay(run.step, 0)
            shared = head + unknowns.levels
            if unknowns.apart:
                lines = np.empty((len(past) + count, 1 + measured))
                lines[: len(past)], lines[len(past) :, 0] = past, x[part]
                if measured:
                    lines[len(past) :, 1] = np.where(np.isnan(y[part]), x[part], y[part])
                _all_pole(point.a, lines, len(past))
                past, lines = lines[count:], _through(run.d, lines)
            else:
                lines = explained[depth + start - na : depth + part.stop, None]
            for line, first in zip(lines.T, (shared, shared + unknowns.shared)):
                for i in range(na):
                    rows[:, first + i] = -line[na - 1 - i :][:count]
            for c, lags in enumerate(unknowns.layout.lags):
                if unknowns.free[c]:
                    rows[:, shared + at[f"mu{c}"].start : shared + at[f"mu{c}"].stop] = run.through_numerator(c)
                f = run.table[:, run.spans[c]] @ point.mus[c]
                for j, lag in enumerate(lags):
                    rows[:, shared + at[f"b{c}"].start + j] = f[run.n - lag :][:count]
            if unknowns.constant:
                rows[:, shared + at["offset"].start] = run.delay(run.step, 0)
            for name, signal in (("c", innovations), ("d", -explained)):
                for i in range(at[name].stop - at[name].start):
                    rows[:, shared + at[name].start + i] = signal[depth + start - i - 1 :][:count]
            rows[:, -1] = -found.innovations[part]
            state = np.concatenate([kinds, found.state[part]])
            if depth:
                late_njit(_mixed)(block, state, np.ascontiguousarray(point.c), np.ascontiguousarray(point.d), depth)
            history, kinds, present = block[count:].copy(), state[count:], state[depth:] == PRESENT
            rows[~present] = 0.0
            yield rows, int(np.count_nonzero(present))

    def _values(self, index: int, part: slice) -> Sequence[Array]:
        """Basis functions (T, P) of every input in a part of an experiment."""
        if self._kept is not None:
            return [values[part] for values in self._kept[index]]
        u = self.data.experiments[index].u[part]
        return [basis.values(u[:, c]) for c, basis in enumerate(self.unknowns.layout.bases)]

    @cached_property
    def _kept(self) -> list[list[Array]] | None:
        """Basis functions that descents on short records evaluate once instead of at every point."""
        bases = self.unknowns.layout.bases
        if self.data.n_samples * sum(basis.size for basis in bases) > TABLE:
            return None
        return [[basis.values(e.u[:, c]) for c, basis in enumerate(bases)] for e in self.data.experiments]


class _Run:
    """Basis functions, the constant and an impulse through D/A (one where D is A), chunk by chunk, n samples before."""

    def __init__(self, unknowns: TransferUnknowns, point: TransferPoint) -> None:
        self.unknowns, self.point, self.n = unknowns, point, unknowns.layout.first_row
        edges = np.cumsum([0, *(basis.size for basis in unknowns.layout.bases)])
        self.spans = [slice(int(i), int(j)) for i, j in zip(edges[:-1], edges[1:])]
        self.step, self.impulse = int(edges[-1]), int(edges[-1]) + 1
        self.d = point.d if unknowns.apart else np.zeros(0)
        self.history = self.table = np.zeros((self.n + len(self.d), self.impulse + 1))
        self.count, self.started, self.peak, self.forgotten = 0, False, 0.0, False

    def advance(self, values: Array) -> None:
        """Filter the basis functions (T, P) of the next chunk."""
        past, self.count = len(self.history), len(values)
        if self.unknowns.apart and self.started and not self.forgotten:
            tail = float(np.max(np.abs(self.history[:, self.impulse]), initial=0.0))
            self.forgotten = tail <= FORGOTTEN * self.peak
        table = np.empty((past + self.count, self.impulse + 1))
        table[:past], table[past:, : self.step] = self.history, values
        table[past:, self.step], table[past:, self.impulse] = 1.0, 0.0
        table[past, self.impulse] += not self.started
        if self.unknowns.apart:
            _all_pole(self.point.a, table, past)
            self.peak = max(self.peak, float(np.max(np.abs(table[:, self.impulse]))))
        self.started, self.history, self.table = True, table[len(table) - past :], _through(self.d, table)

    def delay(self, columns: int | slice, lag: int) -> Array:
        """Return filtered signals of the chunk, delayed."""
        return self.table[self.n - lag : self.n - lag + self.count, columns]

    def through_numerator(self, c: int) -> Array:
        """Return B_c eta_c, filtered, (T, P_c)."""
        total = np.zeros((self.count, self.spans[c].stop - self.spans[c].start))
        for b, lag in zip(self.point.bs[c], self.unknowns.layout.lags[c]):
            total += b * self.delay(self.spans[c], lag)
        return total


def _through(d: Array, table: Array) -> Array:
    """Return the columns of a table (nd + T, K) through D (T, K): its first rows are history."""
    total = table[len(d) :]
    for i, value in enumerate(d, start=1):
        total = total + value * table[len(d) - i : len(table) - i]
    return total


def _all_pole(a: Array, table: Array, first: int) -> None:
    """Filter the columns of a table (first + T, K) by 1 / A in place; its first rows, at least na, are filtered."""
    if len(a) and table.size > SMALL:
        late_njit(_march)(np.ascontiguousarray(a), table, first)
    elif len(a):
        right, count = table[first:], len(table) - first
        for lag, weight in enumerate(a, start=1):
            n = min(lag, count)
            right[:n] -= weight * table[first - lag : first - lag + n]
        right[:] = all_pole(a, right)


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

"""One-step prediction errors of models with a noise filter C/D and their sensitivities, chunk by chunk.

``y = x + (C/D) e`` with ``A x = sum_c B_c f_c(u_c) + d``; D is A (ARX, ARMAX) or a polynomial of its own (Box-Jenkins,
with C = D = 1 output error). With w = D/A (one where D is A) the predicted output has the partial derivatives

    a_i: -q^-i w x (ARMAX: -q^-i y),  mu_c: B_c w eta_c,  b_cj: q^-(nk_c + j) w f_c,  d: w 1,  c_i: q^-i e,
    d_i: -q^-i (y - x),

and all of them pass through 1/C (Ljung 1999, section 10.3). Where an output is missing its innovation counts as zero
and its prediction takes its place, so that there the recursion runs through 1/D instead: the sensitivities stay those
of the criterion. Where a missing input leaves no prediction the innovation is zero as well, and starts anew.
ARX and ARMAX: the first innovations, whose lags reach before the record, are zero. The others: the initial state of
the plant is unknown, the noise starts from rest.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from optid.arrays import Array
from optid.models import noise_filter
from optid.models.layout import Layout
from optid.models.noise_filter import DEAD, PRESENT
from optid.models.nonlinearity import Nonlinearity
from optid.models.recursions import lfilter
from optid.statistics.linearised import CONDITION_LIMIT, Linearised, assembled, compressed
from optid.statistics.sensitivities import CHUNK, PlantPoint, Unknowns

if TYPE_CHECKING:
    from optid.data.record import Data


@dataclass(frozen=True, eq=False)
class NoisePoint:
    """Values of the unknowns.

    Attributes:
        plant: those of the plant.
        c: (nc,) coefficients of C.
        d: (nd,) coefficients of D; A where D is A.
    """

    plant: PlantPoint
    c: Array
    d: Array


@dataclass(frozen=True)
class NoiseUnknowns:
    """The unknowns as one vector x = [those of the plant; c; d; x0 of every experiment].

    Attributes:
        plant: unknowns of the plant, the first entries of x.
        nc: order of C.
        nd: order of D, None where D is A and there are no initial states among the unknowns.
    """

    plant: Unknowns
    nc: int
    nd: int | None = None

    @property
    def layout(self) -> Layout:
        """Orders and bases of the plant."""
        return self.plant.layout

    @property
    def experiments(self) -> int:
        """Number of experiments."""
        return self.plant.experiments

    @property
    def free(self) -> tuple[bool, ...]:
        """Whether the coefficients of every nonlinearity are unknown."""
        return self.plant.free

    @property
    def constant(self) -> bool:
        """Whether the offset is unknown; where not, it is zero."""
        return self.plant.constant

    @property
    def apart(self) -> bool:
        """Whether the noise has poles of its own."""
        return self.nd is not None

    @property
    def memory(self) -> int:
        """Size n of an initial state among the unknowns."""
        return self.plant.memory if self.apart else 0

    @property
    def skipped(self) -> int:
        """First samples of a record whose innovation counts as zero."""
        return 0 if self.apart else self.plant.memory

    @property
    def slices(self) -> dict[str, slice]:
        """Where every part stands in x: those of the plant, "c" and "d"."""
        first, nd = self.plant.shared, self.nd or 0
        noise = {"c": slice(first, first + self.nc), "d": slice(first + self.nc, first + self.nc + nd)}
        return {**self.plant.slices, **noise}

    @property
    def shared(self) -> int:
        """Number of unknowns that all experiments share: the first entries of x."""
        return self.slices["d"].stop

    @property
    def size(self) -> int:
        """Length of x."""
        return self.shared + self.plant.experiments * self.memory

    def pack(self, point: NoisePoint) -> Array:
        """Return x of a point."""
        plant = self.plant.pack(point.plant)[: self.plant.shared]
        x0 = point.plant.x0.ravel() if self.apart else np.zeros(0)
        return np.concatenate([plant, point.c, point.d if self.apart else np.zeros(0), x0])

    def unpack(self, x: Array) -> NoisePoint:
        """Return the point of x."""
        at, states = self.slices, self.plant.experiments * self.plant.memory
        x0 = x[self.shared :] if self.apart else np.zeros(states)
        plant = self.plant.unpack(np.concatenate([x[: self.plant.shared], x0]))
        return NoisePoint(plant, x[at["c"]], x[at["d"]] if self.apart else plant.a)


@dataclass(frozen=True, eq=False)
class Predicted:
    """One experiment at a point, each (N,).

    Attributes:
        x: output of the plant; the zero signal where D is A.
        s: what the noise filter has explained: y - x, or y where D is A; missing samples replaced by predictions.
        innovations: zero where they cannot be computed.
        state: PRESENT, MISSING (predicted only) or DEAD (no prediction).
    """

    x: Array
    s: Array
    innovations: Array
    state: Any

    @property
    def value(self) -> float:
        """Sum of squared innovations."""
        return float(self.innovations @ self.innovations)

    @property
    def rows(self) -> int:
        """Number of innovations."""
        return int(np.count_nonzero(self.state == PRESENT))


def predict(u: Array, y: Array, unknowns: NoiseUnknowns, point: NoisePoint, index: int) -> Predicted:
    """Run the predictor over one experiment.

    Args:
        u: (N, m) inputs.
        y: (N,) output, NaN = missing.
        unknowns: their order.
        point: where; C must be invertible, and A stable where D is not A.
        index: number of the experiment, for its initial state.
    """
    layout, plant = unknowns.plant.layout, point.plant
    drive = np.full(len(u), plant.offset)
    for c, lags in enumerate(layout.lags):
        f = Nonlinearity(layout.bases[c], plant.mus[c])(u[:, c])
        for b, lag in zip(plant.bs[c], lags):
            if lag < len(u):
                drive[lag:] += b * f[: len(u) - lag]
    if unknowns.apart:
        count = min(unknowns.memory, len(u))
        drive[:count] += plant.x0[index][:count]
        x = lfilter([1.0], np.concatenate([[1.0], plant.a]), drive)
        found = noise_filter.innovations(y - x, None, point.c, point.d)
    else:
        x = np.zeros(len(u))
        found = noise_filter.innovations(y, drive, point.c, plant.a, start=unknowns.skipped)
    return Predicted(x, np.nan_to_num(found.filled), found.innovations, found.state)


def blocks(u: Array, found: Predicted, unknowns: NoiseUnknowns, point: NoisePoint, chunk: int = CHUNK
           ) -> Iterator[tuple[Array, int]]:
    """Yield [x0 | shared | errors] of every chunk (predicted less measured output), and its number of innovations.

    Rows without an innovation are zero.
    """
    columns, depth = unknowns.memory + unknowns.shared, max(unknowns.nc, len(point.d))
    history, kinds = np.zeros((depth, columns)), np.full(depth, DEAD, dtype=np.int8)
    for start, table in _direct(u, found, unknowns, point, chunk):
        count = len(table) - depth
        table[:depth] = history
        state = np.concatenate([kinds, found.state[start : start + count]])
        _mixed()(table, state, np.ascontiguousarray(point.c), np.ascontiguousarray(point.d), depth)
        history, kinds = table[count:].copy(), state[count:]
        present = state[depth:] == PRESENT
        block = np.zeros((count, columns + 1))
        block[present, :-1] = table[depth:][present]
        block[:, -1] = -found.innovations[start : start + count]
        yield block, int(np.count_nonzero(present))


def linearise(data: "Data", unknowns: NoiseUnknowns, point: NoisePoint, *, gauge: Array | None = None,
              method: Literal["auto", "gram", "qr"] = "auto", chunk: int = CHUNK) -> Linearised:
    """Predict over all experiments and compress the prediction errors with their sensitivities.

    Args:
        data: the record.
        unknowns: their order.
        point: where, see `predict`.
        gauge: as in `optid.statistics.sensitivities.linearise`.
        method: as there.
        chunk: samples at a time.
    """
    use: Literal["gram", "qr"] = "qr" if method == "qr" else "gram"
    parts = []
    for i, e in enumerate(data.experiments):
        found = predict(e.u, e.y[:, 0], unknowns, point, i)
        parts.append(compressed(blocks(e.u, found, unknowns, point, chunk), unknowns.memory + unknowns.shared + 1, use))
    compact = assembled(parts, unknowns.memory, unknowns.shared, gauge, use)
    if method == "auto" and not compact.condition < CONDITION_LIMIT:
        return linearise(data, unknowns, point, gauge=gauge, method="qr", chunk=chunk)
    return compact


def _direct(u: Array, found: Predicted, unknowns: NoiseUnknowns, point: NoisePoint, chunk: int
            ) -> Iterator[tuple[int, Array]]:
    """Yield the start of every chunk and its partial derivatives before 1/C, below ``depth`` rows of history."""
    layout, at, plant = unknowns.plant.layout, unknowns.slices, point.plant
    n, depth, head = layout.first_row, max(unknowns.nc, len(point.d)), unknowns.memory
    filtered = _Filter(unknowns, point)
    for start in range(0, len(u), chunk):
        part = slice(start, min(start + chunk, len(u)))
        count = part.stop - part.start
        table = np.empty((depth + count, head + unknowns.shared))
        rows = table[depth:]
        signals = filtered.advance(u[part], found.x[part], first=start == 0)
        for i in range(head):
            rows[:, i] = signals.delayed(signals.impulse, i)
        own = signals.delayed if unknowns.apart else None
        for i in range(1, layout.na + 1):
            rows[:, head + i - 1] = -(own(signals.output, i) if own else _delayed(found.s, part, i))
        for c, lags in enumerate(layout.lags):
            if unknowns.plant.free[c]:
                mus = slice(head + at[f"mu{c}"].start, head + at[f"mu{c}"].stop)
                rows[:, mus] = 0.0
                for b, lag in zip(plant.bs[c], lags):
                    rows[:, mus] += b * signals.delayed(signals.spans[c], lag)
            f = signals.table[:, signals.spans[c]] @ plant.mus[c]
            for j, lag in enumerate(lags):
                rows[:, head + at[f"b{c}"].start + j] = f[n - lag : n - lag + count]
        if unknowns.constant:
            rows[:, head + at["offset"].start] = signals.delayed(signals.step, 0)
        for i in range(unknowns.nc):
            rows[:, head + at["c"].start + i] = _delayed(found.innovations, part, i + 1)
        for i in range(unknowns.nd or 0):
            rows[:, head + at["d"].start + i] = -_delayed(found.s, part, i + 1)
        yield start, table


class _Filter:
    """Basis functions, the constant, an impulse and the plant's output through D/A, with n samples of history."""

    def __init__(self, unknowns: NoiseUnknowns, point: NoisePoint) -> None:
        self.unknowns = unknowns
        layout = unknowns.plant.layout
        edges = np.cumsum([0, *(basis.size for basis in layout.bases)])
        self.spans = [slice(int(i), int(j)) for i, j in zip(edges[:-1], edges[1:])]
        self.step, self.impulse, self.output = int(edges[-1]), int(edges[-1]) + 1, int(edges[-1]) + 2
        self.width = self.step + 1 + 2 * unknowns.apart
        one = np.ones(1)
        self.above, self.below = np.concatenate([one, point.d]), np.concatenate([one, point.plant.a])
        self.zi = np.zeros((max(len(self.above), len(self.below)) - 1, self.width))
        self.table = np.zeros((layout.first_row, self.width))
        self.count = 0

    def advance(self, u: Array, x: Array, *, first: bool) -> "_Filter":
        """Take in the next chunk (T, m) and the plant's output (T,)."""
        from scipy import signal

        n, self.count = self.unknowns.plant.layout.first_row, len(u)
        fresh = np.empty((len(u), self.width))
        for c, (basis, span) in enumerate(zip(self.unknowns.plant.layout.bases, self.spans)):
            missing = np.isnan(u[:, c])
            fresh[:, span] = 0.0
            fresh[~missing, span] = basis.values(u[~missing, c])
        fresh[:, self.step] = 1.0
        if self.unknowns.apart:
            fresh[:, self.impulse], fresh[:, self.output] = 0.0, x
            fresh[0, self.impulse] = float(first)
            fresh, self.zi = signal.lfilter(self.above, self.below, fresh, axis=0, zi=self.zi)
        self.table = np.concatenate([self.table[len(self.table) - n :], fresh])
        return self

    def delayed(self, columns: int | slice, lag: int) -> Array:
        """Return filtered signals of the chunk, delayed."""
        start = self.unknowns.plant.layout.first_row - lag
        return self.table[start : start + self.count, columns]


def _delayed(signal: Array, part: slice, lag: int) -> Array:
    first = part.start - lag
    if first >= 0:
        return signal[first : part.stop - lag]
    return np.concatenate([np.zeros(min(-first, part.stop - part.start)), signal[: max(part.stop - lag, 0)]])


def _march(table: Array, state: Any, c: Array, d: Array, first: int) -> None:
    for k in range(first, table.shape[0]):
        if state[k] == 2:
            table[k] = 0.0
            continue
        for i in range(max(c.size, d.size)):
            kind = state[k - 1 - i]
            weight = 0.0
            if kind == 0 and i < c.size:
                weight = c[i]
            elif kind == 1 and i < d.size:
                weight = d[i]
            if weight != 0.0:
                for j in range(table.shape[1]):
                    table[k, j] -= weight * table[k - 1 - i, j]


@cache
def _mixed() -> Any:
    from numba import njit

    return njit(cache=True, nogil=True)(_march)

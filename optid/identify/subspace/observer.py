"""The least-squares step for (B, D, E, offset, x0) with A and C known, in observer form.

With an observer gain L and F = A - L C the outputs

    y(k) = C F^k x0 + sum_{i<k} C F^(k-1-i) ((B - L D) eta(i) + E zeta(i) + L (y(i) - d)) + D eta(k) + d

are linear in the unknowns, whatever the poles of A. L = 0 minimises the simulation error with measured feedback;
a gain that moves the poles inward suits process noise and models near or beyond the stability limit. Every complete run
of samples has its own initial state; those of all but the first run of an experiment are eliminated.
"""

from collections.abc import Iterator, Sequence
from functools import reduce

import numpy as np

from optid.arrays import Array
from optid.data.stretches import runs_of
from optid.errors import RankError
from optid.identify.subspace.realisation import ObserverForm, Realisation
from optid.statistics.factors import add_to_root, conditioning, root_of_gram
from optid.statistics.hankel import CONDITION_LIMIT
from optid.statistics.responses import adjoint_responses
from optid.structures.rank_one import RankOne

CHUNK = 8192
"""Samples whose regressors are formed at once."""

MANY = 10
"""Rows per column from which their Gram matrix is formed first."""

HELD = 1 << 22
"""Numbers held at once at most: models with many functions and states take shorter chunks."""


def observer_problem(records: Sequence[Array], form: ObserverForm, *, instruments: bool = False,
                     targets: Sequence[Array] | None = None) -> Realisation:
    """Compress the step.

    Args:
        records: raw channels (N, m + l), or (N, m + 2 l) with simulated outputs, one per experiment; NaN = missing.
        form: what is known.
        instruments: take the feedback functions of the simulated outputs as instruments for those of the measured ones
            (two-stage least squares); the expansion must contain both. For noise that is fed back and not white.
        targets: measured outputs (N, l), one per experiment, NaN = missing, where those of the records are partly
            estimated: feedback and observer read the estimates, which are no equations.

    Raises:
        RankError: fewer equations than unknowns.
    """
    regressors = _Regressors(form, instruments)
    extra = regressors.extra
    total = form.experiments * form.n + regressors.common + extra  # [x0 | eta, d | zeta simulated | zeta] and y
    root, rows, energy = np.zeros((total + 1, total + 1)), 0, 0.0
    own = slice(form.experiments * form.n, total + 1)
    for e, record in enumerate(records):
        y = record[:, regressors.y] if targets is None else targets[e]
        for i, (start, stop) in enumerate(runs_of(~np.isnan(record[:, regressors.needed]).any(axis=1))):
            part, used, squares = regressors.compress(record[start:stop], y[start:stop])
            rows += used
            energy += squares
            if i == 0:
                wide = np.zeros((len(part), total + 1))
                wide[:, e * form.n : (e + 1) * form.n] = part[:, : form.n]
                wide[:, own] = part[:, form.n :]
                root = add_to_root(root, wide)
            else:  # a state nobody asks for
                root[own, own] = add_to_root(root[own, own], part[form.n :, form.n :])
    if rows < form.size + extra:
        raise RankError(f"{rows} equations for {form.size + extra} unknowns of the step for B, D and x0: use a longer "
                        "record, fewer basis functions or a lower order.")
    if extra:  # the equations seen through the instruments: what lies outside them is dropped
        seen = total - regressors.feeds
        root = root[:seen, np.r_[: seen - regressors.feeds, seen : total + 1]]
    triangle = np.triu(np.linalg.qr(root[:, [*form.columns, -1]], mode="r"))
    size = form.size
    remainder = float(triangle[size, size] ** 2) if len(triangle) > size else 0.0
    problem = RankOne(triangle[:size, :size], triangle[:size, size], remainder, form.blocks, form.linear, energy)
    return Realisation(form, problem, rows, bool(extra))


class _Regressors:
    """Rows of the regression for one run: [x0 | d | D | B | E simulated | E] and the target."""

    def __init__(self, form: ObserverForm, instruments: bool) -> None:
        self.form, x = form, form.expansion
        self.chunk = min(CHUNK, max(64, HELD // (form.l * form.n * (x.p + 2 * x.q + form.l + 1))))
        self.injected = bool(np.any(form.gain))
        self.y = slice(x.m, x.m + x.l)
        self.feeds = form.n * x.q
        self.extra = self.feeds if instruments else 0
        self.common = form.l * form.offset + form.l * x.p + form.n * x.p + self.feeds
        self.needed = np.zeros(x.m + x.l * (1 + x.simulated), dtype=bool)
        self.needed[: x.m] = True
        self.needed[self.y] = x.q > 0 or self.injected
        self.needed[x.m + x.l :] = instruments

    def compress(self, run: Array, target: Array) -> tuple[Array, int, float]:
        """Return the triangular factor of the rows of a run with its target, the rows used, and the outputs' energy.

        Many rows enter by their Gram matrix, unless its condition would cost digits.
        """
        size = self.form.n + self.common + self.extra + 1
        given = (self.form.weights * target)[~np.isnan(target)]
        root = np.zeros((size, size))
        if given.size > MANY * size:
            root = root_of_gram(sum((rows.T @ rows for rows in self._weighted(run, target)), root), size - 1)
        if not conditioning(root) <= CONDITION_LIMIT:
            root = reduce(add_to_root, self._weighted(run, target), np.zeros((size, size)))
        return root, given.size, float(given @ given)

    def _weighted(self, run: Array, target: Array) -> Iterator[Array]:
        """Yield the weighted rows of a run with their target, some samples of one output at a time."""
        form, starts = self.form, range(0, len(run), self.chunk)
        parts = (self._signals(run[start : start + self.chunk]) for start in starts)
        state = np.zeros((form.l, self._signals(run[:1]).shape[1], form.n))
        state[:, 0] = form.c  # C_o F^k, the effect of x0
        responses = adjoint_responses(form.a - form.gain @ form.c, form.c, state, parts)
        for start, (signals, out) in zip(starts, responses):
            y = target[start : start + self.chunk]
            for o in range(form.l):
                present = ~np.isnan(y[:, o])
                rows = self._rows(o, signals, out[:, o], y[:, o])
                rows *= form.weights[o]
                yield rows if present.all() else rows[present]

    def _signals(self, raw: Array) -> Array:
        """Return [0 | eta | (zeta simulated |) zeta (| 1 | y)], the first without any effect but that of its state."""
        x = self.form.expansion
        found, one = x(raw), np.ones((len(raw), 1))
        parts = [0 * one, found[:, : x.p]]
        if self.extra:
            parts.append(found[:, x.zeta_simulated.start :])
        parts.append(found[:, x.p : x.p + x.q])
        if self.injected:
            parts += [one, raw[:, self.y]]
        return np.concatenate(parts, axis=1)

    def _rows(self, o: int, signals: Array, out: Array, y: Array) -> Array:
        """Rows of output o: [x0 | d | D | B | E simulated | E | y], D row by row, B and E column by column."""
        form, x = self.form, self.form.expansion
        n, l, p, count = form.n, form.l, x.p, len(signals)  # noqa: E741
        past = 1 + p + (2 if self.extra else 1) * x.q
        rows = np.zeros((count, n + self.common + self.extra + 1))
        offset, direct, inner = np.cumsum([n, l * form.offset, l * p])
        rows[:, :n], rows[:, inner:-1], rows[:, -1] = out[:, 0], out[:, 1:past].reshape(count, -1), y
        if form.offset:
            rows[:, offset + o] = 1.0
        rows[:, direct + o * p : direct + (o + 1) * p] = signals[:, 1 : 1 + p]
        if self.injected:
            if form.offset:
                rows[:, offset:direct] -= out[:, past] @ form.gain
            rows[:, direct:inner] -= np.einsum("kji,io->koj", out[:, 1 : 1 + p], form.gain).reshape(count, -1)
            rows[:, -1] -= np.einsum("kji,ij->k", out[:, past + 1 :], form.gain)
        return rows

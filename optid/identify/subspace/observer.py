"""The least-squares step for (B, D, E, offset, x0) with A and C known, in observer form.

With an observer gain L and F = A - L C the outputs

    y(k) = C F^k x0 + sum_{i<k} C F^(k-1-i) ((B - L D) eta(i) + E zeta(i) + L (y(i) - d)) + D eta(k) + d

are linear in the unknowns, whatever the poles of A. L = 0 minimises the simulation error with measured feedback;
a gain that moves the poles inward suits process noise and models near or beyond the stability limit. Every complete run
of samples has its own initial state; those of all but the first run of an experiment are eliminated.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.data.stretches import runs_of
from optid.errors import RankError
from optid.statistics.expansion import Expansion
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


@dataclass(frozen=True, eq=False)
class ObserverForm:
    """What is known and how the unknowns are laid out.

    The vector of unknowns is z = [x0 of every experiment; d; vec Theta_1; ...], Theta_i = eta x [B_i; D_i] for an input
    and zeta x E_o for an output that is fed back, as `RankOne` wants them.

    Attributes:
        a: (n, n).
        c: (l, n).
        gain: (n, l) observer gain L.
        expansion: the signals.
        experiments: number of experiments.
        feedthrough: whether every input acts on the outputs at once.
        offset: whether there is a constant d.
        weights: (l,) by which the residuals are multiplied.
    """

    a: Array
    c: Array
    gain: Array
    expansion: Expansion
    experiments: int
    feedthrough: tuple[bool, ...]
    offset: bool
    weights: Array

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.a)

    @property
    def l(self) -> int:  # noqa: E743 - the field's letter
        """Number of outputs."""
        return len(self.c)

    @property
    def linear(self) -> int:
        """Number of unknowns outside the blocks: initial states and offset."""
        return self.experiments * self.n + self.l * self.offset

    @property
    def blocks(self) -> tuple[tuple[int, int], ...]:
        """(functions, entries of [B_i; D_i] or E_o) of every channel, inputs first."""
        inputs = [(p, self.n + self.l * direct) for p, direct in zip(self.expansion.input_sizes, self.feedthrough)]
        return (*inputs, *((family.size, self.n) for family in self.expansion.feedback))

    def block(self, i: int) -> slice:
        """Positions of vec Theta_i in z."""
        sizes = [p * b for p, b in self.blocks]
        start = self.linear + sum(sizes[:i])
        return slice(start, start + sizes[i])

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.linear + sum(p * b for p, b in self.blocks)

    @property
    def channels(self) -> list[str]:
        """Names of the channels in words, those of the feedback last."""
        x = self.expansion
        return [*x.input_names, *(f"feedback of {x.output_names[f.output]}" for f in x.feedback)]

    @cached_property
    def columns(self) -> NDArray[np.intp]:
        """Where the unknowns z stand in [x0 of all experiments | d | D row by row | B and E column by column]."""
        n, l, p = self.n, self.l, self.expansion.p  # noqa: E741
        found, start = [np.arange(self.linear)], 0
        for functions, entries in self.blocks:
            position = start + np.arange(functions)[:, None]
            inner = self.linear + l * p + position * n + np.arange(n)
            found.append(np.hstack([inner, self.linear + np.arange(entries - n) * p + position]).ravel(order="F"))
            start += functions
        return np.concatenate(found)

    def names(self) -> list[str]:
        """Name the unknowns in words for messages."""
        named = [f"x0 of experiment {e + 1}" for e in range(self.experiments) for _ in range(self.n)]
        named += ["the offset"] * (self.l * self.offset)
        for channel, (p, b) in zip(self.channels, self.blocks):
            named += [f"function {j + 1} of {channel}" for _ in range(b) for j in range(p)]
        return named


@dataclass(frozen=True, eq=False)
class ObserverProblem:
    """The compressed step.

    Attributes:
        form: the layout.
        problem: ``||R z - s||^2 + remainder`` with one rank-one block per channel; weighted units.
        rows: equations used.
        instrumented: whether the normal equations are those of instruments.
    """

    form: ObserverForm
    problem: RankOne
    rows: int
    instrumented: bool = False

    def least_squares(self) -> Array:
        """Return the unrestricted minimiser z.

        Raises:
            RankError: the record does not determine it; names the first unknown that is lost.
        """
        root, norms = self.problem.root, np.linalg.norm(self.problem.root, axis=0)
        lost = np.abs(np.diag(root)) <= 1e-10 * np.where(norms > 0, norms, 1.0)
        if lost.any():
            raise RankError(f"The record does not determine {self.form.names()[int(np.argmax(lost))]}: the regressors "
                            "before it explain its effect. Use a longer or richer record, fewer functions, a lower "
                            "order, or leave the channel out.")
        return np.asarray(np.linalg.solve(root, self.problem.target), dtype=float)

    def ratios(self) -> dict[str, float]:
        """Second over first singular value of every channel's unrestricted matrix: zero for a channel of rank one."""
        z, found = self.least_squares(), {}
        for i, (name, shape) in enumerate(zip(self.form.channels, self.form.blocks)):
            if min(shape) > 1:
                values = np.linalg.svd(z[self.form.block(i)].reshape(shape, order="F"), compute_uv=False)
                name = name if i >= self.form.expansion.m else f"channel {name}"
                found[f"second over first singular value, {name}"] = float(values[1] / values[0])
        return found

    def matrices(self, z: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Split z into Bu (n, p), Du (l, p), Ez (n, q), d (l,) and x0 (experiments, n)."""
        form, x = self.form, self.form.expansion
        direct, inner = form.linear, form.linear + form.l * x.p
        found = np.zeros(inner + form.n * (x.p + x.q))
        found[form.columns] = z
        effects, states = found[inner:].reshape(-1, form.n).T, form.experiments * form.n
        offset = found[states:direct] if form.offset else np.zeros(form.l)
        return (effects[:, : x.p], found[direct:inner].reshape(form.l, x.p), effects[:, x.p :], offset,
                found[:states].reshape(form.experiments, form.n))


def observer_problem(records: Sequence[Array], form: ObserverForm, *, instruments: bool = False, chunk: int = CHUNK,
                     targets: Sequence[Array] | None = None) -> ObserverProblem:
    """Compress the step.

    Args:
        records: raw channels (N, m + l), or (N, m + 2 l) with simulated outputs, one per experiment; NaN = missing.
        form: what is known.
        instruments: take the feedback functions of the simulated outputs as instruments for those of the measured ones
            (two-stage least squares); the expansion must contain both. For noise that is fed back and not white.
        chunk: samples whose regressors are formed at once.
        targets: measured outputs (N, l), one per experiment, NaN = missing, where those of the records are partly
            estimated: feedback and observer read the estimates, which are no equations.

    Raises:
        RankError: fewer equations than unknowns.
    """
    regressors = _Regressors(form, instruments, chunk)
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
    return ObserverProblem(form, problem, rows, bool(extra))


class _Regressors:
    """Rows of the regression for one run: [x0 | d | D | B | E simulated | E] and the target."""

    def __init__(self, form: ObserverForm, instruments: bool, chunk: int) -> None:
        self.form, x = form, form.expansion
        self.chunk = min(chunk, max(64, HELD // (form.l * form.n * (x.p + 2 * x.q + form.l + 1))))
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


def observer_gain(a: Array, c: Array, noise: float = 1.0) -> Array:
    """Return the steady Kalman gain (n, l) for unit process noise in balanced coordinates: A - L C is stable.

    Args:
        a: (n, n).
        c: (l, n).
        noise: variance of the measurement noise relative to the mean energy of the rows of C.
    """
    from optid.models.kalman import kalman_gain

    level = noise * float(np.mean(np.sum(c**2, axis=1)))
    return kalman_gain(a, c, np.eye(len(a)), level * np.eye(len(c))).K

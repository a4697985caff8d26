"""The least-squares step for (B, D, E, offset, x0) with A and C known, in observer form: compressed, started, read.

With an observer gain L and F = A - L C the outputs

    y(k) = C F^k x0 + sum_{i<k} C F^(k-1-i) ((B - L D) eta(i) + E zeta(i) + L (y(i) - d)) + D eta(k) + d

are linear in the unknowns, whatever the poles of A. L = 0 minimises the simulation error with measured feedback;
a gain that moves the poles inward suits process noise and models near or beyond the stability limit. Every complete run
of samples has its own initial state; those of all but the first run of an experiment are eliminated.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.bases import Linear
from optid.data.channels import model_meta
from optid.data.record import Data
from optid.data.stretches import runs_of
from optid.errors import RankError
from optid.models import HammersteinSS, Nonlinearity
from optid.statistics.expansion import Expansion
from optid.statistics.factors import add_to_root, conditioning, root_of_gram
from optid.statistics.hankel import CONDITION_LIMIT
from optid.statistics.responses import adjoint_responses
from optid.structures.bilinear import starts
from optid.structures.rank_one import RankOne, matrices
from optid.structures.whitening import leading_pair

Values = Mapping[str, Array]

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

    def thetas(self, z: Array) -> list[Array]:
        """Return the matrices Theta_i of the unknowns z."""
        return matrices(z[self.linear :], self.blocks)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.columns)

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
class Realisation:
    """The compressed step, in named unknowns: one pair of factors per channel, or one matrix.

    Attributes:
        form: the layout.
        problem: ``||R z - s||^2 + remainder`` with one rank-one block per channel; weighted units.
        rows: equations used.
        instrumented: whether the normal equations are those of instruments.
        factored: whether channels are rank one in the programme itself.
    """

    form: ObserverForm
    problem: RankOne
    rows: int
    instrumented: bool = False
    factored: bool = False

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
        found = {}
        for i, (name, theta) in enumerate(zip(self.form.channels, self.form.thetas(self.least_squares()))):
            if min(theta.shape) > 1:
                values = np.linalg.svd(theta, compute_uv=False)
                name = name if i >= self.form.expansion.m else f"channel {name}"
                found[f"second over first singular value, {name}"] = float(values[1] / values[0])
        return found

    def matrices(self, z: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Split z into Bu (n, p), Du (l, p), Ez (n, q), d (l,) and x0 (experiments, n)."""
        form, x, states = self.form, self.form.expansion, self.form.experiments * self.form.n
        thetas = form.thetas(z)
        effects = np.hstack([theta[:, : form.n].T for theta in thetas])
        direct = [theta[:, form.n :].T if direct else np.zeros((form.l, len(theta)))
                  for theta, direct in zip(thetas, form.feedthrough)]
        offset = z[states : form.linear] if form.offset else np.zeros(form.l)
        return effects[:, : x.p], np.hstack(direct), effects[:, x.p :], offset, z[:states].reshape(-1, form.n)

    def names(self, i: int) -> tuple[str, str, str]:
        """Names of the two factors and of the matrix of channel i: ``mu[valve]``, ``mu feedback[level]``."""
        x = self.form.expansion
        if i < x.m:
            kind, several, channel = "", x.m > 1, x.input_names[i]
        else:
            kind, several, channel = " feedback", x.l > 1, x.output_names[x.feedback[i - x.m].output]
        mu, b, theta = (f"{name}{kind}[{channel}]" if several else name + kind for name in ("mu", "b", "Theta"))
        return mu, b, theta

    def start(self) -> dict[str, Array]:
        """Return the unrestricted minimiser; of factored channels the most promising factors.

        Raises:
            RankError: naming what the record does not determine.
        """
        form, z, point = self.form, self.least_squares(), None
        if self.factored:
            point = self.problem.core.point(*starts(self.problem.core, count=1)[0])
        linear = z[: form.linear] if point is None else point.w
        states = form.n * form.experiments
        x0 = linear[:states] if form.experiments == 1 else linear[:states].reshape(form.n, form.experiments, order="F")
        found = {"x0": np.array(x0)} | ({"offset": np.array(linear[states:])} if form.offset else {})
        for i, value in enumerate(form.thetas(z)):
            mu, b, theta = self.names(i)
            found |= {theta: value} if point is None else {mu: point.mus[i], b: point.bs[i]}
        return found

    def model(self, data: Data, values: Values) -> HammersteinSS:
        """Return the model of a point; a matrix is split in the Kronecker metric of the least squares."""
        form, x, core, pairs = self.form, self.form.expansion, self.problem.core, []
        for i, shape in enumerate(form.blocks):
            first, second, whole = self.names(i)
            if first in values:
                mu, b = np.asarray(values[first]), np.asarray(values[second])
            else:
                theta = np.reshape(values[whole], shape)
                if i in core.kept:
                    place = core.kept.index(i)
                    mu, b = leading_pair(theta, core.whitening.factors_mu[place], core.whitening.factors_b[place])
                else:
                    mu, b = (np.ones(1), theta[0]) if shape[0] == 1 else (theta[:, 0], np.ones(1))
            pairs.append(_oriented(mu, b, linear=i < x.m and isinstance(x.inputs[i], Linear)))
        n, l, m = form.n, form.l, x.m  # noqa: E741
        mus, bs = [mu for mu, _ in pairs], [b for _, b in pairs]
        direct = [b[n:] if len(b) > n else np.zeros(l) for b in bs[:m]]
        matrices = form.a, np.column_stack([b[:n] for b in bs[:m]]), form.c, np.column_stack(direct)
        found = state_model(x, data, matrices, mus[:m], mus[m:], np.column_stack([np.zeros((n, 0)), *bs[m:]]),
                            offset=np.asarray(values["offset"]) if form.offset else np.zeros(l))
        return replace(found, gauge="norm") if any(basis.size > 1 for basis in x.inputs) else found


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


def _oriented(mu: Array, b: Array, *, linear: bool) -> tuple[Array, Array]:
    """A linear channel has mu = 1; every other a b of unit length, its largest entry positive."""
    if linear:
        return np.ones(1), b * mu[0]
    length = float(np.linalg.norm(b))
    if length == 0.0:
        return np.zeros_like(mu), np.full(len(b), 1 / np.sqrt(len(b)))
    length *= float(np.sign(b[int(np.argmax(np.abs(b)))]))
    return mu * length, b / length


def state_model(expansion: Expansion, data: Data, matrices: Sequence[Array], mus: Sequence[Array], nus: Sequence[Array],
                e: Array, *, K: Array | None = None, offset: Array | None = None) -> HammersteinSS:
    """Build the model, its feedback functions in their own basis: what is linear in them becomes L and a constant.

    Args:
        expansion: the signals of the fit.
        data: the record, for names, units and sampling time.
        matrices: A (n, n), B (n, m), C (l, n) and D (l, m).
        mus: coefficients of the nonlinearity of every input.
        nus: coefficients of every feedback family in its orthonormal coordinates.
        e: (n, s), one column per family.
        K: (n, l), zero where None.
        offset: (l,) of the output, zero where None.
    """
    families = expansion.feedback
    parts = [np.outer(column, nu) for column, nu in zip(e.T, nus)]
    injection, constant = expansion.injection(np.hstack([np.zeros((len(e), 0)), *parts]))
    A, B, C, D = matrices
    return HammersteinSS(
        A=A, B=B, C=C, D=D, K=K, E=e if families else None, L=injection,
        nonlinearities=tuple(Nonlinearity(basis, mu) for basis, mu in zip(expansion.inputs, mus)),
        feedback=tuple(Nonlinearity(family.basis, family.vectors @ nu) for family, nu in zip(families, nus)),
        output_of=tuple(family.output for family in families), offset_x=constant, offset_y=offset, **model_meta(data))

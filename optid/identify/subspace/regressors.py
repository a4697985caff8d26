"""The equations of the step for (B, D, E, offset, x0) with A and C known, in observer form.

With an observer gain L and F = A - L C the outputs

    y(k) = C F^k x0 + sum_{i<k} C F^(k-1-i) ((B - L D) eta(i) + E zeta(i) + L (y(i) - d)) + D eta(k) + d

are linear in the unknowns, whatever the poles of A. L = 0 minimises the simulation error with measured feedback;
a gain that moves the poles inward suits process noise and models near or beyond the stability limit. Time is the last
axis; matrix products replace loops over samples.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from optid.arrays import Array
from optid.statistics.expansion import Expansion
from optid.statistics.factors import CONDITION_LIMIT, add_to_root, conditioning, root_of_gram
from optid.structures.rank_one import matrices

BLOCK = 32  # samples whose responses are one product with a Toeplitz matrix
TINY = 1e-150  # states below it are zero: denormal numbers would make every product with them slow
CHUNK = 4096  # samples whose regressors are formed at once
MANY = 10  # rows per column from which their Gram matrix is formed first
HELD = 1 << 22  # numbers held at once at most: models with many functions and states take shorter chunks


@dataclass(frozen=True, eq=False)
class ObserverForm:
    """The known quantities and the layout of the unknowns.

    The unknowns are z = [x0 of every experiment; d; vec Theta_1; ...], Theta_i = eta x [B_i; D_i] for an input and
    zeta x E_o for an output that is fed back.
    """

    a: Array  # (n, n)
    c: Array  # (l, n)
    gain: Array  # (n, l) observer gain L
    expansion: Expansion  # the signals
    experiments: int  # number of experiments
    feedthrough: tuple[bool, ...]  # whether every input acts on the outputs at once
    offset: bool  # whether there is a constant d
    weights: Array  # (l,) by which the residuals are multiplied
    # whether feedback functions of simulated outputs are instruments for those of the measured ones (two-stage least
    # squares), for noise that is fed back and not white; the expansion must contain both
    instrumented: bool = False

    n: int = field(init=False)  # number of states
    l: int = field(init=False)  # noqa: E741 - number of outputs, the field's letter
    linear: int = field(init=False)  # number of unknowns outside the blocks: initial states and offset
    # (functions, entries of [B_i; D_i] or E_o) of every channel, inputs first
    blocks: tuple[tuple[int, int], ...] = field(init=False)
    size: int = field(init=False)  # number of unknowns
    extra: int = field(init=False)  # number of instruments, as many as entries of all E_o; zero where there are none
    injected: bool = field(init=False)  # whether the gain feeds measured outputs back

    def __post_init__(self) -> None:
        n, l, x = len(self.a), len(self.c), self.expansion  # noqa: E741
        linear = self.experiments * n + l * self.offset
        blocks = (*((p, n + l * direct) for p, direct in zip(x.input_sizes, self.feedthrough)),
                  *((family.size, n) for family in x.feedback))
        found = {"n": n, "l": l, "linear": linear, "blocks": blocks, "size": linear + sum(p * b for p, b in blocks),
                 "extra": n * x.q * self.instrumented, "injected": bool(np.any(self.gain))}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def thetas(self, z: Array) -> list[Array]:
        """Return the matrices Theta_i of the unknowns z."""
        return matrices(z[self.linear :], self.blocks)

    @property
    def channels(self) -> list[str]:
        """Names of the channels, those of the feedback last."""
        x = self.expansion
        return [*x.input_names, *(f"feedback of {x.output_names[f.output]}" for f in x.feedback)]

    def names(self) -> list[str]:
        """Return the names of the unknowns for messages."""
        named = [f"x0 of experiment {e + 1}" for e in range(self.experiments) for _ in range(self.n)]
        named += ["the offset"] * (self.l * self.offset)
        for channel, (p, b) in zip(self.channels, self.blocks):
            named += [f"function {j + 1} of {channel}" for _ in range(b) for j in range(p)]
        return named

    @property
    def needed(self) -> np.ndarray:
        """Which raw channels must be present."""
        x = self.expansion
        return np.repeat([True, x.q > 0 or self.injected, self.instrumented], [x.m, x.l, x.l * x.simulated])

    def compress(self, run: Array, target: Array) -> tuple[Array, int, float]:
        """Return the triangular factor of the equations of a run, how many there are, and the outputs' energy.

        The columns are [x0 | d | Theta of the inputs | E simulated | E], then the target. Many equations enter by their
        Gram matrix, unless its condition would cost digits.
        """
        given = (self.weights * target)[~np.isnan(target)]
        count = self.size - (self.experiments - 1) * self.n + self.extra
        root = np.zeros((count + 1, count + 1))
        if given.size > MANY * len(root):
            root = root_of_gram(sum((part @ part.T for part in self._weighted(run, target)), root), count)
        if not conditioning(root) <= CONDITION_LIMIT:
            parts = (part.T for part in self._weighted(run, target))
            root = reduce(add_to_root, parts, np.zeros((count + 1, count + 1)))
        return root, given.size, float(given @ given)

    def _weighted(self, run: Array, target: Array) -> Iterator[Array]:
        """Yield the weighted equations (size + 1, K), some samples of one output at a time."""
        x = self.expansion
        chunk = min(CHUNK, max(64, HELD // (self.l * self.n * (x.p + 2 * x.q + self.l + 1))))
        starts = range(0, len(run), chunk)
        signals = 1 + x.p + x.q * (2 if self.extra else 1) + (1 + self.l) * self.injected  # of `_signals`
        state = np.zeros((self.l, signals, self.n))
        state[:, 0] = self.c  # C_o F^k, the effect of x0
        responses = adjoint_responses(self.a - self.gain @ self.c, self.c, state,
                                      (self._signals(run[start : start + chunk]) for start in starts))
        for start, (signals, out) in zip(starts, responses):
            y = target[start : start + chunk].T
            for o in range(self.l):
                rows = self._rows(o, signals, out[o], y[o])
                if self.weights[o] != 1:
                    rows *= self.weights[o]
                present = ~np.isnan(y[o])
                yield rows if present.all() else rows[:, present]

    def _signals(self, raw: Array) -> Array:
        """Return [0 | eta | (zeta simulated |) zeta (| 1 | y)], the first without any effect but that of its state."""
        x = self.expansion
        found, one = x(raw).T, np.ones((1, len(raw)))
        parts = [0 * one, found[: x.p]]
        if self.extra:
            parts.append(found[x.zeta_simulated.start :])
        parts.append(found[x.p : x.p + x.q])
        if self.injected:
            parts += [one, raw[:, x.m : x.m + x.l].T]
        return np.concatenate(parts)

    def _rows(self, o: int, signals: Array, out: Array, y: Array) -> Array:
        """Return the equations of output o with their target, from the responses (d, n, T) to the signals."""
        x, count = self.expansion, len(y)
        p, target = x.p, y
        offset, direct = np.zeros((x.l, count)), np.zeros((x.l, p, count))
        offset[o], direct[o] = 1.0, signals[1 : 1 + p]
        if self.injected:
            past = len(signals) - 1 - x.l
            offset -= self.gain.T @ out[past]
            direct -= np.tensordot(self.gain.T, out[1 : 1 + p], (1, 1))
            target = y - np.einsum("jit,ij->t", out[past + 1 :], self.gain)
        parts, start = [out[0], offset] if self.offset else [out[0]], 0
        feedback = [family.size for family in x.feedback] * (2 if self.extra else 1)
        for size, feedthrough in zip([*x.input_sizes, *feedback], [*self.feedthrough, *[False] * len(feedback)]):
            own = slice(start, start + size)
            parts += [out[1:][own].transpose(1, 0, 2)] + [direct[:, own]] * feedthrough
            start += size
        return np.concatenate([part.reshape(-1, count) for part in [*parts, target]])


def adjoint_responses(inner: Array, outputs: Array, state: Array, parts: Iterable[Array]
                      ) -> Iterator[tuple[Array, Array]]:
    """Yield the signals (d, T) and the regressors (l, d, n, T) of y_o(k) = sum_{i<k} C_o F^(k-1-i) M s(i) by stretches.

    The regressor of output o is X_o(k) (d, n) with X_o(k + 1) = X_o(k) F + s(k) C_o, ``state`` (l, d, n) at the first
    sample; ``inner`` is F (n, n), ``outputs`` C (l, n).
    """
    (l, n), d = outputs.shape, state.shape[1]  # noqa: E741
    powers, known, square = np.empty((BLOCK + 1, n, n)), 1, inner
    powers[0] = np.eye(n)
    while known <= BLOCK:  # twice as many each time
        powers[known : 2 * known] = powers[: min(known, BLOCK + 1 - known)] @ square
        known, square = 2 * known, square @ square
    effects = np.zeros((l, n, 2 * BLOCK + 1))
    effects[..., BLOCK + 1 :] = (outputs @ powers[:BLOCK]).transpose(1, 2, 0)
    lags = BLOCK + np.arange(BLOCK + 1) - np.arange(BLOCK)[:, None]
    toeplitz = effects[:, :, lags].transpose(2, 0, 1, 3).reshape(BLOCK, -1)
    free = powers[:BLOCK].transpose(1, 2, 0).reshape(n, -1)
    for part in parts:
        count = part.shape[1]
        blocks = count // BLOCK + 1  # the last block also holds the state after the last sample
        signals = np.zeros((d, blocks * BLOCK))
        signals[:, :count] = part
        signals = signals.reshape(d, blocks, BLOCK).transpose(1, 0, 2).reshape(-1, BLOCK)
        within = (signals @ toeplitz).reshape(blocks, d, l, n, BLOCK + 1)
        starts = np.concatenate([state.transpose(1, 0, 2)[None], within[:-1, ..., BLOCK]]).reshape(-1, n)
        step, decay = d * l, powers[BLOCK]
        while step < len(starts):  # sums over the preceding blocks, twice as many each time
            starts[step:] += starts[:-step] @ decay
            step, decay = 2 * step, decay @ decay
        starts[np.abs(starts) < TINY] = 0.0
        found = np.empty((l, d, n, blocks, BLOCK))
        np.add(within[..., :BLOCK], (starts @ free).reshape(blocks, d, l, n, BLOCK), out=found.transpose(3, 1, 0, 2, 4))
        found = found.reshape(l, d, n, -1)
        state = found[..., count]
        yield part, found[..., :count]

"""Responses of a linear recursion, many samples at a time: products of matrices in place of a loop over samples."""

from collections.abc import Iterable, Iterator

import numpy as np

from optid.arrays import Array

BLOCK = 32
"""Samples whose responses are one product with a Toeplitz matrix."""

TINY = 1e-150
"""States below it are zero: denormal numbers would make every product with them slow."""


def adjoint_responses(inner: Array, outputs: Array, state: Array, parts: Iterable[Array]
                      ) -> Iterator[tuple[Array, Array]]:
    """Yield the regressors of y_o(k) = sum_{i<k} C_o F^(k-1-i) M s(i), linear in the matrix M (n, d).

    The regressor of output o is the matrix X_o(k) (d, n), like M transposed, with X_o(k + 1) = X_o(k) F + s(k) C_o.

    Args:
        inner: (n, n) F.
        outputs: (l, n) C.
        state: (l, d, n) X at the first sample, for every output.
        parts: (T, d) signals s, one stretch after the other.

    Yields:
        (T, d) and (T, l, d, n), every stretch and its X.
    """
    (l, n), d = outputs.shape, state.shape[1]  # noqa: E741
    powers = np.empty((BLOCK + 1, n, n))
    powers[0] = np.eye(n)
    for k in range(BLOCK):
        powers[k + 1] = powers[k] @ inner
    toeplitz = np.zeros((BLOCK, l, BLOCK + 1, n))
    for i in range(BLOCK):
        toeplitz[i, :, i + 1 :] = np.einsum("oh,khi->oki", outputs, powers[: BLOCK - i])
    toeplitz = toeplitz.reshape(BLOCK, -1)
    free = powers[:BLOCK].transpose(1, 0, 2).reshape(n, -1)
    state = state.transpose(1, 0, 2)
    for part in parts:
        blocks = len(part) // BLOCK + 1  # the state after the last sample stands in the last block, too
        signals = np.zeros((blocks * BLOCK, d))
        signals[: len(part)] = part
        signals = signals.reshape(blocks, BLOCK, d).transpose(0, 2, 1).reshape(-1, BLOCK)
        within = (signals @ toeplitz).reshape(blocks, d, l, BLOCK + 1, n)
        starts = np.concatenate([state[None], within[:-1, :, :, BLOCK]])
        step, decay = 1, powers[BLOCK]
        while step < blocks:  # the sum of all that came before, twice as many blocks each time
            starts[step:] += starts[:-step] @ decay
            step, decay = 2 * step, decay @ decay
        starts[np.abs(starts) < TINY] = 0.0
        found = np.empty((blocks, BLOCK, l, d, n))
        np.add(within[..., :BLOCK, :], (starts @ free).reshape(blocks, d, l, BLOCK, n),
               out=found.transpose(0, 3, 2, 1, 4))
        found = found.reshape(-1, l, d, n)
        state = found[len(part)].transpose(1, 0, 2)
        yield part, found[: len(part)]

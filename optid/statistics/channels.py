"""Channels that a multivariable fit cannot tell apart."""

from collections.abc import Iterator, Sequence
from functools import reduce

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, RankError
from optid.statistics.factors import ROUNDING, add_to_root, conditioning, root_of_gram
from optid.statistics.hankel import CONDITION_LIMIT

CHUNK = 8192
"""Samples whose rows are formed at once."""


def check_channels(records: Sequence[Array], inputs: Sequence[str], outputs: Sequence[str]) -> None:
    """Refuse constant outputs, and channels that are sums of multiples of others.

    Args:
        records: (N, m + l) arrays [u | y], one per experiment; NaN = missing.
        inputs: m names.
        outputs: l names.

    Raises:
        DataError: an output that never changes.
        RankError: an input that the other inputs and a constant give exactly, or an output that other outputs give.
    """
    m = len(inputs)
    for kind, names, columns in (("input", inputs, slice(0, m)), ("output", outputs, slice(m, None))):
        parts = [record[:, columns] for record in records]
        parts = [part[~np.isnan(part).any(axis=1)] if np.isnan(part.sum()) else part for part in parts]
        count = sum(map(len, parts))
        if count <= len(names) + 1:
            raise DataError(f"only {count} samples have all {kind}s at once: {len(names)} {kind}s cannot be told apart "
                            "from so few.")
        root = np.zeros((len(names) + 1, len(names) + 1))
        root = root_of_gram(sum((rows.T @ rows for rows in _with_constant(parts)), root), len(root))
        if not conditioning(root) <= CONDITION_LIMIT:
            root = reduce(add_to_root, _with_constant(parts), np.zeros_like(root))
        for c, name in enumerate(names, start=1):
            if np.abs(root[c, c]) <= 10 * ROUNDING["qr"] * np.linalg.norm(root[:, c]):
                if np.linalg.norm(root[1 : c + 1, c]) <= 10 * ROUNDING["qr"] * np.linalg.norm(root[:, c]):
                    raise DataError(f"{kind} {name!r} is constant: leave the channel out, or use a record in which it "
                                    "moves.")
                shares = np.linalg.lstsq(root[:c, :c], root[:c, c], rcond=None)[0][1:]
                sizes = np.abs(shares) * np.linalg.norm(root[1:, 1:c], axis=0)
                partners = [str(names[j]) for j in np.argsort(-sizes) if sizes[j] > 1e-6 * sizes.max()]
                raise RankError(f"{kind} {name!r} is a sum of multiples of {', '.join(partners)} and a constant: their "
                                "effects cannot be told apart. Leave one channel out.")


def _with_constant(parts: Sequence[Array]) -> Iterator[Array]:
    """Yield the rows [1 | channels] of some records, some at a time."""
    for part in parts:
        for start in range(0, len(part), CHUNK):
            rows = part[start : start + CHUNK]
            yield np.concatenate([np.ones((len(rows), 1)), rows], axis=1)

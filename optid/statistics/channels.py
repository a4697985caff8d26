"""Channels that a multivariable fit cannot tell apart."""

from collections.abc import Sequence

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, RankError
from optid.statistics.factors import ROUNDING
from optid.statistics.hankel import hankel_statistics


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
        count = sum(np.count_nonzero(~np.isnan(part).any(axis=1)) for part in parts)
        if count <= len(names) + 1:
            raise DataError(f"only {count} samples have all {kind}s at once: {len(names)} {kind}s cannot be told apart "
                            "from so few.")
        root = hankel_statistics(parts, 1).root
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

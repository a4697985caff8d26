"""Channels that a multivariable fit cannot tell apart."""

from collections.abc import Sequence

import numpy as np

from optid.bases.basis import Array
from optid.errors import DataError, RankError
from optid.regressors.factors import ROUNDING, add_to_root


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
        root, count = np.zeros((len(names) + 1, len(names) + 1)), 0
        for record in records:
            part = record[:, columns]
            part = part[~np.isnan(part).any(axis=1)]
            count += len(part)
            for start in range(0, len(part), 8192):
                rows = part[start : start + 8192]
                root = add_to_root(root, np.concatenate([np.ones((len(rows), 1)), rows], axis=1))
        if count <= len(names) + 1:
            raise DataError(f"only {count} samples have all {kind}s at once: {len(names)} {kind}s cannot be told apart "
                            "from so few.")
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

"""Which orders would a window show if the plant were healthy?

The order test accepts an order k when the sum T(k) of the squared singular values of R22 = L31 Q2 after the first k is
no more than noise. On a healthy plant the outputs are Pi times the instruments and noise, with Pi the same on every
record. With L11 and Q2 of a window, Pi L11 Q2 is what its R22 would be without noise. Where the squares after the first
k fall short of the threshold, the window is too short or too quiet to reject the order k, and no failure is to blame.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from optid.arrays import Array
from optid.identify.order.ranks import RankTest
from optid.statistics.hankel import HankelStatistics

Positions = Sequence[int] | NDArray[np.intp]

MARGIN = 3.0
"""An order counts as rejected on a healthy plant where its T would exceed its threshold so many times."""


def coefficients(statistics: HankelStatistics, instruments: Positions, outputs: Positions) -> Array:
    """Return Pi (y, z), the regression of the outputs on the instruments."""
    z = np.asarray(instruments, dtype=np.intp)
    triangle = statistics.triangle(np.concatenate([z, np.asarray(outputs, dtype=np.intp)]))
    scale = np.maximum(np.linalg.norm(triangle[: z.size, : z.size], axis=0), 1e-300)
    return np.linalg.lstsq(triangle[: z.size, : z.size] / scale, triangle[: z.size, z.size :], rcond=1e-13)[0].T / scale


def least_order(
    statistics: HankelStatistics, instruments: Positions, regressors: Positions, healthy: Array, test: RankTest,
    order: int, scale: Array,
) -> int:
    """Return the order that a healthy plant would show at least on a window.

    Args:
        statistics: moments of the window.
        instruments: positions of z, the regressors among them.
        regressors: positions of phi.
        healthy: Pi (y, z) of a healthy record.
        test: the test of the window.
        order: of the healthy plant.
        scale: (y,) sizes of the outputs.
    """
    z, phi = (np.asarray(part, dtype=np.intp) for part in (instruments, regressors))
    triangle = statistics.triangle(z) / np.sqrt(statistics.windows)
    place = {int(position): c for c, position in enumerate(z)}
    basis = np.linalg.qr(triangle[:, [place[int(p)] for p in phi]], mode="complete")[0]
    expected = (healthy @ triangle.T @ basis[:, phi.size :]) / scale[:, None]
    squares = np.linalg.svd(expected, compute_uv=False)[:order] ** 2
    tails = np.cumsum(squares[::-1])[::-1]
    count = min(order, tails.size, test.thresholds.size)
    sure = tails[:count] > np.maximum(MARGIN * test.thresholds[:count], test.floor**2)
    return count if sure.all() else int(np.argmin(sure))

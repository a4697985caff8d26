"""Average run length of a CUSUM chart, the yardstick of any running test."""

import numpy as np

from optid.errors import StructureError

NODES = 80
"""Nodes of the quadrature; the run lengths of the usual charts are right to ten digits."""


def cusum_arl(shift: float, k: float = 0.5, h: float = 5.0, *, two_sided: bool = True) -> float:
    """Return the mean number of samples until S = max(0, S + x - k) exceeds h, for x ~ N(shift, 1) and S = 0 at first.

    The integral equation of E. S. Page (Biometrika 41, 1954) is solved by Gauss-Legendre quadrature. The rates of the
    two sides of a two-sided chart add up (K. W. Kemp, J. R. Stat. Soc. B 23, 1961).

    Args:
        shift: mean of the samples, in standard deviations; 0 gives the time between false alarms.
        k: reference value.
        h: threshold.
        two_sided: whether -x is charted, too.

    Raises:
        StructureError: a threshold that is not positive.
    """
    if not (np.isfinite(h) and h > 0 and np.isfinite(k) and np.isfinite(shift)):
        raise StructureError(f"shift={shift!r}, k={k!r}, h={h!r}: finite numbers and a positive threshold are needed.")
    rate = 1 / _one_sided(shift, k, h)
    return 1 / (rate + 1 / _one_sided(-shift, k, h)) if two_sided else 1 / rate


def _one_sided(shift: float, k: float, h: float) -> float:
    from scipy.special import ndtr

    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    nodes, weights = (nodes + 1) * h / 2, weights * h / 2
    starts = np.concatenate([[0.0], nodes])  # the sum may stay at zero, which has a probability of its own
    kernel = np.empty((starts.size, starts.size))
    kernel[:, 0] = ndtr(k - starts - shift)
    step = nodes[None, :] - starts[:, None] + k - shift
    kernel[:, 1:] = weights * np.exp(-(step**2) / 2) / np.sqrt(2 * np.pi)
    return float(np.linalg.solve(np.eye(starts.size) - kernel, np.ones(starts.size))[0])

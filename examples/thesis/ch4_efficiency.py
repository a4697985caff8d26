"""Section 4.5.4, table 4.1: the projections of SIVID with explicit projectors against the triangular form of ASIVID.

The pattern (numbers are lost): explicit projectors cost j^2 (rho + dim phi) operations, the triangular form r^2 j, r
rows: ratio j / r. Run: python ch4_efficiency.py [full]   (full: N = 500 to 6000, 20 runs each; 1 GB)
"""

import sys
import time

import numpy as np

from optid import plants
from optid.statistics.expansion import expand
from optid.statistics.hankel import hankel_statistics
from optid.statistics.rq import rq
from optid.statistics.sums import windows_of

ROWS = 6


def explicit(rows: np.ndarray, z: np.ndarray, phi: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Singular values of Y / Z with the projected regressors removed, by projectors of the size of the record."""
    onto = rows[z].T @ np.linalg.pinv(rows[z] @ rows[z].T) @ rows[z]  # j x j
    projected = rows[phi] @ onto
    return np.linalg.svd(rows[y] @ (onto - onto @ np.linalg.pinv(projected) @ projected), compute_uv=False)


def table(lengths: tuple[int, ...], runs: int) -> dict[str, float]:
    """Time both; return the ratio of the mean times and the disagreement at every length."""
    found, past, future = {}, range(ROWS), range(ROWS, 2 * ROWS)
    print(f"{'N':>6}{'explicit, ms':>14}{'triangular, ms':>16}{'ratio':>8}{'j / r':>8}{'disagreement':>14}")
    for n in lengths:
        times = np.zeros(2)
        for run in range(runs + 1):  # the first warms up
            u = np.random.default_rng(run).uniform(-2, 2, n)
            data = plants.van_der_pol(u, run, process=0.005, measurement=0.02)
            expansion, record = expand(data, "polynomial:4", "polynomial:4"), np.hstack([data.u, data.y])
            start = time.process_time()
            at = (moments := hankel_statistics([record], 2 * ROWS, expansion, centre="mean")).at
            z, y = np.r_[0, at(expansion.eta), at(expansion.zeta, past), at(expansion.y, past)], at(expansion.y, future)
            phi = np.r_[0, at(expansion.eta, future), at(expansion.zeta, future[:-1])]
            fast, middle = rq(moments, z, phi, y).singular_values, time.process_time()
            windows = windows_of(expansion(record) - moments.centre, 2 * ROWS).reshape(n - 2 * ROWS + 1, -1)
            slow = explicit(np.insert(windows, 0, 1.0, axis=1).T, z, phi, y)
            times += np.array([time.process_time() - middle, middle - start]) * (run > 0)
        found[f"ratio, N = {n}"] = ratio = float(times[0] / times[1])
        found[f"disagreement, N = {n}"] = gap = float(np.abs(slow[:fast.size] - fast).max() / fast[0])
        print(f"{n:>6}{1e3 * times[0] / runs:>14.1f}{1e3 * times[1] / runs:>16.2f}{ratio:>8.1f}"
              f"{len(windows) / np.unique(np.r_[z, phi, y]).size:>8.1f}{gap:>14.1e}")
    return found


def main() -> dict[str, float]:
    """Return ratio and disagreement at two short lengths, or at all of the table."""
    return table((500, 1000, 2000, 4000, 6000), 20) if sys.argv[1:] == ["full"] else table((500, 1000), 2)


if __name__ == "__main__":
    main()

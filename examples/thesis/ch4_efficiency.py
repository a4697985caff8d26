"""Section 4.5.4, table 4.1: the projections of SIVID with explicit projectors against the triangular form of ASIVID.

Explicit projectors cost j^2 (rho + dim phi) operations, the triangular form of r rows r^2 j: the ratio is j / r.
Run: python ch4_efficiency.py [folder for the figure] [full]   (full: N = 500 to 6000, 20 runs; 1 GB)
"""

import sys
import time
from pathlib import Path

import numpy as np
from common import run
from drawing import draw_times

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


def main(folder: Path) -> dict[str, float]:
    """Return the ratio of the mean times and the disagreement at every length; save figure 4.10, the times."""
    lengths, runs = ((500, 1000, 2000, 4000, 6000), 20) if "full" in sys.argv[2:] else ((500, 1000, 2000), 2)
    found, means, past, future = {}, [], range(ROWS), range(ROWS, 2 * ROWS)
    print(f"{'N':>6}{'explicit, ms':>14}{'triangular, ms':>16}{'ratio':>8}{'j / r':>8}{'disagreement':>14}")
    for n in lengths:
        means.append(np.zeros(2))  # ms
        for seed in range(runs + 1):  # the first warms up
            u = np.random.default_rng(seed).uniform(-2, 2, n)
            data = plants.van_der_pol(u, seed, process=0.005, measurement=0.02)
            expansion, record = expand(data, "polynomial:4", "polynomial:4"), np.hstack([data.u, data.y])
            start = time.process_time()
            at = (moments := hankel_statistics([record], 2 * ROWS, expansion, centre="mean")).at
            z, y = np.r_[0, at(expansion.eta), at(expansion.zeta, past), at(expansion.y, past)], at(expansion.y, future)
            phi = np.r_[0, at(expansion.eta, future), at(expansion.zeta, future[:-1])]
            fast, middle = rq(moments, z, phi, y).decomposition[1], time.process_time()
            windows = windows_of(expansion(record) - moments.centre, 2 * ROWS).reshape(n - 2 * ROWS + 1, -1)
            slow = explicit(np.insert(windows, 0, 1.0, axis=1).T, z, phi, y)
            means[-1] += np.array([time.process_time() - middle, middle - start]) * (1e3 / runs if seed else 0)
        found[f"ratio, N = {n}"] = ratio = float(means[-1][0] / means[-1][1])
        found[f"disagreement, N = {n}"] = gap = float(np.abs(slow[:fast.size] - fast).max() / fast[0])
        print(f"{n:>6}{means[-1][0]:>14.1f}{means[-1][1]:>16.2f}{ratio:>8.1f}"
              f"{len(windows) / np.unique(np.r_[z, phi, y]).size:>8.1f}{gap:>14.1e}")
    draw_times(folder, "4.10", "efficiency", "mean time of the projections, p = q = 4", lengths, np.transpose(means))
    return found


if __name__ == "__main__":
    run(main)

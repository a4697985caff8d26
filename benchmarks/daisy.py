"""Simulation errors of linear state-space models on DaISy records, beside published subspace results.

    python benchmarks/daisy.py                       # both tables
    python benchmarks/daisy.py --table validation --sets hair robot

Table "validation" (Favoreel, Sima, Van Huffel, Verhaegen and De Moor, SLICOT Working Note 1998-6): error in % =
100 * mean over outputs of sqrt(sum e^2 / sum y^2) on the validation part. The published figures are the smallest over a
grid of orders and block rows, chosen on the validation part itself; here everything is chosen on the estimation part:

* the means of the estimation part are removed from the whole record, and a constant is estimated;
* models of every order of the grid, with and without feedthrough, are fitted to the first 70 % of the estimation part
  by `ss.exact` (simulation error, outputs weighted by their variances, from subspace fits with two numbers of block
  rows); the one that simulates the last 30 % best (same error) is chosen and fitted again to the whole part;
* on the validation part the initial state is fitted to the outputs (least squares), as on the hold-out part. The error
  from the state that the estimation part leaves behind is printed too.

Table "whole" (Sima, SLICOT Working Note 2000-4, table 7): norm(y - ye, 1) / norm(y, 1) on all data with the initial
state estimated, at given orders; the 1-norm of a matrix is its largest column sum. The fit is `ss.exact` on the record
as it is (constant estimated, simulation error), with poles outside the unit circle allowed as in the published methods.

Goals: at most the best published figure on every set.
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import numpy as np

import optid
from optid.errors import DataError, RankError, StructureError
from optid.models import HammersteinSS

VALIDATION = {
    # name: (file, estimation samples, validation samples, orders, published CVA, N4SID, MOESP)
    "hair": ("daisy_hairdryer", 750, 250, range(2, 9), (7.5086, 7.8874, 7.9014)),
    "robot": ("daisy_robotarm", 800, 224, range(2, 13), (5.7773, 3.5258, 3.9485)),
    "dryer": ("daisy_dryer_industrial", 600, 267, range(1, 7), (49.2288, 49.4671, 50.3791)),
    "evaporator": ("daisy_evaporator", 5000, 1305, range(1, 9), (43.0268, 42.9225, 37.4237)),
    "cd": ("daisy_cdplayer", 1500, 548, range(2, 21, 2), (19.6774, 23.5653, 18.0015)),
}
WHOLE = {
    # name: (file, order, published SLmoesp, OMOESP, MOESP, N4SID)
    "hair": ("daisy_hairdryer", 4, (3.30e-2, 7.33e-2, 1.50e-2, 2.16e-2)),
    "robot": ("daisy_robotarm", 4, (1.14e-1, 7.38e4, 3.60e-2, 4.51e-2)),
    "evaporator": ("daisy_evaporator", 4, (5.50e-1, 5.67e-1, 4.89e-1, 5.53e-1)),
    "cd": ("daisy_cdplayer", 8, (1.13e2, 8.06e4, 1.76e-1, 3.45e-1)),
    "ball": ("daisy_ballbeam", 2, (3.61e-1, 2.21e1, 2.54e-1, 2.78e-1)),
}


def read(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and outputs of a DaISy file."""
    table = np.genfromtxt(Path(os.environ["OPTID_DATA"]) / f"{name}.csv", delimiter=",", names=True)
    columns = table.dtype.names
    return tuple(np.column_stack([table[c] for c in columns if c.startswith(letter)]) for letter in "uy")


def simulation_error(model: HammersteinSS, data: optid.Data, x0="fit") -> float:
    """Return 100 * mean over outputs of sqrt(sum e^2 / sum y^2); infinite where the simulation diverges."""
    try:
        error = data.y - model.simulate(data, x0=x0)
    except DataError:
        return np.inf
    return float(100 * np.mean(np.sqrt(np.sum(error**2, axis=0) / np.sum(data.y**2, axis=0))))


def fitted(data: optid.Data, nx: int, iterations: int, **options) -> HammersteinSS | None:
    """Fit a model by simulation error; None where the order cannot be fitted."""
    rows = [nx // data.l + 3, 2 * (nx // data.l) + 8]
    try:
        return optid.fit(data, "ss.exact", nx=nx, block_rows=rows, weighting="scale", iterations=iterations,
                         raises=False, **options).model
    except (RankError, StructureError, DataError):
        return None


def validated(name: str, iterations: int) -> None:
    """Print one row of the first table."""
    file, n_est, n_val, orders, published = VALIDATION[name]
    u, y = read(file)
    u, y = u - u[:n_est].mean(axis=0), y - y[:n_est].mean(axis=0)
    estimation, validation = optid.Data(u[: n_est + n_val], y[: n_est + n_val]).split(n_est)
    first, held = estimation.split(0.7)
    clock, grid = time.process_time(), []
    for nx in orders:
        for feedthrough in (True, False):
            model = fitted(first, nx, iterations, feedthrough=feedthrough)
            if model is not None:
                grid.append((simulation_error(model, held), nx, feedthrough))
    grid.sort()
    error, nx, feedthrough = grid[0]
    model = fitted(estimation, nx, iterations, feedthrough=feedthrough)
    fit = simulation_error(model, validation)
    x0 = np.asarray(model.initial_state(estimation))
    whole = optid.Data(np.vstack([estimation.u, validation.u]), np.vstack([estimation.y, validation.y]))
    through = whole.y - model.simulate(whole, x0=x0)
    carried = 100 * np.mean(np.sqrt(np.sum(through[n_est:] ** 2, axis=0) / np.sum(validation.y**2, axis=0)))
    goal = min(published)
    print(f"{name:10s} nx {nx:2d} feedthrough {feedthrough!s:5s} hold-out {error:8.4f}   validation {fit:8.4f} "
          f"(state carried over {carried:8.4f})   published {' '.join(f'{p:8.4f}' for p in published)}   "
          f"goal {goal:8.4f} {'reached' if fit <= goal else 'MISSED'}   {time.process_time() - clock:.0f} s")
    by_order = [f"{n}{'' if d else '-'}: {e:.2f}" for e, n, d in sorted(grid, key=lambda row: (row[1], not row[2]))]
    print(f"           hold-out by order (- without feedthrough): {', '.join(by_order)}", flush=True)


def on_all_data(name: str, iterations: int) -> None:
    """Print one row of the second table."""
    file, nx, published = WHOLE[name]
    u, y = read(file)
    data, clock = optid.Data(u, y), time.process_time()
    model = fitted(data, nx, iterations, stability="free")
    error = y - model.simulate(data, x0="fit")
    relative = np.linalg.norm(error, 1) / np.linalg.norm(y, 1)
    goal = min(published)
    print(f"{name:10s} nx {nx:2d}   error {relative:.3e}   published {' '.join(f'{p:.2e}' for p in published)}   "
          f"goal {goal:.2e} {'reached' if relative <= goal else 'MISSED'}   {time.process_time() - clock:.0f} s",
          flush=True)


def main() -> None:
    """Parse the arguments and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", choices=["validation", "whole", "both"], default="both")
    parser.add_argument("--sets", nargs="+", choices=sorted({*VALIDATION, *WHOLE}), default=None)
    parser.add_argument("--iterations", type=int, default=60, help="Gauss-Newton steps per descent")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for table, rows, show in (("validation", VALIDATION, validated), ("whole", WHOLE, on_all_data)):
        if arguments.table in (table, "both"):
            print(f"-- {table}: {'simulation error in %' if rows is VALIDATION else 'relative 1-norm error'}")
            for name in rows:
                if arguments.sets is None or name in arguments.sets:
                    show(name, arguments.iterations)


if __name__ == "__main__":
    main()

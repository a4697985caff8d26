"""Speed of the subspace step on expanded inputs, and beside SLICOT on a linear system.

Prints
* 2 inputs x 10 functions, 2 outputs, 10 block rows: CPU time of statistics, RQ and singular values here, of forming
  the block Hankel matrices and taking their QR decomposition, the ratio, and the largest relative difference of the
  singular values (goals: >= 20 times faster, equal to 1e-8);
* plain linear system with 2 inputs, 2 outputs, 4 states: the same step beside IB01AD of SLICOT (package ctrlsys), with
  its fast and its QR route (goal: at most twice the time of the faster), and the largest relative difference of the
  singular values; a reason where ctrlsys is not installed (`pip install ctrlsys`);
* the singular values, order and poles of SLICOT's example, the hair dryer, where OPTID_DATA has it.

Times are medians of CPU time over rounds in which the routes alternate, in one process.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

import argparse
import importlib.util
import time
from pathlib import Path

import numpy as np
from scipy.signal import dlsim

from optid import Data, Polynomial, Triangular, fit
from optid.identify.subspace.projection import project, realise
from optid.statistics.expansion import expand
from optid.statistics.hankel import hankel_statistics
from optid.statistics.rq import rq
from optid.statistics.sums import windows_of

PRINTED = "69.8841 14.9963 3.6675 1.9677 0.3000 0.2078 0.1651 0.1373 0.1133 0.1059 0.0856 0.0784 0.0733 0.0678 0.0571"
A = np.array([[0.7, 0.35, 0, 0], [-0.35, 0.7, 0.1, 0], [0, 0, 0.5, 0.2], [0, 0, 0, -0.4]])
B = np.array([[1, 0.2], [0, 0.8], [0.5, -0.6], [0.3, 1.0]])
C = np.array([[1, 0, 0.5, 0.2], [0, 1, -0.3, 0.6]])


def linear_record(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and outputs of the linear system with a little measurement noise."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (count, 2))
    _, y, _ = dlsim((A, B, C, np.zeros((2, 2)), 1), u)
    return u, y + 0.1 * rng.standard_normal((count, 2))


def expanded_record(count: int, basis: str) -> tuple[np.ndarray, object]:
    """[u | y] of the system behind two static nonlinearities, and the expansion in 10 functions each."""
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, (count, 2))
    f = np.column_stack([u[:, 0] ** 3 + u[:, 0], np.tanh(3 * u[:, 1])])
    _, y, _ = dlsim((A, B, C, np.zeros((2, 2)), 1), f)
    family = (Polynomial(10) if basis == "polynomial" else Triangular(10)).with_interval(-1.0, 1.0)
    record = np.hstack([u, y + 0.1 * rng.standard_normal((count, 2))])
    return record, expand(Data(u, record[:, 2:]), family)


def own(record: np.ndarray, expansion, rows: int):
    """Statistics, RQ and singular values without a Hankel matrix."""
    return project([record], expansion, rows, instruments="inputs+past", offset=True)


def formed(record: np.ndarray, expansion, rows: int, scale: np.ndarray) -> np.ndarray:
    """The singular values from Hankel matrices that are formed and a QR decomposition of all of them."""
    hankel = windows_of(expansion(record), 2 * rows).reshape(len(record) - 2 * rows + 1, -1)
    hankel = np.concatenate([np.ones((len(hankel), 1)), hankel], axis=1)
    statistics = hankel_statistics([record[: 4 * rows]], 2 * rows, expansion, method="gram")  # for positions alone
    z, phi, y = expansion.positions(statistics.at, "inputs+past", rows)
    order = np.concatenate([phi, z[~np.isin(z, phi)], y])
    triangle = np.linalg.qr(hankel[:, order], mode="r")
    r22 = triangle[phi.size : z.size, -y.size :].T
    return np.linalg.svd(r22 / np.tile(scale, rows)[:, None], compute_uv=False)


def cpu(work, *arguments) -> tuple[float, object]:
    """CPU seconds of a call, and what it returned."""
    start = time.process_time()
    found = work(*arguments)
    return time.process_time() - start, found


def expanded(count: int, rows: int, rounds: int, basis: str) -> None:
    record, expansion = expanded_record(count, basis)
    own(record, expansion, rows)  # compiled and warm
    times = []
    for _ in range(rounds):
        fast, projection = cpu(own, record, expansion, rows)
        slow, values = cpu(formed, record, expansion, rows, projection.scale)
        times.append((fast, slow))
    fast, slow = np.median(np.array(times), axis=0)
    ours = projection.values
    error = float(np.max(np.abs(ours - values[: ours.size]) / values[0]))
    poles = np.sort(np.abs(np.linalg.eigvals(realise(projection.gamma(4), 2)[0])))
    print(f"expanded inputs, {basis}, {count} samples, 2 x {expansion.input_sizes[0]} functions, 2 outputs, {rows} "
          f"block rows ({2 * rows * (expansion.p + 2)} rows):")
    print(f"  here {1e3 * fast:.0f} ms ({projection.statistics.method}), formed and QR {1e3 * slow:.0f} ms: "
          f"{slow / fast:.1f} times faster (goal >= 20)")
    print(f"  singular values equal to {error:.1e} of the largest (goal 1e-8); moduli of the poles {poles.round(4)}")


def slicot(count: int, rows: int, rounds: int) -> None:
    print(f"linear system, 2 inputs, 2 outputs, 4 states, {count} samples, {rows} block rows:")
    if importlib.util.find_spec("ctrlsys") is None:
        print("  SLICOT skipped: package ctrlsys is not installed (pip install ctrlsys)")
        return
    import ctrlsys

    u, y = linear_record(count)
    record, uf, yf = np.hstack([u, y]), np.asfortranarray(u), np.asfortranarray(y)

    def here() -> np.ndarray:
        statistics = hankel_statistics([record], 2 * rows)
        past, future = range(rows), range(rows, 2 * rows)
        z = np.concatenate([statistics.at([0, 1], future), statistics.at([0, 1, 2, 3], past)])
        return rq(statistics, z, statistics.at([0, 1], future), statistics.at([2, 3], future)).decomposition[1]

    def there(route: str) -> np.ndarray:
        order, _, values, _, info = ctrlsys.ib01ad("M", route, "N", "O", "N", "N", rows, 2, 2, uf, yf, 0.0, -1.0)
        if info or order != 4:
            raise RuntimeError(f"IB01AD: info {info}, order {order}")
        return values

    here()
    times = []
    for _ in range(rounds):
        found = [cpu(here), *(cpu(there, route) for route in "CFQ")]
        times.append([seconds for seconds, _ in found])
    ours, cholesky, fast, plain = np.median(np.array(times), axis=0)
    difference = float(np.max(np.abs(found[0][1] - found[3][1]) / found[3][1][0]))
    print(f"  here {1e3 * ours:.1f} ms; IB01AD Cholesky {1e3 * cholesky:.1f}, fast QR {1e3 * fast:.1f}, "
          f"QR {1e3 * plain:.1f} ms: {ours / min(cholesky, fast, plain):.2f} times the fastest (goal <= 2)")
    print(f"  singular values equal to {difference:.1e} of the largest")


def hair_dryer() -> None:
    folder = os.environ.get("OPTID_DATA", "")
    path = Path(folder) / "daisy_hairdryer.csv"
    if not folder or not path.is_file():
        print("hair dryer skipped: OPTID_DATA does not name a folder with daisy_hairdryer.csv")
        return
    columns = np.loadtxt(path, delimiter=",", skiprows=1)
    data = Data(u=columns[:, -2], y=columns[:, -1], dt=0.08)
    found = fit(data, "hammerstein_ss.sid", nx="gap", block_rows=15, offset=False)
    ours = " ".join(f"{value:.4f}" for value in found.figures["singular values"])
    poles = ", ".join(f"{p.real:.4f}" + f"{p.imag:+.4f}i" * int(abs(p.imag) > 1e-9) for p in found.model.poles)
    print("hair dryer, 15 block rows (SLICOT IB01AD):")
    print(f"  singular values {ours}\n  printed         {PRINTED}   {'equal' if ours == PRINTED else 'DIFFERENT'}")
    print(f"  order {found.figures['order']} (4); poles {poles} (0.9611, 0.7455, 0.4758 +- 0.2001i)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--block-rows", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    for basis in ("polynomial", "triangular"):
        expanded(options.samples, options.block_rows, options.rounds, basis)
    slicot(options.samples, options.block_rows, options.rounds)
    hair_dryer()


if __name__ == "__main__":
    main()

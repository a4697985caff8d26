"""How often a rank-one fit is proved globally optimal, at which rung of the ladder, and whether a proof is ever false.

Random Hammerstein-ARX regressions: n_b 2-6, 4-12 basis functions, SNR 0.3/1/10, N = 5/10/50 x columns, triangular or
Legendre, white or AR(0.9) input, truth of rank one or two. Reference: exact search over the circle for n_b = 2, the
best of 50 starts otherwise. Run ``python benchmarks/certificate.py``; smaller with --problems --monotone --channels.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from time import perf_counter

import numpy as np
from rank_one_fits import minimise_in_cones, solve_certified
from scipy.signal import lfilter
from scipy.special import ndtr

from optid.certificate.ladder import certify
from optid.program.solution import relative_gap
from optid.structures.bilinear import best_of
from optid.structures.rank_one import RankOne, reduce

TOLERANCE = 1e-8


def basis_values(u, size, kind):
    """(N, size) values on [-1, 1] without the constant."""
    if kind == "legendre":
        return np.polynomial.legendre.legvander(u, size)[:, 1:]
    nodes = np.linspace(-1, 1, size + 1)
    return np.delete(np.maximum(0, 1 - np.abs(u[:, None] - nodes) / (nodes[1] - nodes[0])), size // 2, axis=1)


def increments_matrix(size):
    """Increments between the nodes of the triangular basis, acting on its coefficients."""
    return np.delete(np.diff(np.eye(size + 1), axis=0), size // 2, axis=1)


def draw(seed, channels=1, truth="any", scarce=False):
    """A random problem and the cell of the grid it comes from; None where a basis function was never excited."""
    rng = np.random.default_rng([seed, channels, len(truth)])
    nb, size = int(rng.integers(2, 7)), int(rng.integers(4, 13))
    cell = {"nb": nb, "size": size, "snr": float(rng.choice([0.3, 1, 10])), "ratio": int(rng.choice([5, 10, 50])),
            "white": bool(rng.random() < 0.5), "rank": 1 if truth != "any" else int(rng.integers(1, 3)),
            "basis": "triangular" if truth != "any" else str(rng.choice(["triangular", "legendre"]))}
    columns = 3 + channels * nb * size
    rows = cell["ratio"] * columns
    if scarce:
        rows = max(cell["ratio"] * (3 + channels * (nb + size - 1)), int(1.3 * columns))
    lagged, signal = [], np.zeros(rows)
    common = rng.standard_normal(rows + nb + 100)
    for _ in range(channels):
        drive = rng.standard_normal(rows + nb + 100)
        if channels > 1:
            drive = 0.8 * drive + 0.6 * common
        if not cell["white"]:
            drive = lfilter([np.sqrt(1 - 0.81)], [1, -0.9], drive)
        values = basis_values(2 * ndtr(drive[100:]) - 1, size, cell["basis"])
        block = np.hstack([values[nb - j:nb - j + rows] for j in range(nb)])
        if truth == "any":
            theta = sum(np.kron(rng.standard_normal(nb), rng.standard_normal(size)) for _ in range(cell["rank"]))
        else:
            steps = rng.exponential(size=size) * (rng.random(size) < 0.6) + 1e-3
            steps = steps if truth == "monotone" else rng.standard_normal(size)
            theta = np.kron(rng.standard_normal(nb), np.linalg.solve(increments_matrix(size), steps))
        lagged.append(block)
        signal = signal + block @ theta
    noise = rng.standard_normal(rows) * np.std(signal) / np.sqrt(cell["snr"])
    y = lfilter([1.0], [1, -1.5, 0.7], signal + noise)
    past = -np.column_stack([np.r_[0.0, y[:-1]], np.r_[0.0, 0.0, y[:-2]]])
    triangle = np.linalg.qr(np.column_stack([past, np.ones(rows), *lagged, y]), mode="r")
    n = len(triangle) - 1
    if np.abs(triangle.diagonal()).min() < 1e-9 * np.abs(triangle).max():
        return None
    return RankOne(triangle[:n, :n], triangle[:n, n], triangle[n, n] ** 2, ((size, nb),) * channels, 3), cell


def search_circle(problem, points=720):
    """Exact minimum for n_b = 2: value on a fine grid of angles, every local minimum refined by golden section."""
    size, n = problem.blocks[0][0], problem.linear
    root, target = problem.root[n:, n:], problem.target[n:]

    def value(angle):
        design = np.cos(angle) * root[:, :size] + np.sin(angle) * root[:, size:]
        basis = np.linalg.qr(design)[0]
        residual = target - basis @ (basis.T @ target)
        return float(residual @ residual) + problem.remainder

    step = np.pi / points
    values = np.array([value(k * step) for k in range(points)])
    best, ratio = np.inf, (np.sqrt(5) - 1) / 2
    for k in np.flatnonzero((values <= np.roll(values, 1)) & (values <= np.roll(values, -1))):
        low, high = (k - 1) * step, (k + 1) * step
        while high - low > 1e-8:
            left, right = high - ratio * (high - low), low + ratio * (high - low)
            low, high = (low, right) if value(left) < value(right) else (left, high)
        best = min(best, value((low + high) / 2))
    return best


def row(problem, cell, bound, value, reference, stage, seconds):
    """What is kept of one problem."""
    floor = 1e-9 * problem.scale
    return cell | {
        "proved": bound.proved, "stage": stage, "gap": relative_gap(value, bound.value, problem.scale),
        "seconds": seconds,
        "false": bound.proved and value > reference + TOLERANCE * max(reference, floor),
        "excess": (bound.value - min(reference, value)) / max(value, floor),
        "missed": value > reference * (1 + 1e-7)}


def run_free(seed, channels, max_size, scarce=False):
    """Solve and certify one unconstrained problem; the reference never sees the certificate."""
    drawn = draw(seed, channels, scarce=scarce)
    if drawn is None:
        return None
    problem, cell = drawn
    began = perf_counter()
    result = solve_certified(problem, effort="ascent")
    seconds = perf_counter() - began
    stage = result.certification.bound.method
    if not result.certification.bound.proved and max_size:
        result = solve_certified(problem, effort="sdp", max_size=max_size)
        stage, seconds = "sdp", perf_counter() - began
    value = result.solution.value
    if cell["nb"] == 2 and channels == 1:
        reference = search_circle(problem)
    else:
        reference = best_of(reduce(problem), 50, seed=12345).value
    attempted = "multipliers exceeds" not in result.certification.bound.reason
    return row(problem, cell, result.certification.bound, value, reference, stage, seconds) | {"attempted": attempted}


def run_monotone(seed, truth, max_size):
    """Solve and certify one problem with monotone constraints; None where they are not active."""
    drawn = draw(seed, truth=truth)
    if drawn is None:
        return None
    problem, cell = drawn
    cone = increments_matrix(cell["size"])
    began = perf_counter()
    found = minimise_in_cones(problem, {0: cone})
    if np.abs(cone @ found.point.mus[0]).min() > 1e-9 * np.abs(found.point.mus[0]).max():
        return None
    solved = perf_counter()
    outcome = certify(problem, found.point, cones={0: cone}, effort="ascent")
    seconds, stage = perf_counter() - solved, outcome.bound.method
    if not outcome.bound.proved and max_size:
        outcome = certify(problem, found.point, cones={0: cone}, max_size=max_size)
        again = [minimise_in_cones(problem, {0: cone}, start=point) for point in outcome.better]
        challenger = min(again, key=lambda solution: solution.value, default=found)
        if challenger.value < found.value * (1 - 1e-10):
            found = challenger
            outcome = certify(problem, found.point, cones={0: cone}, max_size=max_size)
        stage, seconds = "product cuts", perf_counter() - solved
    reference = minimise_in_cones(problem, {0: cone}, count=20, seed=12345).value
    attempted = "multipliers exceeds" not in outcome.bound.reason
    return row(problem, cell, outcome.bound, found.value, reference, stage, seconds) | {
        "attempted": attempted, "solving": solved - began}


def summarise(title, rows, white=True):
    """Print fractions proved by stage, false proofs, worst gaps and times."""
    total = len(rows)
    if not total:
        return
    proved = [r for r in rows if r["proved"]]
    cheap = [r for r in proved if r["stage"] in ("instant", "ascent")]
    print(f"\n{title}: {total} problems")
    for stage in ("instant", "ascent", "sdp", "product cuts"):
        some = [r for r in proved if r["stage"] == stage]
        times = [1e3 * r["seconds"] for r in some] or [np.nan]
        print(f"  proved by {stage:<12} {len(some) / total:8.4f}   median {np.median(times):8.2f} ms, "
              f"worst {max(times):9.1f} ms")
    print(f"  proved before the SDP   {len(cheap) / total:8.4f}")
    print(f"  proved in all           {len(proved) / total:8.4f}")
    within = [r for r in rows if r["attempted"]]
    print(f"  proved where the SDP fits the size limit {sum(r['proved'] for r in within)} of {len(within)} = "
          f"{sum(r['proved'] for r in within) / max(len(within), 1):.4f}")
    easy = [r for r in rows if r["white"] and r["ratio"] == 50]
    if white and easy:
        print(f"  white input, largest N: before the SDP "
              f"{sum(r in cheap for r in easy)} of {len(easy)}; all white inputs "
              f"{sum(r['white'] for r in cheap) / max(sum(r['white'] for r in rows), 1):.4f}")
    for rank in (1, 2):
        some = [r for r in rows if r["rank"] == rank]
        if some and white:
            print(f"  truth of rank {rank}: before the SDP "
                  f"{sum(r['stage'] in ('instant', 'ascent') and r['proved'] for r in some) / len(some):.4f}")
    print(f"  FALSE PROOFS            {sum(r['false'] for r in rows)}")
    print(f"  bounds above the best known value by more than 1e-8: {sum(r['excess'] > TOLERANCE for r in rows)} "
          f"(worst relative excess {max(r['excess'] for r in rows):.1e})")
    print(f"  worst gap among proved  {max((r['gap'] for r in proved), default=np.nan):.1e}, "
          f"among the rest {max((r['gap'] for r in rows if not r['proved']), default=0.0):.1e}")
    print(f"  local solutions above the reference: {sum(r['missed'] for r in rows)}")


def collect(function, count, workers):
    """Run ``function(seed)`` until ``count`` problems have been kept."""
    kept, seed = [], 0
    with ProcessPoolExecutor(workers) as pool:
        while len(kept) < count:
            batch = range(seed, seed + max(count - len(kept), 2 * workers))
            kept += [r for r in pool.map(function, batch, chunksize=8) if r is not None]
            seed = batch.stop
    return kept[:count]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=10_000)
    parser.add_argument("--monotone", type=int, default=2_000)
    parser.add_argument("--channels", type=int, default=2_000, help="problems with two channels")
    parser.add_argument("--violated", type=int, default=0, help="problems whose truth breaks the monotone constraint")
    parser.add_argument("--scarce", type=int, default=0,
                        help="problems with N = 5/10/50 x the parameters of the rank-one model, at least 1.3 x columns")
    parser.add_argument("--max-size", type=int, default=450, help="multipliers in the SDP (0: no SDP)")
    parser.add_argument("--max-cut-size", type=int, default=1400, help="the same with product cuts")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    tasks = [("One channel", partial(run_free, channels=1, max_size=args.max_size), args.problems, True),
             ("Two channels", partial(run_free, channels=2, max_size=args.max_size), args.channels, True),
             ("One channel, scarce data",
              partial(run_free, channels=1, max_size=args.max_size, scarce=True), args.scarce, True),
             ("Monotone constraint active, monotone truth",
              partial(run_monotone, truth="monotone", max_size=args.max_cut_size), args.monotone, False),
             ("Monotone constraint active, truth not monotone",
              partial(run_monotone, truth="otherwise", max_size=args.max_cut_size), args.violated, False)]
    for title, function, count, white in tasks:
        began = perf_counter()
        summarise(title, collect(function, count, args.workers) if count else [], white)
        if count:
            print(f"  wall time {perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()

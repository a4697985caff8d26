"""What missing samples cost: accuracy, coverage, and nothing else.

    python benchmarks/missing.py [--runs 1000] [--samples 1000 5000] [--workers 2]

10 and 30 % of the samples are removed at random, from y alone and from u and y. Printed are the share of the rows kept,
the median of 100 - fit (simulation from rest against the noise-free output) over that of the complete records, beside
its limit 1.1 / sqrt(rows kept), and how often the 95 % intervals of a, b and f contain the truth. Last, the statistics
with missing samples are compared with those of the dense regressor whose incomplete rows were deleted.
"""

import argparse
import warnings

import numpy as np
from montecarlo import BASIS, NODES, STRUCTURE, TRUTHS, A, B, mapped, record
from scipy.signal import lfilter

import optid
from optid.errors import DataWarning
from optid.identify.uncertainty import uncertainty
from optid.models.layout import Layout
from optid.statistics import collect

VALUES = TRUTHS["dead zone"]
GRID = np.linspace(-1.0, 1.0, 41)
PATTERNS = {"none": (0.0, 0.0), "y 10 %": (0.0, 0.1), "y 30 %": (0.0, 0.3), "u, y 10 %": (0.1, 0.1),
            "u, y 30 %": (0.3, 0.3)}


def punctured(data: optid.Data, pattern: str, seed: int) -> optid.Data:
    """Remove samples of u and y at random, each with its own probability."""
    rng = np.random.default_rng([seed, 1])
    u, y = data.u.copy(), data.y.copy()
    for signal, share in zip((u, y), PATTERNS[pattern]):
        signal[rng.random(signal.shape) < share] = np.nan
    return optid.Data(u=u, y=y, dt=data.dt)


def run(job: tuple[str, int, int]) -> tuple[float, float, np.ndarray]:
    """Return 100 - fit, the share of rows kept, and which of a, b and f (41 points) are covered."""
    pattern, n, seed = job
    whole = record(VALUES, n, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)  # few rows are the point here
        fit = optid.fit(punctured(whole, pattern, seed), prove=False, **STRUCTURE)
    clean = lfilter(B, np.r_[1.0, A], np.interp(whole.u[:, 0], NODES, VALUES))
    error = clean - fit.model.simulate(whole.u[:, 0])
    found = uncertainty(fit)
    intervals = [found.a, found.b[0], found.band(0, GRID)]
    lower, upper = (np.concatenate([getattr(i, end) for i in intervals]) for end in ("lower", "upper"))
    truth = np.concatenate([A, B, np.interp(GRID, NODES, VALUES)])
    lost = 100 * float(np.linalg.norm(error) / np.linalg.norm(clean - clean.mean()))
    return lost, fit.figures["rows"] / (n - 2), (lower <= truth) & (truth <= upper)


def disagreement(pattern: str, n: int) -> float:
    """Largest difference of the Gram matrices with missing samples and of the dense rows, relative to its scale."""
    data = punctured(record(VALUES, n, 0), pattern, 0)
    layout = Layout(2, (2,), (0,), (BASIS,), ("y",), ("u",))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        gram = collect(data, layout).gram
    y, eta = data.y, BASIS.values(data.u[:, 0])
    rows = np.hstack([-y[1:-1], -y[:-2], eta[2:], eta[1:-1], np.ones((n - 2, 1)), y[2:]])
    rows = rows[~np.isnan(rows).any(axis=1)]
    dense = rows.T @ rows
    scale = np.sqrt(np.diag(dense))
    return float(np.max(np.abs(gram - dense) / np.outer(scale, scale)))


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--samples", type=int, nargs="+", default=[1000, 5000])
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(argv)
    figures = {}
    print(f"{'missing':>10} {'N':>5}   rows kept   100 - fit   ratio   limit     a1    a2    b0    b1    f mean "
          "  f points")
    for n in options.samples:
        complete = np.nan
        for pattern in PATTERNS:
            jobs = [(pattern, n, seed) for seed in range(options.runs)]
            lost, kept, hits = map(np.array, zip(*mapped(run, jobs, options.workers)))
            median, share = float(np.median(lost)), float(np.mean(kept))
            complete = median if pattern == "none" else complete
            covered = 100 * hits.mean(axis=0)
            figures[pattern, n] = {"ratio": median / complete, "limit": 1.1 / np.sqrt(share), "coverage": covered}
            print(f"{pattern:>10} {n:5d}   {100 * share:7.1f} %   {median:9.3f}   {median / complete:5.3f}   "
                  f"{1.1 / np.sqrt(share):5.3f}   " + " ".join(f"{s:5.1f}" for s in covered[:4])
                  + f"   {covered[4:].mean():6.1f}   {covered[4:].min():5.1f}-{covered[4:].max():5.1f}", flush=True)
    worst = max(disagreement(pattern, n) for pattern in PATTERNS for n in options.samples)
    figures["statistics"] = worst
    print(f"statistics with missing samples against the dense rows: largest relative difference {worst:.1e}")
    return figures


if __name__ == "__main__":
    main()

"""Do 95 % intervals contain the truth in 95 % of the records, also where constraints are active?

    python benchmarks/interval_coverage.py [--runs 1000] [--free-runs 4000] [--samples 200 1000] [--truths ...]
                                           [--constraints increasing slope]

Every record of the simulation example is fitted without constraints, with the constraint that f increases, and with
bounds on the slope of the static curve at the smallest and the largest slope that it has. Counted are a, b,
and f (its offset included, gauge norm of b one) at 41 points, nodes and cell interiors. The truths: strictly
increasing; with a flat piece inside (dead zone); on the boundary of the cone at both ends (saturation). Width is the
mean width of the band under the constraint relative to the one without, averaged over the points. The extremes over 41
points scatter: the standard error of one share is 0.7 % for 1000 runs, 0.35 % for 4000; the fits without constraint are
cheap, so there are more of them.
"""

import argparse

import numpy as np
from montecarlo import NODES, STRUCTURE, TRUTHS, A, B, mapped, record

import optid
from formulations.constraints import shape
from optid.identify.uncertainty import uncertainty

GRID = np.linspace(-1.0, 1.0, 41)
CASES = ("strictly monotone", "dead zone", "saturation")
ROUNDING = 1e-7
"""A limit that lies on the truth, as where a constraint holds it there, may miss it by the accuracy of the solver."""


CONSTRAINTS = ("increasing", "slope")


def rules(word: str, values: np.ndarray) -> tuple:
    """Constraints of a word for a truth with these values of f at the nodes."""
    if word == "increasing":
        return ("monotone:increasing",)
    slopes = np.diff(values) / np.diff(NODES) * B.sum() / (1 + A.sum())
    return (shape.slope(float(slopes.min()), float(slopes.max())),) if word else ()


def run(job: tuple[str, int, int, str]) -> tuple[np.ndarray, np.ndarray]:
    """Return which of a (2), b (2) and f (41) are covered, and the widths."""
    name, n, seed, word = job
    values = TRUTHS[name]
    constraints = rules(word, values)
    fit = optid.fit(record(values, n, seed), prove=False, constraints=constraints, **STRUCTURE)
    found = uncertainty(fit, seed=seed)
    intervals = [found.a, found.b[0], found.band(0, GRID)]
    lower, upper = (np.concatenate([getattr(i, end) for i in intervals]) for end in ("lower", "upper"))
    truth = np.concatenate([A, B, np.interp(GRID, NODES, values)])
    return (lower - ROUNDING <= truth) & (truth <= upper + ROUNDING), upper - lower


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--free-runs", type=int, default=4000, help="runs without the constraint")
    parser.add_argument("--samples", type=int, nargs="+", default=[200, 1000])
    parser.add_argument("--truths", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--constraints", nargs="+", default=["increasing"], choices=CONSTRAINTS)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(argv)
    figures = {}
    print(f"{'truth':>18} {'N':>5}  {'constraint':>10}  runs   a1    a2    b0    b1    f mean   f points       width")
    for name in options.truths:
        for n in options.samples:
            free = None
            for word in ("", *options.constraints):
                count = options.runs if word else options.free_runs
                jobs = [(name, n, seed, word) for seed in range(count)]
                hits, widths = map(np.array, zip(*mapped(run, jobs, options.workers)))
                share, width = 100 * hits.mean(axis=0), widths.mean(axis=0)
                free = width if free is None else free
                relative = float(np.mean(width[4:] / free[4:]))
                figures[name, n, word] = {"parameters": share[:4], "points": share[4:], "width": relative}
                print(f"{name:>18} {n:5d}  {word or '-':>10} {count:5d}  "
                      + " ".join(f"{s:5.1f}" for s in share[:4])
                      + f"   {share[4:].mean():5.1f}   {share[4:].min():5.1f}-{share[4:].max():5.1f}   {relative:.3f}",
                      flush=True)
    return figures


if __name__ == "__main__":
    main()

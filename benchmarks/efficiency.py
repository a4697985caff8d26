"""Does the exact fit reach the smallest error there is, and is it never worse than the plain SVD split?

    python benchmarks/efficiency.py [--runs 1000] [--samples 200 1000] [--workers 2]

Efficiency: root mean square error of every reported parameter (a, b, mu, offset, gauge norm of b one) over
``sigma sqrt(mean (J^T J)^-1)``, J the Jacobian of the one-step predictions at the truth in the tangent space of the
rank-one manifold, averaged over the records. Split: the bilinear least-squares objective of the fit against that of
the plain SVD split of the over-parametrised estimate, once as Algorithm 3.1 leaves it and once with A and the offset
re-estimated for the split f and B. Exactness: b1 / b0 for a function that is not odd, without noise.
"""

import argparse

import numpy as np
from montecarlo import STRUCTURE, TRUTHS, A, B, mapped, noise_level, record
from scipy.linalg import null_space

import optid
from optid.identify.equation_error import EquationStructure, compress

VALUES = TRUTHS["dead zone"]
MU = np.delete(VALUES, 4) - VALUES[4]
TRUTH = np.concatenate([A, [0.0], MU, B])
NAMES = ["a1", "a2", "offset", *(f"mu{j}" for j in range(1, 9)), "b0", "b1"]


def bound(problem) -> np.ndarray:
    """Diagonal of (J^T J)^-1 at the truth, from the triangular system of one record."""
    lift = np.zeros((19, 13))
    lift[:3, :3] = np.eye(3)
    lift[3:, 3:11] = np.kron(B[:, None], np.eye(8))
    lift[3:, 11:] = np.kron(np.eye(2), MU[:, None])
    free = null_space(np.r_[np.zeros(11), B][None])
    jacobian = problem.root @ lift @ free
    return np.diag(free @ np.linalg.inv(jacobian.T @ jacobian) @ free.T)


def split_objectives(problem) -> tuple[float, float]:
    """Objective of the plain SVD split, as it is and with the linear unknowns re-estimated."""
    full = np.linalg.solve(problem.root, problem.target)
    u, d, vt = np.linalg.svd(full[3:].reshape(2, 8).T)
    theta = np.kron(vt[0], d[0] * u[:, 0])
    again = np.linalg.lstsq(problem.root[:, :3], problem.target - problem.root[:, 3:] @ theta)[0]
    return tuple(problem.value(np.concatenate([w, theta])) for w in (full[:3], again))


def run(job: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n, seed = job
    fit = optid.fit(record(VALUES, n, seed), prove=False, **STRUCTURE)
    model, problem = fit.model, compress(fit.data, EquationStructure(nk=0, **STRUCTURE), own=False).problem
    estimate = np.concatenate([model.a, model.offset, model.nonlinearities[0].mu, model.b[0]])
    return estimate - TRUTH, bound(problem), np.array([fit.solution.objective, *split_objectives(problem)])


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--samples", type=int, nargs="+", default=[200, 1000])
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(argv)
    figures = {}
    for n in options.samples:
        errors, bounds, objectives = map(np.array, zip(*mapped(
            run, [(n, seed) for seed in range(options.runs)], options.workers)))
        ratio = np.sqrt(np.mean(errors**2, axis=0) / np.mean(bounds, axis=0)) / noise_level(VALUES)
        overall = float(np.sqrt(np.mean(ratio**2)))
        above = objectives[:, 1:] / objectives[:, :1] - 1
        worse = int(np.sum(np.min(above, axis=1) < -1e-10))
        figures[n] = {"overall": overall, "worst": float(np.max(np.abs(ratio - 1))), "worse": worse}
        print(f"N = {n}, {options.runs} runs: RMSE over the bound {overall:.3f} over all parameters "
              f"(root mean square of the ratios), each {ratio.min():.3f} .. {ratio.max():.3f}")
        print("  " + ", ".join(f"{name} {r:.3f}" for name, r in zip(NAMES, ratio)))
        print(f"  plain SVD split: objective {100 * np.mean(above[:, 0]):.2f} % above the fit on average "
              f"({100 * np.mean(above[:, 1]):.2f} % with A and offset re-estimated), below it in {worse} runs")
    data = record(TRUTHS["non-odd"], 1000, 0, sigma=0.0)
    for formulation in ("hammerstein_arx.exact", "hammerstein_arx.overparametrised"):
        b = optid.fit(data, formulation, **STRUCTURE).model.b[0]
        figures[formulation] = abs(b[1] / b[0] - 0.75)
        print(f"non-odd f, noise free, {formulation}: b1/b0 = {b[1] / b[0]:.12f}, error {figures[formulation]:.1e}")
    return figures


if __name__ == "__main__":
    main()

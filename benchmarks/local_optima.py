"""How often does a fit stop above the global optimum where that is hard to find?

    python benchmarks/local_optima.py [--problems 200] [--only collinear|signed]

* collinear: two inputs of which one is the other plus a little noise (1e-1 to 1e-4 of it): large mu of either sign
  nearly cancel, and descents creep along the valley. The best of the fit, of 24 starts and of IPOPT counts as optimum.
* signed: `sign` and `monotone` together on short, noisy records, where mu = 0 is stationary for most directions b. The
  optimum comes from a search over the angle of b with the convex problem that is left at each angle.
"""

import argparse
import warnings

import numpy as np
from montecarlo import mapped

import optid
from formulations.constraints import shape
from optid.core.statement import statement_of
from optid.structures.bilinear import best_of


def collinear(seed: int, count: int = 300) -> optid.Data:
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, (count, 1)), np.zeros(count)
    near = 10.0 ** -np.random.default_rng(seed + 999).uniform(1, 4)
    u = np.hstack([u, u + near * rng.standard_normal((count, 1))])
    f = np.column_stack([np.tanh(2 * u[:, 0]), 0.5 * u[:, 1] ** 2 + 0.3 * u[:, 1]])
    e, b = 0.3 * rng.standard_normal(count), rng.standard_normal((3, 2))
    for k in range(2, count):
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + np.sum(b * f[[k, k - 1, k - 2]]) + e[k]
    return optid.Data(u=u, y=y)


def signed(seed: int, count: int = 60) -> optid.Data:
    rng, gain = np.random.default_rng(seed), 1.0 if seed % 2 == 0 else -1.0
    u, e, y = rng.uniform(-1, 1, count), rng.standard_normal(count), np.zeros(count)
    for k in range(2, count):
        f = gain * np.tanh(2 * u[[k, k - 1]])
        y[k] = 1.2 * y[k - 1] - 0.5 * y[k - 2] + f[0] + 0.6 * f[1] + 0.3 + e[k]
    return optid.Data(u=u, y=y)


def excess_of_collinear(seed: int) -> tuple[float, str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data, orders = collinear(seed), {"na": 2, "nb": 3, "basis": optid.Triangular(5)}
        fit = optid.fit(data, **orders)
        other = optid.fit(data, prove=False, solver="ipopt", raises=False, **orders)
    core = fit.problem.compressed.problem.core
    tries = [fit.problem.unit * best_of(core, 24, seed=7, iterations=2000).value, other.solution.objective]
    best = min([fit.solution.objective, *(value for value in tries if np.isfinite(value))])
    return fit.solution.objective / best - 1, str(fit.solution.status)


def excess_of_signed(seed: int) -> tuple[float, str]:
    import cvxpy as cp

    rules = [shape.monotone(("increasing", "decreasing")[seed // 2 % 2]), shape.sign("b")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fit = optid.fit(signed(seed), na=2, nb=2, basis=optid.Triangular(6, interval=(-1.0, 1.0)), constraints=rules)
        b = cp.Parameter(2, value=np.array([1.0, 0.0]))  # what is left of the problem for a given b is convex
        stated = statement_of(fit.problem)
        swap = {id(stated.variables["b"]): b}
        left = [member.tree_copy(swap) for name, group in stated.constraints.items() if name != "gauge"
                for member in group]
        half = cp.Problem(stated.objective.tree_copy(swap), left)
        values = []
        for angle in np.linspace(0, 2 * np.pi, 145)[:-1]:
            b.value = np.array([np.cos(angle), np.sin(angle)])
            try:
                half.solve(solver=cp.CLARABEL)
            except cp.SolverError:
                continue
            if half.status == cp.OPTIMAL:
                values.append(fit.problem.unit * float(half.value))
    return fit.solution.objective / min(values) - 1, str(fit.solution.status)


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=200)
    parser.add_argument("--only", choices=["collinear", "signed"])
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(argv)
    for name, run in (("collinear", excess_of_collinear), ("signed", excess_of_signed)):
        if options.only in (None, name):
            found = mapped(run, range(options.problems), options.workers)
            above = [(excess, seed) for seed, (excess, _) in enumerate(found) if excess > 1e-6]
            words = {word: sum(status == word for _, status in found) for word in sorted({s for _, s in found})}
            print(f"{name}: {len(above)} of {len(found)} above the optimum by more than 1e-6"
                  + (f", at most {100 * max(above)[0]:.2g} % (seed {max(above)[1]})" if above else "")
                  + "; " + ", ".join(f"{count} {word}" for word, count in words.items()), flush=True)


if __name__ == "__main__":
    main()

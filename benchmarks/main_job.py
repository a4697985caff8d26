"""Speed of a Hammerstein-ARX fit with proof against the naive routes, in one process and one run.

    python benchmarks/main_job.py [--samples 100000] [--nuclear 20000] [--skip-raw]

1. ``hammerstein_arx.exact`` with its proof (na 2, nb 10, 20 cells), warm, against the same programme written directly
   in CasADi on the raw samples and solved by IPOPT from the same start.
2. ``hammerstein_arx.nuclear`` against the raw-sample CVXPY problem.
3. What ``fit`` adds to the solver on a small problem, and the time of ``import optid``.
"""

import argparse
import subprocess
import sys
import time

import cvxpy as cp
import numpy as np
from scipy.signal import lfilter

import optid


def record(n: int, nb: int, seed: int = 0) -> optid.Data:
    """A dead-zone plant with a long numerator, 10 % noise."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, n)
    f = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0)
    a = [1, -1.5, 0.7]
    clean = lfilter(0.8 ** np.arange(nb), a, f)
    noise = lfilter([1], a, rng.standard_normal(n))
    return optid.Data(u=u, y=clean + 0.1 * np.std(clean) / np.std(noise) * noise)


def regressor(data: optid.Data, na: int, nb: int, basis) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The dense regressor of the naive route: (-y lags, 1), expanded inputs lag by lag, and y."""
    u, y = data.u[:, 0], data.y[:, 0]
    first, n = max(na, nb - 1), len(y)
    past = np.column_stack([-y[first - i : n - i] for i in range(1, na + 1)] + [np.ones(n - first)])
    eta = basis.with_interval(float(u.min()), float(u.max())).values(u)
    return past, np.hstack([eta[first - j : n - j] for j in range(nb)]), y[first:]


def best(function, repeats: int) -> tuple[float, object]:
    """Median wall time of several calls and the last result."""
    times, result = [], None
    for _ in range(repeats):
        started = time.perf_counter()
        result = function()
        times.append(time.perf_counter() - started)
    return float(np.median(times)), result


def casadi_raw(data: optid.Data, na: int, nb: int, basis, start) -> tuple[float, float]:
    """The bilinear programme written directly in CasADi on the raw samples; returns seconds and objective."""
    import casadi as ca

    past, eta, y = regressor(data, na, nb, basis)
    started = time.perf_counter()
    w, b, mu = ca.MX.sym("w", na + 1), ca.MX.sym("b", nb), ca.MX.sym("mu", eta.shape[1] // nb)
    theta = ca.reshape(ca.mtimes(mu, b.T), -1, 1)
    r = ca.DM(y) - ca.mtimes(ca.DM(past), w) - ca.mtimes(ca.DM(eta), theta)
    nlp = {"x": ca.vertcat(w, b, mu), "f": ca.sumsqr(r), "g": ca.sumsqr(b)}
    solver = ca.nlpsol("raw", "ipopt", nlp, {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes",
                                             "ipopt.tol": 1e-10})
    found = solver(x0=np.concatenate([start["a"], start["offset"], start["b"], start["mu"]]), lbg=1, ubg=1)
    return time.perf_counter() - started, float(found["f"])


def nuclear_raw(data: optid.Data, na: int, nb: int, basis, weight: float):
    """The nuclear-norm problem written directly in CVXPY on the raw samples."""
    past, eta, y = regressor(data, na, nb, basis)
    started = time.perf_counter()
    w, theta = cp.Variable(na + 1), cp.Variable((eta.shape[1] // nb, nb))
    r = y - past @ w - eta @ cp.vec(theta, order="F")
    # one accuracy for both routes; at 1e-8 the raw route's Theta is good to three digits only
    problem = cp.Problem(cp.Minimize(cp.sum_squares(r) + 2 * weight * cp.normNuc(theta)))
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    return time.perf_counter() - started, theta.value


def main(argv=None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--nuclear", type=int, default=20_000)
    parser.add_argument("--skip-raw", action="store_true", help="leave out the raw CasADi programme (minutes)")
    options = parser.parse_args(argv)
    structure = {"na": 2, "nb": 10, "basis": optid.Triangular(20)}
    figures = {}

    data = record(options.samples, 10)
    optid.fit(data, **structure)
    seconds, fit = best(lambda: optid.fit(data, **structure), 9)
    t = fit.solution.times
    print(f"exact, N = {options.samples}, na 2, nb 10, 20 cells: {1e3 * seconds:.1f} ms in all, "
          f"status {fit.solution.status}, proof {fit.solution.proof} ({fit.solution.bound.method})")
    print(f"  build {1e3 * t.build:.1f}, solve {1e3 * t.solve:.1f}, judge {1e3 * t.judge:.1f}, "
          f"prove {1e3 * t.prove:.1f} ms")
    figures["exact_ms"] = 1e3 * seconds
    if not options.skip_raw:
        raw, objective = casadi_raw(data, 2, 10, structure["basis"], fit.problem.start)
        same = abs(objective - fit.solution.objective) / objective
        print(f"  raw samples in CasADi + IPOPT: {raw:.1f} s, {raw / seconds:.0f} times as long; "
              f"objectives agree to {same:.0e} (relative)")
        figures.update(exact_ratio=raw / seconds, exact_agreement=same)

    data = record(options.nuclear, 10)
    weight = 1e-4 * fit.solution.scale * options.nuclear / options.samples
    arguments = {**structure, "accuracy": 1e-10, "weight": weight}
    optid.fit(data, "hammerstein_arx.nuclear", **arguments)
    seconds, fit = best(lambda: optid.fit(data, "hammerstein_arx.nuclear", **arguments), 3)
    raw, theta = nuclear_raw(data, 2, 10, structure["basis"], weight)
    difference = float(np.linalg.norm(theta - fit.values["Theta"]) / np.linalg.norm(theta))
    print(f"nuclear, N = {options.nuclear}: {1e3 * seconds:.0f} ms; raw samples in CVXPY {raw:.1f} s, "
          f"{raw / seconds:.0f} times as long; Theta agrees to {difference:.0e} (relative)")
    figures.update(nuclear_ratio=raw / seconds, nuclear_agreement=difference)

    data = record(1000, 2)
    small = {"na": 2, "nb": 2, "basis": optid.Triangular(10)}
    optid.fit(data, **small)
    seconds, fit = best(lambda: optid.fit(data, **small), 21)
    extra = seconds - fit.solution.times.solve
    print(f"small problem (N = 1000, na 2, nb 2, 10 cells): {1e3 * seconds:.1f} ms in all, "
          f"{1e3 * extra:.1f} ms beyond the solver, proof included")
    code = "import time; t = time.perf_counter(); import optid; print(time.perf_counter() - t)"
    command = [sys.executable, "-c", code]
    imports = float(np.median([float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
                               for _ in range(5)]))
    print(f"import optid: {imports:.3f} s")
    figures.update(overhead_ms=1e3 * extra, import_s=imports)
    return figures


if __name__ == "__main__":
    main()

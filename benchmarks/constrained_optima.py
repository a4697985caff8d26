"""Does a search of another kind improve what constrained fits call locally optimal?

    python benchmarks/constrained_optima.py [--records 8] [--workers 2] [--only ss.exact]

Records of 200 samples of plants of second order, most of which contradict the constraints. From the model of every fit
IPOPT minimises the squares of its free run over all coefficients together, with exact sensitivities of CasADi. Poles
are held by the polynomial inequalities in the trace and the determinant that say the same of two of them, which may
move by up to 0.02; words about f are those of its values at the nodes. Printed: how many points improve by more than
1e-5.
"""

import argparse
import warnings
from typing import Any

import casadi
import numpy as np
from montecarlo import mapped
from scipy.signal import lfilter

import optid

REGIONS = ("stable:0.7", "disc:0.5,0.2", "strip:0.2,0.6", "sector:0.2")
WORDS = ("monotone:increasing", "monotone:decreasing", "convex", "concave", "odd")
# formulation, its arguments, sets of constraints
FITS: dict[str, tuple[dict[str, Any], list[list[str]]]] = {
    "ss.exact": ({"nx": 2}, [[region] for region in REGIONS]),
    "oe.exact": ({"na": 2, "nb": 2, "nk": 0}, [[region] for region in REGIONS[:2]]),
    "hammerstein_ss.exact": ({"nx": 2, "basis": optid.Triangular(6, interval=(-1.0, 1.0))}, [
        *([word] for word in WORDS), *([region] for region in REGIONS), ["stable:0.7", "monotone:increasing"],
        ["disc:0.5,0.2", "odd"]]),
    "lfr.exact": ({"nx": 2, "tries": 1}, [["stable:0.7"]]),
}
MOVE = 0.02  # of the poles
MARGIN = 1e-6  # by which regions are held inside


def record(seed: int, name: str) -> optid.Data:
    """A plant of second order; the kind of its function and of its noise changes with the seed."""
    rng = np.random.default_rng([seed, 7])
    u = lfilter([1], [1, -rng.choice([0.0, 0.8])], rng.uniform(-1, 1, 250))
    u /= np.abs(u).max()
    turn = rng.uniform(0.6, 0.95) * np.exp(1j * rng.uniform(0, 0.6))
    poles = rng.uniform(0.4, 0.95, 2) if seed % 2 else [turn, turn.conjugate()]
    functions = [lambda v: v] if name in ("ss.exact", "oe.exact") else [np.tanh, lambda v: v**3, np.abs]
    y = lfilter(rng.standard_normal(2), np.real(np.poly(poles)), functions[seed % len(functions)](2 * u))
    if name == "lfr.exact":
        y = y / y.std() + 0.2 * np.tanh(y / y.std())
    return optid.Data(u[50:], (y / y.std() + 10 ** rng.uniform(-2, 0) * rng.standard_normal(250))[50:])


def region_rows(word: str, trace: Any, determinant: Any) -> list[Any]:
    """Expressions that are not negative where both poles lie in a region."""
    kind, _, figures = word.partition(":")
    first, second = (*map(float, figures.split(",")), np.nan)[:2]
    if kind == "stable":
        first *= 1 - MARGIN
        return [first**2 - determinant, first**2 + determinant - first * trace, first**2 + determinant + first * trace]
    if kind == "disc":
        second *= 1 - MARGIN
        moved, product = trace - 2 * first, determinant - first * trace + first**2
        return [second**2 - product, second**2 + product - second * moved, second**2 + product + second * moved]
    if kind == "strip":
        first, second = first + MARGIN, second - MARGIN
        return [trace - 2 * first, 2 * second - trace, first**2 - first * trace + determinant,
                second**2 - second * trace + determinant]
    tip = MARGIN / np.sin(first)  # a sector about the real axis, with its tip moved inside
    trace, determinant = trace - 2 * tip, determinant - tip * trace + tip**2
    return [trace, determinant, (1 + np.tan(first) ** 2) * trace**2 / 4 - determinant]


class Coefficients:
    """Coefficients of a model as one vector of CasADi, and where they begin."""

    def __init__(self) -> None:
        self.symbols: list[Any] = []
        self.start: list[float] = []

    def add(self, value: Any) -> Any:
        """Return the symbol of a coefficient, a column of them or a matrix."""
        value = np.asarray(value, dtype=float)
        value = value[:, None] if value.ndim == 1 else np.atleast_2d(value)
        self.symbols.append(casadi.SX.sym(f"p{len(self.symbols)}", *value.shape))
        self.start += list(value.ravel(order="F"))
        return self.symbols[-1]

    @property
    def vector(self) -> Any:
        """All of them in order."""
        return casadi.vertcat(*(casadi.vec(symbol) for symbol in self.symbols))


def transfer_run(model: Any, p: Coefficients, driven: Any, count: int) -> tuple[list[Any], Any, Any, Any]:
    """Return the run, the initial state, (trace, determinant) of the poles, and the static gain."""
    state, a, b, level = p.add(np.zeros(2)), p.add(model.a), p.add(model.b[0]), p.add(
        model.offset / (1 + model.a.sum()))
    ys = [state[0], state[1]]
    for k in range(count):
        ys.append(sum(b[i] * driven[k - i] for i in range(b.numel()) if k >= i) - a[0] * ys[-1] - a[1] * ys[-2])
    return [y + level for y in ys[2:]], state, (-a[0], a[1]), casadi.sum1(b)


def state_run(model: Any, p: Coefficients, driven: Any, u: Any, state: Any) -> tuple[list[Any], Any, Any, Any]:
    """As `transfer_run`, of a state-space model with functions of latent signals."""
    x = state = p.add(state)
    A, B, C, level = (p.add(part) for part in (model.A, model.B, model.C, model.offset_y))
    D = p.add(model.D) if np.any(model.D) else 0.0
    latent = [tuple(p.add(part) for part in (model.Ez[:, i], model.Cz[i], model.Dz[i], model.offset_z[i], h.mu[1:]))
              for i, h in enumerate(model.latent)]
    run = []
    for k in range(len(u)):
        run.append(C @ x + D * driven[k] + level)
        more = 0
        for e, c, d, constant, mu in latent:
            z = c.T @ x + d * u[k] + constant
            more = more + e * (mu[0] * (3 * z**2 - 1) / 2 + mu[1] * (5 * z**3 - 3 * z) / 2)  # Legendre's, none affine
        x = A @ x + B * driven[k] + casadi.DM(model.offset_x) + more
    gain = C @ casadi.solve(casadi.SX.eye(2) - A, B) + D
    return run, state, (casadi.trace(A), A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]), gain


def word_rows(word: str, basis: Any, mu: Any, gain: Any) -> tuple[list[Any], list[Any]]:
    """What a word says of the values of f at the nodes: expressions that are not negative, and that are zero."""
    values = casadi.DM(basis.values(basis.nodes)) @ mu
    if word == "odd":  # the nodes lie symmetrically
        half = len(basis.nodes) // 2
        return [], [values[:half] + values[::-1][:half] - 2 * values[half]]
    rises, bends = values[1:] - values[:-1], values[2:] - 2 * values[1:-1] + values[:-2]
    return [{"monotone:increasing": rises, "monotone:decreasing": -rises, "convex": bends, "concave": -bends}[word],
            gain], []


def improvement(job: tuple[str, list[str], int]) -> tuple[str, float, float, bool]:
    """Return the status of a fit, by what share its point improves, how far its squares are from ours, and IPOPT's end.

    The last is whether IPOPT says that it arrived: where it did not, a point that does not improve says less.
    """
    name, words, seed = job
    data = record(seed, name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            fit = optid.fit(data, name, constraints=words, raises=False, **FITS[name][0])
        except optid.errors.OptidError as error:
            return type(error).__name__, 0.0, 0.0, True
    status = str(fit.solution.status)
    if status != "locally optimal":
        return status, 0.0, 0.0, True
    model, p, (u, y) = fit.model, Coefficients(), (data.u[:, 0], data.y[:, 0])
    f, latent = model.nonlinearities[0], bool(getattr(model, "latent", ()))
    free = f.mu.size > 1
    mu = p.add(f.mu) if free else casadi.SX(f.mu)
    driven = casadi.DM(f.basis.values(u) if free else u[:, None]) @ mu
    run, state, poles, gain = (transfer_run(model, p, driven, len(u)) if hasattr(model, "a")
                               else state_run(model, p, driven, u, fit.values["x0"]))
    errors = casadi.vertcat(*run) - casadi.DM(y)
    at, total = p.vector, casadi.sumsqr(errors)
    told = casadi.Function("told", [at], [errors, casadi.jacobian(errors, state)])
    start, first = np.array(p.start), int(mu.numel()) if free else 0
    for _ in range(0 if latent else 1):  # the initial state that fits best
        now, slopes = (np.asarray(part) for part in told(start))
        start[first : first + 2] -= np.linalg.lstsq(slopes, now[:, 0])[0]
    value = float(np.sum(np.asarray(told(start)[0]) ** 2))
    above: list[Any] = []
    zero: list[Any] = []
    for word in words:
        rows, equations = (word_rows(word, f.basis, mu, gain) if word in WORDS else (region_rows(word, *poles), []))
        above, zero = above + rows, zero + equations
    limits = casadi.densify(casadi.vertcat(*poles, *above, *zero))
    held, count = casadi.Function("held", [at], [limits]), casadi.vertcat(*above).numel()
    here, rest = np.asarray(held(start)).ravel(), np.zeros(limits.numel() - 2 - count)
    apart = float(np.abs(np.diff(np.roots([1, -here[0], here[1]])))[0])
    room = 0.5 * MOVE * np.clip(apart, MOVE, 1.0)  # of both coefficients, for moves of the poles by about `MOVE`
    low = np.r_[here[:2] - room, np.minimum(here[2 : 2 + count], 0.0), rest]
    high = np.r_[here[:2] + room, np.full(count, np.inf), rest]
    options = {"print_time": False, "ipopt": {
        "print_level": 0, "sb": "yes", "max_iter": 300, "tol": 1e-10, "mu_init": 1e-6, "bound_push": 1e-8,
        "bound_frac": 1e-8, "constr_viol_tol": 1e-9}}
    search = casadi.nlpsol("search", "ipopt", {"x": at, "f": total / value, "g": limits}, options)
    found = search(x0=start, lbg=low, ubg=high)
    there = np.asarray(held(found["x"])).ravel()
    outside = np.max(np.r_[low - there, there - high], initial=0.0)
    inside = outside <= 1e-8 * max(1.0, float(np.max(np.abs(here[2:]), initial=0.0)))
    gained = 1 - float(found["f"]) if inside and np.isfinite(float(found["f"])) else 0.0
    theirs = float(np.sum((np.ravel(model.simulate(data, x0=fit.values["x0"] if latent else "fit")) - y) ** 2))
    return status, gained, abs(value / theirs - 1), bool(search.stats()["success"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=8)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", nargs="+", default=list(FITS))
    options = parser.parse_args()
    for name in options.only:
        jobs = [(name, words, seed) for words in FITS[name][1] for seed in range(options.records)]
        found = mapped(improvement, jobs, options.workers)
        local = [(gained, job) for (status, gained, *_), job in zip(found, jobs) if status == "locally optimal"]
        better = [(gained, job) for gained, job in local if gained > 1e-5]
        apart = max(difference for _, _, difference, _ in found)
        lost = sum(not arrived for *_, arrived in found)
        print(f"{name}: {len(better)} of {len(local)} improve by more than 1e-5, most {max(local)[0]:.1e} "
              f"({' '.join(max(local)[1][1])}, seed {max(local)[1][2]}); {len(jobs) - len(local)} of {len(jobs)} are "
              f"not called locally optimal; our squares and theirs differ by at most {apart:.0e}; "
              f"{lost} searches of IPOPT did not arrive", flush=True)
        for gained, (_, words, seed) in sorted(better, reverse=True)[:5]:
            print(f"   {gained:.1e}  {' '.join(words)}, seed {seed}")


if __name__ == "__main__":
    main()

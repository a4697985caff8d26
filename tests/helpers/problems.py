"""Records, raw-sample routes and searches that the tests of the formulations share."""

import warnings
from dataclasses import replace

import cvxpy as cp
import numpy as np
from scipy.optimize import minimize_scalar
from systems import by_hand

import optid
from optid.bases import Triangular
from optid.core.statement import statement_of
from optid.models import HammersteinTF, Nonlinearity

BASIS = Triangular(6).with_interval(-1.0, 1.0)
NODES = np.linspace(-1, 1, 7)


def plant(gain=1.0, a=(-1.2, 0.5), b=(1.0, 0.6), f=lambda u: np.tanh(2 * u), offset=0.3):
    """A SISO plant whose nonlinearity is in the basis (up to a constant)."""
    values = f(NODES) - f(0.0)
    return HammersteinTF(list(a), (gain * np.array(b),), (Nonlinearity(BASIS, np.delete(values, 3)),), (0,), offset)


def record(gain=1.0, count=150, noise=0.4, seed=0, model=None):
    model = plant(gain) if model is None else model
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (count, model.m))
    return optid.Data(u=u, y=by_hand(model, u, noise=noise * rng.standard_normal((count, model.l))))


def dense(data, na, nb, nk, bases):
    """Form regressor and outputs sample by sample; rows with anything missing are left out."""
    rows, targets = [], []
    for e in data.experiments:
        etas = [basis.values(np.nan_to_num(e.u[:, c])) for c, basis in enumerate(bases)]
        etas = [np.where(np.isnan(e.u[:, c])[:, None], np.nan, eta) for c, eta in enumerate(etas)]
        for k in range(max([na, *(d + q - 1 for d, q in zip(nk, nb))]), len(e.u)):
            row = [-e.y[k - i] for i in range(1, na + 1)]
            row += [eta[k - d - j] for eta, d, q in zip(etas, nk, nb) for j in range(q)]
            row = np.concatenate([*row, [1.0]])
            if not (np.isnan(row).any() or np.isnan(e.y[k]).any()):
                rows.append(row)
                targets.append(e.y[k])
    return np.array(rows), np.array(targets)


def raw_problem(phi, y, na, shapes, loss, weight=0.0, constrain=lambda a, thetas, d: []):
    """Solve a one-output problem in (a, Theta, d) on the raw samples; return its value and the Thetas."""
    a, d = cp.Variable(na), cp.Variable()
    thetas = [cp.Variable(shape) for shape in shapes]
    z = cp.hstack([a, *(cp.vec(t, order="F") for t in thetas), d])
    penalty = 2 * weight * sum(cp.normNuc(t) for t in thetas) if weight else 0.0
    problem = cp.Problem(cp.Minimize(loss(y[:, 0] - phi @ z) + penalty), constrain(a, thetas, d))
    problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-8, tol_gap_rel=1e-8, tol_feas=1e-8)
    return float(problem.value), [t.value for t in thetas]


def with_b_given(program):
    """Return the CVXPY problem that is left of a bilinear programme for a given b, and the parameter for b."""
    b = cp.Parameter(2, value=np.array([1.0, 0.0]))
    swap = {id(statement_of(program).variables["b"]): b}
    left = [member.tree_copy(swap) for name, group in statement_of(program).constraints.items() if name != "gauge"
            for member in group]
    return cp.Problem(statement_of(program).objective.tree_copy(swap), left), b  # those of b alone hold or not


def search(program, points=72):
    """Global minimum of a programme with one input and n_b = 2: for a fixed direction b a convex problem is left."""
    problem, b = with_b_given(program)

    def value(angle):
        b.value = np.array([np.cos(angle), np.sin(angle)])
        with warnings.catch_warnings():  # on a direction that a constraint all but forbids the solver may give up
            warnings.simplefilter("ignore")
            try:
                problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-8, tol_gap_rel=1e-8, tol_feas=1e-8)
            except cp.SolverError:
                return 1e300
        return float(problem.value) if problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) else 1e300

    angles = np.linspace(0, 2 * np.pi, points, endpoint=False)
    values = np.array([value(angle) for angle in angles])
    step, best = angles[1], float(np.min(values))
    for i in np.argsort(values)[:2]:
        if values[i] < 1e300:
            found = minimize_scalar(value, bounds=(angles[i] - step, angles[i] + step), method="bounded",
                                    options={"xatol": 1e-6})
            best = min(best, float(found.fun))
    return program.unit * best


def regression(fit, solution=None):
    """Coefficients (columns, l) of the dense regressor in the units of the record, of a fit or of one of its steps."""
    fit = fit if solution is None else replace(fit, outcome=replace(fit.outcome, solution=solution))
    values, ny, layout = fit.values, fit.data.l, fit.problem.compressed.layout
    a = values.get("a", np.zeros(0))
    rows = [np.reshape(a, (ny, -1), order="F" if ny > 1 else "C").T if a.size else np.zeros((0, ny))]
    for name in layout.inputs:
        key = "" if layout.m == 1 else f"[{name}]"
        theta = values[f"Theta{key}"] if f"Theta{key}" in values else values[f"b{key}"]
        rows.append(np.reshape(theta, (-1, ny), order="F"))
    return np.vstack([*rows, values["offset"][None]])

"""Every installed back end over the zoo of its classes, and the translator against CVXPY's own values."""

import subprocess
import sys
from types import SimpleNamespace

import cvxpy as cp
import numpy as np
import pytest
import scipy.sparse as sp
from cvxpy.atoms.elementwise.hyperbolic import asinh, sinh, tanh
from cvxpy.atoms.elementwise.trig import cos, sin, tan
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from scipy.optimize import minimize_scalar, nnls
from zoo import CASES, case, pose

from optid.backends import BackEnd, Settings, back_ends
from optid.backends import casadi as casadi_backend
from optid.backends.catalogue import CONIC
from optid.backends.conic import tolerances
from optid.backends.dnlp import smooth
from optid.conformance.checks import SUCCESS, ConformanceError, check_back_end, run_case, value_error
from optid.conformance.zoo import planted_fit
from optid.core.judge import judge
from optid.core.statement import class_of, for_solvers
from optid.errors import StructureError
from optid.program.solution import Status
from optid.solving.solve import solve

INSTALLED = sorted(name for name, back_end in back_ends().items() if back_end.installed)


def test_the_catalogue_agrees_with_cvxpy():
    from cvxpy.reductions.solvers.defines import SOLVER_MAP_CONIC, SOLVER_MAP_QP

    offered: dict[str, set[str]] = {}
    for name, interface in SOLVER_MAP_CONIC.items():
        cones = {c.__name__ for c in interface.SUPPORTED_CONSTRAINTS}
        offered[name.lower()] = {"LP"} | ({"QP", "SOCP"} if cones & {"SOC", "PSD", "SvecPSD"} else set()) | (
            {"SDP"} if cones & {"PSD", "SvecPSD"} else set()) | ({"conic"} if "ExpCone" in cones else set())
    for name in SOLVER_MAP_QP:
        offered[name.lower()] = offered.get(name.lower(), set()) | {"LP", "QP"}
    left_out = {"glpk_mi": {"LP"}, "diffcp": offered["diffcp"]}
    unfit = {"proxqp": {"LP"}, "scip": {"SOCP"}}
    assert {name: set(classes.split()) | unfit.get(name, set()) for name, (classes, _, _) in CONIC.items()} | left_out \
        == offered
    assert {name.upper() for name, end in back_ends().items() if name in CONIC and end.installed} \
        == set(cp.installed_solvers()) - {"GLPK_MI", "DIFFCP"} - {"IPOPT", "UNO", "COPT", "KNITRO"}


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", INSTALLED)
def test_back_end_is_conformant(name):
    rows = check_back_end(back_ends()[name])
    assert any(row.solution.status in SUCCESS for row in rows)
    for row in rows:
        if row.solution.status in SUCCESS:
            assert value_error(row.case, row.solution) <= 1e-6


def test_every_class_has_a_solver_that_solves_all_of_it():
    for kind, name in {"LP": "clarabel", "QP": "clarabel", "SOCP": "clarabel", "SDP": "clarabel", "conic": "clarabel",
                       "NLP": "ipopt"}.items():
        programmes = {c.name: for_solvers(c.build()) for c in CASES.values() if c.outcome == "solved"}
        rows = [run_case(back_ends()[name], CASES[key]) for key, one in programmes.items()
                if class_of(one) == kind and not back_ends()[name].refuses(one)]
        assert rows and all(row.solution.status in SUCCESS and not row.complaints for row in rows), kind


def test_known_multipliers_satisfy_the_optimality_conditions():
    # the zoo is checked without any solver: points and multipliers known in closed form must be stationary
    checked = 0
    for entry in CASES.values():
        problem = entry.build()
        names = {one.name for one in problem.constraints()}
        if entry.outcome != "solved" or set(entry.point) < set(problem.start) or set(entry.duals) < names or (
                not problem.is_measured):
            continue
        duals = {k: np.ravel(np.asarray(v, dtype=float)) for k, v in entry.duals.items()}
        found = judge(problem, {k: np.asarray(v, dtype=float) for k, v in entry.point.items()}, duals)
        residuals = found.residuals
        assert found.objective == pytest.approx(entry.value, rel=1e-12, abs=1e-12), entry.name
        assert max(residuals.violation, residuals.stationarity, residuals.complementarity) < 1e-12, entry.name
        checked += 1
    assert checked >= 12


def test_conformance_names_what_is_wrong():
    right = back_ends()["clarabel"]

    def run(program, settings):
        answer = right.run(program, settings)
        return type(answer)(answer.status, answer.word, {k: v + 1e-2 for k, v in answer.values.items()}, answer.duals)

    with pytest.raises(ConformanceError, match="qp_equality"):
        check_back_end(BackEnd("shifted", frozenset({"QP"}), run), [case("qp_equality"), case("qp_box")])


@pytest.mark.parametrize("name", ["ipopt", "fatrop", "uno"])
def test_multipliers_are_the_prices_of_the_right_hand_side(name):
    # L = f + dual (lhs - rhs): the value falls by dual per unit that the right-hand side is raised
    def value(radius: float, level: float):
        x = cp.Variable(2, name="x")
        program = pose("priced", x[0] * x[1] + x[0], {
            "level": x[1] - cp.square(x[0]) == level, "radius": cp.sum_squares(x) <= radius,
            "floor": -2.5 <= x[0]}, [x], start={"x": np.array([-1.0, 1.0])})
        return solve(program, name)

    base, step = value(4.0, 0.3), 1e-5
    assert base.status is Status.LOCAL
    radius = (value(4.0 + step, 0.3).objective - value(4.0 - step, 0.3).objective) / (2 * step)
    level = (value(4.0, 0.3 + step).objective - value(4.0, 0.3 - step).objective) / (2 * step)
    assert base.duals["radius"] == pytest.approx(-radius, abs=1e-5)
    assert base.duals["level"] == pytest.approx(-level, abs=1e-5)
    assert abs(radius) > 0.1 and abs(level) > 0.1
    assert base.duals["floor"] == pytest.approx(0.0, abs=1e-6)


def translated(expression: cp.Expression):
    """Value of an expression by CasADi at the values its variables hold."""
    import casadi as ca

    weights = np.cos(np.arange(expression.size)).reshape(expression.shape, order="F")
    problem = cp.Problem(cp.Minimize(cp.sum(cp.multiply(weights, expression))))
    form = smooth(problem)
    parts = casadi_backend.translate(form)
    value, rows = ca.Function("f", [parts["x"]], [parts["f"], parts["g"]])(form.start())
    known = float(np.ravel(weights, order="F") @ np.ravel(expression.value, order="F"))
    return float(value), known, np.asarray(rows).ravel()


rng = np.random.default_rng(0)
X, Y = cp.Variable((3, 4), name="X"), cp.Variable((4, 2), name="Y")
v, w, s = cp.Variable(4, name="v"), cp.Variable(3, name="w"), cp.Variable(name="s")
X.value, Y.value = rng.uniform(0.5, 1.5, (3, 4)), rng.uniform(0.5, 1.5, (4, 2))
v.value, w.value, s.value = rng.uniform(0.5, 1.5, 4), rng.uniform(0.5, 1.5, 3), 0.7
P = cp.Parameter((3, 3), value=rng.standard_normal((3, 3)), name="P")
N = cp.Parameter(4, nonneg=True, value=rng.uniform(0.5, 1.5, 4), name="N")
Q = rng.standard_normal((4, 4))
ATOMS = {
    "add": X + X[0:1, :] + 1, "neg": -X, "scalar times": s * X, "elementwise": cp.multiply(X, 2 * X),
    "broadcast": cp.multiply(X, cp.reshape(v, (1, 4), order="F")),
    "matmul": X @ Y, "matrix vector": X @ v, "vector matrix": w @ X, "inner": v @ v, "constant left": Q @ v,
    "constant right": v @ Q, "sparse": sp.csc_array(np.diag([1.0, 0, 2, 3])) @ v,
    "parameter": P @ X, "entropy to parameters": cp.rel_entr(v, N), "over a parameter": cp.quad_over_lin(v, N[0]),
    "outer": cp.outer(w, v), "divided by a constant": X / -2.0, "divided": v / (1 + s),
    "power 2": X**2, "power 3": v**3, "power -1": v**-1, "square root": cp.sqrt(v), "sum squares": cp.sum_squares(X),
    "sum squares of columns": cp.sum_squares(X, axis=0), "quad over lin": cp.quad_over_lin(v, 2.0),
    "quad form": cp.quad_form(v, Q @ Q.T), "sum": cp.sum(X), "sum of rows": cp.sum(X, axis=1),
    "sum of columns kept": cp.sum(X, axis=0, keepdims=True), "reshape F": cp.reshape(X, (2, 6), order="F"),
    "reshape C": cp.reshape(X, (2, 6), order="C"), "vec C": cp.vec(X, order="C"), "vec F": cp.vec(X, order="F"),
    "hstack": cp.hstack([X, X @ Y, w[:, None]]), "vstack": cp.vstack([v, X]), "stack 1-D": cp.hstack([v, w, s]),
    "concatenate": cp.concatenate([X, X], axis=1), "slice": X[1:, ::-1], "item": X[2, 1], "list index": v[[3, 0, 0]],
    "mask": v[np.array([True, False, True, True])], "new axis": v[None, :],
    "transpose": X.T, "trace": cp.trace(X[:, :3] + 1),
    "diag of vector": cp.diag(v), "diag of matrix": cp.diag(X @ X.T), "upper triangle": cp.upper_tri(X @ X.T),
    "kron left": cp.kron(np.arange(4.0).reshape(2, 2), X), "kron right": cp.kron(X, np.arange(4.0).reshape(2, 2)),
    "cumsum": cp.cumsum(v), "cumsum rows": cp.cumsum(X, axis=1), "diff": cp.diff(v, 2),
    "block": cp.bmat([[X, X], [X, X]]),
    "convolution": cp.convolve(np.array([1.0, -2.0]), v), "exp": cp.exp(X), "log": cp.log(X), "log1p": cp.log1p(X),
    "sin": sin(v), "cos": cos(v), "tan": tan(0.5 * v), "tanh": tanh(v), "sinh": sinh(v), "asinh": asinh(v),
    "logistic": cp.logistic(v), "entr": cp.entr(v), "rel entr": cp.rel_entr(v, v[::-1]),
    "kl div": cp.kl_div(v, v[::-1]),
    "product": cp.prod(v), "norm": cp.norm(v), "norm1": cp.norm1(v), "abs": cp.abs(v - 1), "max": cp.max(v),
    "pos": cp.pos(v - 1), "huber": cp.huber(v, 0.8),
    "log sum exp": cp.log_sum_exp(v), "geometric mean": cp.geo_mean(v),
    "composition": sin(X @ v) + cp.exp(-w), "scalars": s * s + cp.exp(s),
}


@pytest.mark.parametrize("name", sorted(ATOMS))
@pytest.mark.filterwarnings("ignore:.*denominator.*")
def test_translation_agrees_with_cvxpy(name):
    value, known, rows = translated(ATOMS[name])
    assert value == pytest.approx(known, rel=1e-9, abs=1e-9)
    if name != "log sum exp":  # its auxiliary variables are moved off their bounds on purpose
        assert np.all(rows <= 1e-9)  # auxiliary variables start consistent: equalities hold, epigraphs are not cut


@given(rows=st.integers(1, 4), inner=st.integers(1, 4), columns=st.integers(1, 3), flat=st.sampled_from(["", "l", "r"]))
def test_products_follow_numpy_in_every_shape(rows, inner, columns, flat):
    left = cp.Variable(inner if flat == "l" else (rows, inner))
    right = cp.Variable(inner if flat == "r" else (inner, columns))
    generator = np.random.default_rng(rows + 10 * inner + 100 * columns)
    left.value, right.value = generator.standard_normal(left.shape), generator.standard_normal(right.shape)
    value, known, _ = translated(left @ right)
    assert value == pytest.approx(known, rel=1e-12, abs=1e-12)


def test_unknown_atom_is_named():
    from cvxpy.atoms.elementwise.normcdf import normcdf

    x = cp.Variable(2, name="x")
    x.value = np.zeros(2)
    assert translated(normcdf(x))[0] == pytest.approx(translated(normcdf(x))[1])
    saved = casadi_backend.ATOMS.pop("normcdf")
    try:
        program = pose("unknown", cp.sum(normcdf(x)), {"floor": x >= -1}, [x], start={"x": np.zeros(2)})
        refuses(StructureError, "normcdf", solve, program, "ipopt")
    finally:
        casadi_backend.ATOMS["normcdf"] = saved


def test_cone_in_a_nonconvex_programme_is_refused_with_the_remedy():
    x = cp.Variable(2, name="x")
    with pytest.raises(StructureError, match="ball"):
        solve(pose("cone", x[0] * x[1], {"ball": cp.bmat([[1.0, x[0]], [x[0], 1.0]]) >> 0}, [x]), "ipopt")


@pytest.mark.parametrize("name", ["ipopt", "uno"])
def test_symmetric_and_bounded_variables_go_there_and_back(name):
    a = np.array([[2.0, 1.0], [1.0, 3.0]])
    x = cp.Variable((2, 2), name="x", symmetric=True)
    y = cp.Variable(2, name="y", bounds=[0.0, 0.25])
    program = pose("attributes", cp.sum_squares(x - a) + cp.sum_squares(y - np.array([1.0, 0.1]))
                   + 0 * x[0, 0] * y[0] ** 3, {"corner": x[0, 1] + x[1, 0] == 1}, [x, y],
                   start={"x": np.eye(2), "y": np.zeros(2)})
    found = solve(program, name)
    assert found.status in SUCCESS
    assert found.values["x"] == pytest.approx(np.array([[2.0, 0.5], [0.5, 3.0]]), abs=1e-6)
    assert found.values["y"] == pytest.approx([0.25, 0.1], abs=1e-6)
    assert found.duals["corner"] == pytest.approx([1.0], abs=1e-5)


@pytest.mark.parametrize("name", ["ipopt", "fatrop", "uno"])
def test_nothing_is_printed_unless_asked(name, capfd):
    solve(case("nlp_hs071").build(), name)
    solve(case("nlp_unbounded").build(), name)
    captured = capfd.readouterr()
    assert captured.out == "" and captured.err == ""


NO_TOLERANCE = {"glpk", "scipy", "scip", "ipopt", "fatrop", "uno", "gauss_newton", "lstsq", "alternating", "admm",
                "block_descent"}


def test_one_accuracy_is_translated_for_every_solver():
    for name in INSTALLED:
        coarse, fine = (tolerances(name, Settings(accuracy=eps)) for eps in (1e-4, 1e-8))
        assert coarse != fine or name in NO_TOLERANCE, name
    assert tolerances("scs", Settings(accuracy=1e-5, time_limit=3.0))["time_limit_secs"] == 3.0
    assert tolerances("clarabel", Settings(options={"tol_feas": 1e-3}))["tol_feas"] == 1e-3


def test_alternating_agrees_with_a_search_over_the_angle_and_reports_multipliers():
    for name in ("rank_one_fit", "rank_one_convex"):
        found = solve(case(name).build(), "alternating")
        assert found.status in SUCCESS and value_error(case(name), found) < 1e-8
        assert found.residuals.stationarity < 1e-5 and set(found.duals) >= {"residual"}


@pytest.mark.parametrize("name, convex", [("rank_one_fit", False), ("rank_one_convex", True)])
def test_the_known_values_of_the_bilinear_cases_are_those_of_a_search(name, convex):
    assert case(name).value == pytest.approx(search_angle(*planted_fit(), convex=convex), rel=1e-9)


def search_angle(matrix, y, *, convex):
    """Minimise over the direction of b, a single angle; for each angle the rest is (constrained) least squares."""
    levels = (matrix.shape[1] - 1) // 2
    # mu = free line + kinks with coefficients >= 0 is exactly "convex"; without the constraint kinks of either sign
    ramps = np.maximum(np.subtract.outer(np.arange(levels), np.arange(levels)), 0.0)
    line, kinks = np.column_stack([np.ones(levels), ramps[:, 0]]), ramps[:, 1:-1]
    shapes = np.column_stack([line, -line, kinks] if convex else [line, -line, kinks, -kinks])

    def value(angle):
        b = np.array([np.cos(angle), np.sin(angle)])
        wide = matrix[:, 1:].reshape(-1, levels, 2, order="F") @ b
        return nnls(np.column_stack([matrix[:, 0], -matrix[:, 0], wide @ shapes]), y)[1] ** 2

    grid = np.linspace(0.0, 2 * np.pi, 721)
    best = float(min(grid, key=value))
    found = minimize_scalar(value, bounds=(best - 0.01, best + 0.01), method="bounded", options={"xatol": 1e-10})
    return float(found.fun)


def test_a_solver_writes_nothing_to_standard_output(capfd):
    """HiGHS prints its name on its first run, whatever its options say; what is printed is for other programmes."""
    code = ("import optid\n"
            "data = optid.examples.example('heater').data\n"
            "optid.fit(data, 'arx', na=1, nb=1, nk=5, solver='highs', constraints=['stable:0.5'])\n"
            "print('done')\n")
    subprocess.run([sys.executable, "-c", code], check=True)
    assert capfd.readouterr().out == "done\n"


@pytest.mark.parametrize("courses, options, limit", [
    ((), {}, casadi_backend.LIMIT), (("x",), {}, casadi_backend.FAR), (("x",), {"max_iter": 3000}, 3000),
    (("x",), {"ipopt.max_iter": casadi_backend.LIMIT}, casadi_backend.LIMIT)])
def test_the_limit_of_iterations_is_that_of_the_user_where_there_is_one(courses, options, limit):
    problem = SimpleNamespace(scale=1.0, settled=False, courses=courses)
    assert casadi_backend.options("ipopt", problem, Settings(options=options))["ipopt.max_iter"] == limit

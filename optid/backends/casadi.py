"""IPOPT and fatrop through CasADi: the smooth CVXPY expression tree is translated into one CasADi graph.

Every CVXPY expression becomes a CasADi column: its entries in column-major order, whatever its shape. Atoms that only
move entries about (index, reshape, stack, diag, ...) are one rule: the atom itself is evaluated on the numbers of the
entries. Derivatives are CasADi's, Hessians exact; a limited-memory Hessian does not converge on bilinear fits.

CasADi's other solvers are not offered because they do not pass `optid.conformance.checks`: SLEQP runs for ever on an
infeasible programme, bonmin returns no multipliers, the sqpmethod variants stay at the start.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from operator import mul
from typing import Any

import casadi as ca
import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from optid.backends.back_end import Answer, Settings
from optid.backends.dnlp import Smooth, get_or_make, smooth
from optid.core.problem import Problem
from optid.core.statement import statement_of
from optid.errors import StructureError
from optid.program.expressions import MOVES, sources
from optid.program.solution import Status

LIMIT = 3000  # iterations
# iterations from where no run of the equations exists: thousands of states are either in reach soon or not at all
FAR = 300

STATUS = {
    "Solve_Succeeded": Status.LOCAL, "Feasible_Point_Found": Status.LOCAL,
    "Solved_To_Acceptable_Level": Status.INACCURATE, "Search_Direction_Becomes_Too_Small": Status.INACCURATE,
    "Infeasible_Problem_Detected": Status.INFEASIBLE, "Diverging_Iterates": Status.UNBOUNDED,
    "Maximum_Iterations_Exceeded": Status.LIMIT, "Maximum_CpuTime_Exceeded": Status.LIMIT,
    "Maximum_WallTime_Exceeded": Status.LIMIT,
}


def translate(form: Smooth) -> dict[str, Any]:
    """Translate a programme after CVXPY's smooth chain into CasADi's dictionary ``{"x", "f", "g"}``.

    Raises:
        StructureError: an atom without a translation, by name.
    """
    edges = np.cumsum([0, *(v.size for v in form.variables)]).tolist()
    x = ca.MX.sym("x", edges[-1])
    column = _translator({v.id: part for v, part in zip(form.variables, ca.vertsplit(x, edges))})
    rows = [column(one) for one in form.rows]
    return {"x": x, "f": column(form.problem.objective.expr), "g": ca.vertcat(*rows) if rows else ca.MX(0, 1)}


def function_of(groups: Sequence[Sequence[cp.Variable]], results: Sequence[Sequence[Any]]) -> Any:
    """Return plain expressions of scalar variables as a `casadi.Function` of one vector per group.

    Args:
        groups: the variables of every argument.
        results: the expressions of every result, CVXPY's or numbers.

    Raises:
        StructureError: an atom without a translation, by name.
    """
    arguments = [ca.MX.sym(f"v{i}", len(group)) for i, group in enumerate(groups)]
    column = _translator({leaf.id: vector[i] for group, vector in zip(groups, arguments)
                          for i, leaf in enumerate(group)})
    rows = [ca.vertcat(*(column(cp.Constant(one) if np.isscalar(one) else one) for one in result))
            for result in results]
    return ca.Function("equations", arguments, rows).expand()


def _translator(leaves: Mapping[int, Any]) -> Callable[[Any], Any]:
    """Return what makes a dense column of an expression, from the columns of variables by their ids."""
    done: dict[int, tuple[Any, Any]] = {}

    def column(expr: Any) -> Any:
        """Translate an expression, each once; it is kept, so that its id stays its own."""
        if id(expr) not in done:
            done[id(expr)] = (expr, make(expr))
        return done[id(expr)][1]

    def make(expr: Any) -> Any:
        if isinstance(expr, cp.Variable):
            return leaves[expr.id]
        if expr.is_constant():
            return constant(expr.value, (int(expr.size), 1))
        name, columns = type(expr).__name__, [column(arg) for arg in expr.args]
        if name in MOVES:
            return _move(expr, columns)
        if name not in ATOMS:
            raise StructureError(f"the atom {name} in {expr} has no translation for CasADi's solvers")
        return ATOMS[name](expr, columns)

    return lambda expr: ca.densify(column(expr))


def constant(value: Any, shape: tuple[int, int]) -> Any:
    """Return a CasADi matrix of a number, array or sparse matrix, column by column, without its zeros."""
    if sp.issparse(value):
        return ca.DM(sp.csc_matrix(sp.csc_array(value).reshape(shape, order="F")))  # CasADi 3.8.0 knows no csc_array
    return ca.sparsify(ca.DM(np.reshape(np.asarray(value, dtype=float), shape, order="F")))


def _move(expr: Any, columns: list) -> Any:
    """Apply an atom that only moves entries."""
    moved, column = sources(expr), columns[0] if len(columns) == 1 else ca.vertcat(*columns)
    if np.all(moved >= 0):
        return column if np.array_equal(moved, np.arange(column.numel())) else column[moved.tolist(), 0]
    kept = np.flatnonzero(moved >= 0)
    place = ca.Sparsity(moved.size, 1, [0, kept.size], kept.tolist())
    return ca.MX(place, ca.densify(column)[moved[kept].tolist(), 0])


def _matrix(column: Any, shape: tuple[int, ...], *, row: bool = False) -> Any:
    """Give a column the shape of a matrix; a vector is a column, or a row where it stands on the left."""
    if len(shape) > 2:
        raise StructureError(f"an array of {len(shape)} dimensions has no translation for CasADi's solvers")
    if len(shape) == 2:
        return ca.reshape(column, *shape)
    return column.T if row else column


def _matmul(expr: Any, columns: list) -> Any:
    left, right = expr.args
    if left.ndim == 0 or right.ndim == 0:
        return columns[0] * columns[1]
    return ca.vec(ca.mtimes(_matrix(columns[0], left.shape, row=True), _matrix(columns[1], right.shape)))


def _sum(expr: Any, columns: list) -> Any:
    if expr.axis is None:
        return ca.sum1(columns[0])
    argument = expr.args[0]
    entries = np.reshape(np.arange(argument.size), argument.shape, order="F")  # by the entry of the sum they add to
    group = np.ravel(np.broadcast_to(np.max(entries, axis=expr.axis, keepdims=True), argument.shape), order="F")
    names, group = np.unique(group, return_inverse=True)
    adding = sp.csc_array((np.ones(group.size), (group, np.arange(group.size))), shape=(names.size, group.size))
    return ca.mtimes(constant(adding, (names.size, group.size)), columns[0])


def _cumsum(expr: Any, columns: list) -> Any:
    shape = expr.args[0].shape
    axis = expr.axis if expr.axis is not None else 0
    if len(shape) > 2 or (expr.axis is None and len(shape) == 2):
        raise StructureError(f"{expr}: a cumulative sum needs an axis and at most two dimensions")
    return ca.vec(ca.cumsum(ca.densify(_matrix(columns[0], shape)), axis % max(len(shape), 1)))


def _convolve(expr: Any, columns: list) -> Any:
    short, long = (columns[0], columns[1]) if expr.args[0].size <= expr.args[1].size else (columns[1], columns[0])
    terms = [ca.vertcat(ca.MX(i, 1), short[i] * long, ca.MX(short.numel() - 1 - i, 1)) for i in range(short.numel())]
    return sum(terms[1:], terms[0])


def _power(expr: Any, columns: list) -> Any:
    exponent = float(expr.p.value)
    if exponent == 2.0:
        return columns[0] * columns[0]
    return 1 / columns[0] if exponent == -1.0 else columns[0] ** exponent


def _prod(expr: Any, columns: list) -> Any:
    if expr.axis is not None:
        raise StructureError(f"{expr}: a product along an axis has no translation for CasADi's solvers")
    return reduce(mul, ca.vertsplit(columns[0]))


def _softplus(x: Any) -> Any:
    """log(1 + exp x) that does not overflow."""
    return ca.fmax(x, 0) + ca.log1p(ca.exp(-ca.fabs(x)))


def _of_one(function: str) -> Callable[[Any, list], Any]:
    return lambda _, columns: getattr(ca, function)(ca.densify(columns[0]))


ATOMS: dict[str, Callable[[Any, list], Any]] = {
    "AddExpression": lambda _, columns: sum(columns[1:], columns[0]),
    "NegExpression": lambda _, columns: -columns[0],
    "multiply": lambda _, columns: columns[0] * columns[1],
    "DivExpression": lambda _, columns: columns[0] / columns[1],
    "MulExpression": _matmul, "Sum": _sum, "cumsum": _cumsum, "convolve": _convolve, "conv": _convolve,
    "kron": lambda expr, columns: ca.vec(ca.kron(*(ca.densify(_matrix(column, arg.shape))
                                                   for column, arg in zip(columns, expr.args)))),
    "Power": _power, "PowerApprox": _power, "Prod": _prod,
    "Trace": lambda expr, columns: ca.trace(_matrix(columns[0], expr.args[0].shape)),
    "quad_over_lin": lambda _, columns: ca.sumsqr(columns[0]) / columns[1],
    "QuadForm": lambda expr, columns: ca.dot(columns[0], _matrix(columns[1], expr.args[1].shape) @ columns[0]),
    "entr": lambda _, columns: -columns[0] * ca.log(columns[0]),
    "rel_entr": lambda _, columns: columns[0] * ca.log(columns[0] / columns[1]),
    "logistic": lambda _, columns: _softplus(ca.densify(columns[0])),
    "normcdf": lambda _, columns: 0.5 * (1.0 + ca.erf(ca.densify(columns[0]) / np.sqrt(2.0))),
    **{name: _of_one(name) for name in ("exp", "log", "log1p", "sin", "cos", "tan", "sinh", "tanh", "asinh", "atanh")},
}


def options(name: str, problem: Problem, settings: Settings) -> dict[str, Any]:
    """Translate what is asked into options of "ipopt" or "fatrop"; native options of the user come last.

    Raises:
        StructureError: a Hessian that is not exact.
    """
    eps, loud = settings.accuracy, settings.verbose
    chosen: dict[str, Any] = {"tol": eps, "max_iter": LIMIT, "print_level": 5 if loud else 0}
    if name == "ipopt":
        chosen |= {"constr_viol_tol": eps, "compl_inf_tol": eps, "acceptable_iter": 0, "bound_relax_factor": 0.1 * eps,
                   "sb": "yes"}
        if settings.time_limit is not None:
            chosen["max_wall_time"] = float(settings.time_limit)
        if 0 < problem.scale < 1:  # its tolerances are absolute: outputs of 1e-3 would all be met
            chosen["obj_scaling_factor"] = 1.0 / problem.scale
        if problem.settled and settings.warm:  # a large barrier would throw away the start
            chosen["mu_init"] = 1e-6
        if problem.courses and not problem.settled:
            chosen["max_iter"] = FAR
    chosen = {key if "." in key else f"{name}.{key}": value for key, value in {**chosen, **settings.options}.items()}
    chosen = {"print_time": loud, "show_eval_warnings": loud, "error_on_fail": False} | chosen
    if chosen.get("ipopt.hessian_approximation", "exact") != "exact":
        raise StructureError("ipopt with a limited-memory Hessian does not converge on these programmes; "
                             "leave hessian_approximation at 'exact'")
    return chosen


def solve_with(name: str, problem: Problem, settings: Settings) -> Answer:
    """Solve an LP, QP or smooth nonconvex programme with "ipopt" or "fatrop".

    The translated programme and the compiled solver are kept with the CVXPY problem: only the start is new in the next
    solve. Multipliers are in CVXPY's convention ``L = f + dual (lhs - rhs)``.
    """
    clock = time.perf_counter()
    posed = statement_of(problem).problem
    form, chosen = smooth(posed), options(name, problem, settings)
    graph = get_or_make(posed, "casadi", lambda: translate(form))
    solver = get_or_make(posed, (name, repr(sorted(chosen.items()))),
                         lambda: ca.nlpsol("solver", name, graph, chosen))
    compiling = time.perf_counter() - clock
    (lower, upper), (row_lower, row_upper) = form.bounds, form.row_bounds
    found = solver(x0=form.start(), lbx=lower, ubx=upper, lbg=row_lower, ubg=row_upper)
    statistics = solver.stats()
    word, status = _status(statistics)
    return form.answer(problem, status, word, np.asarray(found["x"]), np.asarray(found["lam_g"]),
                       iterations=int(statistics.get("iter_count", -1)), compile=compiling)


def _status(statistics: dict[str, Any]) -> tuple[str, Status]:
    """Read IPOPT's words; fatrop only reports success or failure, so that its point is judged."""
    word = str(statistics.get("return_status", ""))
    if word in STATUS:
        return word, STATUS[word]
    if statistics.get("success"):
        return "success", Status.LOCAL
    stopped = int(statistics.get("iter_count", 0)) >= LIMIT
    return ("iteration limit", Status.LIMIT) if stopped else (f"no success ({word})", Status.INACCURATE)

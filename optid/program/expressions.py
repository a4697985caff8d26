"""CVXPY expressions: how they are written and solved, their derivatives and sizes at the assigned point."""

import ctypes
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

Map = Callable[[np.ndarray], np.ndarray]
"""Of arrays, such as from the Jacobian of an argument to its part of that of an atom."""

DENSE = 100_000  # entries of the Jacobian up to which an expression is small
MOST = 30_000_000  # entries up to which a large expression is differentiated here where CVXPY has no gradient
MOVES = {"index", "special_index", "reshape", "transpose", "Hstack", "Vstack", "Concatenate", "Promote", "broadcast_to",
         "diag_vec", "diag_mat", "upper_tri", "squeeze", "Stack", "nonneg_wrap", "nonpos_wrap", "symmetric_wrap",
         "psd_wrap", "nsd_wrap", "real"}
"""Atoms that only move entries about."""

KINKS = {"abs", "max", "maximum", "min", "minimum", "norm1", "norm_inf", "normNuc", "lambda_max", "sigma_max",
         "sum_largest", "lambda_sum_largest", "pos", "neg"}
"""Atoms whose gradient says nothing where they have a kink."""

PROBES = 3  # random points at which the size of an expression is tried


def has_kinks(expression: cp.Expression) -> bool:
    """Whether an expression has atoms whose gradient says nothing at some points."""
    return not expression.is_affine() and bool({atom.__name__ for atom in expression.atoms()} & KINKS)


def flat(expression: cp.Expression) -> cp.Expression:
    """Stack the columns of an expression."""
    return expression if expression.ndim == 1 else cp.vec(expression, order="F")


def solve_quietly(problem: cp.Problem, solver: str = "CLARABEL", **options: Any) -> None:
    """Solve a problem by CVXPY; a point that may be inaccurate is ours to judge, and no reason for a warning.

    A solver that crashes is a `cvxpy.SolverError`, also where a panic of Rust ends it, which is no `Exception`.
    """
    greets = solver == "HIGHS" and not options.get("verbose")
    with warnings.catch_warnings(), _unprinted() if greets else nullcontext():
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver=solver, **options)
        except BaseException as error:
            if isinstance(error, Exception) or not is_crash(error):
                raise
            raise cp.SolverError(f"{solver} crashed: {error}") from error


@contextmanager
def _unprinted() -> Iterator[None]:
    """Drop what compiled code writes to standard output: HiGHS says its name whatever its options are."""
    try:
        kept = os.dup(1)
    except OSError:  # there is no standard output
        yield
        return
    if sys.stdout is not None:
        sys.stdout.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        with suppress(OSError, TypeError, AttributeError):  # its buffer; Windows keeps one for every library
            ctypes.CDLL(None).fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)


def is_crash(error: BaseException) -> bool:
    """Whether an error comes from a solver: an exception, or a panic of Rust, which is none; not an interruption."""
    return isinstance(error, Exception) or type(error).__name__ == "PanicException"


def flat_value(expression: cp.Expression) -> np.ndarray:
    """Return the value of an expression as a flat array, column by column."""
    return np.ravel(np.asarray(expression.value, dtype=float), order="F")


def jacobians(expression: cp.Expression) -> dict[cp.Variable, Any] | None:
    """Return the Jacobian (rows, size) of an expression with respect to each of its variables.

    Rows and columns follow the entries column by column. None where CVXPY has no gradient at the assigned point.
    Small expressions are differentiated here, with the common atoms by their own rules: CVXPY composes sparse
    matrices atom by atom, which takes ten times as long. Large ones are left to it, and their Jacobians are sparse.
    """
    entries = expression.size * sum(variable.size for variable in expression.variables())
    gradients: Any = expression.grad if entries > DENSE else {None: None}
    if None in gradients.values():  # CVXPY has no gradient of an odd power where it is negative
        node = _differentiate(expression, {}) if entries <= MOST else None
        return None if node is None else dict(node.slopes)
    found = {}
    for variable, part in gradients.items():
        matrix = part if sp.issparse(part) else np.reshape(np.asarray(part, dtype=float),
                                                           (variable.size, expression.size))
        found[variable] = sp.csr_array(sp.csr_array(matrix).T)
    return found


@dataclass(frozen=True)
class _Node:
    """Value of an expression and its Jacobians (size, size of the variable), entries column by column."""

    value: Any
    slopes: dict[cp.Variable, np.ndarray]


def _differentiate(expression: cp.Expression, known: dict[int, _Node | None]) -> _Node | None:
    """Differentiate by the chain rule; None where a value is missing or an atom has no gradient."""
    if id(expression) not in known:
        known[id(expression)] = _derive(expression, known)
    return known[id(expression)]


def _derive(expression: Any, known: dict[int, _Node | None]) -> _Node | None:
    if isinstance(expression, cp.Variable) or expression.is_constant():
        value: Any = expression.value
        if value is None:
            return None
        value = value.toarray() if sp.issparse(value) else np.asarray(value, dtype=float)
        return _Node(value, {} if expression.is_constant() else {expression: np.eye(expression.size)})
    nodes = [_differentiate(arg, known) for arg in expression.args]
    if any(node is None for node in nodes):
        return None
    values = [node.value for node in nodes]  # type: ignore[union-attr]
    name = type(expression).__name__
    if name in RULES and all(value.ndim <= 2 for value in values):
        maps: Any = RULES[name](expression, values)
    else:
        maps = _moved(expression) if name in MOVES else map(_of_atom, expression._grad(values), values)
    slopes: dict[cp.Variable, np.ndarray] = {}
    for node, apply in zip(nodes, maps):
        for variable, slope in node.slopes.items():  # type: ignore[union-attr]
            if apply is None:
                return None
            part = apply(slope)
            slopes[variable] = slopes[variable] + part if variable in slopes else part
    value = expression.numeric(values)
    return _Node(value.toarray() if sp.issparse(value) else np.asarray(value, dtype=float), slopes)


def sources(expression: Any) -> np.ndarray:
    """Return where an atom of `MOVES` takes every entry from, counted through all its arguments; -1 where it is zero.

    The atom is evaluated on the numbers 1, 2, ... of the entries.
    """
    numbers, first = [], 1
    for arg in expression.args:
        numbers.append(np.reshape(np.arange(first, first + arg.size, dtype=float), arg.shape, order="F"))
        first += arg.size
    moved = expression.numeric(numbers)
    return np.ravel(moved.toarray() if sp.issparse(moved) else np.asarray(moved), order="F").astype(int) - 1


def _moved(expression: Any) -> list[Map]:
    source, edges = sources(expression), np.cumsum([0, *(arg.size for arg in expression.args)])
    inside = [(source >= low) & (source < high) for low, high in zip(edges, edges[1:])]
    return [lambda slope, low=low, own=own: np.where(own[:, None], slope[np.where(own, source - low, 0)], 0.0)
            for low, own in zip(edges, inside)]


def _of_atom(part: Any, value: np.ndarray) -> Map | None:
    """Use the gradient (size of the argument, size) of an atom by CVXPY."""
    if part is None:
        return None
    matrix = part.toarray() if sp.issparse(part) else np.asarray(part, dtype=float)
    return partial(np.matmul, np.reshape(matrix, (value.size, -1)).T)


def _scaled(factors: np.ndarray) -> Map:
    """Multiply every row by a number."""
    return partial(np.multiply, np.ravel(factors, order="F")[:, None])


def _product(expression: Any, values: list[Any]) -> list[Map]:
    left, right = values[0], values[1] if values[1].ndim == 2 else values[1][:, None]
    left = left if left.ndim == 2 else left[None]
    (rows, inner), columns = left.shape, right.shape[1]
    return [lambda slope: np.tensordot(right.T, slope.reshape(inner, rows, -1), 1).reshape(rows * columns, -1),
            lambda slope: np.matmul(left, slope.reshape(columns, inner, -1)).reshape(rows * columns, -1)]


def _power(expression: Any, values: list[Any]) -> list[Map | None]:
    exponent = float(expression.p.value)
    with np.errstate(divide="ignore", invalid="ignore"):
        factors = exponent * np.power(values[0], exponent - 1)
    return [_scaled(factors) if np.all(np.isfinite(factors)) else None]


def _sum(expression: Any, values: list[Any]) -> list[Map]:
    shape, axis = values[0].shape, expression.axis
    axes = range(len(shape)) if axis is None else [axis] if isinstance(axis, int) else axis
    summed = tuple(len(shape) - 1 - one % len(shape) for one in axes)  # rows run through the entries in reverse order
    return [lambda slope: slope.reshape(*shape[::-1], slope.shape[1]).sum(axis=summed).reshape(-1, slope.shape[1])]


def _squares(expression: Any, values: list[Any]) -> list[Map]:
    above, below = values
    (total,) = _sum(expression, [above])
    return [lambda slope: total(_scaled(2 / below * above)(slope)),
            lambda slope: -total(np.ravel((above / below) ** 2, order="F")[:, None] * slope)]


RULES: dict[str, Callable[[Any, list[Any]], Any]] = {
    "AddExpression": lambda _, values: [lambda slope: slope] * len(values),
    "NegExpression": lambda _, values: [np.negative],
    "multiply": lambda _, values: [_scaled(value) for value in reversed(values)],
    "DivExpression": lambda _, values: [_scaled(1 / values[1]), _scaled(-values[0] / values[1] ** 2)],
    "Power": _power, "PowerApprox": _power, "MulExpression": _product, "Sum": _sum, "quad_over_lin": _squares}
"""By atom, from its arguments' values, what maps the Jacobian of every argument; arguments have the atom's shape."""


def differences(function: Map, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobian and value of a function that is affine in each entry of x alone: its differences are exact."""
    base = function(x)
    jacobian = np.empty((base.size, x.size))
    steps = np.maximum(np.abs(x), 1e-3 * float(np.max(np.abs(x), initial=0.0)) or 1.0)
    for j, step in enumerate(steps):
        moved = x.copy()
        moved[j] += step
        jacobian[:, j] = (function(moved) - base) / (moved[j] - x[j])
    return jacobian, base


def affine_parts(expression: cp.Expression) -> tuple[dict[cp.Variable, Any], np.ndarray] | None:
    """Return the Jacobians of an affine expression, as `jacobians` does, and its constant, flat; None if not affine.

    The constant is the value at the origin, so that one that is zero is exactly zero.
    """
    if not expression.is_affine():
        return None
    with _values_kept(expression.variables()) as variables:
        for variable in variables:
            variable.save_value(np.zeros(variable.shape))
        slopes = jacobians(expression)
        return None if slopes is None else (slopes, flat_value(expression))


def row_sizes(expression: cp.Expression, usual: Mapping[int, float]) -> np.ndarray:
    """Return the change of every entry of an affine or smooth expression by variables of usual size; never zero.

    The usual size of the entries is given by the id of a variable; it is one where it is not.
    """
    rng = np.random.default_rng(0)
    with _values_kept(expression.variables()) as variables:
        for variable in variables:
            variable.save_value(np.zeros(variable.shape))
        origin, largest = flat_value(expression), np.zeros(expression.size)
        for _ in range(PROBES):
            for variable in variables:
                entries = rng.uniform(0.5, 1.5, variable.shape) * rng.choice([-1.0, 1.0], variable.shape)
                if variable.ndim == 2 and variable.attributes["symmetric"]:
                    entries = (entries + entries.T) / 2
                variable.save_value(usual.get(variable.id, 1.0) * entries)
            largest = np.fmax(largest, np.abs(flat_value(expression) - origin))
    usable = np.isfinite(largest) & (largest > 64 * np.finfo(float).eps * np.abs(origin))
    return np.where(usable, largest, 1.0)


@contextmanager
def _values_kept(variables: list[cp.Variable]) -> Iterator[list[cp.Variable]]:
    saved = [variable.value for variable in variables]
    try:
        yield variables
    finally:
        for variable, value in zip(variables, saved):
            variable.save_value(value)

"""Derivatives of expressions: our chain rule against CVXPY's, on random expressions."""

import cvxpy as cp
import numpy as np
import pytest

from optid.program.expressions import affine_parts, jacobians


def random_expression(rng, variables, depth):
    """A random composition of the atoms that constraints are made of, in the shape of the first variable."""
    if depth == 0:
        return variables[rng.integers(len(variables))]
    x, y = (random_expression(rng, variables, depth - 1) for _ in range(2))
    n, m = x.shape
    constant = rng.standard_normal((n, m))
    return [
        lambda: x + y, lambda: x - 2.0 * y, lambda: cp.multiply(x, y), lambda: cp.multiply(constant, x) + constant,
        lambda: rng.standard_normal((n, n)) @ x, lambda: x @ rng.standard_normal((m, m)), lambda: (x @ y.T) @ x,
        lambda: cp.vstack([x[1:], y[:1]]), lambda: cp.hstack([y[:, :1], x[:, 1:]]), lambda: x[::-1] + cp.sum(y),
        lambda: x + cp.sum(y, axis=0, keepdims=True), lambda: x - cp.reshape(cp.sum(y, axis=1), (n, 1), order="F"),
        lambda: cp.reshape(cp.vec(x, order="F"), (n, m), order="C"), lambda: x / 3.0, lambda: -x,
        lambda: cp.square(x) + cp.exp(0.1 * y), lambda: cp.outer(x[:, 0], y[0]), lambda: x * cp.sum_squares(y),
        lambda: cp.cumsum(x, axis=0), lambda: cp.tanh(x) if hasattr(cp, "tanh") else x, lambda: (x.T @ x)[0, 0] * y,
        lambda: x + cp.trace(x @ y.T), lambda: cp.diag(x[:, 0]) @ y, lambda: x + y[0][None, :] * 2.0,
    ][rng.integers(24)]()


@pytest.mark.parametrize("seed", range(150))
def test_the_chain_rule_agrees_with_cvxpy(seed):
    rng = np.random.default_rng(seed)
    shape = (int(rng.integers(2, 5)), int(rng.integers(2, 4)))
    variables = [cp.Variable(shape, name=f"x{i}") for i in range(3)]
    for variable in variables:
        variable.value = rng.standard_normal(shape)
    expression = random_expression(rng, variables, int(rng.integers(1, 4)))
    if seed % 3 == 0:
        expression = cp.sum(expression)
    found, expected = jacobians(expression), expression.grad
    assert set(found) == {v for v, part in expected.items()}
    for variable, part in expected.items():
        part = np.reshape(part.toarray() if hasattr(part, "toarray") else part, (variable.size, -1)).T
        assert found[variable].shape == part.shape
        assert np.allclose(found[variable], part, rtol=1e-11, atol=1e-11 * max(np.abs(part).max(), 1e-300))


def test_missing_values_and_missing_gradients_are_none():
    x = cp.Variable(2)
    assert jacobians(x[0] * x[1]) is None
    x.value = np.array([-1.0, 1.0])
    assert jacobians(cp.log(x)) is None
    assert jacobians(cp.Constant(3.0) + cp.sum(x))[x].tolist() == [[1.0, 1.0]]


def test_affine_parts_have_an_exact_constant_and_leave_values_alone():
    x = cp.Variable((2, 2), value=np.eye(2))
    slopes, constant = affine_parts(cp.vec(3 * x + 1, order="F")[1:])
    assert constant.tolist() == [1.0, 1.0, 1.0] and np.array_equal(x.value, np.eye(2))
    assert slopes[x].tolist() == [[0, 3, 0, 0], [0, 0, 3, 0], [0, 0, 0, 3]]
    assert affine_parts(x @ x) is None

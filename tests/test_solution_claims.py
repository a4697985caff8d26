"""What a solution keeps of the solver's claim, and the times of compiling."""

import math
from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest

from optid.backends import Answer, BackEnd
from optid.program.program import Program
from optid.program.solution import Solution, Status
from optid.program.view import View
from optid.solving.solve import solve


def _program():
    x = cp.Variable(2, name="x")
    objective = cp.Minimize(cp.sum_squares(x - np.array([1.0, 2.0])))
    return Program("small", objective, {"sum": (cp.sum(x) == 2.0,)}, {"x": x}, {"x": np.ones(2)}, dict,
                   View({"x": x}), frozenset({"sum"}))


def _claiming(status, values):
    return BackEnd("liar", frozenset({"QP"}), lambda program, settings: Answer(status, "trust me", values))


@pytest.mark.parametrize("status, x, false", [
    (Status.OPTIMAL, [9.0, 9.0], True),
    (Status.OPTIMAL, [math.nan, 1.0], True),
    (Status.LIMIT, [9.0, 9.0], False),
    (Status.INFEASIBLE, [0.5, 1.5], True),
    (Status.UNBOUNDED, None, False),
])
def test_a_claim_that_is_taken_back_is_false(status, x, false):
    values = {} if x is None else {"x": np.array(x)}
    solution = solve(_program(), _claiming(status, values))
    assert solution.claim is status and solution.false_claim is false


@pytest.mark.parametrize("values", [{}, {"x": np.array([math.nan, 1.0])}, {"y": np.ones(2)}])
def test_an_answer_without_a_usable_point_is_in_units_of_the_record(values):
    solution = solve(replace(_program(), scale=3.0, unit=4.0), _claiming(Status.LOCAL, values))
    assert solution.status is Status.FAILED and solution.scale == 12.0


@pytest.mark.parametrize("x, words", [([1e200, 1.0], "inf"), ([1.0, 2.0, 3.0], "cannot be judged: cannot reshape")])
def test_a_point_of_another_shape_or_beyond_numbers_is_a_failure(x, words):
    solution = solve(_program(), _claiming(Status.OPTIMAL, {"x": np.array(x)}))
    assert solution.status is Status.FAILED and words in solution.reason + str(solution.objective)


def test_nothing_claimed_is_not_false():
    assert not Solution(Status.FAILED, "", "").false_claim


@pytest.mark.parametrize("solver", ["clarabel", "ipopt", "osqp"])
def test_compiling_is_told_apart_and_part_of_the_solve(solver):
    times = solve(_program(), solver).times
    assert 0.0 < times.compile <= times.solve
    assert times.total == pytest.approx(times.build + times.solve + times.judge + times.prove)

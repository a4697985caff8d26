"""An infeasible set is explained by an irreducible subset, in the user's names."""

from itertools import combinations

import cvxpy as cp
import numpy as np
import pytest
from problems import BASIS, record
from refusals import refuses

import optid
from formulations.constraints import shape
from optid.certificate.infeasibility import conflicting_subset, explain, satisfiable
from optid.core.problem import Problem
from optid.core.statement import for_solvers
from optid.core.terms import Expressed
from optid.errors import InfeasibleError, UnboundedError

SETS = {
    # with 1 + sum(a) = 0, an integrator, every static bound would hold of nothing at all
    "slope and gain": ([shape.slope(low=2, high=3), shape.gain(1.0, at=0.1), shape.coefficients("a", high=3)],
                       {"slope", "gain"}),
    "stability": ([shape.coefficients("a", low=1.5, index=1), shape.stable(), shape.monotone()],
                  {"coefficients:a", "stable:1"}),
    "a point outside the range": ([shape.through(0.0, 1.0), shape.value_range(high=0.5), shape.monotone()],
                                  {"through", "range"}),
    "a sign of b": ([shape.sign("b"), lambda v: {"first": v["b"][0] <= -0.1}, lambda v: {"idle": v["a"][0] <= 5}],
                    {"sign:b:positive", "first"}),
    "monotone and gain": ([shape.sign("b"), shape.monotone(), shape.gain(-2.0, at=0.1), shape.stable()],
                          {"monotone:increasing", "gain"}),
    "three": ([shape.sign("b"), lambda v: {"rising": v.bases["u"].increments() @ v["mu"] >= 0},
               shape.gain(-2.0, at=0.1), shape.stable()], {"sign:b:positive", "rising", "gain"}),
    "both directions": ([shape.monotone(), shape.monotone("decreasing"), shape.gain(5.0), shape.stable()],
                        {"monotone:decreasing", "gain"}),
    "only b = 0": ([shape.monotone(), shape.sign("b", "negative"), shape.stable()],
                   {"monotone:increasing", "sign:b:negative"}),
    "one alone": ([lambda v: {"itself": [v["a"][0] >= 1, v["a"][0] <= 0]}, shape.monotone()], {"itself"}),
    "three halves": ([lambda v: {"p": v["a"][0] >= 0}, lambda v: {"q": v["a"][1] >= 0},
                      lambda v: {"r": cp.sum(v["a"]) <= -1}], {"p", "q", "r"}),
}


def program_of(rules, form="hammerstein_arx.exact"):
    from optid.registry import formulation

    return for_solvers(formulation(form)[1](record(), na=2, nb=2, basis=BASIS, constraints=rules))


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", SETS)
def test_the_subset_is_named_and_irreducible(name):
    rules, expected = SETS[name]
    program = program_of(rules)
    found = conflicting_subset(program)
    assert set(found) == expected
    assert not satisfiable(program, found)
    for size in range(len(found)):  # by brute force: no smaller subset of it conflicts
        assert all(satisfiable(program, list(part)) for part in combinations(found, size))
    with pytest.raises(InfeasibleError) as caught:
        optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=rules)
    assert all(repr(one) in str(caught.value) for one in expected)
    assert all(repr(one) not in str(caught.value) for one in set(program.constraint_names) - expected)


@pytest.mark.parametrize("name", ["slope and gain", "stability", "a point outside the range", "three halves"])
def test_convex_formulations_explain_themselves_too(name):
    rules, expected = SETS[name]
    assert set(conflicting_subset(program_of(rules, "hammerstein_arx.overparametrised"))) == expected
    with pytest.raises(InfeasibleError):
        optid.fit(record(), "hammerstein_arx.overparametrised", na=2, nb=2, basis=BASIS, constraints=rules)


def test_what_can_be_satisfied_is_not_blamed():
    program = program_of([shape.monotone(), shape.gain(1.0, at=0.1)])
    assert conflicting_subset(program) is None
    assert "can be satisfied together" in explain(program)


def test_an_unbounded_programme_says_so():
    def falling(data):
        return Problem("falling", {"x": np.zeros(1)}, (Expressed(lambda v: v["x"][0]),),
                       restrictions=(lambda v: {"cap": v["x"] <= 1},))

    refuses(UnboundedError, "'falling' has no minimum", optid.fit, record(), falling)

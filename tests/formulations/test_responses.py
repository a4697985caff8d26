"""Constraints where B and D are chosen: responses written out by simulation, gains by the transfer function."""

from dataclasses import replace

import numpy as np
import pytest

import optid
from formulations.constraints import responses, shape
from optid.core.problem import Problem
from optid.core.terms import Squares, flat
from optid.data.record import Data
from optid.errors import StructureError
from optid.program.solution import Status
from optid.program.view import View
from optid.registry import named_constraint
from optid.solving.solve import solve

INPUTS, OUTPUTS, N = ("u1", "u2"), ("y1", "y2"), 3


def system(seed=0, direct=True, functions=None):
    """A problem that fits random targets Theta, with A and C held."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N, N))
    a *= 0.8 / np.max(np.abs(np.linalg.eigvals(a)))
    c = rng.normal(size=(2, N))
    bases = {name: _fitted(functions) for name in INPUTS}
    width = N + 2 * direct
    targets = {f"Theta[{name}]": rng.normal(size=(bases[name].size, width)) for name in INPUTS}
    wanted = {**targets, "offset": np.ones(2)}
    cost = Squares(np.eye(sum(map(np.size, wanted.values()))), np.concatenate([flat(one) for one in wanted.values()]),
                   0.0, tuple(wanted))
    problem = Problem("realisation", {name: np.zeros(np.shape(one)) for name, one in wanted.items()}, (cost,),
                      facts={"channels": INPUTS, "outputs": OUTPUTS, "bases": bases, "reference": {"A": a, "C": c}})
    return problem, a, c, bases, targets


def _fitted(functions):
    from optid.bases import fitted_bases

    data = Data(u=np.linspace(-1, 2, 40)[:, None], y=np.zeros((40, 1)), dt=1.0)
    return fitted_bases(data, functions or optid.Polynomial(3))[0]


def markov(a, c, theta, count):
    """Markov parameters (count, l, functions) written out."""
    b = theta[:, :N].T
    d = theta[:, N:].T if theta.shape[1] > N else np.zeros((len(c), len(theta)))
    found, state = [d], b
    for _ in range(count - 1):
        found.append(c @ state)
        state = a @ state
    return np.array(found)


@pytest.mark.parametrize("direct", [True, False])
@pytest.mark.parametrize("rule, value", [(shape.gain(0.7, at=0.5, channel="u1", output="y2"), 0.7),
                                         (shape.gain(high=-0.3, at=0.5, channel="u1", output="y2"), -0.3)])
def test_a_gain_is_the_slope_of_the_steady_state(rule, value, direct):
    program, a, c, bases, targets = system(direct=direct)
    free = solve(program)
    solution = solve(program.subject_to(rule))
    assert solution.status is Status.OPTIMAL
    slope = bases["u1"].slopes(np.array([0.5]))[0]

    def slopes(values):
        return np.sum(markov(a, c, values["Theta[u1]"], 3000), axis=0)[1] @ slope

    if rule.name.startswith("gain") and value < 0 and slopes(free.values) < value:
        assert slopes(solution.values) == pytest.approx(slopes(free.values), abs=1e-5)
    else:
        assert slopes(solution.values) == pytest.approx(value, abs=1e-5)


def test_a_point_and_a_monotone_curve_in_steady_state():
    program, a, c, bases, _ = system(3)
    solution = solve(program.subject_to(shape.through(0.5, 2.0, channel="u2", output="y1"),
                                        shape.monotone("increasing", channel="u1")))
    total = np.sum(markov(a, c, solution.values["Theta[u2]"], 3000), axis=0)[0]
    assert total @ bases["u2"].values(np.array([0.5]))[0] + solution.values["offset"][0] == pytest.approx(2, abs=1e-5)
    curve = np.sum(markov(a, c, solution.values["Theta[u1]"], 3000), axis=0) @ bases["u1"].values(bases["u1"].grid()).T
    assert np.min(np.diff(curve, axis=1)) > -1e-6


@pytest.mark.parametrize("sign, factor", [("positive", 1.0), ("negative", -1.0)])
@pytest.mark.parametrize("direct", [True, False])
def test_responses_keep_their_sign(sign, factor, direct):
    program, a, c, bases, _ = system(1, direct)
    solution = solve(program.subject_to(
        responses.step_response(sign, 30, channel="u1", output="y1"),
        responses.impulse_response(sign, 30, at=0.2, channel="u2", output="y2")))
    rise = np.diff(bases["u1"].values(np.array(bases["u1"].interval)), axis=0)[0]
    step = np.cumsum(markov(a, c, solution.values["Theta[u1]"], 31), axis=0)[:, 0] @ rise
    assert np.min(factor * step) > -1e-6 and np.max(np.abs(step)) > 1e-3
    impulse = markov(a, c, solution.values["Theta[u2]"], 31)[:, 1] @ bases["u2"].slopes(np.array([0.2]))[0]
    assert np.min(factor * impulse) > -1e-6


def test_an_input_without_effect_on_one_output_and_on_all():
    program, a, c, _, _ = system(2)
    solution = solve(program.subject_to(responses.no_effect("u1", "y2"), responses.no_effect("u2")))
    assert np.max(np.abs(markov(a, c, solution.values["Theta[u1]"], 40)[:, 1])) < 1e-7
    assert np.max(np.abs(solution.values["Theta[u2]"])) < 1e-8
    # with two outputs and all states observed from one of them, what is left of u1 is its feedthrough to the other
    assert np.max(np.abs(solution.values["Theta[u1]"][:, N])) > 1e-2


@pytest.mark.sampled(4)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("margin", [0.0, 0.5])
def test_positive_realness_is_that_of_the_frequency_response(seed, margin):
    program, a, c, _, targets = system(seed, functions=optid.Linear())
    constrained = program.subject_to(responses.positive_real(margin))
    solution = solve(constrained)
    assert solution.status is Status.OPTIMAL, solution.reason
    thetas = [solution.values[f"Theta[{name}]"] for name in INPUTS]
    least = _passivity(a, c, thetas)
    assert least > margin - 1e-6
    if _passivity(a, c, [targets[f"Theta[{name}]"] for name in INPUTS]) < margin - 1e-3:
        assert least == pytest.approx(margin, abs=2e-3)  # it binds, and no more than needed
    assert solution.values[f"P of {constrained.constraint_names[0]}"].shape == (N, N)


def _passivity(a, c, thetas):
    b, d = np.vstack([t[0, :N] for t in thetas]).T, np.vstack([t[0, N:] for t in thetas]).T
    found = []
    for w in np.linspace(0, np.pi, 2000):
        g = d + c @ np.linalg.solve(np.exp(1j * w) * np.eye(N) - a, b)
        found.append(np.min(np.linalg.eigvalsh(g + g.conj().T)) / 2)
    return min(found)


def test_contradictions_are_infeasible():
    program, *_ = system(0)
    solution = solve(program.subject_to(responses.no_effect("u1"), shape.gain(1.0, channel="u1", output="y1")))
    assert solution.status is Status.INFEASIBLE


def test_a_pole_at_one_has_no_static_gain():
    problem, _, c, _, _ = system(0)
    whole = replace(problem, facts={**problem.facts, "reference": {"A": np.eye(N), "C": c}})
    with pytest.raises(StructureError, match="pole at 1"):
        whole.subject_to(shape.gain(1.0, channel="u1", output="y1")).constraints()


@pytest.mark.parametrize("build, words", [
    (lambda view: shape.gain(1.0, channel="u1")(view), "needs output="),
    (lambda view: shape.gain(1.0, channel="u1", output="y9")(view), "no output 'y9'; the outputs are y1, y2"),
    (lambda view: responses.step_response(output="y1")(view), "needs channel="),
    (lambda view: responses.no_effect("u7")(view), "no input 'u7'"),
    (lambda view: responses.positive_real()(view), "one function for each"),
    (lambda view: responses.positive_real(-1.0), "must be nonnegative"),
    (lambda view: responses.step_response("up"), "'positive' or 'negative'"),
    (lambda view: responses.impulse_response(horizon=0), "at least one sample"),
    (lambda view: responses.no_effect("u")(View({}, channels=("u",))), "no such step"),
])
def test_bad_arguments(build, words):
    with pytest.raises(StructureError, match=words):
        system()[0].subject_to(build).constraints()


@pytest.mark.parametrize("word", ["step_response:positive,30", "impulse_response:negative", "no_effect:u1,y2",
                                  "positive_real", "gain:1.0,channel=u1,output=y2"])
def test_every_constraint_has_a_word(word):
    assert callable(named_constraint(word).build)

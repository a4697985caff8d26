"""A back end chosen automatically that gives no usable answer is replaced by the next of its class, and named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import optid
import optid.solving.solve
from optid.backends import Answer
from optid.backends.choice import choose
from optid.errors import SolverFailed
from optid.program.solution import Status


def level(samples=2000, seed=0):
    """Two tanks in series with time constants of 300 and 120 samples: a level that six lags describe nearly twice."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 1, samples // 300 + 1), 300)[:samples]
    b, a, _ = cont2discrete(([1.0], np.polymul([300.0, 1.0], [120.0, 1.0])), 1.0)
    return optid.Data(u, 0.5 + lfilter(b.ravel(), a, u) + 0.01 * rng.normal(size=samples))


def failing(program):
    back_end, why = choose(program)
    if back_end.name != "clarabel":
        return back_end, why
    return replace(back_end, run=lambda program, settings: Answer(Status.FAILED, "numbers ran out")), why


def test_another_back_end_solves_the_programmes_and_that_is_said_once(monkeypatch):
    data = level()
    expected = optid.fit(data, "oe.exact", na=2, nb=2, constraints=["stable:0.999"])
    monkeypatch.setattr(optid.solving.solve, "choose", failing)
    fit = optid.fit(data, "oe.exact", na=2, nb=2, constraints=["stable:0.999"])
    count = len(fit.steps)
    assert fit.figures["solver fallback"].startswith(f"clarabel gave no usable answer for {count} of {count} program")
    assert fit.solution.solver in optid.backends.choice.FALLBACKS and fit.solution.failed == "clarabel"
    assert fit.solution.objective == pytest.approx(expected.solution.objective, rel=1e-6)
    assert "solver fallback" not in expected.figures and str(fit).count("gave no usable answer") == 1


@pytest.mark.filterwarnings("ignore:the expanded regressor is poorly excited")
def test_a_level_with_many_lags():
    fit = optid.fit(level(), "oe.exact", na=6, nb=6, constraints=["stable:0.999"])
    assert fit.solution.status is Status.LOCAL and fit.simulation_fit[0] > 95


def test_a_solver_that_was_asked_for_is_not_replaced(monkeypatch):
    def run(program, settings):
        return Answer(Status.FAILED, "numbers ran out")

    with pytest.raises(SolverFailed, match="clarabel gave no usable answer .*numbers ran out"):
        optid.fit(level(), "oe.exact", na=2, nb=2, solver=replace(optid.backends.find("clarabel"), run=run))
    monkeypatch.setattr(optid.solving.solve, "choose", failing)
    monkeypatch.setattr(optid.backends.choice, "FALLBACKS", ())
    with pytest.raises(SolverFailed, match="clarabel gave no usable answer .*numbers ran out"):
        optid.fit(level(), "oe.exact", na=2, nb=2, constraints=["stable:0.999"])

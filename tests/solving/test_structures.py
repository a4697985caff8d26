"""Structures: one of a third party, with its solver and its certificate, is chosen, judged, proved and constrained."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize, nnls

import optid
from optid.backends import Answer, back_ends
from optid.errors import SolverRefused
from optid.program.solution import Status

pytestmark = pytest.mark.core


@pytest.fixture
def positive(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "third_party"))
    from optid_third_party import positive as theirs

    monkeypatch.setitem(back_ends(), "active_set", theirs.back_end)
    yield theirs
    for name in [name for name in sys.modules if name.startswith("optid_third_party")]:
        del sys.modules[name]


def record(seed=1):
    rng = np.random.default_rng(seed)
    u = rng.normal(size=300)
    y = np.convolve(u, [0.0, 1.0, 0.5, -0.2, 0.1])[:300] + 2.0 + 0.1 * rng.normal(size=300)
    return optid.Data(u=u, y=y, dt=1.0)


def test_auto_takes_the_method_of_a_structure_and_the_point_is_proved(positive):
    data = record()
    fit = optid.fit(data, positive.positive, length=5)
    assert fit.solution.solver == "active_set" and fit.solution.chosen == "active_set: positive"
    assert fit.solution.status is Status.OPTIMAL and fit.solution.bound.method == "strong convexity"
    u, y = data.experiments[0].u[:, 0], data.experiments[0].y[4:, 0]
    rows = np.array([u[k - 4 : k + 1][::-1] for k in range(4, 300)])
    expected, rest = nnls(np.column_stack([rows, np.ones(296), -np.ones(296)]), y)  # an independent route
    np.testing.assert_allclose(fit.solution.values["b"], expected[:5], atol=1e-9)
    assert fit.solution.objective == pytest.approx(rest**2, rel=1e-12)
    assert fit.solution.bound.value == pytest.approx(rest**2, rel=1e-9)


def test_a_claim_of_the_method_is_judged(positive):
    lying = replace(positive.back_end, run=lambda program, settings: Answer(
        Status.OPTIMAL, "optimal", {"b": np.full(5, 0.3), "offset": np.zeros(1)}, {"positive": np.zeros(5)}))
    solution = optid.solve(positive.positive(record(), length=5), lying)
    assert solution.status is Status.INACCURATE and not solution.proof


def test_constraints_that_the_method_does_not_take_go_to_another(positive):
    program = positive.positive(record(), length=5, constraints=(lambda v: {"small": v["b"] <= 0.7},))
    with pytest.raises(SolverRefused, match="active_set takes no further constraints .'small'.; .* class QP"):
        optid.solve(program, "active_set")
    bounded, free = optid.solve(program), optid.solve(positive.positive(record(), length=5))
    assert bounded.solver == "clarabel" and bounded.objective > free.objective
    assert np.max(bounded.values["b"]) <= 0.7 + 1e-7


@pytest.mark.filterwarnings("ignore:18 outliers")
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("solver", ["clarabel", "scs"])
def test_a_term_of_a_third_party_is_solved_and_judged(positive, seed, solver):
    from optid_third_party import huber

    data = record(seed)
    y = np.array(data.y)
    y[::17] += 40.0  # outliers
    bad = optid.Data(data.u, y, dt=1.0)
    fit = optid.fit(bad, huber.robust, length=5, threshold=0.3, solver=solver, accuracy=1e-9)
    assert fit.solution.status.value in ("optimal", "locally optimal") and fit.solution.residuals.stationarity < 1e-5
    x, problem = fit.solution.values, huber.robust(bad, length=5, threshold=0.3)
    (term,) = problem.terms

    def value(z):
        return term.value({"b": z[:5], "offset": z[5:]})

    found = minimize(value, np.concatenate([x["b"], x["offset"]]) + 0.1, method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(found.x[:5], x["b"], atol=1e-4)  # an independent route
    assert fit.solution.objective == pytest.approx(found.fun, rel=1e-6)
    np.testing.assert_allclose(x["b"], [0.0, 1.0, 0.5, -0.2, 0.1], atol=0.05)
    held = optid.fit(bad, huber.robust, length=5, threshold=0.3, solver=solver, accuracy=1e-9,
                     constraints=[lambda v: {"large": v["b"][1] <= 0.8}])
    rate = (optid.fit(bad, huber.robust, length=5, threshold=0.3, solver=solver, accuracy=1e-9, constraints=[
        lambda v: {"large": v["b"][1] <= 0.801}]).solution.objective - held.solution.objective) / 1e-3
    assert held.prices[0].multiplier == pytest.approx(-rate, rel=0.02)

"""Robust losses: equal to the raw-sample problems, bounded from below where they are convex."""

import cvxpy as cp
import numpy as np
import pytest
from problems import BASIS, dense, plant, raw_problem, record, regression
from refusals import refuses
from systems import by_hand

import optid
from optid.bases import Linear
from optid.errors import DataWarning, StructureError
from optid.identify.equation_error import reweighting as losses
from optid.identify.verdict import verdict


def soiled():
    """A record of a plant that is disturbed grossly in some samples; its outputs are read right."""
    rng = np.random.default_rng(3)
    u, noise = rng.uniform(-1, 1, (200, 1)), 0.3 * rng.standard_normal((200, 1))
    noise[::17] += 4
    return optid.Data(u=u, y=by_hand(plant(), u, noise=noise))


def threshold(fit, kind, number):
    """The width in units of the output, from the residuals of the pass in which the scale settled."""
    theta, layout = regression(fit, fit.steps[2][1]), fit.problem.compressed.layout
    phi, y = dense(soiled(), layout.na, layout.nb, layout.nk, fit.problem.compressed.bases)
    return number * np.median(np.abs(y - phi @ theta)) / 0.6745


def sizes(kind, width):
    if kind == "l1":
        return lambda r: cp.norm1(r)
    return lambda r: cp.sum(cp.huber(r, width))


CASES = [("huber", losses.HUBER), ("huber:0.7", 0.7), ("l1", 0.0)]


@pytest.mark.parametrize("loss, number", CASES)
def test_linear_arx_equals_the_raw_sample_problem(loss, number):
    fit = optid.fit(soiled(), "arx", na=2, nb=2, loss=loss)
    phi, y = dense(soiled(), 2, (2,), (0,), [Linear().with_interval(-1, 1)])
    value, _ = raw_problem(phi, y, 2, [(1, 2)], sizes(loss[:2], threshold(fit, loss, number)))
    assert fit.solution.objective == pytest.approx(value, rel=1e-7)
    assert value * (1 - 1e-6) <= fit.solution.bound.value <= value * (1 + 1e-8)
    assert fit.solution.proof


@pytest.mark.slow
@pytest.mark.parametrize("loss, number", CASES[:2])
def test_nuclear_equals_the_raw_sample_problem(loss, number):
    fit = optid.fit(soiled(), "hammerstein_arx.nuclear", na=2, nb=2, basis=BASIS, weight=3.0, loss=loss)
    phi, y = dense(soiled(), 2, (2,), (0,), [BASIS])
    value, (theta,) = raw_problem(phi, y, 2, [(6, 2)], sizes(loss[:2], threshold(fit, loss, number)), 3.0)
    assert fit.solution.objective == pytest.approx(value, rel=1e-6)
    assert np.allclose(fit.values["Theta"], theta, atol=1e-3)
    assert value * (1 - 1e-6) <= fit.solution.bound.value <= value * (1 + 1e-8)


@pytest.mark.slow
def test_l1_with_a_penalty_and_a_constraint_is_bounded_honestly(monkeypatch):
    monkeypatch.setattr(losses, "PASSES", 50)  # stopped early, the bound must hold all the same
    fit = optid.fit(soiled(), "hammerstein_arx.nuclear", na=2, nb=2, basis=BASIS, weight=1.0, loss="l1",
                    constraints=[lambda v: {"pole": v["a"][0] >= -1.1}])
    phi, y = dense(soiled(), 2, (2,), (0,), [BASIS])
    value, _ = raw_problem(phi, y, 2, [(6, 2)], cp.norm1, 1.0, lambda a, t, d: [a[0] >= -1.1])
    assert value * (1 - 1e-9) <= fit.solution.objective <= value * (1 + 2e-3)
    assert value * (1 - 2e-2) <= fit.solution.bound.value <= value * (1 + 1e-8)
    assert fit.solution.proof == (fit.solution.gap < 1e-6)


@pytest.mark.parametrize("loss", ["huber", "l1"])
def test_the_exact_form_says_that_it_has_no_proof(loss, monkeypatch):
    monkeypatch.setattr(losses, "PASSES", 40)
    fit = optid.fit(soiled(), na=2, nb=2, basis=BASIS, loss=loss)
    assert not fit.solution.proof and "no proof" in fit.solution.bound.reason
    assert fit.solution.status is optid.program.solution.Status.LOCAL


def test_the_exact_robust_objective_is_a_local_minimum_of_its_loss():
    fit = optid.fit(soiled(), na=2, nb=2, basis=BASIS, loss="huber")
    width = threshold(fit, "huber", losses.HUBER)
    phi, y = dense(soiled(), 2, (2,), (0,), [BASIS])

    def value(x):
        z = np.concatenate([x[:2], np.kron(x[8:10], x[2:8]), x[10:]])
        r = np.abs(y[:, 0] - phi @ z)
        return np.sum(np.where(r <= width, r**2, 2 * width * r - width**2))

    v = fit.values
    x = np.concatenate([v["a"], v["mu"], v["b"], v["offset"]])
    assert value(x) == pytest.approx(fit.solution.objective, rel=1e-9)
    slope = [(value(x + h) - value(x - h)) / 2e-6 for h in 1e-6 * np.eye(x.size)]
    assert np.max(np.abs(slope)) < 1e-4 * value(x)


def test_outliers_hurt_squares_more_than_robust_losses(monkeypatch):
    monkeypatch.setattr(losses, "PASSES", 40)
    rng, true = np.random.default_rng(1), plant()
    noise = 0.1 * rng.normal(size=(400, 1))
    noise[rng.choice(400, 20, replace=False)] += 6
    u = rng.uniform(-1, 1, (400, 1))
    soiled = optid.Data(u=u, y=by_hand(true, u, noise=noise))
    errors = {loss: np.abs(optid.fit(soiled, na=2, nb=2, basis=BASIS, loss=loss).model.a - true.a).max()
              for loss in ("squares", "huber", "l1")}
    assert errors["huber"] < errors["squares"] / 2
    assert errors["l1"] < errors["squares"] / 2


def test_one_step_fit_is_that_of_the_record_not_of_the_weights():
    data = soiled()
    fit = optid.fit(data, na=2, nb=2, basis=BASIS, loss="huber")
    p = fit.model.predict(data)[2:]
    y = data.y[2:]
    assert fit.one_step_fit[0] == pytest.approx(100 * (1 - np.linalg.norm(y - p) / np.linalg.norm(y - y.mean())))


def test_without_outliers_a_wide_huber_is_least_squares():
    data = record()
    plain = optid.fit(data, na=2, nb=2, basis=BASIS)
    wide = optid.fit(data, na=2, nb=2, basis=BASIS, loss="huber:50")
    assert wide.solution.objective == pytest.approx(plain.solution.objective, rel=1e-10)


@pytest.mark.parametrize("loss, words", [("hubr", "Did you mean 'huber'"), ("huber:x", "positive number"),
                                         ("huber:-1", "positive number"), ("huber:inf", "positive number"),
                                         ("l1:2", "only huber"), (3, "'3'|3")])
def test_unknown_losses(loss, words):
    refuses(StructureError, words, losses.parse_loss, loss)


CONTAMINATED = [("hammerstein_arx.exact", 1.0, False), ("hammerstein_arx.exact", 1e-6, True),
                ("hammerstein_arx.overparametrised", 1e6, True), ("arx", 1.0, True)]


@pytest.mark.sampled(3)
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
@pytest.mark.parametrize("formulation, unit, both_signs", CONTAMINATED)
@pytest.mark.parametrize("loss", ["huber", "l1"])
def test_outputs_read_wrong_cost_no_more_than_two_points(formulation, unit, both_signs, loss, monkeypatch):
    monkeypatch.setattr(losses, "PASSES", 15)
    structure = {"na": 2, "nb": 2} if formulation == "arx" else {"na": 2, "nb": 2, "basis": BASIS}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        pair = rng.uniform(0.3, 0.85) * np.exp(1j * rng.uniform(0.3, 2))
        true = plant(a=np.poly([pair, pair.conj()]).real[1:], b=rng.normal(size=2))
        clean, new = (record(0, 500, 0.1, seed=100 * seed + i, model=true) for i in range(2))
        y = clean.y.copy()
        places = rng.choice(500, 8, replace=False)
        y[places, 0] += 50 * (rng.choice([-1, 1], 8) if both_signs else 1)
        fits = []
        for part, word in ((clean.y, "squares"), (y, loss)):
            read = optid.Data(u=clean.u, y=unit * part)
            model = optid.fit(read, formulation, loss=word, prove=False, **structure).model
            for shown in (model.predict(optid.Data(u=new.u, y=unit * new.y))[4:], model.simulate(new.u)[4:]):
                misfit = unit * new.y[4:] - shown.reshape(-1, 1)
                fits.append(100 * (1 - np.linalg.norm(misfit) / np.linalg.norm(unit * (new.y - new.y.mean()))))
        assert fits[2] > fits[0] - 2 and fits[3] > fits[1] - 2, (seed, fits)


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_readings_left_out_are_named_and_squares_keeps_them():
    data = record(noise=0.3, count=400, seed=2)
    y = data.y.copy()
    y[[40, 90, 91, 250]] += 60
    y[300] += 4  # within the scatter of the output, far outside that of the residuals
    wild = optid.Data(u=data.u, y=y)
    plain = optid.fit(wild, na=2, nb=2, basis=BASIS)
    robust = optid.fit(wild, na=2, nb=2, basis=BASIS, loss="huber")
    assert plain.figures["rows"] == 398 and "marked" not in plain.findings[0] and "NaN" in plain.findings[0]
    assert robust.figures["rows"] == 398 - 3 - 4 - 3 - 3
    assert str(robust.figures["outliers of y"]) == "samples 40, 90, 91, 250"
    assert robust.findings[0].endswith("leaves out every row that contains one, as output or as past output")
    assert robust.findings[1].startswith("outliers by the residuals of y, sample 300, were left out")
    # the verdict is that of the same model on the record without them
    clean = y.copy()
    clean[[40, 90, 91, 250, 300]] = np.nan
    assert str(robust.verdict) == str(verdict(robust.model, optid.Data(u=data.u, y=clean)))
    assert robust.verdict.score > plain.verdict.score + 10


def test_a_disturbance_of_the_plant_is_no_wrong_reading():
    rng, true = np.random.default_rng(4), plant()
    noise = 0.1 * rng.normal(size=(400, 1))
    noise[rng.choice(400, 12, replace=False)] += 2
    u = rng.uniform(-1, 1, (400, 1))
    fit = optid.fit(optid.Data(u=u, y=by_hand(true, u, noise=noise)), na=2, nb=2, basis=BASIS, loss="huber")
    assert fit.findings == () and fit.figures["rows"] == 398


def test_several_outputs_leave_out_the_rows_of_each():
    rng = np.random.default_rng(5)
    u = rng.uniform(-1, 1, (600, 1))
    first, second = (by_hand(plant(gain), u, noise=0.1 * rng.normal(size=(600, 1))) for gain in (1.0, -0.5))
    y = np.hstack([first, second])
    y[[50, 300], 0] = 999
    y[[77, 301], 1] = -999
    with pytest.warns(DataWarning, match="leaves out every row"):
        fit = optid.fit(optid.Data(u=u, y=y), "arx", na=2, nb=2, loss="huber")
    assert fit.figures["rows"] == 598 - 3 - 3 - 4
    assert str(fit.figures["outliers of y2"]) == "samples 77, 301"

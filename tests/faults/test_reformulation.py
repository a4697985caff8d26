"""Reformulation: refits against a dense oracle, filters against Riccati, allocation against other solvers, refusals."""

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fault_plants import levels, noisy, refused, standard
from scipy.optimize import lsq_linear

from formulations.constraints.shape import monotone
from formulations.faults.refit import actuator, parameters
from optid import Data
from optid.bases import Polynomial, Triangular
from optid.core.statement import class_of, for_solvers
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.faults import (
    Certificate,
    Diagnosis,
    Estimate,
    Fault,
    FaultAnswer,
    RefitPrior,
    allocate,
    conditional_mean,
    dictionary,
    inject,
    inverse,
    observer,
    predictor,
    probe_input,
    reformulate,
    subspace_projection,
    trajectory,
)
from optid.faults.repair.damage import Damage
from optid.faults.repair.refitting import refitting
from optid.models import Nonlinearity
from optid.solving.solve import run, solve

ONSET, COUNT = 80, 140


def plant(m=2):
    """Two inputs, two outputs, triangular nonlinearities: nothing from files."""
    A = np.array([[0.8, 0.2, 0.0], [-0.2, 0.8, 0.1], [0.0, 0.0, 0.5]])
    B = np.array([[1.0, 0.2, 0.3], [0.3, -0.8, -0.7], [0.5, 0.6, 0.4]])[:, :m]
    C = np.array([[1.0, 0.0, 0.4], [0.2, 1.0, -0.3]])
    D = np.array([[0.1, 0.0, 0.0], [0.0, 0.05, 0.0]])[:, :m]
    basis = Triangular(6, (-1.2, 1.2))
    shapes = [lambda u: u + 0.25 * u**3, lambda u: np.tanh(1.5 * u) + 0.15 * u, lambda u: 0.9 * u][:m]
    functions = tuple(Nonlinearity(basis, np.delete(f(basis.nodes), 3)) for f in shapes)
    return noisy(A, B, C, 4e-4 * np.eye(3), 1e-3 * np.eye(2), D=D, nonlinearities=functions)


@pytest.fixture(scope="module")
def healthy():
    return plant()


@pytest.fixture(scope="module")
def faults(healthy):
    kinds = ["bias", "loss", "stuck", "frozen", "noise"]
    return dictionary(healthy, kinds=kinds, process={"load": [0.3, 0.2, -0.1]})


def estimate(faults, label, size, half=0.1, onset=ONSET):
    c, size = faults[label], np.atleast_1d(np.asarray(size, dtype=float))
    interval = np.stack([size - half, size + half], axis=1)
    return Estimate(c.label, c.name, c.kind, c, onset, (onset, onset), False, size, interval, np.eye(size.size), 20.0)


def diagnosis(model, *answers, verdict="faulty"):
    proof = Certificate("exhaustive", 10.0)
    best = answers[0] if answers else None
    return Diagnosis(
        verdict, bool(answers), best, answers, 1e-3, proof, {}, COUNT, 0.01, 0.95, "exact", "", model.title,
        model.outputs)


def answer(*estimates, posterior=1.0):
    return FaultAnswer(estimates, posterior, 10.0)


def clean_outputs(model, count, seed):
    """A record and the outputs without their noise."""
    u = levels(count, seed)
    told = trajectory(model, u, seed=seed)
    return Data(u, told.y), told.x @ model.C.T + model.expand_inputs(u) @ model.D.T


def broken_record(model, fault, seed=0, count=COUNT):
    u = levels(count, seed, m=model.m)
    return Data(u, inject(model, u, fault, seed=seed, process={"load": [0.3, 0.2, -0.1]}))


def simulated_fit(model, truth, seed=99):
    u = levels(800, seed, m=model.m)
    y = truth.simulate(u)
    return 100 * (1 - np.linalg.norm(y - model.simulate(u)) / np.linalg.norm(y - y.mean(axis=0)))


def exchanged(model, column, function):
    functions = [function if i == column else f for i, f in enumerate(model.nonlinearities)]
    return replace(model, nonlinearities=tuple(functions))


def without(model, column):
    return exchanged(model, column, Nonlinearity(Triangular(1, (-1.2, 1.2)), np.zeros(1)))


def scaled(model, column, share):
    f = model.nonlinearities[column]
    return exchanged(model, column, replace(f, mu=share * f.mu))


def with_feedback(model):
    g = Nonlinearity(Triangular(2, (-9, 9), "extrapolate"), np.array([0.9, 2.7]))
    return replace(model, E=np.array([[0.05], [0.0], [-0.1]]), feedback=(g,), output_of=(1,))


TURNING = Nonlinearity(Polynomial(3, (-1.2, 1.2)), np.array([0.2, 0.0, 1.0]))


def reformulated(model, faults, label, size, data, **how):
    """The reformulation after one answer of a diagnosis."""
    return reformulate(model, diagnosis(model, answer(estimate(faults, label, size))), data, **how)


def damaged(column, offsets=(), onset=ONSET):
    """Damage of one of the two actuators of the standard plant, of three states, and additions to it."""
    return Damage("", 1.0, onset, True, (column,), (), (), offsets, {}, np.zeros((3, 3)), np.ones(2), np.zeros(2),
                  np.zeros(3), ())


def test_the_state_before_the_fault_is_that_of_the_predictor(healthy):
    model = replace(with_feedback(healthy), L=np.array([[0.1, 0.0], [0.0, -0.1], [0.05, 0.1]]))
    data = broken_record(model, Fault.loss("actuator:u1", 300, 0.5), count=360)
    y = data.y.copy()
    y[150, 0] = np.nan  # corrects nothing, and is interpolated where it is fed back
    window = refitting(model, Data(data.u, y), damaged(0, onset=300)).windows[0]
    steady, f, x = predictor(model), model.expand_inputs(data.u), np.zeros(3)
    filled = y.copy()
    filled[150, 0] = (y[149, 0] + y[151, 0]) / 2
    for k in range(300):
        e = np.nan_to_num(y[k] - model.C @ x - model.D @ f[k] - model.offset_y)
        state, x = x, (model.A @ x + model.B @ f[k] + model.offset_x + model.L @ filled[k]
                       + model.E[:, 0] * float(model.feedback[0](filled[k, 1])) + steady.K @ e)
    assert window.held and np.allclose(window.x0, state, atol=1e-8) and np.allclose(window.e0, e, atol=1e-8)


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("hidden", [False, True])
def test_sensitivities_are_those_of_finite_differences(healthy, faults, whole, hidden):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5))
    if hidden:
        y = np.array(data.y)
        y[ONSET + 4 : ONSET + 9, 0] = np.nan
        y[ONSET + 7] = np.nan
        data = Data(data.u, y)
    load = replace(faults["process:load"], kind="bias")
    problem = refitting(healthy, data, damaged(1, offsets=(load,)), whole=whole)
    theta = problem.start + 0.02 * np.random.default_rng(0).standard_normal(problem.start.size)
    r, s = problem.linearise(theta)
    assert r.size == problem.readings
    eye = 1e-6 * np.eye(problem.start.size)
    moved = [(problem.linearise(theta + e)[0] - problem.linearise(theta - e)[0]) / 2e-6 for e in eye]
    assert np.abs(np.stack(moved, axis=1) - s).max() < 1e-6 * np.abs(s).max()


def test_refit_equals_regularised_least_squares_where_no_rule_binds(healthy):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.4), count=400)
    problem = refitting(healthy, data, damaged(1))
    found = run(actuator(problem, constraints=[]))
    r, s = problem.linearise(problem.start)
    curve, half = problem.curves[0], problem.curves[0].half_range
    second = np.diff(np.eye(7), n=2, axis=0) / (0.2 * half)
    rows = np.vstack([
        np.column_stack([s, np.zeros(len(s))]), np.column_stack([curve.to_nodes / (0.5 * half), np.zeros(7)]),
        np.column_stack([second @ curve.to_nodes, second @ curve.healthy])])
    wanted = np.concatenate([s @ problem.start - r, curve.healthy / (0.5 * half), second @ curve.healthy])
    expected = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    assert 0 < expected[-1] < 1
    assert found.model.theta == pytest.approx(expected[:-1], abs=1e-6)
    assert found.model.lost["u2"] == pytest.approx(expected[-1], abs=1e-6)
    assert found.solution.proof


def test_evidence_is_the_density_of_the_record(healthy):
    from scipy.stats import multivariate_normal

    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.4), count=ONSET + 12)
    found = []
    for curvature in (0.02, 0.1, 0.5):
        problem = refitting(healthy, data, damaged(1), prior=RefitPrior(curvature=curvature))
        r, s = problem.linearise(problem.start)
        rows, wanted = problem.prior_rows()
        rows, wanted = np.vstack([rows, 2 * np.eye(8)[7:]]), np.append(wanted, 1.0)
        spread = np.linalg.inv(rows.T @ rows)
        full = np.column_stack([s, np.zeros(len(s))])
        mean = full @ spread @ rows.T @ wanted
        density = multivariate_normal(mean, np.eye(len(s)) + full @ spread @ full.T).logpdf(s @ problem.start - r)
        found.append(problem.evidence() - density)
    assert found == pytest.approx([found[0]] * 3, abs=1e-6)


@pytest.mark.parametrize("solver", ["clarabel", "osqp", "daqp", "ipopt"])
def test_refit_is_the_same_by_any_back_end(healthy, solver):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5), seed=1, count=ONSET + 10)
    problem = refitting(healthy, data, damaged(1))
    stated = actuator(problem)
    assert class_of(for_solvers(stated)) == "QP"
    found, other = solve(stated, solver), solve(stated, "piqp")
    assert found.objective == pytest.approx(other.objective, rel=1e-5)


def test_rules_hold_and_binding_ones_are_named(healthy):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5), seed=1, count=ONSET + 6)
    found = run(actuator(refitting(healthy, data, damaged(1))))
    mu = np.insert(found.model.model.nonlinearities[1].mu, 3, 0.0)
    before = np.insert(healthy.nonlinearities[1].mu, 3, 0.0)
    assert np.all(np.diff(mu) >= -1e-7) and np.all(np.diff(mu) <= np.diff(before) + 1e-7)
    again = run(actuator(refitting(healthy, data, damaged(1)), constraints=["monotone:increasing"]))
    assert again.model.model.nonlinearities[1].mu.shape == (6,)
    alone = run(actuator(refitting(healthy, data, damaged(1)), constraints="monotone:increasing"))
    assert np.array_equal(alone.model.model.nonlinearities[1].mu, again.model.model.nonlinearities[1].mu)
    with pytest.raises(LookupFailed, match="'defaults'"):
        actuator(refitting(healthy, data, damaged(1)), constraints="defaults")
    assert run(actuator(refitting(healthy, data, damaged(1)), constraints=[monotone("increasing")])).model


@pytest.mark.slow
def test_refit_beats_the_healthy_model_and_the_wrong_part(healthy):
    fits = {"right": [], "wrong": [], "healthy": []}
    for seed in range(4):
        data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.6), seed=seed, count=ONSET + 30)
        truth = scaled(healthy, 1, 0.4)
        for word, column in (("right", 1), ("wrong", 0)):
            model = run(actuator(refitting(healthy, data, damaged(column)))).model.model
            fits[word].append(simulated_fit(model, truth))
        fits["healthy"].append(simulated_fit(healthy, truth))
    assert np.median(fits["right"]) > 95 > np.median(fits["healthy"]) > np.median(fits["wrong"])


@pytest.mark.slow
def test_all_parameters_overtake_when_the_healthy_model_is_off(healthy, faults):
    rng = np.random.default_rng(5)
    off = replace(healthy, **{name: getattr(healthy, name) * (1 + 0.03 * rng.standard_normal(getattr(
        healthy, name).shape)) for name in "ABC"})
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5), count=900)
    found = reformulated(off, faults, "actuator:u2 loss", 0.5, data)
    assert found.schedule.stage == "all with prior"
    assert found.schedule.held_out["all with prior"] < found.schedule.held_out["affected only"]
    narrow = reformulated(off, faults, "actuator:u2 loss", 0.5, data, stage="affected only")
    truth = scaled(healthy, 1, 0.5)
    assert simulated_fit(found.model, truth) > simulated_fit(narrow.model, truth)


def test_gauss_newton_ends_at_a_stationary_point(healthy):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5), count=300)
    problem = refitting(healthy, data, damaged(1), whole=True, prior=RefitPrior(healthy=0.05))
    found = run(parameters(problem, constraints=[]), prove=False)
    r, s = problem.linearise(found.model.theta)
    rows, wanted = problem.prior_rows()
    z = np.append(found.model.theta, found.model.lost["u2"])
    gradient = s.T @ r + (rows.T @ (rows @ z - wanted))[:-1]
    size = np.sqrt(np.sum(s**2, axis=0) + np.sum(rows[:, :-1] ** 2, axis=0))
    a = problem.slices["A"]
    assert np.abs(gradient[a]).max() < 1e-3 * size[a].max() * np.sqrt(r.size)


def test_a_dead_actuator_is_one_constant_and_moves_nothing(healthy, faults):
    data = broken_record(healthy, Fault.stuck("actuator:u1", ONSET, 0.5), count=ONSET + 40)
    value = float(healthy.nonlinearities[0](0.5))
    found = reformulated(healthy, faults, "actuator:u1 stuck", [1.0, value], data)
    assert found.members[0].damage.dead == (0,)
    assert not found.model.nonlinearities[0].mu.any()
    assert found.schedule.values[0].values == pytest.approx(np.full(7, value), abs=0.1)
    assert found.allocation.moving == ("u2",)
    assert found.allocation.route == "qp"


def test_healthy_is_the_identity(healthy):
    found = reformulate(healthy, diagnosis(healthy, verdict="healthy"), broken_record(healthy, ()))
    assert found.model is healthy and found.status == "healthy" and found.if_ambiguous is None
    assert "as it was" in str(found)


def test_too_few_samples_name_the_least_number_and_fall_back(healthy, faults):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5), count=ONSET + 3)
    unsure = replace(estimate(faults, "actuator:u2 loss", 0.5), size=np.array([np.nan]))
    with pytest.warns(DataWarning, match="at least 4 samples"):
        found = reformulate(healthy, diagnosis(healthy, answer(unsure)), data, nodes=5)  # f has seven of its own
    assert found.status == "as diagnosed" and found.schedule.stage == "prior" and found.schedule.least == 4
    assert found.model.nonlinearities[1].mu == pytest.approx(healthy.nonlinearities[1].mu)
    assert not refitting(healthy, broken_record(healthy, (), count=ONSET + 5), damaged(1)).shortage


@pytest.mark.parametrize("still", [False, True])
def test_values_that_no_sample_visits_are_prior_only(healthy, faults, still):
    u = np.clip(levels(COUNT, 3), -0.35, 0.35)
    if still:
        u[ONSET - 1 :, 1] = 0.1
    data = Data(u, inject(healthy, u, Fault.loss("actuator:u2", ONSET, 0.5), seed=3))
    with pytest.warns(DataWarning, match="prior only"):
        found = reformulated(healthy, faults, "actuator:u2 loss", 0.5, data)
    one = found.schedule.values[0]
    assert one.prior_only.tolist() == [True, True, still, False, False, True, True]
    assert one.seen[0] >= -0.35 and "prior only" in str(found)
    assert one.std[0] > 3 * one.std[3] and (one.excitation < 1e-3) == still


def test_a_lost_unstable_mode_is_named():
    A = np.diag([1.05, 0.5])
    unstable = noisy(A, np.eye(2), np.eye(2), 1e-3 * np.eye(2), 1e-3 * np.eye(2),
                     nonlinearities=(Nonlinearity(Triangular(2, (-1, 1)), np.array([-1.0, 1.0])),) * 2)
    with pytest.raises(StructureError, match=r"Without sensor y1 the mode at 1.05 .*state x1.*not detectable"):
        observer(unstable, ["y1"])
    assert observer(unstable, ["sensor:y2"]).lost == ("y2",)
    with pytest.raises(StructureError, match=r"Without actuator u1 the mode at 1.05 .*not stabilisable"):
        allocate(without(unstable, 0), low=-1, high=1)
    allocate(without(unstable, 1), low=-1, high=1)
    faults = dictionary(unstable, kinds=["bias", "loss"], state_jump=False)
    for label, size, words in (("sensor:y1", 0.5, "not detectable"), ("actuator:u1 loss", 1.0, "not stabilisable")):
        with pytest.raises(StructureError, match=words):
            reformulated(unstable, faults, label, size, None)


def test_what_does_not_fit_is_refused_by_name(healthy, faults):
    good, data = diagnosis(healthy, answer(estimate(faults, "actuator:u2 loss", 0.5))), broken_record(healthy, ())
    u = np.array(data.u)
    u[ONSET + 10, 0] = np.nan
    refused(
        *((StructureError, verdict, lambda v=verdict: reformulate(healthy, diagnosis(healthy, verdict=v)))
          for verdict in ("unknown", "untestable", "not isolable")),
        (DataError, "outputs a, b", lambda: reformulate(healthy, replace(good, outputs=("a", "b")), data)),
        (StructureError, "no diagnosis", lambda: reformulate(healthy, "d.json", data)),
        (StructureError, "Several diagnoses", lambda: reformulate(healthy, (good, good), data)),
        (DataError, "no column 'u1'", lambda: reformulate(healthy, good, data.y)),
        (DataError, "beyond the record", lambda: reformulate(healthy, good, Data(data.u[:50], data.y[:50]))),
        *((StructureError, next(iter(wrong)), lambda w=wrong: reformulate(healthy, good, data, **w)) for wrong in (
            {"stage": "everything"}, {"nodes": 2}, {"if_ambiguous": "maybe"}, {"low": [-1.0, -1.0, -1.0]})),
        (DataError, f"Sample {ONSET + 10} lacks an input", lambda: reformulate(healthy, good, Data(u, data.y))),
        (StructureError, "positive", lambda: RefitPrior(damaged=0)),
        (LookupFailed, "y9", lambda: observer(healthy, ["y9"])),
        *((StructureError, words, lambda how=how: allocate(healthy, **how)) for how, words in (
            ({"low": 1.0, "high": 0.0}, "empty"), ({"weights": [1.0, -1.0]}, "positive"),
            ({"route": "magic"}, "route"), ({"norm": np.eye(3), "limit": 1.0}, "norm of shape"))),
        *((StructureError, "reference", lambda r=r: allocate(healthy).attainable(r)) for r in ([1.0], [1.0, np.nan])))


def test_the_filter_is_as_good_as_it_predicts(healthy):
    for lost, name in enumerate(healthy.outputs):
        filtered = observer(healthy, [name])
        record, clean = clean_outputs(healthy, 6000, 11)
        y = np.array(record.y)
        y[1:, lost] = np.nan
        error = (filtered.estimate(Data(record.u, y)) - clean)[50:, lost]
        assert np.sqrt(np.mean(error**2)) == pytest.approx(filtered.rmse[name], rel=0.06)
        assert filtered.rmse[name] < filtered.open_loop[name]
        assert np.array_equal(filtered.estimate(record), filtered.estimate(Data(record.u, y)))
        assert observer(healthy).rmse[name] < filtered.rmse[name]


def test_sensors_learnt_from_healthy_data(healthy):
    record, _ = clean_outputs(healthy, 3000, 12)
    later, clean = clean_outputs(healthy, 1500, 13)
    bound = observer(healthy, ["y1"]).rmse["y1"]
    for learn in (conditional_mean, subspace_projection):
        learnt = learn(healthy, record, ["y1"])
        error = np.sqrt(np.nanmean((learnt.estimate(later)[:, 0] - clean[:, 0]) ** 2))
        assert bound * 0.95 < error < 3 * bound
        if learn is conditional_mean:
            assert error < 1.15 * bound and learnt.rmse["y1"] == pytest.approx(error, rel=0.2)
    short = Data(record.u[:60], record.y[:60])
    refused((DataError, "healthy samples are needed", lambda: conditional_mean(healthy, short, ["y1"])),
            (LookupFailed, "u1", lambda: conditional_mean(healthy, record, ["u1"])))


def test_a_broken_sensor_leaves_the_plant_and_is_not_used(healthy, faults):
    data = broken_record(healthy, Fault.step("sensor:y2", ONSET, 0.4))
    found = reformulated(healthy, faults, "sensor:y2", 0.4, data)
    assert found.observer.lost == ("y2",) and found.schedule is None
    assert np.array_equal(found.model.B, healthy.B) and "0.4" in " ".join(found.notes)
    noisy_one = reformulated(healthy, faults, "sensor:y2 noise", 0.3, data)
    assert noisy_one.observer.lost == () and noisy_one.model.noise.R[1, 1] == pytest.approx(1e-3 + 0.09)
    assert noisy_one.observer.rmse["y2"] > observer(healthy).rmse["y2"]


def test_a_load_is_estimated_and_added(healthy, faults):
    data = broken_record(healthy, Fault.step("process:load", ONSET, 0.5), count=ONSET + 60)
    found = reformulated(healthy, faults, "process:load", 0.4, data, stage="affected only")
    assert found.model.offset_x == pytest.approx(0.5 * np.array([0.3, 0.2, -0.1]), abs=0.03)


@pytest.mark.parametrize("seed", range(6))
def test_the_inverse_undoes_any_monotone_nonlinearity(seed):
    rng = np.random.default_rng(seed)
    sign = 1 if seed % 2 else -1
    values = np.cumsum(rng.uniform(0.05, 1.0, 9)) * sign
    basis = Triangular(8, (-1.0, 2.0))
    f = Nonlinearity(basis, np.delete(values - values[basis.dropped], basis.dropped))
    one = inverse(f, -0.9, 1.7)
    v = rng.uniform(one.v_low, one.v_high, 200)
    assert not one.refused and one.message == ""
    assert f(one(v)) == pytest.approx(v, abs=1e-10 * (one.v_high - one.v_low))
    assert np.all((one([-1e9, 1e9]) >= -0.9) & (one([-1e9, 1e9]) <= 1.7))


def test_no_inverse_where_flat_or_turning_back():
    flat = Nonlinearity(Triangular(6, (-1.2, 1.2)), np.array([-1.0, -0.5, 0.0, 0.0, 0.5, 0.9]))
    one = inverse(flat, -1.2, 1.2)
    assert not one.turns and one.refused[0] == pytest.approx((-0.4, 0.4))
    assert "flat" in one.message and one(0.0, near=0.3) == pytest.approx(0.3)
    back = inverse(TURNING, -1, 1)
    assert back.turns and "turns back" in back.message
    assert TURNING(back(np.array([-0.3, 0.1]))) == pytest.approx([-0.3, 0.1], abs=1e-9)
    with pytest.raises(StructureError, match="empty"):
        inverse(flat, 1.0, 1.0)


def test_allocation_falls_back_to_the_nlp_with_a_message(healthy):
    odd = exchanged(healthy, 1, TURNING)
    with pytest.warns(DataWarning, match=r"u2: no inverse on \[.*turns back.*NLP route"):
        found = allocate(odd)
    assert found.route == "nlp"
    # f takes every value between its extremes, so that the programme in v knows the optimum
    exact = allocate(odd, route="qp")
    for reference in ([0.5, 0.1], [3.0, -4.0]):
        assert found.attainable(reference).distance == pytest.approx(exact.attainable(reference).distance, abs=2e-3)
    saturated = Nonlinearity(Triangular(6, (-1.2, 1.2)), np.array([-0.9, -0.9, -0.45, 0.45, 0.9, 0.9]))
    with pytest.warns(DataWarning, match="is flat there.*NLP route"):
        allocate(exchanged(healthy, 1, saturated))


@pytest.mark.parametrize("seed", range(5))
def test_targets_against_bounded_least_squares(healthy, seed):
    found = allocate(healthy, weights=[1.0, 2.0])
    r = np.random.default_rng(seed).normal(0, 4, 2)
    member = found.members[0]
    base = member.rest_output(np.zeros(2))
    exact = lsq_linear(np.array([[1.0], [2.0]]) * member.gain(), np.array([1.0, 2.0]) * (r - base),
                       (found.v_low, found.v_high))
    target = found.attainable(r)
    assert target.distance == pytest.approx(np.sqrt(2 * exact.cost), abs=1e-5)
    assert target.reachable == (exact.cost < 1e-8)
    if not target.reachable:
        assert target.limiting and str(target).count("limited by actuator:")
        name, price = next(iter(target.limiting.items()))  # the price is what moving the bound is worth
        i = found.names.index(name)
        at_top = target.v[i] > found.v_middle[i]
        low, high = np.array(found.v_low), np.array(found.v_high)
        (high if at_top else low)[i] += 1e-4 if at_top else -1e-4
        moved = replace(found, v_low=low, v_high=high).attainable(r)
        assert (target.distance - moved.distance) / 1e-4 == pytest.approx(price, rel=0.05, abs=1e-3)


@pytest.mark.slow
def test_unreachable_targets_are_never_clipped_silently(healthy):
    dead = without(healthy, 0)
    target = allocate(dead).attainable([2.0, 2.0])
    assert not target.reachable and target.distance > 0.1 and "actuator:u1" in target.limiting
    assert "cannot be reached" in str(target)


def test_corners_bound_what_can_be_held():
    for m in (2, 3):
        found = allocate(plant(m))
        corners = found.corners()
        assert len(corners) == 2 * m
        rng = np.random.default_rng(0)
        for _ in range(20):
            v = rng.uniform(found.v_low, found.v_high)
            y = found.members[0].rest_output(v)
            edges = np.roll(corners, -1, axis=0) - corners
            sides = edges[:, 0] * (y - corners)[:, 1] - edges[:, 1] * (y - corners)[:, 0]
            assert np.all(sides >= -1e-9) or np.all(sides <= 1e-9)
        for corner in corners:
            assert found.attainable(corner).distance < 1e-3


@pytest.mark.slow
def test_the_nlp_agrees_with_the_problem_in_v(healthy):
    smooth = replace(healthy, nonlinearities=tuple(
        Nonlinearity(Polynomial(3, (-1.2, 1.2)), mu) for mu in (np.array([1.4, 0.0, 0.2]), np.array([1.0, 0.0, -0.1]))))
    for r in ([0.5, -0.2], [3.0, 2.0]):
        qp, nlp = allocate(smooth).attainable(r), allocate(smooth, route="nlp").attainable(r)
        assert qp.u == pytest.approx(nlp.u, abs=1e-4) and qp.distance == pytest.approx(nlp.distance, abs=1e-5)


@pytest.mark.parametrize("kind", ["turning", "feedback"])
def test_any_nlp_back_end_takes_the_problem_in_u_and_its_point_is_the_plants(healthy, kind):
    model = exchanged(healthy, 1, TURNING) if kind == "turning" else with_feedback(healthy)
    goal = allocate(model, route="nlp").attainable([0.3, 0.1])
    assert goal.reachable and goal.y == pytest.approx(model.equilibrium(goal.u)[1], abs=1e-6)
    for solver in ("ipopt", "uno", "fatrop"):
        other = allocate(model, route="nlp", solver=solver).attainable([0.3, 0.1])
        assert other.solution.solver == solver and other.solution.residuals.violation < 1e-6
        assert other.reachable and other.y == pytest.approx(goal.y, abs=1e-6)


def test_shared_limits_hold(healthy):
    shared = allocate(healthy, limit=0.6)
    target = shared.attainable([1.0, 1.0])
    assert np.linalg.norm(target.v) <= 0.6 + 1e-6
    limited = allocate(healthy, limit=0.6, route="nlp").attainable([1.0, 1.0])
    assert np.linalg.norm(limited.v) <= 0.6 + 1e-6 and limited.distance == pytest.approx(target.distance, abs=1e-4)


def test_the_model_stays_healthy_while_several_answers_are_left(healthy, faults):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5))
    several = diagnosis(healthy, answer(estimate(faults, "actuator:u2 loss", 0.5), posterior=0.7),
                        answer(estimate(faults, "sensor:y2", 0.2), posterior=0.25))
    found = reformulate(healthy, several, data)
    assert found.status == "ambiguous" and found.model is healthy and len(found.members) == 2
    assert found.observer.lost == ("y2",)
    assert found.if_ambiguous.labels == ("actuator:u2 loss", "sensor:y2")
    assert not np.array_equal(found.members[0].model.nonlinearities[1].mu, healthy.nonlinearities[1].mu)
    assert "advice: wait" in str(found) and max(map(len, str(found).splitlines())) <= 80
    for action in ("robust", "probe", "wait"):
        assert reformulate(healthy, several, data, if_ambiguous=action).if_ambiguous.action == action
    probed = reformulate(healthy, several, data, if_ambiguous="probe", low=-0.5, high=[0.4, 0.6]).if_ambiguous.probe
    assert np.all((probed.u == -0.5) | (probed.u == [0.4, 0.6]))


def test_kinds_of_one_part_are_one_explanation(healthy, faults):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5))
    kinds = diagnosis(healthy, answer(estimate(faults, "actuator:u2 loss", 0.5), posterior=0.6),
                      answer(estimate(faults, "actuator:u2 stuck", [0.5, 0.0]), posterior=0.35))
    found = reformulate(healthy, kinds, data)
    assert found.status == "refitted" and found.members[0].damage.posterior == pytest.approx(0.95)


def test_robust_control_is_the_best_for_the_worst_member(healthy, faults):
    several = diagnosis(healthy, answer(estimate(faults, "actuator:u2 loss", 0.6), posterior=0.5),
                        answer(estimate(faults, "actuator:u1 loss", 0.5), posterior=0.5))
    robust = reformulate(healthy, several).if_ambiguous.robust
    r = np.array([1.0, 0.5])
    target = robust.attainable(r)

    def worst(v):
        return max(np.linalg.norm(m.rest_output(v) - r) for m in robust.members)

    assert target.distance == pytest.approx(worst(target.v), abs=1e-9)
    rng = np.random.default_rng(0)
    grid = rng.uniform(robust.v_low, robust.v_high, (4000, 2))
    near = target.v + 0.05 * rng.standard_normal((500, 2))
    near = np.clip(near, robust.v_low, robust.v_high)
    assert min(worst(v) for v in np.vstack([grid, near])) >= target.distance - 1e-4
    assert target.u.shape == (2,) and np.all(np.abs(target.u) <= 1.2)


def test_a_probe_separates_more_than_chance_and_less_than_its_bound(healthy, faults):
    pair = [answer(estimate(faults, "actuator:u2 loss", 0.3)), answer(estimate(faults, "actuator:u1 loss", 0.2))]
    probe = probe_input(healthy, pair, length=20)
    assert probe.ordinary < probe.separation <= probe.bound * (1 + 1e-9)
    # the distance is that of the signatures
    signatures = [faults.signature("actuator:u2 loss", 20, 0, probe.u)[..., 0] * 0.3,
                  faults.signature("actuator:u1 loss", 20, 0, probe.u)[..., 0] * 0.2]
    assert np.linalg.norm(signatures[0] - signatures[1]) == pytest.approx(probe.separation, rel=1e-6)
    still = [answer(estimate(faults, "actuator:u1", 0.3)), answer(estimate(faults, "process:load", 1.0))]
    refused((StructureError, "nothing that an input changes", lambda: probe_input(healthy, still)),
            (StructureError, "at least two", lambda: probe_input(healthy, pair[:1])))


def test_printing_drawing_and_the_page(healthy, faults, tmp_path):
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5))
    both = answer(estimate(faults, "actuator:u2 loss", 0.5), estimate(faults, "sensor:y1", 0.3))
    found = reformulate(healthy, diagnosis(healthy, both), data)
    assert max(map(len, str(found).splitlines())) <= 80
    assert set(found.error_bound) == {"y1", "y2"} and "rms error of the simulation at most: y1 " in str(found)
    assert len(found.plot().axes) == 3
    page = found.report(tmp_path / "r.html", record="faulty").read_text()
    assert "actuator:u2 loss" in page
    assert not re.search(r'(src|href)="https?:', page)  # it loads nothing


@pytest.mark.skipif("OPTID_DATA" not in os.environ, reason="needs the standard plant in OPTID_DATA")
def test_figures_of_the_standard_plant():
    model, _ = standard(Path(os.environ["OPTID_DATA"]))
    assert observer(model, ["y1"]).rmse["y1"] == pytest.approx(0.133, abs=5e-4)
    assert observer(model, ["y2"]).rmse["y2"] == pytest.approx(0.0378, abs=5e-5)

"""Subspace methods on noise-free and noisy systems with known parameters, and their refusals."""


import numpy as np
import pytest
from refusals import refuses
from sample_fits import quiet

import optid
from formulations.constraints import shape
from optid.bases import UserFunctions
from optid.data.record import Data
from optid.errors import DataError, DataWarning, RankError, StructureError
from optid.models import state_simulation
from optid.program.solution import Status

A = np.array([[0.7, 0.35, 0.0], [-0.35, 0.7, 0.1], [0.0, 0.0, 0.5]])
B = np.array([[1.0, 0.2], [0.0, 0.8], [0.5, -0.6]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]])
E = np.array([[0.4, 0.0], [-0.2, 0.3], [0.1, 0.5]])


def cubic(u):
    return u + 0.5 * u**3


def g2(y):
    return -y * np.abs(y) / (1 + y * y)


def example1(count, process=0.0, measurement=0.0, seed=0, colour=0.0, closed=True, offset=(0.0, 0.0), gaps=0):
    """Example 1 of the dissertation's chapter 4: two inputs, two outputs, three states, nonlinear feedback."""
    rng = np.random.default_rng(seed)
    u, x, y, v = rng.uniform(-2, 2, (count, 2)), np.zeros(3), np.zeros((count, 2)), np.zeros(2)
    for k in range(count):
        v = colour * v + np.sqrt(1 - colour**2) * measurement * rng.standard_normal(2)
        y[k] = C @ x + v
        f = np.array([cubic(u[k, 0]), np.tanh(2 * u[k, 1])])
        g = np.array([-np.sin(y[k, 0]), g2(y[k, 1])]) if closed else np.zeros(2)
        x = A @ x + B @ f + E @ g + process * rng.standard_normal(3)
    y = y + offset
    for _ in range(gaps):
        k, c = rng.integers(50, count), rng.integers(0, 4)
        (u if c < 2 else y)[k, c % 2] = np.nan
    return Data(u=u, y=y)


F = [UserFunctions((lambda u: u, lambda u: u**3)), UserFunctions((lambda u: np.tanh(2 * u),))]
G = [UserFunctions((lambda y: -np.sin(y),)), UserFunctions((g2,))]
KNOWN = {"basis": F, "feedback_basis": G, "nx": 3, "block_rows": 5}


def gap(found, true):
    """Largest distance of the eigenvalues of two matrices, paired greedily."""
    left, worst = list(np.linalg.eigvals(true)), 0.0
    for value in np.linalg.eigvals(found):
        i = int(np.argmin(np.abs(np.array(left) - value)))
        worst = max(worst, abs(left.pop(i) - value))
    return worst


def markov(a, c, b, count=8):
    return np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(count)])


def without_injection(model):
    """The model with the linear part of the feedback back in g, as the plant has it."""
    return model.inject_output(-model.L)


@pytest.mark.parametrize("arguments", [{}, {"noise": "white"}, {"iterations": 0, "noise": "white"}, {"iterations": 1},
                                       {"form": "correlation"}, {"weighting": "cva"}, {"split": "lumped"}])
def test_asivid_recovers_a_noise_free_system(arguments):
    fit = optid.fit(example1(1500), "hammerstein_ss.asivid", **KNOWN, **arguments)
    model = without_injection(fit.model)
    assert gap(model.A, A) < 1e-10
    assert fit.figures["second over first singular value, channel u1"] < 1e-10
    true = markov(A, C, B[:, :1]) * cubic(1.3)
    np.testing.assert_allclose(markov(model.A, model.C, model.B[:, :1]) * model.nonlinearities[0](1.3), true, atol=1e-6)
    feed = markov(A, C, E[:, 1:]) * g2(0.8)
    np.testing.assert_allclose(markov(model.A, model.C, model.E[:, 1:]) * model.feedback[1](0.8), feed, atol=1e-6)
    assert np.abs(model.D).max() < 1e-6 and fit.solution.status is Status.LOCAL


def test_offsets_gaps_and_experiments_do_not_disturb_recovery(monkeypatch):
    runs, linearised = [], state_simulation._linearised
    monkeypatch.setattr(state_simulation, "_linearised", lambda *a, **k: runs.append(1) or linearised(*a, **k))
    pieces = [example1(700, seed=s, offset=(3.0, -50.0), gaps=g) for s, g in ((1, 0), (2, 3), (3, 5))]
    fit = quiet(Data.join(*pieces), "hammerstein_ss.asivid", **KNOWN)
    feedback = [UserFunctions((lambda y: -np.sin(y - 3.0),)), UserFunctions((lambda y: g2(y + 50.0),))]
    fit = quiet(Data.join(*pieces), "hammerstein_ss.asivid", **(KNOWN | {"feedback_basis": feedback}))
    assert gap(without_injection(fit.model).A, A) < 1e-8
    whole = [p for p in pieces if not any(p.missing.values())]
    errors = [fit.model.simulate_measured_feedback(p, x0="fit") - p.y for p in whole]
    assert max(np.abs(e).max() for e in errors) < 1e-2  # the tables of the simulator
    assert len(runs) < 60  # without noise the search for an initial state ends where rounding begins


def test_many_gaps_are_told_of():
    data = example1(1500, 0.05, 0.1)
    u = data.u.copy()
    u[np.random.default_rng(0).random(1500) < 0.1, 0] = np.nan
    with pytest.warns(DataWarning, match="missing samples leave"):
        found = optid.fit(Data(u=u, y=data.y), "hammerstein_ss.asivid", **KNOWN).model
    assert gap(without_injection(found).A, A) < 0.05


def test_sid_recovers_a_linear_system_of_unknown_order():
    rng = np.random.default_rng(0)
    u, x = rng.standard_normal((600, 2)), np.zeros(3)
    y = np.empty((600, 2))
    for k in range(600):
        y[k] = C @ x + [0.3 * u[k, 0], 0.0] + [1.0, 2.0]
        x = A @ x + B @ u[k]
    fit = optid.fit(Data(u=u, y=y), "hammerstein_ss.sid")
    model = fit.model
    assert fit.figures["order"] == 3 and gap(model.A, A) < 1e-10
    np.testing.assert_allclose(markov(model.A, model.C, model.B), markov(A, C, B), atol=1e-6)
    np.testing.assert_allclose(model.D, [[0.3, 0], [0, 0]], atol=1e-6)
    assert model.noise is None and "vanish" in fit.figures["noise model"]
    assert np.min(fit.simulation_fit) > 99.999


def test_sivid_recovers_with_future_inputs():
    fit = optid.fit(example1(1500), "hammerstein_ss.sivid", **KNOWN, instruments="inputs+past", tolerance=1e-8)
    assert gap(without_injection(fit.model).A, A) < 1e-9


@pytest.mark.slow
def test_reference_errors_of_example_1():
    """Theory 2.10 for process 0.05, measurement 0.1: 3.2 / 6.2 %; linear 26 / 32 %; without feedback 10.6 / 17 %."""
    estimation, validation = example1(7000, 0.05, 0.1).split(6000)

    def errors(fit):
        predicted = fit.model.simulate_measured_feedback(validation, x0="fit")
        return 100 * np.linalg.norm(predicted - validation.y, axis=0) / np.linalg.norm(validation.y, axis=0)

    full = errors(optid.fit(estimation, "hammerstein_ss.asivid", **KNOWN))
    assert full[0] < 3.3 and full[1] < 6.3
    open_loop = errors(optid.fit(estimation, "hammerstein_ss.sivid", nx=3, block_rows=5, basis=F))
    assert open_loop[0] > 2 * full[0] and open_loop[1] > 2 * full[1]
    linear = errors(optid.fit(estimation, "hammerstein_ss.sid", nx=3, block_rows=5))
    assert linear[0] > 15 and linear[1] > 20


@pytest.mark.slow
def test_coloured_noise_needs_instruments_without_outputs():
    """Theory 2.6: past outputs bias the poles under AR(0.9) noise; simulated feedback does not."""
    data = example1(12000, 0.0, 0.5, colour=0.9)
    biased = optid.fit(data, "hammerstein_ss.asivid", **KNOWN, noise="white", iterations=0).model
    found = optid.fit(data, "hammerstein_ss.asivid", **KNOWN).model
    assert gap(without_injection(found).A, A) < 0.05 < gap(without_injection(biased).A, A)


@pytest.mark.slow
def test_condition_stays_bounded_only_with_simulated_feedback():
    """Condition of R11 as the record grows."""
    figures = {}
    for count in (2000, 32000):
        data = example1(count, 0.0, 0.5)
        figures[count] = [optid.fit(data, "hammerstein_ss.asivid", **KNOWN, **more).figures["condition of R11"]
                          for more in ({}, {"iterations": 0, "noise": "white"})]
    assert figures[32000][0] < 1.2 * figures[2000][0]
    assert figures[32000][1] > 2 * figures[2000][1]


def test_simulated_feedback_that_explains_nothing_is_warned_of():
    """A limit cycle that noise drives and the input does not hold: its simulated phase is not the measured one."""
    from optid.plants import van_der_pol

    u = np.random.default_rng(0).uniform(-0.02, 0.02, 3000)
    data = van_der_pol(u, 0, process=0.2, measurement=0.02, x0=(1.0, 0.0))
    with pytest.warns(DataWarning, match="explains .* % of the measured one"):
        fit = optid.fit(data, "hammerstein_ss.asivid", nx=2, block_rows=6, basis="linear",
                        feedback_basis="polynomial:3")
    assert fit.figures["share of the feedback that the simulated one explains"] < 0.1


def test_innovation_form_predicts_better_than_the_simulation():
    rng = np.random.default_rng(0)
    u, x, y = rng.standard_normal((4000, 1)), np.zeros(2), np.empty((4000, 1))
    a, k = np.array([[0.9, 0.3], [-0.3, 0.8]]), np.array([0.9, -0.4])
    c, b = np.array([1.0, 0.2]), np.array([1.0, 0.5])
    for t in range(4000):
        e = 0.5 * rng.standard_normal()
        y[t] = c @ x + e
        x = a @ x + b * u[t, 0] + k * e
    fit = optid.fit(Data(u=u, y=y), "hammerstein_ss.sid", nx=2)
    model = fit.model
    assert np.sqrt(model.noise.innovation[0, 0]) == pytest.approx(0.5, rel=0.05)
    np.testing.assert_allclose(markov(model.A, model.C, model.K, 5).ravel(), markov(a, c[None], k[:, None], 5).ravel(),
                               atol=0.1)
    assert fit.one_step_fit[0] > fit.simulation_fit[0] + 3


def test_gain_and_idle_input_are_obeyed():
    from formulations.constraints.responses import no_effect

    data = example1(1500, 0.05, 0.1, closed=False)
    fit = optid.fit(data, "hammerstein_ss.sid", nx=3, constraints=[shape.gain(2.5, channel="u1", output="y1")])
    model = fit.model
    found = (model.C @ np.linalg.solve(np.eye(3) - model.A, model.B) + model.D)[0, 0]
    assert found == pytest.approx(2.5, abs=1e-6)
    idle = optid.fit(data, "hammerstein_ss.sid", nx=3, constraints=[no_effect("u2")]).model
    assert np.abs(idle.B[:, 1]).max() < 1e-6 and np.abs(idle.D[:, 1]).max() < 1e-6


def test_gain_of_a_hammerstein_channel_and_monotone():
    data = example1(1500, 0.05, 0.1, closed=False)
    rules = [shape.gain(3.0, at=0.5, channel="u1", output="y1"), shape.monotone("increasing", channel="u1")]
    for split in ("exact", "lumped"):
        fit = quiet(data, "hammerstein_ss.sid", nx=3, basis="polynomial:3", constraints=rules[:1], split=split)
        model = fit.model
        steady = (model.C @ np.linalg.solve(np.eye(3) - model.A, model.B) + model.D)[0, 0]
        tolerance = 1e-5 if split == "exact" else 0.3  # the split of a lumped Theta does not keep the constraint
        assert steady * model.nonlinearities[0].slope(0.5) == pytest.approx(3.0, abs=tolerance)
    fit = quiet(data, "hammerstein_ss.sid", nx=3, basis="polynomial:3", constraints=rules)
    f = fit.model.nonlinearities[0](np.linspace(-2, 2, 50))
    assert np.all(np.diff(f) > -1e-9) or np.all(np.diff(f) < 1e-9)


def test_known_feedthrough():
    data = example1(1500, closed=False)
    model = optid.fit(data, "hammerstein_ss.sid", nx=3, basis=F, feedthrough=[True, False]).model
    assert not model.D[:, 1].any() and np.abs(model.D[:, 0]).max() < 1e-6


def broken(change):
    """A record changed by a function of (u, y)."""
    data = example1(600, 0.05, 0.1)
    return Data(*change(data.u, data.y))


@pytest.mark.parametrize("data, arguments, error, text", [
    (example1(600), {"nx": 3, "block_rows": 3}, StructureError, "3 block rows for order 3: more block rows"),
    (example1(600), {"nx": 0}, StructureError, "nx.* must be a positive integer; got 0"),
    (example1(600), {"nx": "many"}, StructureError, "must be a positive integer; got 'many'"),
    (example1(600), {"block_rows": 1}, StructureError, "block_rows must be an integer of at least 2; got 1"),
    (example1(60), {"nx": 3, "block_rows": 12}, RankError, "complete windows"),
    (example1(20), {"nx": 3, "block_rows": 12}, RankError, "experiment 1 has 20 samples"),
    (broken(lambda u, y: (u[:, :1] * [1, 2] + [0, 1], y)), {"nx": 3}, RankError, "'u2' is a sum of multiples of u1"),
    (broken(lambda u, y: (u, y[:, :1] * [1, -3])), {"nx": 3}, RankError, "output 'y2' is a sum of multiples of y1"),
    (broken(lambda u, y: (u, y * [0, 1] + [4, 0])), {"nx": 3}, DataError, "output 'y1' is constant"),
    (example1(600), {"nx": 3, "feedback_basis": ["polynomial:3"]}, StructureError, "1 feedback bases for 2 outputs"),
    (example1(600), {"nx": 3, "feedback_basis": ["polynomial:1", None]}, RankError, "linear in the outputs"),
    (example1(600), {"nx": 3, "feedback_basis": [3, None]}, StructureError, "feedback basis of output 'y1'"),
    (example1(600), {"nx": 3, "noise": "pink"}, StructureError, "noise='pink'"),
    (example1(600), {"nx": 3, "iterations": -1}, StructureError, "iterations must be a nonnegative integer"),
    (example1(600), {"nx": 3, "observer": "luenberger"}, StructureError, "observer="),
    (example1(600), {"nx": 3, "weighting": "n4"}, StructureError, "weighting="),
    (example1(600), {"nx": 3, "feedthrough": [True]}, StructureError, "feedthrough=")])
def test_refusals(data, arguments, error, text):
    arguments = {"basis": F} | arguments
    refuses(error, text, quiet, data, "hammerstein_ss.asivid", **arguments)


@pytest.mark.parametrize("method", ["hammerstein_ss.sid", "hammerstein_ss.sivid", "subspace.nuclear"])
@pytest.mark.parametrize("offset", [True, False])
@pytest.mark.parametrize("change, text", [
    (lambda u, y: (u[:, :1] * [1, 2] + [0, 1], y), "input 'u2' is a sum of multiples of u1"),
    (lambda u, y: (u, y[:, :1] * [1, -3]), "output 'y2' is a sum of multiples of y1")])
def test_channels_that_depend_on_others_are_named_in_linear_models_too(method, offset, change, text):
    refuses(RankError, text, quiet, broken(change), method, basis="linear", nx=3, block_rows=6, offset=offset)


def test_nearly_linear_feedback_is_refused_or_warned_of():
    data = broken(lambda u, y: (u, 1e-4 * y))
    with pytest.raises(RankError, match="cannot be distinguished from an output injection"):
        optid.fit(data, "hammerstein_ss.asivid", nx=3, basis=F, feedback_basis=[G[0], None])
    small = broken(lambda u, y: (u, 0.02 * y))
    with pytest.warns(DataWarning, match="nearly linear"):
        optid.fit(small, "hammerstein_ss.asivid", nx=3, basis=F, feedback_basis=[G[0], None])


def test_order_beyond_the_rank_of_the_data_is_refused():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((400, 1)), np.zeros((400, 1))
    for k in range(1, 400):
        y[k] = 0.8 * y[k - 1] + u[k - 1]
    with pytest.raises(RankError, match="order 4, but the projected outputs have rank 1"):
        optid.fit(Data(u=u, y=y), "hammerstein_ss.sid", nx=4)


def test_single_sinusoid_is_refused():
    k = np.arange(800)
    data = Data(u=np.sin(0.3 * k), y=np.sin(0.3 * k - 0.5) + 0.01 * np.random.default_rng(0).standard_normal(800))
    with pytest.raises((RankError, DataError), match="sinusoid|singular"):
        optid.fit(data, "hammerstein_ss.sid", nx=2, block_rows=6)


def test_unstable_estimate_is_moved_inside_with_a_warning():
    rng = np.random.default_rng(1)
    u, grown = rng.standard_normal((300, 1)), np.zeros((300, 1))
    for k in range(299):
        grown[k + 1] = 1.01 * grown[k] + u[k]
    data = Data(u=u, y=grown + 0.1 * rng.standard_normal((300, 1)))
    free = optid.fit(data, "hammerstein_ss.sid", nx=1, stability="free").model
    assert free.poles[0].real == pytest.approx(1.01, abs=2e-3)
    with pytest.warns(DataWarning, match="were brought to modulus 0.999"):
        fit = optid.fit(data, "hammerstein_ss.sid", nx=1)
    assert fit.model.is_stable


def test_hair_dryer_as_slicot_sees_it(real_data):
    """IB01AD: order 4 by the largest gap; poles as printed to three decimals (P1)."""
    record = np.loadtxt(real_data / "daisy_hairdryer.csv", delimiter=",", skiprows=1)
    data = Data(u=record[:, -2], y=record[:, -1], dt=0.08)
    fit = quiet(data, "hammerstein_ss.sid", nx="gap", block_rows=15, offset=False)
    assert fit.figures["order"] == 4
    printed = [69.8841, 14.9963, 3.6675, 1.9677, 0.3000, 0.2078, 0.1651, 0.1373, 0.1133, 0.1059, 0.0856, 0.0784, 0.0733,
               0.0678, 0.0571]
    np.testing.assert_array_equal(np.round(fit.figures["singular values"], 4), printed)
    poles = np.sort_complex(fit.model.poles)
    np.testing.assert_allclose(poles, [0.4758 - 0.2000j, 0.4758 + 0.2000j, 0.7456, 0.9610], atol=6e-4)

"""Whitened innovations: a predictor run by hand, records with and without a fault, laws of healthy records."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import levels, noisy, refused, standard
from state_systems import with_feedback
from test_fault_injection import small

from optid import Data
from optid.errors import DataError, DataWarning, StructureError
from optid.faults import Fault, health, inject, model_uncertainty, predictor, whiten
from optid.faults.nuisance import largest_factor, overdispersion, parameters
from optid.models import HammersteinSS, NoiseCovariances
from optid.models.kalman import kalman_gain


def with_gaps(y, seed=0, share=0.1):
    return np.where(np.random.default_rng(seed).random(y.shape) < share, np.nan, y)


def test_whitened_innovations_of_a_predictor_run_by_hand():
    model, u = small(), levels(80, 0)
    y = with_gaps(inject(model, u, seed=1))
    steady = kalman_gain(model.A, model.C, model.noise.Q, model.noise.R)
    found = whiten(model, Data(u, y), x0=[0.1, 0.2, 0.3])
    x = np.array([0.1, 0.2, 0.3])
    for k in range(80):
        error = y[k] - (model.C @ x + model.D @ u[k] + model.offset_y)
        there = ~np.isnan(y[k])
        expected = np.zeros(2)
        block = steady.innovation[np.ix_(there, there)]
        expected[there] = np.linalg.solve(np.linalg.cholesky(block), error[there]) if there.any() else []
        np.testing.assert_allclose(found.r[k], expected, atol=1e-10)
        x = model.A @ x + model.B @ u[k] + model.offset_x + steady.K @ np.where(there, error, 0.0)


def test_a_missing_reading_is_fed_back_as_predicted():
    model = with_feedback(feedback=(), E=None, output_of=())
    u = levels(60, 0)
    y = inject(model, u, seed=1)
    faulty = inject(model, u, Fault.jump("state", 20, [1.0, -1.0, 0.5]), seed=1)
    y[22, 0] = faulty[22, 0] = y[30] = faulty[30] = np.nan
    a, b = (whiten(model, Data(u, r, dt=0.5, outputs=["p", "q"]), x0="zero") for r in (y, faulty))
    into_state = np.zeros((60, 3, 1))
    into_state[20, :, 0] = [1.0, -1.0, 0.5]
    signature = a.whiten_signature(a.predictor.respond(into_state, np.zeros((60, 2, 1)), a.present))
    # the plant feeds back the reading that was lost, so its share of the fault stays unknown to the predictor
    np.testing.assert_allclose(signature[:23, :, 0], (b.r - a.r)[:23], atol=1e-10)


def test_healthy_records_are_white_and_of_unit_size():
    model = small()
    found = [health(whiten(model, Data(u, with_gaps(inject(model, u, seed=s), s, 0.02))))
             for s, u in ((s, levels(600, s)) for s in range(60))]
    p = np.array([h.p_value for h in found])
    assert np.mean(p < 0.1) < 0.25 and np.mean(p > 0.5) > 0.3 and all(h.white and h.scaled for h in found)
    assert abs(np.mean([h.ratio for h in found]) - 1) < 0.06
    assert "p-value" in str(found[0]) and max(map(len, str(found[0]).splitlines())) <= 80
    u = levels(300, 0)
    parts = whiten(model, Data([u, u[:200]], list(inject(model, [u, u[:200]], seed=1))))
    assert [len(part.r) for part in parts] == [300, 200] and health(parts).samples == 500


def test_innovations_that_are_not_white_are_refused():
    model, u = small(), levels(600, 0)
    other = replace(model, A=model.A - 0.25 * np.eye(3))
    steady, found = predictor(other), health(whiten(other, Data(u, inject(model, u))))
    assert found.p_value < 1e-3
    with pytest.raises(DataError, match="not white.*model_uncertainty.*healthy"):
        found.predictor(steady, rescale=True)


def scaled(model, factor):
    noise = model.noise
    return replace(model, noise=replace(noise, **{w: getattr(noise, w) * factor for w in ("Q", "R", "innovation")}))


def test_a_wrong_scale_of_the_noise_is_an_error_unless_it_is_taken_from_the_record():
    model, u = small(), levels(2000, 0)
    optimistic, data = scaled(model, 1 / 1.5**2), Data(u, inject(model, u))
    steady, found = predictor(optimistic), health(whiten(optimistic, data))
    assert abs(found.ratio - 1.5) < 0.1
    with pytest.raises(DataError, match=r"1\.[45]\d times as large.*rescale=True"):
        found.predictor(steady)
    right = found.predictor(steady, rescale=True)
    np.testing.assert_allclose(right.covariance, model.noise.innovation, rtol=0.15, atol=1e-3)
    np.testing.assert_allclose(right.root @ right.covariance @ right.root.T, np.eye(2), atol=1e-12)
    again = health(whiten(optimistic, data, scale=right))
    assert abs(again.ratio - 1) < 1e-6
    pessimistic = scaled(model, 4.0)
    with pytest.warns(DataWarning, match="small faults will be missed"):
        health(whiten(pessimistic, data)).predictor(predictor(pessimistic))


def test_bad_input():
    model, u = small(), levels(60, 0)
    refused(
        (StructureError, "noise covariances", lambda: whiten(replace(model, noise=None), Data(u, np.zeros((60, 2))))),
        (DataError, "too few", lambda: health(whiten(model, Data(u[:15], inject(model, u[:15]))))),
        (DataError, "determine", lambda: model_uncertainty(model, Data(u[:10], inject(model, u[:10])))))


# -- the uncertainty of an identified model ----------------------------------------------------------------------------


def drawn(uncertainty, seed):
    """A model of the distribution."""
    theta, _, back = parameters(uncertainty.model)
    return back(theta + uncertainty.root @ np.random.default_rng(seed).standard_normal(uncertainty.root.shape[1]))


def test_directions_that_change_no_prediction_are_left_out(real_data):
    model, _ = standard(real_data)
    u = levels(400, 0)
    found = model_uncertainty(model, Data(u, inject(model, u)))
    # 16 similarity transformations and a factor between each f and its column are not parameters of the predictions
    assert found.root.shape[1] == found.root.shape[0] - 16 - 2


@pytest.mark.slow
def test_model_errors_count_as_noise(real_data):
    """Innovations of models drawn from their distribution: too large without it, of unit size with it."""
    model, _ = standard(real_data)
    long, u = levels(150, 0), levels(200, 1)
    identified = model_uncertainty(model, Data(long, inject(model, long)))
    naive, aware = [], []
    for seed in range(60):
        wrong = drawn(identified, seed)
        data = Data(u, inject(model, u, seed=seed + 100))
        own = replace(identified, model=wrong)
        with warnings.catch_warnings(action="ignore", category=DataWarning):
            naive.append(np.sum(whiten_with(wrong, data, identified).r ** 2))
            aware.append(np.sum(whiten_with(wrong, data, identified, own).r ** 2))
    root = identified.predictor.root  # in units of the size that this short record shows
    freedom = (400 - 4) * np.trace(root @ model.noise.innovation @ root.T) / 2  # the initial state takes four
    assert np.mean(naive) > 1.05 * freedom
    assert abs(np.mean(aware) / freedom - 1) < 4 * np.sqrt(2 / freedom / 60)


@pytest.mark.slow
def test_the_largest_factor_is_an_upper_bound():
    rng, s2 = np.random.default_rng(0), np.geomspace(0.05, 4, 20)
    for true in (1.5, 4.0):
        found = [largest_factor(s2, (1 + true * s2) * rng.chisquare(1, 20)) for _ in range(250)]
        assert abs(np.mean(np.array(found) >= true) - 0.95) < 0.035
    assert largest_factor(s2, np.zeros(20)) == 1.0


def test_a_healthy_record_enlarges_a_covariance_that_is_too_small():
    """A plant that stayed as it was, and plants that changed by twice what the covariance claims."""
    model = small()
    long, u = levels(400, 0), levels(300, 1)
    origin = Data(long, inject(model, long))
    claimed = model_uncertainty(model, origin)
    healthy = Data(u, inject(model, u, seed=50))
    assert model_uncertainty(model, origin, healthy=healthy).inflation < 3  # the model is right
    factors = []
    for seed in range(7):
        wrong = drawn(replace(claimed, root=2 * claimed.root), seed)
        noise = NoiseCovariances.of_innovations(wrong.K, claimed.predictor.covariance)
        wrong = replace(wrong, noise=noise)
        factors.append(model_uncertainty(wrong, Data(long, inject(wrong, long)), healthy=healthy).inflation)
    assert np.median(factors) > 3


def test_parameters_that_are_not_the_most_likely_ones_deviate_by_what_their_record_shows():
    """A model moved by twenty standard deviations: the covariance gets this displacement, as predictions see it."""
    model, u = small(), levels(1000, 0)
    data = Data(u, inject(model, u))
    right = model_uncertainty(model, data)
    theta, _, back = parameters(right.model)
    moved = back(theta + 20 * right.root[:, -1])
    moved = replace(moved, noise=NoiseCovariances.of_innovations(moved.K, right.predictor.covariance))
    found = model_uncertainty(moved, data)
    assert found.root.shape[1] == right.root.shape[1] + 1 and found.inflation == 1.0
    assert 15 < found.deviation < 25 and "hammerstein_ss.exact" in found.remark
    assert right.deviation == 0 and right.remark == ""
    part, present = data.experiments[0], np.ones((1000, model.l), dtype=bool)
    displacement = replace(right, root=np.column_stack([20 * right.root[:, -1], found.root[:, -1]]))
    moves, _ = displacement.sensitivities(part, np.zeros(model.nx), present)
    seen = right.predictor.whitened_columns(moves, present)
    # the true parameters are not the most likely ones either: sqrt(q) standard deviations off
    assert np.linalg.norm(seen[:, 0] - seen[:, 1]) < 2 * np.sqrt(right.root.shape[1])
    assert np.linalg.norm(seen[:, 0]) > 19


def test_parameters_that_vary_with_the_operating_point_enlarge_the_covariance():
    """A plant whose parameters change every 100 samples; a plant of the model class leaves the covariance as it is."""
    model, u = small(), levels(1000, 0)
    steady = [model_uncertainty(model, Data(u, inject(model, u, seed=seed))) for seed in range(5)]
    assert [one.inflation for one in steady] == [1.0] * 5
    gains = 1 + 0.2 * np.random.default_rng(1).standard_normal(10)
    varying = np.concatenate([
        inject(replace(model, B=gain * model.B), u, seed=0)[100 * k : 100 * k + 100] for k, gain in enumerate(gains)])
    found = model_uncertainty(model, Data(u, varying))
    assert found.inflation > 5


def test_missing_readings_are_no_variation_of_the_parameters():
    """After a gap the innovations of the steady predictor are larger, which says nothing of the parameters."""
    A, C = np.array([[1.5, -0.7], [1.0, 0.0]]), np.array([[1.0, 0.5]])
    model = noisy(A, np.array([[1.0], [0.0]]), C, 0.09 * np.eye(2), np.array([[0.01]]))
    for seed in range(6):
        u = levels(800, seed, 1)
        y = inject(model, u, seed=seed)
        y[np.arange(800) % 120 < 20] = np.nan
        found = model_uncertainty(model, Data(u, y))
        assert found.inflation == 1.0 and found.deviation == 0.0


def test_the_variation_between_sections_is_estimated():
    rng, q = np.random.default_rng(0), 8
    S = np.linalg.qr(rng.standard_normal((6000, q)))[0].reshape(10, 600, q)
    grams = [part.T @ part for part in S]
    for ratio in (1.0, 40.0):
        estimates = []
        for _ in range(20):
            moved = np.sqrt(ratio - 1) * rng.standard_normal((10, q, 1))
            r = rng.standard_normal((10, 600)) + (S @ moved)[:, :, 0]
            fitted = np.einsum("kni,kn->i", S, r)
            r -= S @ fitted
            estimates.append(overdispersion(grams, [part.T @ left for part, left in zip(S, r)]))
        assert abs(np.mean(estimates) / ratio - 1) < 0.15


def whiten_with(model, data, identified, uncertainty=None):
    """Whiten by the gain that the model carries, which is as uncertain as its matrices."""
    steady = replace(identified.predictor, A=model.A, C=model.C, K=model.K)
    return whiten(model, data, scale=steady, uncertainty=uncertainty)


@pytest.mark.slow
def test_a_fitted_record_is_scaled_by_its_degrees_of_freedom():
    """Innovations of the record a model was fitted to are too small; those of other records are of unit size."""
    model, ratios = small(), []
    for seed in range(40):
        u = levels(60, seed)
        data = Data(u, inject(model, u, seed=seed))
        found = model_uncertainty(model, data)  # of the true model, which is fitted to nothing
        own = whiten(model, data, scale=found.predictor).r
        freedom = found.readings - found.root.shape[1]
        assert abs(np.sum(own**2) / freedom - 1) < 0.02  # the initial state is fitted in another norm
        ratios.append(np.linalg.det(found.predictor.covariance) / np.linalg.det(model.noise.innovation))
    expected = (120 - 3) / freedom
    assert abs(np.mean(np.sqrt(ratios)) / expected - 1) < 0.1


def test_a_noise_without_power_at_some_frequency_still_has_a_predictor():
    """A gain that puts an eigenvalue of A - K C on the unit circle: deviations would be remembered for ever."""
    A, C, K = np.diag([0.9, 0.5]), np.eye(2), np.diag([-0.1, 0.2])
    noise = NoiseCovariances(K @ K.T, np.eye(2), K, np.eye(2))
    model = HammersteinSS(A, np.ones((2, 1)), C, K=K, noise=noise)
    with pytest.warns(DataWarning, match="no power at some frequency"):
        assert np.max(np.abs(np.linalg.eigvals(predictor(model).F))) < 0.999
    u = levels(400, 0, 1)
    data = Data(u, inject(model, u, seed=1))
    found = model_uncertainty(model, data).predictor
    assert np.max(np.abs(np.linalg.eigvals(found.F))) < 0.995
    unseen = replace(model, A=np.diag([1.0, 0.5]), C=np.array([[0.0, 1.0]]), K=None, D=None, offset_y=None, L=None,
                     outputs=("y",), output_units=("",),
                     noise=NoiseCovariances(np.eye(2), np.eye(1), np.zeros((2, 1)), np.eye(1)))
    with pytest.raises(StructureError, match="Riccati"):
        predictor(unseen)


def test_a_known_initial_state_keeps_its_information(real_data):
    model, _ = standard(real_data)
    u = levels(300, 0)
    data = Data(u, inject(model, u))
    found = model_uncertainty(model, data)
    free, known = (whiten(model, data, x0=x0, uncertainty=found) for x0 in ("fit", "zero"))
    assert free.nuisance.s.max() > 1e5 and known.nuisance.s.max() < 10
    # the explicit inverse root of I + M M'
    U, s = known.nuisance.U, known.nuisance.s
    values, axes = np.linalg.eigh(np.eye(600) + (U * s**2) @ U.T)
    plain = whiten(model, data, x0="zero", scale=found.predictor).r
    np.testing.assert_allclose(known.r.ravel(), axes @ ((axes.T @ plain.ravel()) / np.sqrt(values)), atol=1e-8)

"""The search for two faults: equal to dense least squares over all pairs on random models."""

import warnings

import numpy as np
import pytest
from fault_plants import levels, refused, standard
from test_fault_injection import small
from test_fault_scan import KINDS, LOAD, random_model, record

from optid import Data
from optid.errors import DataWarning, StructureError
from optid.faults import Fault, best_subsets, dictionary, inject, model_uncertainty, scan, thresholds, whiten
from optid.faults.false_alarms import Thresholds


def penalties(found, seed=0):
    q = np.random.default_rng(seed).uniform(5, 20, len(found.candidates))
    return Thresholds(found.labels, q, 0.01, 0, 0, 0)


def dense(result, limits):
    """Energy less penalties of every pair of candidates, best over the onsets, by least squares on the window."""
    found, r = result.dictionary, result.whitened.r.ravel()
    size = len(found.candidates)
    atoms = []
    for c, candidate in enumerate(found.candidates):
        for onset in np.flatnonzero(~np.isnan(result.statistic[c])):
            G = result.signature(candidate, int(onset)).reshape(r.size, -1)
            axes, values, _ = np.linalg.svd(G, full_matrices=False)
            atoms.append((c, onset, axes[:, values > 3e-5 * values[0]]))
    best, where, alike = np.full((size, size), -np.inf), {}, 0
    for i, (c, k, first) in enumerate(atoms):
        for other, j, second in atoms[i + 1 :]:
            beside = second - first @ (first.T @ second)
            axes, values, _ = np.linalg.svd(beside, full_matrices=False)
            axes = axes[:, values > np.sqrt(2e-6)]
            if not axes.shape[1]:
                alike += 1
                continue
            gain = np.sum((first.T @ r) ** 2) + np.sum((axes.T @ r) ** 2) - limits.q[c] - limits.q[other]
            low, high = sorted(((c, k), (other, j)))
            if gain > best[low[0], high[0]]:
                best[low[0], high[0]] = gain
                where[low[0], high[0]] = low[1], high[1]
    return best, where, alike


def compare(result, limits):
    found = best_subsets(result, limits)
    best, where, _ = dense(result, limits)
    ranked = [subset for subset in found.ranked if len(subset.labels) == 2]
    there = np.isfinite(best)
    gains = {tuple(result.labels.index(label) for label in pair.labels): pair.gain for pair in ranked}
    assert set(gains) == set(map(tuple, np.argwhere(there).tolist()))
    np.testing.assert_allclose([gains[i, j] for i, j in np.argwhere(there)], best[there], rtol=1e-5, atol=1e-5)
    top = np.unravel_index(np.argmax(best), best.shape)
    assert found.best_of(2) == ranked[0] and ranked[0].labels == tuple(result.labels[i] for i in top)
    assert ranked[0].onsets == where[top]
    signatures = [result.signature(label, onset).reshape(result.whitened.r.size, -1)
                  for label, onset in zip(ranked[0].labels, ranked[0].onsets)]
    nu = np.linalg.lstsq(np.hstack(signatures), result.whitened.r.ravel(), rcond=None)[0]
    fitted = np.hstack(signatures) @ found.estimate(ranked[0]).nu
    np.testing.assert_allclose(fitted, np.hstack(signatures) @ nu, atol=1e-5)
    assert abs(np.sum(fitted**2) - ranked[0].energy) < 1e-4 * ranked[0].energy
    return found


@pytest.mark.sampled(2)
@pytest.mark.parametrize("gaps", [0.0, 0.2])
@pytest.mark.parametrize("shape", [(3, 2, 2), (2, 1, 1)])
def test_all_pairs_are_dense_least_squares(shape, gaps):
    model = random_model(1, *shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        found = dictionary(model, kinds=KINDS, process={"load": np.ones(shape[0])})
    data = record(model, 16, 1, gaps)
    compare(scan(found, whiten(model, data, x0="zero"), data.experiments[0].u), penalties(found))


@pytest.mark.slow
def test_all_pairs_with_scheduled_changes():
    model = random_model(4, 3, 2, 2)
    changed = {"a": Fault.schedule(A=0.9 * model.A), "b": Fault.schedule(B=lambda k: model.B * (1 - k / 32))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        found = dictionary(model, kinds=["bias", "drift", "loss"], schedules=changed, state_jump=False)
    data = record(model, 16, 3, 0.1)
    compare(scan(found, whiten(model, data, x0="zero"), data.experiments[0].u), penalties(found))


def test_all_pairs_with_an_uncertain_model():
    model = small()
    found = dictionary(model, kinds=["bias", "drift", "loss"], process={"load": LOAD})
    data = record(model, 16, 3, 0.05)
    white = whiten(model, data, x0="zero", uncertainty=model_uncertainty(model, record(model, 120, 7)))
    compare(scan(found, white, data.experiments[0].u), penalties(found))


def test_two_faults_are_found(real_data):
    model, load = standard(real_data)
    found, u = dictionary(model, process={"load": load}), levels(300, 4)
    y = inject(model, u, [Fault.step("actuator:u1", 160, 0.2), Fault.step("sensor:y2", 220, 0.15)], seed=2)
    result = scan(found, whiten(model, Data(u, y), x0="zero"))
    limits = thresholds(found, 300, draws=5000)
    two = best_subsets(result, limits)
    assert two.best is not None and two.best.labels == ("actuator:u1", "sensor:y2")
    assert abs(two.best.onsets[0] - 160) <= 2 and abs(two.best.onsets[1] - 220) <= 2
    nu, covariance = two.estimate(two.best)
    assert np.all(np.abs(nu - [0.2, 0.15]) < 4 * np.sqrt(np.diag(covariance)))
    assert two.runner_up is not None and set(two.runner_up.labels) != set(two.best.labels) and two.margin > 0
    assert max(map(len, str(two).splitlines())) <= 80


def test_one_fault_is_not_called_two():
    model, u = small(), levels(120, 0)
    found = dictionary(model)
    result = scan(found, whiten(model, Data(u, inject(model, u, Fault.step("sensor:y1", 60, 0.8), seed=1)), x0="zero"))
    two = best_subsets(result, thresholds(found, 120, draws=5000))
    assert two.best.labels == ("sensor:y1",) and two.gain > two.best_of(2).gain > 0


def test_faults_that_look_the_same_near_the_end_are_reported():
    """With one output the last sample shows one number only, whatever it is that began there."""
    model = random_model(1, 2, 1, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        found = dictionary(model, state_jump=False)
    result, limits = scan(found, whiten(model, record(model, 30, 0))), penalties(found)
    two = best_subsets(result, limits)
    assert two.alike == dense(result, limits)[2] > 0 and "indistinguishable" in str(two)


def test_bad_input():
    model, data = small(), record(small(), 40, 0)
    found = dictionary(model, kinds=["bias", "loss"])
    result = scan(found, whiten(model, data), data.experiments[0].u)
    long = scan(found, whiten(model, record(model, 12_000, 0)))
    refused(
        (StructureError, "no threshold for actuator:u1 loss.*u=u",
         lambda: best_subsets(result, thresholds(found, 40, draws=5000))),
        (StructureError, "other candidates", lambda: best_subsets(result, penalties(dictionary(model)))),
        (StructureError, "too many for an exact search", lambda: best_subsets(long, penalties(found))),
    )

"""The scikit-learn estimator: its checks, pipelines, grid search by blocks of time."""

import warnings

import numpy as np
import pytest

import optid

pytest.importorskip("sklearn")

from sklearn.model_selection import GridSearchCV, TimeSeriesSplit, cross_val_score
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

from optid.errors import DataWarning
from optid.sklearn import HammersteinRegressor

TIME = {
    "check_methods_sample_order_invariance": "the order of the rows is that of time",
    "check_methods_subset_invariance": "the past of a row decides its prediction",
    "check_regressor_multioutput": "ten rows do not determine five outputs that depend on each other's past",
}


def plant(n=600, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, (n, 1)), np.zeros(n)
    for k in range(1, n):
        y[k] = 0.7 * y[k - 1] + u[k, 0] + 0.5 * u[k, 0] ** 3 + 0.02 * rng.standard_normal()
    return u, y


def test_it_passes_the_checks_of_scikit_learn_where_a_time_series_allows():
    with warnings.catch_warnings(action="ignore"):
        found = check_estimator(HammersteinRegressor("arx", basis=None), expected_failed_checks=TIME, on_skip=None,
                                on_fail=None)
    failed = [(one["check_name"], str(one["exception"])) for one in found if one["status"] == "failed"]
    assert failed == []


def test_its_free_run_is_that_of_the_model():
    u, y = plant()
    made = HammersteinRegressor(na=1, nb=1, dt=0.1).fit(u[:400], y[:400])
    assert made.score(u[400:], y[400:]) > 0.97  # the record does not start from rest there
    reference = optid.fit(optid.Data(u[:400], y[:400], 0.1), na=1, nb=1, basis="polynomial:3").model
    late = made.predict(u[400:])[100:]
    np.testing.assert_allclose(late, reference.simulate(u[400:])[100:, 0], atol=1e-9)


def test_a_prediction_starts_from_rest_at_its_first_input():
    u, y = plant()
    made = HammersteinRegressor().fit(u, y + 5.0)
    level = made.predict(np.full((50, 1), 0.3))
    np.testing.assert_allclose(level, level[-1], rtol=1e-9)


def test_grid_search_by_blocks_of_time_finds_the_order():
    u, y = plant()
    search = GridSearchCV(HammersteinRegressor(), {"basis": ["polynomial:1", "polynomial:3"], "na": [1, 2]},
                          cv=TimeSeriesSplit(3)).fit(u, y)
    assert search.best_params_["basis"] == "polynomial:3"
    scores = cross_val_score(make_pipeline(StandardScaler(), HammersteinRegressor()), u, y, cv=TimeSeriesSplit(3))
    assert np.median(scores) > 0.9


def test_groups_are_experiments():
    u, y = plant(400)
    made = HammersteinRegressor().fit(u, y, groups=np.repeat([0, 1], 200))
    assert made.fit_.data.n_experiments == 2


def test_several_outputs_and_constraints():
    u, y = plant()
    both = HammersteinRegressor(constraints=["monotone:increasing"]).fit(u, y)
    assert [price.name for price in both.fit_.prices] == ["monotone:increasing"]
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        several = HammersteinRegressor("arx", basis=None).fit(u, np.c_[y, -y + 0.01 * u[:, 0]])
    assert several.predict(u).shape == (600, 2)

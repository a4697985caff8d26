"""The simulated plant records of the benchmarks: exact sampling, dead times, loops, and the error of a response."""

import numpy as np
import pytest
from scripts import benchmark

import optid

plants = benchmark("simulated_plants")
records = benchmark("plant_records")


def continuous(numerator, denominator, dead, u, substeps=400):
    """Integrate a first- or second-order plant by Euler's method, its input held over a sample and late."""
    a = np.asarray(denominator, dtype=float)
    a, b = a / a[0], np.asarray(numerator, dtype=float) / a[0]
    b = np.concatenate([np.zeros(len(a) - 1 - len(b)), b])
    fine = np.repeat(u, substeps)
    fine = np.concatenate([np.zeros(round(dead * substeps)), fine])[: fine.size]
    x, y, h = np.zeros(len(a) - 1), np.zeros(len(u)), 1 / substeps
    for k, drive in enumerate(fine):  # observer form
        if k % substeps == 0:
            y[k // substeps] = x[0]
        x = x + h * (np.append(x[1:], 0.0) - a[1:] * x[0] + b * drive)
    return y


@pytest.mark.parametrize(("numerator", "denominator"), [
    ([2.0], [8.0, 1.0]), ([-4.0, 1.5], [36.0, 15.0, 1.0]), ([1.0], [9.0, 1.5, 1.0]), ([0.1], [1.0, 0.0])])
@pytest.mark.parametrize("dead", [0.0, 3.0, 2.25])
def test_sampled_plants_follow_their_differential_equations(numerator, denominator, dead):
    plant = plants.Linear(np.array(numerator), np.array(denominator), dead, 60)
    u = np.repeat(np.random.default_rng(0).normal(size=8), 5)
    expected = continuous(numerator, denominator, dead, u)
    np.testing.assert_allclose(plant.respond(u), expected, atol=0.01 * np.max(np.abs(expected)))


@pytest.mark.parametrize("dead", [0.0, 0.5, 4.0, 7.9])
def test_nk_is_the_lag_of_the_first_sample_that_answers(dead):
    plant = plants.Linear(np.array([1.0]), np.array([10.0, 1.0]), dead, 60)
    assert np.flatnonzero(plant.respond(np.ones(20)))[0] == plant.nk == np.floor(dead) + 1


@pytest.mark.parametrize("kind", records.KINDS)
def test_records_are_functions_of_kind_and_seed(kind):
    one, again, other = (records.record(kind, seed).data.experiments[0] for seed in (3, 3, 4))
    assert np.array_equal(one.u, again.u) and np.array_equal(one.y, again.y)
    assert one.y.shape != other.y.shape or not np.array_equal(one.y, other.y)
    assert np.ptp(one.u) > 0 and np.ptp(one.y) > 0


@pytest.mark.parametrize("kind", ["open: second order", "open: saturation", "open: Wiener", "open: bump",
                                  "open: nonlinear feedback", "dead time 100: PRBS, first order"])
def test_records_are_the_plant_and_noise_of_the_stated_size(kind):
    one = records.record(kind, 1)
    (e,) = one.data.experiments
    late = slice(records.BEFORE if kind != "open: bump" else 0, None)  # the plant was in motion before the record
    clean = one.plants[0].respond(e.u[:, 0])[late]
    assert np.std(e.y[late, 0] - clean) == pytest.approx(one.noise * np.std(clean), rel=0.5)


@pytest.mark.parametrize("kind", records.REGULATED_KINDS)
def test_a_regulated_input_is_a_function_of_the_past_of_the_output(kind):
    one = records.record(kind, 2)
    (e,) = one.data.experiments
    u, y, lags = e.u[:, 0] - e.u.mean(), e.y[:, 0] - e.y.mean(), 3
    columns = np.column_stack([np.ones(len(u) - lags), *(y[lags - i : len(y) - i] for i in range(lags + 1)),
                               *(u[lags - i : len(u) - i] for i in range(1, lags + 1))])
    rest = u[lags:] - columns @ np.linalg.lstsq(columns, u[lags:], rcond=None)[0]
    assert np.std(rest) < 1e-6 * np.std(u)


def test_moved_loops_are_not_a_function_of_the_output_alone():
    for kind in records.MOVED_KINDS:
        (e,) = records.record(kind, 2).data.experiments
        u, y = e.u[:, 0] - e.u.mean(), e.y[:, 0] - e.y.mean()
        columns = np.column_stack([np.ones(len(u) - 3), y[3:], y[2:-1], y[1:-2], u[2:-1], u[1:-2], u[:-3]])
        rest = u[3:] - columns @ np.linalg.lstsq(columns, u[3:], rcond=None)[0]
        assert np.std(rest) > 1e-3 * np.std(u), kind


class Itself:
    """A plant as a model, with a gain that is off by a share."""

    def __init__(self, plant, off=0.0):
        self.plant, self.off, self.m = plant, off, 1

    def simulate(self, u, x0="zero"):
        return (1 + self.off) * self.plant.respond(np.ravel(u))


@pytest.mark.parametrize("kind", ["open: staircase", "open: integrating", "open: saturation", "open: Wiener"])
def test_the_error_of_a_response_is_relative_to_that_of_the_plant(kind):
    one = records.record(kind, 0)
    (e,) = one.data.experiments
    assert plants.response_error(Itself(one.plants[0]), one.plants, e.u, e.y) < 1e-9
    assert 0.03 < plants.response_error(Itself(one.plants[0], 0.1), one.plants, e.u, e.y) < 0.1
    assert plants.response_error(Itself(one.plants[0]), (None,), e.u, e.y) == np.inf


def test_a_right_fit_has_a_small_error_and_a_wrong_gain_a_large_one():
    one = records.record("open: staircase", 0)
    orders = benchmark("model_verdicts").orders(one.plants[0])
    model = optid.fit(one.data, "oe.exact", prove=False, **orders).model
    (e,) = one.data.experiments
    assert plants.response_error(model, one.plants, e.u, e.y) < 0.02

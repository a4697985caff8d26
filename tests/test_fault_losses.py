"""Losses and stuck actuators between bounds: equal to a quadratic programme, right about what is left."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import levels, refused, standard
from scipy.optimize import lsq_linear
from state_systems import with_feedback
from test_fault_injection import small
from test_fault_scan import record

from optid import Data
from optid.bases import Triangular
from optid.errors import StructureError
from optid.faults import Fault, bounded, dictionary, inject, scan, severity, whiten
from optid.models import Nonlinearity


def broken(model, fault, seed=0, count=160):
    u = levels(count, seed, model.m)
    data = Data(u, inject(model, u, fault, seed=seed), dt=model.dt, outputs=model.outputs)
    found = dictionary(model, kinds=["loss", "stuck"], state_jump=False)
    return scan(found, whiten(model, data, x0="zero"), u)


def test_a_nonlinearity_that_is_constant_over_the_reach_has_one_stop():
    saturated = Nonlinearity(Triangular(8, (-2.0, 2.0)), np.clip(np.linspace(-3, 3, 8), -1, 1))
    model = small()
    model = replace(model, nonlinearities=(saturated, *model.nonlinearities[1:]))
    result = broken(model, Fault.stuck("actuator:u1", 80, 1.8))
    one = bounded(result, "actuator:u1 stuck", reach=(1.6, 2.0))
    assert one.low[-1] == one.high[-1] == 1.0
    tested = ~np.isnan(one.statistic)
    assert tested.any() and np.all(one.sizes[tested, -1] == 1.0)


def test_bounds_at_every_onset_are_a_quadratic_programme(real_data):
    model, _ = standard(real_data)
    result = broken(model, Fault.stuck("actuator:u1", 100, 1.1))
    for label in ("actuator:u1 loss", "actuator:u1 stuck", "actuator:u2 stuck"):
        one = bounded(result, label)
        for onset in range(0, 150, 10):
            G = result.signature(label, onset).reshape(320, -1)
            expected = lsq_linear(G, result.whitened.r.ravel(), (one.low, one.high), tol=1e-14)
            np.testing.assert_allclose(one.sizes[onset], expected.x, atol=1e-5)
            energy = np.sum(result.whitened.r**2)
            assert abs(one.statistic[onset] - (energy - 2 * expected.cost)) < 1e-5
        free = (one.sizes > one.low) & (one.sizes < one.high)
        there = ~np.isnan(one.sizes)
        slopes = np.where(there, one.multipliers, 0.0) / (1 + np.nanmax(np.abs(result.correlations)))
        assert np.abs(slopes[free & there]).max() < 1e-9
        assert slopes[(one.sizes == one.low) & there].max(initial=0) <= 1e-12
        assert slopes[(one.sizes == one.high) & there].min(initial=0) >= -1e-12
        both = ~np.isnan(one.statistic)
        assert np.all(one.statistic[both] <= result.statistic[result.index(label), both] + 1e-7)


def test_the_constant_of_a_stuck_actuator_is_in_the_image_of_its_function(real_data):
    model, _ = standard(real_data)
    result = broken(model, Fault.stuck("actuator:u1", 100, 1.1))
    f = model.nonlinearities[0]
    for reach in (1.2, 0.5):
        one = bounded(result, "actuator:u1 stuck", reach=None if reach == 1.2 else (-reach, reach))
        np.testing.assert_allclose([one.low, one.high], [[0, f(-reach)], [1, f(reach)]], atol=1e-9)
    free = broken(small(), ())
    assert np.isinf(bounded(free, "actuator:u1 stuck").high[1])  # a linear actuator has no interval
    several = dictionary(with_feedback(feedback=(), E=None, output_of=()), kinds="stuck")
    u = 0.5 * np.random.default_rng(0).normal(size=(60, 2))
    data = Data(u, inject(several.model, u, seed=1), dt=0.5, outputs=["p", "q"])
    wide = scan(several, whiten(several.model, data, x0="zero"), u)
    assert bounded(wide, "actuator:u2 stuck").low.size == 3


@pytest.mark.parametrize("fault, hard_over, share", [
    (Fault.hard_over("actuator:u1", 100), True, 1.0), (Fault.stuck("actuator:u1", 100, 0.4), True, 1.0),
    (Fault.loss("actuator:u1", 100, 0.4), False, 0.4), (Fault.loss("actuator:u1", 100, 0.8), False, 0.8),
], ids=str)
def test_a_complete_loss_is_told_from_a_partial_one(real_data, fault, hard_over, share):
    model, _ = standard(real_data)
    label = "actuator:u1 stuck" if fault.kind == "stuck" else "actuator:u1 loss"
    found = severity(broken(model, fault, 1, 300), label)
    assert found.hard_over == hard_over and abs(found.onset - 100) <= 2
    assert abs(found.share - share) < 0.06 and found.share_interval[0] <= share <= found.share_interval[1]
    if fault.kind == "stuck":
        assert abs(found.stop[0] - model.nonlinearities[0](0.4)) < 0.1
    assert max(map(len, str(found).splitlines())) <= 80 and ("complete loss" in str(found))


def test_intervals_of_the_share_cover_with_the_onset_searched(real_data):
    model, _ = standard(real_data)
    inside = 0
    for seed in range(100):
        found = severity(broken(model, Fault.loss("actuator:u2", 80, 0.5), seed), "actuator:u2 loss")
        inside += found.share_interval[0] <= 0.5 <= found.share_interval[1]
    assert inside >= 90


def test_no_loss_at_all_is_no_hard_over():
    found = severity(broken(small(), (), 3), "actuator:u1 loss")
    assert not found.hard_over and found.share_interval[0] == 0


def test_bad_input():
    data = record(small(), 60, 0)
    found = dictionary(small(), kinds=["bias", "loss", "stuck"])
    white, u = whiten(small(), data), data.experiments[0].u
    refused(
        (StructureError, "only a loss and a stuck", lambda: bounded(scan(found, white, u), "sensor:y1")),
        (StructureError, "pass the inputs", lambda: bounded(scan(found, white), "actuator:u1 loss")),
        (StructureError, "untestable", lambda: bounded(scan(found, white, np.zeros((60, 2))), "actuator:u1 loss")),
        (StructureError, "reach=", lambda: bounded(scan(found, white, u), "actuator:u1 stuck", reach=(1, 0))),
        (StructureError, "coverage=", lambda: severity(scan(found, white, u), "actuator:u1 loss", coverage=95)),
    )

"""Faults of a plant under control: what is identified, named, sized and promised there."""

import numpy as np
import pytest

import optid
from optid.errors import DataError, RankError
from optid.faults import Monitor, model_uncertainty


def regulated(count=1500, seed=0):
    """Three coupled tanks, two under PI controllers that answer at once; nothing but disturbances moves them."""
    rng = np.random.default_rng(seed)
    flow = np.array([[0.95, 0.0, 0.03], [0.0, 0.93, 0.03], [0.03, 0.03, 0.92]])
    x, total = np.zeros(3), np.zeros(2)
    u, y = np.empty((count, 2)), np.empty((count, 3))
    for k in range(count):
        y[k] = x + 0.05 * rng.standard_normal(3)
        total += y[k, :2]
        u[k] = -0.6 * y[k, :2] - 0.05 * total
        x = flow @ x + 0.1 * np.append(u[k], 0.0) + 0.05 * rng.standard_normal(3)
    return optid.Data(u, y, inputs=["q1", "q2"], outputs=["h1", "h2", "h3"])


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_the_inverse_of_a_controller_is_not_fitted_by_prediction_errors():
    with pytest.raises(RankError, match=r"prediction errors of h\d, .* feedthrough=false"):
        optid.fit(regulated(600), "ss.exact", nx=2, criterion="prediction", prove=False)


@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
def test_the_inverse_of_a_controller_is_not_monitored():
    record = regulated()
    inverse = optid.fit(record, "hammerstein_ss.sid", basis="linear", nx=2).model
    for refused in (lambda: Monitor(inverse, uncertainty=record), lambda: model_uncertainty(inverse, record)):
        with pytest.raises(DataError, match="answer of a controller .* feedthrough=false"):
            refused()


@pytest.mark.filterwarnings("ignore:The model is unstable")
def test_a_regulated_plant_is_fitted_without_feedthrough_and_the_advice_is_taken():
    record = regulated()
    found = optid.fit(record, "ss.exact", nx=3, criterion="prediction", feedthrough=False)
    assert not found.model.D.any()
    assert all("use a noise model" not in str(one) for one in found.advice)
    monitor = Monitor(found.model, arl0=20_000, window=30, uncertainty=record)
    later = regulated(seed=1)
    y = later.y.copy()
    y[700:, 0] += 0.6
    alarms = [e for e in monitor.run(later.u, y) if e.kind == "alarm"]
    assert alarms and alarms[0].sample >= 700

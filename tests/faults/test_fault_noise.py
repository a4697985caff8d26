"""More noise at one place: the likelihood is that of the full covariance."""

import numpy as np
import pytest
from fault_plants import LOAD, record
from scipy.stats import multivariate_normal
from test_fault_injection import small

from optid.faults import Fault, dictionary, whiten
from optid.faults.consistency.waveforms import waveform_matrix
from optid.faults.diagnosis.courses import noise_places


@pytest.mark.parametrize("missing", [0.0, 0.2])
@pytest.mark.parametrize("onset", [0, 12])
def test_the_likelihood_is_that_of_the_full_covariance(missing, onset):
    found = dictionary(small(), process={"load": LOAD}, kinds=["noise"], state_jump=False)
    w = whiten(found.model, record(found.model, 1, Fault.sensor_noise("sensor:y1", 10, scale=3.0), missing, 40),
               x0="zero")
    there, r = w.present.ravel(), w.r.ravel()
    places = noise_places(found, list(found.candidates), w, onset)
    assert [place.label for place in places] == list(found.labels)
    for place, candidate in zip(places, found.candidates):
        H = waveform_matrix(found, candidate, w, onset)[there]
        for rho in (0.0, 0.01, 0.7):
            laws = [multivariate_normal(cov=np.eye(there.sum()) + part * H @ H.T) for part in (rho, 0.0)]
            expected = laws[0].logpdf(r[there]) - laws[1].logpdf(r[there])
            value = place.likelihood(np.array([rho]), (place.axes.T @ r) ** 2)[0]
            assert value == pytest.approx(expected, rel=1e-8, abs=1e-8)

"""Weights of penalties: along a path, and by hold-out."""

import numpy as np
import pytest
from problems import BASIS, record

import optid
from optid.errors import StructureError
from optid.identify.selection import default_weights, fit_by_holdout, path

STRUCTURE = {"na": 2, "nb": 2, "basis": BASIS}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("formulation, penalty", [("hammerstein_arx.exact", "curvature"),
                                                  ("hammerstein_arx.exact", "ridge"),
                                                  ("hammerstein_arx.nuclear", "weight")])
def test_every_point_of_a_path_is_the_fit_with_that_weight(formulation, penalty):
    data = record(count=600)
    train, test = data.split(0.7)
    found = path(data, formulation, penalty=penalty, weights=[3.0, 0.1], **STRUCTURE)
    assert np.array_equal(found.weights, [0.1, 3.0])
    for weight, one, score in zip(found.weights, found.fits, found.scores):
        direct = optid.fit(train, formulation, **STRUCTURE, **{penalty: weight})
        assert one.solution.objective == pytest.approx(direct.solution.objective, rel=1e-7)
        assert score == pytest.approx(optid.validate(direct.model, test).one_step["y"].fit, abs=1e-3)
    assert found.fits[0].solution.objective < found.fits[1].solution.objective
    assert str(found).count("\n") == 2


def test_hold_out_takes_the_best_weight_and_says_so():
    data = record()
    weights = [1e-3, 1.0, 1e6]
    scores = path(data, "hammerstein_arx.exact", penalty="curvature", weights=weights, **STRUCTURE).scores
    fit = fit_by_holdout(data, "hammerstein_arx.exact", penalty="curvature", weights=weights, **STRUCTURE)
    chosen = weights.index(fit.arguments["curvature"])
    assert scores[chosen] >= scores.max() - 0.02
    assert scores[2] < scores.max() - 0.02  # the heaviest penalty leaves a straight line, which is worse
    assert any("chosen by hold-out" in sentence for sentence in fit.findings)


def test_default_weights_follow_the_units_of_the_output():
    data = record()
    scaled = optid.Data(u=data.u, y=10 * data.y)
    assert np.allclose(default_weights(scaled), 100 * default_weights(data))


@pytest.mark.parametrize("change, words", [({"penalty": "rigde"}, "ridge, curvature, weight"),
                                           ({"holdout": 1.0}, "below 1"), ({"holdout": 0.0}, "above 0")])
def test_impossible_requests(change, words):
    with pytest.raises(StructureError, match=words):
        fit_by_holdout(record(), "hammerstein_arx.exact", **{"penalty": "ridge", **change}, **STRUCTURE)

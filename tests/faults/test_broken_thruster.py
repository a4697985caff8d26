"""What a new user does: identify a built-in rig, then diagnose the broken one."""

import numpy as np
import pytest
from commands import run

import optid
from optid.examples import example
from optid.faults import load_diagnosis


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "thruster.json"
    result = run("fit", "--example", "thruster", "--formulation", "hammerstein_ss.exact", "--nx", 2, "--set",
                 "criterion=prediction", "--model", path)
    assert result.exit_code == 0, result.output
    return path


@pytest.fixture(scope="module")
def answer(model):
    path = model.with_name("d.json")
    result = run("diagnose", model, "--example", "broken_thruster", "--identified", "thruster", "--out", path)
    assert result.exit_code == 0 and "--identified" not in result.output, result.output
    return path


def test_the_broken_propeller_is_named_with_the_share_that_is_lost(answer):
    found, truth = load_diagnosis(answer), example("broken_thruster").truth
    assert found.verdict == "faulty" and found.best.faults[0].kind == "loss"
    low, high = found.size_interval[0]
    assert low < truth["lost"] < high
    assert found.onset_interval[0] <= truth["onset"] <= found.onset_interval[1]


def test_the_broken_rig_is_refitted(model, answer, tmp_path):
    page = tmp_path / "r.html"
    result = run("reformulate", model, answer, "--example", "broken_thruster", "--model", tmp_path / "damaged.json",
                 "--report", page)
    assert result.exit_code == 0, result.output
    damaged, healthy = optid.load(tmp_path / "damaged.json"), optid.load(model)
    ratio = np.ptp(damaged.f([-1.2, 1.2])) / np.ptp(healthy.f([-1.2, 1.2]))
    assert abs(ratio - (1 - example("broken_thruster").truth["lost"])) < 0.1
    assert "predicted RMSE" not in page.read_text()  # no sensor is lost
    assert run("reformulate", model, answer).exit_code == 2


def test_a_model_that_counts_as_exact_is_said_to(model):
    result = run("diagnose", model, "--example", "broken_thruster", "--kinds", "loss")
    assert result.exit_code == 0 and "--identified FILE" in result.output
    assert not result.output.startswith("healthy")


@pytest.mark.parametrize("words", [["no.csv", "--example", "broken_thruster"], ["--example", "brokn_thruster"], []])
def test_one_record_is_needed(model, words):
    result = run("diagnose", model, *words)
    assert result.exit_code == 2 and result.output.startswith("error:")

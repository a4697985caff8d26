"""What a new user does: identify a built-in rig, then diagnose the broken one."""

import pytest
from typer.testing import CliRunner

from optid.cli.app import app
from optid.examples import example
from optid.faults import load_diagnosis


def run(*words):
    return CliRunner().invoke(app, list(map(str, words)))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("rig") / "thruster.json"
    result = run("fit", "--example", "thruster", "--formulation", "hammerstein_ss.exact", "--nx", 2, "--set",
                 "criterion=prediction", "--model", path)
    assert result.exit_code == 0, result.output
    return path


def test_the_broken_propeller_is_named_with_the_share_that_is_lost(model, tmp_path):
    result = run("diagnose", model, "--example", "broken_thruster", "--identified", "thruster", "--out",
                 tmp_path / "d.json")
    assert result.exit_code == 0, result.output
    found, truth = load_diagnosis(tmp_path / "d.json"), example("broken_thruster").truth
    assert found.verdict == "faulty" and found.best.faults[0].kind == "loss"
    low, high = found.size_interval[0]
    assert low < truth["lost"] < high
    assert found.onset_interval[0] <= truth["onset"] <= found.onset_interval[1]
    assert "--identified" not in result.output


def test_a_model_that_counts_as_exact_is_said_to(model):
    result = run("diagnose", model, "--example", "broken_thruster", "--kinds", "loss")
    assert result.exit_code == 0 and "--identified FILE" in result.output
    assert not result.output.startswith("healthy")


@pytest.mark.parametrize("words", [["no.csv", "--example", "broken_thruster"], ["--example", "brokn_thruster"], []])
def test_one_record_is_needed(model, words):
    result = run("diagnose", model, *words)
    assert result.exit_code == 2 and result.output.startswith("error:")

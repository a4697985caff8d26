"""The command `optid diagnose`: from files to a diagnosis, a page and a picture; one message for what is wrong."""

import re

import numpy as np
import pytest
from commands import run
from fault_plants import levels
from test_fault_injection import small

from optid.faults import Fault, diagnose, dictionary, inject, load_diagnosis


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A model and records of it."""
    path = tmp_path_factory.mktemp("diagnose")
    small().save(path / "model.json")
    u = levels(120, 0)
    for name, faults, seed in (("faulty", [Fault.step("sensor:y2", 60, 0.8)], 1), ("sound", [], 2),
                               ("crossing", [Fault.step("sensor:y2", 50, 0.9), Fault.step("actuator:u1", 56, 0.9)], 1)):
        write(path / f"{name}.csv", u, inject(small(), u, faults, seed=seed))
    return path


def write(path, u, y, names="u1,u2,y1,y2"):
    np.savetxt(path, np.hstack([u, y]), delimiter=",", header=names, comments="", fmt="%.17g")


@pytest.mark.slow
def test_a_record_becomes_a_diagnosis_a_page_and_a_picture(folder, tmp_path):
    out, page, picture = tmp_path / "d.json", tmp_path / "d.html", tmp_path / "d.png"
    result = run("diagnose", folder / "model.json", folder / "faulty.csv", "--kinds", "bias", "--out", out, "--report",
                 page, "--picture", picture)
    assert result.exit_code == 0, result.output
    assert "faulty: sensor:y2" in result.output and "diagnosis written to" in result.output
    found = load_diagnosis(out)
    data = np.loadtxt(folder / "faulty.csv", delimiter=",", skiprows=1)
    direct = diagnose(small(), (data[:, :2], data[:, 2:]), dictionary(small(), kinds=["bias"]))
    assert found.findings == ("no time column: 1 sample = 1; pass --dt (seconds)",)
    assert {**found.to_dict(), "findings": []} == direct.to_dict()
    html = page.read_text()
    assert html.count("data-chart=") == 3 and "sensor:y2" in html and "Diagnosis: faulty" in html
    assert not re.search(r'(src|href)="https?:', html)  # it loads nothing
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_two_faults_and_the_other_options(folder):
    two = run("diagnose", folder / "model.json", folder / "crossing.csv", "-k", "bias", "--max-faults", 2, "--coverage",
              0.9, "--false-alarm", "0.02", "--seed", "3", "--no-state-jump", "--load", "pump=0.3,-0.2,0.5", "--robust")
    assert two.exit_code == 0, two.output
    assert "actuator:u1" in two.output and "false alarm 0.02" in two.output


def test_a_healthy_record_is_told_as_such_and_exits_well(folder, tmp_path):
    page = tmp_path / "h.html"
    result = run("diagnose", folder / "model.json", folder / "sound.csv", "--kinds", "bias", "--report", page)
    assert result.exit_code == 0 and "healthy: no alarm" in result.output
    assert "Diagnosis: healthy" in page.read_text()


@pytest.mark.slow
def test_the_scale_of_the_noise_and_the_uncertainty_come_from_files(folder, tmp_path):
    u = levels(400, 5)
    loud = tmp_path / "loud.csv"
    y = inject(small(), u, noise="none")
    write(loud, u, y + 3 * (inject(small(), u, seed=9) - y))
    refused = run("diagnose", folder / "model.json", folder / "faulty.csv", "--healthy", loud)
    assert refused.exit_code != 0 and "rescale" in refused.output
    scaled = run("diagnose", folder / "model.json", folder / "faulty.csv", "-k", "bias", "--healthy", loud, "--rescale")
    assert scaled.exit_code == 0, scaled.output
    origin = tmp_path / "origin.csv"
    write(origin, u, inject(small(), u, seed=9))
    unsure = run("diagnose", folder / "model.json", folder / "faulty.csv", "-k", "bias", "--identified", origin)
    assert unsure.exit_code == 0 and "sensor:y2" in unsure.output, unsure.output


def test_bad_input_is_one_message(folder, tmp_path):
    model, faulty = folder / "model.json", folder / "faulty.csv"
    table = np.loadtxt(faulty, delimiter=",", skiprows=1)
    holes, short, names = tmp_path / "holes.csv", tmp_path / "short.csv", tmp_path / "names.csv"
    gone = table.copy()
    gone[17, 1] = np.nan
    write(holes, gone[:, :2], gone[:, 2:])
    write(short, table[:6, :2], table[:6, 2:])
    write(names, table[:, :2], table[:, 2:], "a,b,c,d")
    damaged = tmp_path / "damaged.json"
    damaged.write_text(model.read_text()[:200])
    for words, expected in (
        ((model, holes), "missing at sample 17"), ((model, short), "samples"), ((model, names), "u1"),
        ((damaged, faulty), "truncated"), ((tmp_path / "none.json", faulty), "none.json"),
        ((model, tmp_path / "none.csv"), "none.csv"), ((model, faulty, "--method", "exakt"), "exact"),
        ((model, faulty, "--kinds", "bais"), "bias"), ((model, faulty, "--max-faults", "3"), "sparse"),
        ((model, faulty, "--false-alarm", "1e-9"), "simulated windows"), ((model, faulty, "--load", "pump"), "NAME=E1"),
        ((model, faulty, "--load", "pump=1,2"), "2 numbers for 3 states"),
        ((model, faulty, "--process", "leak=y9:-1"), "no output 'y9'"), ((model, faulty, "--rescale"), "healthy"),
        ((model, faulty, "--disturbance", "wind"), "'wind'"), ((model, faulty, "--zero", "u1"), "INPUT=VALUE"),
        ((model, faulty, "--disturbance", "y1", "--disturbance", "y2"), "nothing is left to judge"),
        ((model, faulty, "--out", tmp_path / "no" / "d.json"), "no folder"), ((model, faulty, faulty), "2 experiments"),
        ((model, faulty, "--picture", tmp_path / "d.xyz"), "xyz"), ((model, faulty, "--dt", "0.5"), "sampled every"),
    ):
        result = run("diagnose", *words)
        said = " ".join(result.output.split())
        assert result.exit_code not in (0, None) and expected in said, (words, result.output)
        assert "Traceback" not in result.output and not isinstance(result.exception, KeyError | TypeError)

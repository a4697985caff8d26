"""A back end and a formulation of a third party: built, installed, listed, judged, and compared in a study."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "third_party"
STUDY = """
name = "third party"
solvers = ["predictor_corrector", "clarabel", "gauss_newton"]
time_limit = 300

[[data]]
system = "linear"
samples = 200

[[formulation]]
formulation = "fir.decaying"
length = 30
constraints = ["gain:low=10"]

[[formulation]]
formulation = "arx"
na = 2
nb = 2
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Environment of a process that finds the distribution; it is installed into a folder of its own."""
    folder = tmp_path_factory.mktemp("third_party")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder / "wheels")]
    subprocess.run(build, cwd=SOURCE, check=True, capture_output=True)
    (wheel,) = (folder / "wheels").glob("*.whl")
    target = folder / "site"
    install = ["install", "--quiet", "--no-deps", "--no-index", "--target", str(target), str(wheel)]
    subprocess.run([sys.executable, "-m", "pip", *install], check=True, capture_output=True)
    path = os.pathsep.join(filter(None, (str(target), os.environ.get("PYTHONPATH", ""))))
    return {**os.environ, "PYTHONPATH": path, "COLUMNS": "160"}


def run(environment, *words, folder=None):
    found = subprocess.run([sys.executable, *words], env=environment, cwd=folder, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    return found.stdout


def test_it_is_listed(installed):
    line = next(line for line in run(installed, "-m", "optid", "solvers").splitlines() if "predictor_corr" in line)
    assert line.split()[1] == "QP" and "a third party's interior-point method" in line
    listing = run(installed, "-m", "optid", "formulations")
    assert "fir.decaying" in listing and "length" in listing


def test_it_is_conformant(installed):
    code = ("import optid\n"
            "from optid.backends import find\n"
            "from optid.conformance.checks import check_back_end, check_formulation\n"
            "from optid.studies.sources.systems import simulate\n"
            "rows = check_back_end(find('predictor_corrector'))\n"
            "check_formulation('fir.decaying', simulate('linear', 300)[0], length=30)\n"
            "print(len(rows), sum(str(row.solution.status) == 'optimal' for row in rows))")
    cases, optimal = map(int, run(installed, "-c", code).split())
    assert cases >= 7 and optimal == cases - 2  # the others have no solution


def test_it_takes_part_in_a_study(installed, tmp_path):
    (tmp_path / "study.toml").write_text(STUDY)
    printed = run(installed, "-m", "optid", "study", "run", "study.toml", "-w", "1", folder=tmp_path)
    assert "6 cells to run" in printed
    from optid.studies.storage.store import read_rows

    rows = read_rows(tmp_path / "study.sqlite")
    status = {(f, s): (o, v) for f, s, o, v in zip(rows["formulation_name"], rows["solver"], rows["outcome"],
                                                   rows["status_verified"])}
    for formulation in ("fir.decaying", "arx"):
        assert status[formulation, "predictor_corrector"] == status[formulation, "clarabel"] == ("done", "optimal")
        assert status[formulation, "gauss_newton"] == ("refused", "")
        values = rows["objective"][(rows["formulation_name"] == formulation) & (rows["outcome"] == "done")]
        assert values[0] == pytest.approx(values[1], rel=1e-6)
    mine = rows["solver"] == "predictor_corrector"
    assert all('"optid-third-party": "1.0"' in text and "source of predictor_corrector" in text
               for text in rows["versions"][mine])
    compared = run(installed, "-m", "optid", "compare", "--example", "thruster", "-f", "fir.decaying", "--length", "20",
                   "--solvers", "predictor_corrector", "osqp", "--repetitions", "1", folder=tmp_path)
    assert "predictor_corrector" in compared and "Use " in compared

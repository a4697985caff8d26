"""What is imported when; who may import whom stands in pyproject.toml as contracts."""

import subprocess
import sys
from pathlib import Path

import pytest

import optid

ROOT = Path(optid.__file__).parent
HEAVY = ("cvxpy", "casadi", "numba", "matplotlib", "typer", "rich", "jinja2", "narwhals", "dask",
         "distributed")


def test_private_names_of_cvxpy_live_in_one_back_end():
    users = {path.name for path in ROOT.rglob("*.py") if "cvxpy.reductions" in path.read_text()}
    assert users == {"dnlp.py"}


def test_importing_the_package_is_light():
    code = f"import sys, optid; print([m for m in {HEAVY!r} + ('formulations',) if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.sampled(1)
@pytest.mark.parametrize("words, missing", [
    ("formulations", HEAVY), ("constraints", HEAVY), ("solvers", HEAVY), ("examples", HEAVY), ("--help", HEAVY),
    ("fit nowhere.csv", HEAVY), ("fit --example thrster", HEAVY), ("fit --example thruster -f hammerstein", HEAVY),
    ("fit --example thruster -c montone", HEAVY), ("fit --example thruster -s clarabl", HEAVY), ("fti", HEAVY),
    ("fit --example thruster", ("numba", "matplotlib", "scipy.signal", "scipy.stats", "scipy.ndimage")),
    ("fit --example thruster --report {folder}/r.html", ("numba", "scipy.signal", "scipy.stats", "scipy.ndimage"))])
def test_a_command_imports_what_it_uses(words, missing, tmp_path):
    missing = tuple(name for name in missing if name not in ("typer", "rich"))
    code = f"""
import sys
from optid.cli import app
sys.argv = ["optid", *{words.format(folder=tmp_path).split()!r}]
try:
    app()
except SystemExit:
    pass
print([name for name in {missing!r} if name in sys.modules])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1] == "[]"


def test_importing_the_package_is_quick():
    code = "import time; t = time.perf_counter(); import numpy; n = time.perf_counter(); import optid; " \
           "print(time.perf_counter() - n)"
    runs = [subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True) for _ in range(3)]
    assert min(float(run.stdout) for run in runs) < 0.3


@pytest.mark.parametrize("package", ["pydantic", "tomlkit"])
def test_studies_name_the_extra_that_they_need(package):
    code = (f"import sys; sys.modules[{package!r}] = None\n"
            "import optid, optid.errors\n"
            "try:\n    optid.Study\nexcept optid.errors.StudyError as error:\n    print(error)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert package in done.stdout and 'pip install "optid[study]"' in done.stdout

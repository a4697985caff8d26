"""Who may import what."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import optid

ROOT = Path(optid.__file__).parent
HEAVY = ("cvxpy", "casadi", "numba", "matplotlib", "typer", "rich", "jinja2", "narwhals", "dask",
         "distributed")
# the only modules of the engine that may know CVXPY: programmes, what reads their constraints, proofs, test problems
CVXPY = {"certificate/convex", "certificate/infeasibility", "certificate/lifting", "certificate/sdp", "conformance/zoo",
         "identify/equation_error/compression", "identify/gauges", "identify/tangent"}


def modules():
    return {path.relative_to(ROOT).with_suffix(""): path for path in ROOT.rglob("*.py")}


def imported(path, top_level_only=False):
    """Names of the packages a module imports, everywhere or when it is itself imported."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else list(ast.walk(tree))
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("name, path", modules().items(), ids=str)
def test_the_engine_never_imports_the_catalogue(name, path):
    assert "formulations" not in imported(path)


@pytest.mark.slow
def test_cvxpy_is_known_to_programmes_certificates_and_back_ends_only():
    users = {str(name) for name, path in modules().items() if "cvxpy" in imported(path)}
    beyond = {name for name in users if not name.startswith(("backends/", "program/"))} - CVXPY
    assert not beyond, f"{sorted(beyond)} import CVXPY; state why in this list, or go through a programme"


@pytest.mark.slow
def test_casadi_is_known_to_its_back_end_and_the_export_only():
    users = {str(name) for name, path in modules().items() if "casadi" in imported(path)}
    assert {name for name in users if not name.startswith("backends/")} <= {"models/export"}


@pytest.mark.slow
def test_private_names_of_cvxpy_live_in_one_back_end():
    for name, path in modules().items():
        inner = [node.module for node in ast.walk(ast.parse(path.read_text()))
                 if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cvxpy.reductions")]
        assert not inner or str(name) == "backends/dnlp", f"{name} imports {inner}"


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


def test_catalogue_files_do_not_know_solvers():
    import formulations

    for path in Path(formulations.__file__).parent.glob("*.py"):
        text = path.read_text()
        assert "optid.backends" not in text and "solver=" not in text

"""The posed problems of a study, solved by bare solvers without optid."""

import csv
import subprocess
import sys

import numpy as np
import pytest

from optid.errors import StudyError
from optid.studies.execution.running import _description
from optid.studies.problem_set import write_problems
from optid.studies.storage.store import Store
from optid.studies.study import Study

STUDY = """
name = "problems"
solvers = "auto"
[[data]]
file = "rig.csv"
inputs = "u"
outputs = "y"
[[formulation]]
name = "relaxed"
formulation = "hammerstein_arx.nuclear"
na = 2
nb = 2
basis = "triangular:5"
[[formulation]]
name = "gains"
formulation = "arx"
na = 2
nb = 2
constraints = ["stable:0.95", "gain:0.5"]
[[formulation]]
name = "absolute"
formulation = "arx"
na = 1
nb = 2
loss = "l1"
[[formulation]]
formulation = "hammerstein_ss.sid"
nx = 2
[[formulation]]
name = "exact"
formulation = "hammerstein_arx.exact"
na = 1
nb = 1
basis = "triangular:5"
"""


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    place = tmp_path_factory.mktemp("problems")
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 120)
    y = np.convolve(np.tanh(u), 0.6 ** np.arange(12))[:120] + 0.05 * rng.standard_normal(120)
    (place / "rig.csv").write_text("u,y\n" + "".join(f"{a},{b}\n" for a, b in zip(u, y)))
    study = Study.from_text(STUDY, place)
    with Store(place / "study.sqlite", write=True) as store:
        store.describe(study.name, _description(study))
    return place / "out", write_problems(place / "study.sqlite", place / "out")


@pytest.mark.slow
def test_every_convex_programme_is_written(written):
    out, lines = written
    kinds = {line["formulation"]: line["kind"] for line in lines}
    assert kinds["relaxed"] == "SDP" and kinds["gains"] in ("QP", "SOCP") and "exact" not in kinds
    with (out / "problems.csv").open() as file:
        assert [row["name"] for row in csv.DictReader(file)] == [line["name"] for line in lines]
    assert {path.stem for path in out.glob("*.mps")} == {line["name"] for line in lines if line["kind"] in ("LP", "QP")}


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["clarabel", "scs", "highs"])
def test_bare_solvers_agree_with_the_verified_objectives(written, solver):
    pytest.importorskip("highspy" if solver == "highs" else solver)
    out, lines = written
    done = subprocess.run([sys.executable, str(out / "solve_problems.py"), solver], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = {words[0]: float(words[3]) for line in done.stdout.splitlines()
             if len(words := line.split()) == 4 and words[0].isdigit()}
    wanted = {line["name"] for line in lines if solver != "highs" or line["kind"] in ("LP", "QP")}
    assert set(found) == wanted and max(found.values()) < 1e-6, found


def test_a_study_without_its_text_has_no_problems(tmp_path):
    with Store(tmp_path / "s.sqlite", write=True) as store:
        store.describe("in memory", "")
    with pytest.raises(StudyError, match="no text of a study, .* be built: it has 'in memory'"):
        write_problems(tmp_path / "s.sqlite", tmp_path / "out")

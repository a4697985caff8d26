"""optid study and optid compare, as a user runs them."""

import csv as comma
from pathlib import Path

import pytest
from study_rows import FAILED, append, row
from typer.testing import CliRunner

from optid.cli.app import app
from optid.errors import StudyError
from optid.examples import example
from optid.studies import conclude
from optid.studies.execution.cell import lost_row
from optid.studies.grid import cells
from optid.studies.storage.store import read_rows
from optid.studies.study import Study

SOLVERS = '["clarabel", "gauss_newton", "auto"]'
STUDY = """
name = "rigs"
solvers = {solvers}
seeds = 2
time_limit = 300.0

[[data]]
system = "thruster"
samples = 120

[[data]]
file = "rig.csv"
inputs = "current"
outputs = "thrust"
dt = 0.1

[[formulation]]
name = "exact"
formulation = "hammerstein_arx.exact"
na = 2
nb = 1
basis = "triangular:5"

[[formulation]]
formulation = "arx"
na = 2
nb = 1
"""


def run(*words: object):
    return CliRunner().invoke(app, [str(word) for word in words])


def write_rig(path: Path, seed: int = 0) -> Path:
    data = example("thruster", seed=seed, n=200).data
    rows = "\n".join(f"{u!r},{y!r}" for u, y in zip(data.u[:, 0].tolist(), data.y[:, 0].tolist()))
    path.write_text("current,thrust\n" + rows + "\n")
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a study and its data."""
    write_rig(tmp_path / "rig.csv")
    (tmp_path / "rigs.toml").write_text(STUDY.format(solvers=SOLVERS))
    monkeypatch.chdir(tmp_path)
    return tmp_path


# -- run, resume, report, export ---------------------------------------------------------------------------------------


def test_a_study_from_run_to_page(folder):
    plan = run("study", "run", "rigs.toml", "--dry-run")
    assert plan.exit_code == 0 and "18 cells, 18 of them to run" in plan.stdout and not Path("rigs.sqlite").exists()

    first = run("study", "run", "rigs.toml", "-w", 1, "--export", "rows.csv")
    assert first.exit_code == 0, first.stderr
    assert first.stdout.startswith("18 cells to run\n") and "18 rows written to rows.csv" in first.stdout
    assert "optid study report rigs.sqlite -o rigs.html" in first.stdout
    rows = read_rows("rigs.sqlite")
    pairs = set(zip(rows["formulation"], rows["solver"], rows["outcome"], rows["status_verified"]))
    assert pairs == {("exact", "gauss_newton", "done", "optimal"), ("exact", "auto", "done", "optimal"),
                     ("arx", "clarabel", "done", "optimal"), ("arx", "auto", "done", "optimal"),
                     ("exact", "clarabel", "refused", ""), ("arx", "gauss_newton", "refused", "")}
    table = {words[0]: words[1:] for words in map(str.split, first.stdout.splitlines()) if len(words) > 7}
    assert table["auto"][:3] == ["6", "of", "6"] and table["clarabel"][:3] == ["3", "of", "3"]
    assert table["clarabel"][-3:] == ["3", "3", "0"]  # proved, refused, false claims
    with open("rows.csv", newline="") as file:
        assert len(list(comma.DictReader(file))) == 18

    started = sorted(rows["started"])
    again = run("study", "run", "rigs.toml")
    assert again.stdout.startswith("18 of 18 cells are in rigs.sqlite already; nothing is left to run")
    assert sorted(read_rows("rigs.sqlite")["started"]) == started  # nothing was computed again

    Path("rigs.toml").write_text(STUDY.format(solvers='["clarabel", "gauss_newton", "auto", "osqp"]'))
    more = run("study", "run", "rigs.toml", "-w", 1)
    assert more.stdout.startswith("18 of 24 cells are in rigs.sqlite already; 6 to run")

    told = run("study", "report", "rigs.sqlite", "-o", "page.html")
    assert told.exit_code == 0 and "report written to page.html" in told.stdout
    assert "auto" in told.stdout and Path("page.html").stat().st_size > 20_000
    assert run("study", "export", "rigs.sqlite", "rows.parquet").stdout == "24 rows written to rows.parquet\n"


def test_a_dry_run_counts_what_the_run_would_run(folder):
    Path("rigs.toml").write_text(STUDY.format(solvers='["auto"]').replace("seeds = 2", "seeds = 2\nmemory_limit = 1.0"))
    assert run("study", "run", "rigs.toml", "-w", 1).exit_code == 4
    rows, before = read_rows("rigs.sqlite"), Path("rigs.sqlite").read_bytes()
    assert set(rows["outcome"]) == {"memory limit"} and rows["key"].size == 6

    def left(*words):
        found = run("study", "run", "rigs.toml", "--dry-run", *words)
        assert found.exit_code == 0, found.stderr
        return int(found.stdout.split(" cells, ")[1].split()[0])

    assert (left(), left("--retry", "crashed"), left("--retry", "memory limit")) == (0, 0, 6)
    write_rig(folder / "rig.csv", seed=1)
    refused = run("study", "run", "rigs.toml", "--dry-run")
    assert refused.exit_code == 2 and "--accept-changed-data" in refused.stderr
    assert left("--accept-changed-data") == 2
    write_rig(folder / "rig.csv")

    Path("rigs.toml").write_text(STUDY.format(solvers='["auto"]'))
    assert left() == 6
    text = Path("rigs.toml").read_text()
    cell = next(c for c in cells(Study.from_text(text, folder)) if c.seed == 1)
    assert Path("rigs.sqlite").read_bytes() == before  # nothing was run, and nothing was written
    append(folder / "rigs.sqlite", [lost_row(cell, "crashed", "for the test")])
    assert left() == 5
    told = run("study", "run", "rigs.toml", "--dry-run", "--db", "rig.csv").stderr
    assert told.startswith("error: rig.csv ")


def test_every_reason_is_told_once_and_a_run_without_an_answer_ends_with_4(folder):
    exact = STUDY.partition('[[formulation]]\nformulation = "arx"')[0]
    Path("rigs.toml").write_text(exact.format(solvers='["clarabel", "scs"]'))
    first = run("study", "run", "rigs.toml", "-w", 1, "--export", "rows.csv")
    assert first.exit_code == 4 and Path("rows.csv").is_file()
    for found in first, run("study", "report", "rigs.sqlite"):
        told = " ".join(found.stdout.split())
        assert told.count("clarabel: refused 3: ") == told.count("scs: refused 3: ") == 1
        assert ".exact' is not convex" in told
    for accuracy in (-1, "nan", 1):
        refused = run("study", "report", "rigs.sqlite", "--accuracy", accuracy)
        assert refused.exit_code == 2 and f"between 0 and 1; {accuracy} is not" in refused.stderr
    Path("rigs.toml").write_text(exact.format(solvers='["clarabel", "gauss_newton"]'))
    assert run("study", "run", "rigs.toml", "-w", 1).exit_code == 0


def test_two_studies_of_one_database_are_never_one(folder):
    text = STUDY.partition("[[data]]\nfile")[0] + STUDY[STUDY.index('[[formulation]]\nformulation = "arx"'):]
    for name in ("first rig", "other_rig"):
        Path("rigs.toml").write_text(text.format(solvers='["clarabel"]').replace('"rigs"', f'"{name}"'))
        told = run("study", "run", "rigs.toml", "-w", 1, "--export", "one.csv")
        assert told.exit_code == 0 and "2 rows written to one.csv" in told.stdout
        said = "optid study report rigs.sqlite -o rigs.html" + (" --study other_rig" if name == "other_rig" else "")
        assert said in told.stdout.splitlines()
    refused = run("study", "report", "rigs.sqlite", "-o", "page.html")
    assert refused.exit_code == 2 and not Path("page.html").exists()
    assert "holds 2 studies: 'first rig' (2 rows), 'other_rig' (2 rows). Name one: --study TITLE" in refused.stderr
    one = run("study", "report", "rigs.sqlite", "--study", "first rig", "-o", "page.html")
    assert one.exit_code == 0 and "other_rig" not in Path("page.html").read_text()
    assert "Did you mean 'other_rig'?" in run("study", "report", "rigs.sqlite", "--study", "othr_rig").stderr
    assert run("study", "export", "rigs.sqlite", "all.csv").stdout == "4 rows of 2 studies written to all.csv\n"
    assert run("study", "export", "rigs.sqlite", "1.csv", "--study", "other_rig").stdout == "2 rows written to 1.csv\n"
    with open("1.csv", newline="") as file:
        assert {line["study"] for line in comma.DictReader(file)} == {"other_rig"}
    assert run("study", "export", "rigs.sqlite", "2.csv", "--study", "third").exit_code == 2
    with pytest.raises(StudyError, match="holds 2 studies"):
        conclude("rigs.sqlite")
    assert set(conclude("rigs.sqlite", study="first rig").table["study"]) == {"first rig"}
    assert "other_rig" not in str(conclude("rigs.sqlite", study="first rig"))


def test_reasons_that_differ_in_their_numbers_are_one():
    failed = [row("a", **FAILED | {"reason": f"no step after {k} iterations"}, seed=k) for k in range(3)]
    told = str(conclude([row("b"), row("b", **FAILED | {"reason": "it\nbroke"}, seed=5), *failed]))
    assert "a: failed 3: no step after … iterations" in told and "b: failed 1: it broke" in told
    told = str(conclude([row(f"s{k}", **FAILED | {"reason": "ab"[k % 2] * (k + 1)}) for k in range(14)]))
    assert "and 2 more reasons" in told


def test_what_is_taken_out_of_a_study_leaves_its_reports_which_say_so(folder):
    Path("rigs.toml").write_text(STUDY.format(solvers='["auto", "gauss_newton"]'))
    first = run("study", "run", "rigs.toml", "-w", 1)
    assert first.exit_code == 0 and "superseded" not in first.stdout
    Path("rigs.toml").write_text(STUDY.format(solvers='["auto"]'))
    before = Path("rigs.sqlite").read_bytes()
    said = "6 rows are set aside: solver gauss_newton is no longer in the study (6)"
    assert said in run("study", "run", "rigs.toml", "--dry-run").stdout and Path("rigs.sqlite").read_bytes() == before
    assert said in run("study", "run", "rigs.toml", "-w", 1).stdout.splitlines()
    report = run("study", "report", "rigs.sqlite").stdout
    assert "gauss_newton" not in report
    assert "6 rows of former entries" in report and "kept in rigs.sqlite (table superseded)" in report
    Path("rigs.toml").write_text(STUDY.format(solvers='["auto", "gauss_newton"]'))
    assert "set aside" not in run("study", "run", "rigs.toml", "-w", 1).stdout  # they are back
    Path("rigs.toml").write_text(STUDY.format(solvers='["auto"]').replace("0.1", "0.2"))
    changed = run("study", "run", "rigs.toml", "-w", 1).stdout
    assert "former data, settings or versions, or run again (2); solver gauss" not in changed
    assert "solver gauss_newton is no longer in the study (6); former data" in changed and "run again (2)" in changed


def test_a_dry_run_names_the_solvers_that_are_not_installed(folder, monkeypatch):
    from optid.errors import SolverMissing
    from optid.studies import grid

    def missing(name):
        raise SolverMissing(f"solver {name!r} is not installed: pip install {name}")

    monkeypatch.setattr(grid, "find", missing)
    Path("rigs.toml").write_text(STUDY.format(solvers='["clarabel"]'))
    told = run("study", "run", "rigs.toml", "--dry-run").stdout
    assert "6 cells cannot be run here: solver 'clarabel' is not installed: pip install clarabel" in told


def test_the_database_is_called_as_the_study_file(folder):
    """Whatever stands before the last full stop of its name."""
    for name in ("v1.2", "v1.3"):
        Path(f"{name}.toml").write_text(STUDY.format(solvers='["gauss_newton"]').split("[[data]]\nfile")[0]
                                        + STUDY[STUDY.index("[[formulation]]"):].split("[[formulation]]\nform")[0])
        assert run("study", "run", f"{name}.toml", "-w", 1).exit_code == 0
        assert Path(f"{name}.sqlite").is_file()


def test_ctrl_c_says_what_is_kept_and_how_to_go_on(folder, monkeypatch):
    from optid.studies.execution import running

    def interrupted(study, db, *, progress, **settings):
        append(db, [])
        progress(0, 18, None)
        progress(1, 18, {"formulation": "exact", "solver": "auto", "status_verified": None, "outcome": "crashed"})
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "run", interrupted)
    found = run("study", "run", "rigs.toml")
    assert found.exit_code == 130
    assert "stopped: 1 of 18 cells are in rigs.sqlite; the same command goes on from there" in found.stdout


def test_the_built_in_study_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = run("study", "run", "--example", "--dry-run")
    assert found.exit_code == 0 and "96 cells, 96 of them to run" in found.stdout


def test_compare_says_why_a_solver_was_not_run_and_what_to_do(folder):
    words = ("compare", "rig.csv", "-u", "current", "-y", "thrust", "--na", 2, "--nb", 1, "--repetitions", 1)
    linear = run(*words, "-f", "arx", "--solvers", "mosek", "clarabel")
    assert linear.exit_code == 0 and "mosek: solver 'mosek' is not installed: pip install Mosek" in linear.stdout
    assert "not applicable to arx" not in linear.stdout
    nobody = run(*words, "--basis", "triangular:5", "--solvers", "clarabel")
    said = " ".join(nobody.stdout.split())
    assert nobody.exit_code == 4 and "taken by alternating, fatrop, gauss_newton, ipopt, uno" in said


def test_systems_are_listed():
    from optid.studies.sources.systems import SYSTEMS

    found = run("study", "systems")
    assert found.exit_code == 0 and all(name in found.stdout for name in SYSTEMS)
    lines = {words[0]: words[3:6] for words in map(str.split, found.stdout.splitlines()) if words}
    assert lines["thruster"] == ["2", "1", "0"] and lines["pendulum"] == ["3", "2", "1"]


# -- compare -----------------------------------------------------------------------------------------------------------


def test_compare_says_which_solver_to_use(folder):
    words = ("compare", "rig.csv", "--inputs", "current", "--outputs", "thrust", "--na", 2, "--nb", 1, "--basis",
             "triangular:5", "--solvers", "gauss_newton", "ipopt", "clarabel", "--repetitions", 2)
    found = run(*words, "-o", "page.html", "--db", "kept.sqlite")
    assert found.exit_code == 0, found.stderr
    lines = found.stdout.splitlines()
    assert lines[0].startswith("6 cells to run") and Path("page.html").stat().st_size > 20_000
    sentence = next(line for line in lines if line.startswith("Use "))
    assert "reached the accuracy of 1e-08 (verified residuals up to 1e-06 count) in" in sentence
    assert "proved globally optimal" in sentence and "not applicable to hammerstein_arx.exact: clarabel" in found.stdout
    assert read_rows("kept.sqlite")["warm_s"].size == 6
    again = run(*words, "--db", "kept.sqlite")
    assert again.stdout.startswith("6 of 6 cells are in kept.sqlite already; nothing is left to run")


def test_compare_assumes_orders_that_nobody_gives_and_says_so(folder):
    found = run("compare", "rig.csv", "--inputs", "current", "--outputs", "thrust", "--formulation",
                "hammerstein_arx.exact", "--solvers", "uno", "--repetitions", 1)
    assert found.exit_code == 0 and "na = 2, nb = 2, basis = triangular:8 assumed" in found.stderr
    assert "Use uno" in found.stdout and "no other to compare it with" in found.stdout
    assert sorted(path.name for path in folder.iterdir()) == ["rig.csv", "rigs.toml"]  # nothing is left behind


def test_compare_tells_an_error_of_the_record_once(folder):
    Path("binary.csv").write_text("u,y\n" + "\n".join(f"{k // 3 % 2},{k % 7}" for k in range(60)))
    found = run("compare", "binary.csv", "--solvers", "gauss_newton", "uno", "--repetitions", 1)
    assert found.exit_code == 2 and found.stderr.count("is binary") == 1 and "no solver was run" in found.stderr


# -- what a new user gets wrong ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("words, told", [
    (("study", "run"), "give a study file, or --example"),
    (("study", "run", "rigs.toml", "--example"), "not both"),
    (("study", "run", "rags.toml"), "study file rags.toml cannot be read: No such file"),
    (("study", "run", "rig.csv"), "at line 1, column"),
    (("study", "run", "rigs.toml", "--db", "no/rows.sqlite"), "there is no folder"),
    (("study", "run", "rigs.toml", "--db", "rig.csv"), "rig.csv"),
    (("study", "run", "rigs.toml", "--export", "rows.xlsx"), ".parquet or .csv"),
    (("study", "run", "rigs.toml", "--retry", "crshed"), "Did you mean 'crashed'"),
    (("study", "run", "rigs.toml", "-w", 0), "workers must be a positive integer; got 0"),
    (("study", "report", "none.sqlite", "-o", "."), "it is a folder; name a file in it"),
    (("study", "report", "none.sqlite"), "no such database"),
    (("study", "report", "rigs.toml"), "rigs.toml"),
    (("study", "export", "none.sqlite", "rows.csv"), "no such database"),
    (("compare",), "give a data file, or --example"),
    (("compare", "none.csv"), "no file 'none.csv'"),
    (("compare", "rig.csv"), "no column 'u'"),
    (("compare", "rig.csv", "-u", "curent", "-y", "thrust"), "Did you mean 'current'"),
    (("compare", "--example", "thrster"), "Did you mean 'thruster'"),
    (("compare", "--example", "thruster", "--solvers", "clarabell"), "Did you mean 'clarabel'"),
    (("compare", "--example", "thruster", "--accuracy", 3), "--accuracy must be less than 1"),
    (("compare", "--example", "thruster", "--repetitions", 0), "--repetitions must be greater than 0"),
    (("compare", "--example", "thruster", "-f", "hammerstein_arx.exat"), "Did you mean 'hammerstein_arx.exact'"),
    (("compare", "--example", "thruster", "--basis", "triangel:8"), "Did you mean 'triangular'"),
    (("compare", "--example", "thruster", "-c", "monoton"), "Did you mean 'monotone'"),
    (("compare", "--example", "thruster", "--bassis", "triangular:8"), "takes no --bassis"),
])
def test_what_a_new_user_gets_wrong(folder, words, told):
    found = run(*words)
    assert found.exit_code == 2 and not isinstance(found.exception, StudyError)
    assert told in " ".join(found.stderr.replace("│", " ").split()), found.stderr
    assert "Traceback" not in found.stderr and not list(folder.glob("rigs.sqlite"))


def test_a_place_that_takes_no_files_is_told_before_any_work(folder, monkeypatch):
    from optid.cli import results

    monkeypatch.setattr(results.os, "access", lambda path, mode: Path(path) == folder / "rig.csv")
    told = run("study", "report", "none.sqlite", "-o", "page.html").stderr
    assert f"page.html cannot be written: folder {folder} is read-only; give a file in another folder" in told
    results.check_folders(folder / "rig.csv")


def test_names_from_files_reach_the_terminal_without_their_control_characters(capfd):
    from optid.cli.terminal import note, print_text

    hostile = "\x1b]0;title\x07\x1b[31mred\x9b2J\u202egnp"
    print_text(hostile)
    note(hostile)
    print_text(str(conclude([row(hostile, **FAILED)])))
    out, err = capfd.readouterr()
    assert "red" in out and out.count("gnp") >= 2 and "red" in err
    assert not set("\x1b\x07\x9b\u202e") & set(out + err)


def test_a_study_of_one_solver_concludes_about_formulations_and_shows_their_table(folder):
    Path("rigs.toml").write_text(STUDY.format(solvers='["auto"]').replace("seeds = 2", "seeds = 1"))
    found = run("study", "run", "rigs.toml", "-w", 1)
    assert found.exit_code == 0 and "Models: cannot tell" in found.stdout and "needs at least 6" in found.stdout
    assert all(word in found.stdout for word in ("simul.", "params", "on thruster", "2 of 2"))

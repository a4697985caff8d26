"""One cell: whatever the fit does is a row."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from optid import Data, fit
from optid.backends import Answer, BackEnd, back_ends
from optid.core.least_squares import RankOneForm
from optid.core.statement import statement_of
from optid.errors import StudyError
from optid.program.solution import Status
from optid.studies.definition import DataEntry, FormulationEntry, SolverEntry
from optid.studies.execution import cell as cells
from optid.studies.execution import machine as memory
from optid.studies.execution.cell import lost_row, run_cell
from optid.studies.execution.machine import Peak
from optid.studies.grid import cells as expand
from optid.studies.storage.rows import NAMES
from optid.studies.study import Study

OPTIONS = {"na": 2, "nb": 2, "basis": "triangular:6"}


def one(solver="gauss_newton", formulation="hammerstein_arx.exact", *, entry=None, options=OPTIONS, constraints=(),
        solver_options=None, **settings):
    entry = entry or DataEntry("dead zone", system="dead_zone", samples=(300,), noise=(0.1,))
    study = Study("small", (entry,), (FormulationEntry("f", formulation, constraints, options),),
                  (SolverEntry("s", solver, options=solver_options or {}),), **settings)
    return expand(study)[0]


@pytest.fixture
def solver(monkeypatch):
    """Register a back end for the test."""

    def register(run, classes=(), takes=RankOneForm.of):
        monkeypatch.setitem(back_ends(), "mine", BackEnd("mine", frozenset(classes), run, form="rank-one", takes=takes))
        return "mine"

    return register


def test_a_row_has_what_the_fit_says():
    cell = one(holdout=0.25)
    row = run_cell(cell)
    assert tuple(row) == NAMES
    assert (row["outcome"], row["status_verified"], row["reached"], row["proved"]) == ("done", "optimal", True, True)
    record = cells.load(cell)
    direct = fit(record.data, cell.formulation_name, solver="gauss_newton", **OPTIONS)
    assert row["objective"] == pytest.approx(direct.solution.objective, rel=1e-12)
    assert json.loads(row["parameters"])["a1"] == pytest.approx(direct.model.a[0], rel=1e-12)
    poles = [complex(*pole) for pole in json.loads(row["poles"])]
    np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(direct.model.poles), rtol=1e-9)
    assert row["n_estimation"] == 300 and row["n_samples"] == 400
    y, predicted = record.holdout.y, direct.model.predict(record.holdout)
    here = ~np.isnan(predicted[:, 0])
    e, y = (y - predicted)[here, 0], y[here, 0]
    expected = 100 * (1 - np.linalg.norm(e) / np.linalg.norm(y - y.mean()))
    assert row["one_step_fit"] == pytest.approx(expected, rel=1e-9)
    assert row["simulation_fit"] < row["one_step_fit"]
    assert 0.0 < row["parameter_error"] < 0.2 and 0.0 < row["nonlinearity_error"] < 0.2
    assert row["build_s"] > 0.0 and row["solve_s"] > 0.0 and row["total_s"] >= row["fit_s"]
    assert row["peak_mb"] >= row["base_mb"] > 10.0


def test_the_record_is_loaded_once_per_worker(monkeypatch):
    cells._records.clear()
    calls = []
    monkeypatch.setattr(cells, "load", lambda cell, real=cells.load: calls.append(cell.seed) or real(cell))
    study_cells = [one(seeds=(seed,)) for seed in (1, 2, 1, 3, 4, 1)]
    for cell in study_cells:
        cells._loaded(cell)
    assert calls == [1, 2, 3, 4]
    assert len(cells._records) == cells.KEPT


def test_warm_is_a_second_solve_from_the_solution():
    row = run_cell(one("ipopt", warm=True))
    assert row["warm_s"] > 0.0 and row["warm_status"] == "locally optimal"
    assert row["warm_iterations"] <= row["iterations"]
    assert run_cell(one("ipopt"))["warm_s"] is None


def test_the_solver_has_the_time_that_loading_left_and_the_second_solve_the_same(solver, monkeypatch):
    """The same: another number would have some back ends compile once more."""
    limits = []

    def run(program, settings):
        limits.append(settings.time_limit)
        return back_ends()["ipopt"].run(program, settings)

    monkeypatch.setattr(cells, "_records", {})
    monkeypatch.setattr(cells, "load", lambda cell, real=cells.load: time.sleep(0.3) or real(cell))
    monkeypatch.setattr(cells, "REHEARSED", 0.0)
    row = run_cell(one(solver(run), warm=True, time_limit=50.0))
    assert row["outcome"] == "done", row["reason"]
    assert row["warm_s"], row["reason"]
    assert limits[0] == limits[1] <= 49.7


@pytest.mark.slow
def test_a_second_solve_for_which_too_little_time_is_left_is_left_out(solver):
    calls = []

    def run(program, settings):
        calls.append(settings.time_limit)
        time.sleep(1.6)
        return back_ends()["ipopt"].run(program, settings)

    row = run_cell(one(solver(run), warm=True, time_limit=3.0))
    assert row["outcome"] == "done" and row["reached"] and row["warm_s"] is None and len(calls) == 1
    assert "no warm solve: " in row["reason"] and "s of the time limit were left" in row["reason"]


@pytest.mark.parametrize("error", [ZeroDivisionError("no"), MemoryError("no"), SystemExit("no")])
def test_an_error_in_the_second_solve_leaves_the_row_of_the_first(monkeypatch, error):
    kept = []

    def broken(*arguments, **settings):
        assert kept  # the parent has it, whatever becomes of this process
        raise error

    monkeypatch.setattr(cells, "keep", kept.append)
    monkeypatch.setattr(cells, "solve", broken)
    row = run_cell(one("ipopt", warm=True))
    assert row["outcome"] == "done" and row["reached"] and row["warm_status"] is None
    assert row["reason"] == f"no warm solve: {type(error).__name__}: no"
    changed = {"reason", "total_s", "peak_mb"}
    assert {k: v for k, v in row.items() if k not in changed} == {k: v for k, v in kept[-1].items() if k not in changed}


def test_memory_that_only_the_second_solve_takes_leaves_the_row_of_the_first(monkeypatch):
    def hungry(*arguments, real=cells.solve, **settings):
        np.ones(60_000_000)
        return real(*arguments, **settings)

    run_cell(one("ipopt", warm=True))
    monkeypatch.setattr(cells, "solve", hungry)
    row = run_cell(one("ipopt", warm=True, memory_limit=Peak().start + 300.0))
    assert row["outcome"] == "done" and row["reached"] and row["warm_s"] is None
    assert "no warm solve: held" in row["reason"]


@pytest.mark.slow
def test_a_procedure_has_its_steps_and_their_times():
    row = run_cell(one("auto", "subspace.nuclear", options={"nx": 2}, warm=True))
    assert row["outcome"] == "done" and row["n_programs"] > 1 and row["warm_s"] is None
    assert row["build_s"] > 0.0
    assert row["compile_s"] is None  # no step goes through CVXPY
    assert row["build_s"] + row["solve_s"] + row["judge_s"] + row["prove_s"] <= row["fit_s"] * 1.01


def test_a_file_without_truth(tmp_path):
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 400)
    y = np.convolve(u, [0.0, 0.5, 0.3])[:400] + 0.01 * rng.standard_normal(400)
    np.savetxt(tmp_path / "x.csv", np.column_stack([u, y]), delimiter=",", header="u,y", comments="")
    entry = DataEntry("mine", files=("x.csv",), options={"inputs": ["u"], "outputs": ["y"], "dt": 0.1})
    row = run_cell(one("clarabel", "arx", entry=entry, options={"na": 1, "nb": 2, "nk": 1}, folder=tmp_path))
    assert row["outcome"] == "done" and row["parameter_error"] is None and row["data_hash"]
    assert row["n_samples"] == 400 and row["n_estimation"] == 280
    assert row["one_step_fit"] > 95.0 and row["samples"] is None and row["seed"] is None


def test_a_file_that_changed_since_the_study_started_is_no_longer_its_data(tmp_path):
    file = tmp_path / "x.csv"
    rng = np.random.default_rng(0)
    np.savetxt(file, rng.standard_normal((200, 2)), delimiter=",", header="u,y", comments="")
    entry = DataEntry("mine", files=("x.csv",), options={"inputs": ["u"], "outputs": ["y"]})
    cell = one("clarabel", "arx", entry=entry, options={"na": 1, "nb": 1}, folder=tmp_path)
    assert run_cell(cell)["outcome"] == "done"
    cells._records.clear()
    file.write_text(file.read_text() + "1.0,2.0\n")
    row = run_cell(cell)
    assert row["outcome"] == "error" and "changed since" in row["reason"]
    file.unlink()
    assert run_cell(cell)["outcome"] == "error"


def test_the_first_quick_cell_of_its_kind_is_run_twice(monkeypatch):
    calls = []
    monkeypatch.setattr(cells, "fit", lambda *a, real=cells.fit, **k: calls.append(k["solver"]) or real(*a, **k))
    monkeypatch.setattr(cells, "_rehearsed", set())
    for solver in ("gauss_newton", "gauss_newton", "ipopt", "clarabel", "clarabel"):  # the last refuses
        run_cell(one(solver))
    assert calls == ["gauss_newton"] * 3 + ["ipopt"] * 2  # a solver of no step is refused before a fit
    calls.clear()
    run_cell(replace(one("fatrop"), options={**OPTIONS, "na": -1}))  # it ends before the solver is imported
    run_cell(one("fatrop"))
    assert calls == ["fatrop"] * 3
    monkeypatch.setattr(cells, "_rehearsed", set())
    monkeypatch.setattr(cells, "REHEARSED", 0.0)
    calls.clear()
    run_cell(one())
    assert calls == ["gauss_newton"]


def test_memory_above_the_limit_that_nobody_saw_is_an_outcome(monkeypatch):
    def hungry(*arguments, real=cells.fit, **settings):
        np.ones(60_000_000)
        return real(*arguments, **settings)

    limit = Peak().start + 300.0
    assert run_cell(one(memory_limit=limit))["outcome"] == "done"
    monkeypatch.setattr(cells, "fit", hungry)
    row = run_cell(one(memory_limit=limit))
    assert row["outcome"] == "memory limit" and row["peak_mb"] > limit and row["objective"] is None


@pytest.mark.parametrize("without", ["nothing", "_CLEAR", "_STATUS"])
def test_the_peak_of_memory_is_that_since_the_start(monkeypatch, tmp_path, without):
    """Some kernels let nobody reset the figure, some take the reset and do not have the figure."""
    if without == "_CLEAR":
        monkeypatch.setattr(memory, "_CLEAR", tmp_path / "not" / "there")
    if without == "_STATUS":
        monkeypatch.setattr(memory, "_STATUS", tmp_path / "status")
        (tmp_path / "status").write_text("Name: python\n")
    before = Peak()
    held = np.ones(40_000_000)
    assert before.mb() > before.start + 300.0
    after = Peak()
    assert after.start > 300.0
    del held
    assert after.mb() < after.start + 50.0


def test_nothing_held_out():
    row = run_cell(one(holdout=0.0))
    assert row["one_step_fit"] is row["simulation_fit"] is None and row["parameter_error"] is not None


@pytest.mark.parametrize("cell, outcome, words", [
    (lambda: one("clarabel"), "refused", "is not convex and is taken by alternating"),
    (lambda: replace(one(), solver_name="gurobi"), "refused", "pip install gurobipy"),
    (lambda: replace(one("osqp"), formulation_name="subspace.nuclear", options={"nx": 1}), "refused",
     "osqp does not take 'low rank', the main step"),
    (lambda: replace(one(), options={**OPTIONS, "na": -1}), "error", "StructureError.*na"),
    (lambda: replace(one(), options={**OPTIONS, "nab": 1}), "error", "takes no argument 'nab'"),
    (lambda: one(options={**OPTIONS, "na": 200, "nb": 200}), "error", "RankError"),
    (lambda: replace(one(), constraints=("monoton:increasing",)), "error", "Did you mean 'monotone'"),
    (lambda: one(entry=DataEntry("flat", record=Data(np.ones(100), np.arange(100.0)))), "error", "RankError|DataError"),
    (lambda: replace(one(), formulation_name="hammerstein_arx.exact", samples=None), "error", "needs a length"),
])
def test_what_cannot_be_run_is_a_row_with_its_reason(cell, outcome, words):
    import re

    row = run_cell(cell())
    assert row["outcome"] == outcome and re.search(words, row["reason"])
    assert not row["reached"] and row["objective"] is None


@pytest.mark.parametrize("error, outcome", [
    (MemoryError("Unable to allocate 3 TiB"), "memory limit"), (SystemExit(3), "error"),
    (ZeroDivisionError("x"), "error"),
])
def test_errors_outside_the_solver(monkeypatch, error, outcome):
    def broken(*arguments, **options):
        raise error

    monkeypatch.setattr(cells, "fit", broken)
    row = run_cell(one())
    assert row["outcome"] == outcome and str(error) in row["reason"]


@pytest.mark.parametrize("change, outcome", [
    (lambda v: np.full_like(v, np.nan), "non-finite"), (lambda v: v * 1e100, "non-finite"),
    (lambda v: v * 1e200, "non-finite"), (lambda v: v + 0.5, "done")])
def test_a_solver_that_lies_or_returns_what_is_not_finite_is_caught(solver, change, outcome):
    row = run_cell(one(solver(lambda program, settings: Answer(Status.OPTIMAL, "solved!", {
        name: change(np.array(value, dtype=float)) for name, value in program.start.items()}))))
    assert row["outcome"] == outcome and row["status_claimed"] == "solved!", row["reason"]
    assert row["false_claim"] and not row["reached"] and not row["proved"]
    assert all(value is None or not isinstance(value, float) or np.isfinite(value) for value in row.values())
    if np.isnan(change(np.ones(1))[0]):
        assert row["status_verified"] == "failed" and row["objective"] is None and row["one_step_fit"] is None
        assert "non-finite" in row["reason"]


def test_a_channel_whose_name_holds_null_is_finite():
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 200)
    y = np.convolve(u, [0.0, 0.5, 0.3])[:200] + 0.01 * rng.standard_normal(200)
    entry = DataEntry("rig", record=Data(u, y, inputs=["null_pressure"]))
    row = run_cell(one("clarabel", "arx", entry=entry, options={"na": 1, "nb": 2}))
    assert "null_pressure" in row["parameters"]
    assert row["outcome"] == "done" and row["reached"]


@pytest.mark.parametrize("value", [np.nan, [1.0, np.inf]])
def test_a_model_whose_parameters_are_not_finite_is_an_outcome(monkeypatch, value):
    monkeypatch.setattr(cells, "_parameters", lambda model: {"a1": 0.5, "mu[u]": value})
    row = run_cell(one())
    assert row["outcome"] == "non-finite" and not row["reached"] and not row["proved"]
    assert "parameters that are not finite" in row["reason"]


def test_a_step_that_was_not_finite_is_no_outcome_of_a_procedure_that_went_on(solver, monkeypatch):
    """The procedure takes a shorter step then; that the claim was false stays in the row."""
    steps = []

    def run(program, settings):
        steps.append(program.name)
        if len(steps) == 1:
            nothing = {name: np.full(v.shape, np.nan) for name, v in statement_of(program).variables.items()}
            return Answer(Status.OPTIMAL, "solved!", nothing)
        return back_ends()["clarabel"].run(program, settings)

    monkeypatch.setattr(cells, "REHEARSED", 0.0)
    row = run_cell(one(solver(run, ("QP", "SOCP", "conic")), "oe.exact", options={"na": 2, "nb": 2},
                       constraints=("stable",)))
    assert len(steps) > 1 and row["outcome"] == "done" and row["reached"] and row["false_claim"]


def test_a_solver_that_raises_is_judged_not_lost(solver):
    def run(program, settings):
        raise RuntimeError("segment lost")

    row = run_cell(one(solver(run)))
    assert (row["outcome"], row["status_verified"]) == ("done", "failed") and "segment lost" in row["reason"]
    assert not row["false_claim"]


def test_an_infeasible_cell_is_done():
    row = run_cell(one("ipopt", constraints=("monotone:increasing", "slope:-5,-4")))
    assert row["outcome"] == "done" and not row["reached"], row["reason"]
    assert row["status_verified"] in ("infeasible", "failed", "inaccurate")


def test_a_seed_that_no_database_holds_is_refused():
    with pytest.raises(StudyError, match=r"must be less than 4611686018427387904"):
        one(seeds=(2**70,))
    assert run_cell(one(seeds=(2**62 - 1,)))["seed"] == 2**62 - 1


def test_the_row_of_a_cell_that_made_none():
    row = lost_row(one(), "crashed", "the worker died: signal SIGSEGV", total_s=1.5)
    assert tuple(row) == NAMES and row["reason"].endswith("SIGSEGV") and row["n_estimation"] == 300
    assert row["key"] == run_cell(one())["key"]

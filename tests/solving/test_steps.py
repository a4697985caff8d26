"""Steps of a formulation: refused before any work, or solved by the solver asked for and judged."""

import warnings

import numpy as np
import pytest
from refusals import refuses

import optid
from optid import Data
from optid.backends.back_end import BackEnd
from optid.backends.choice import back_ends
from optid.cli.results import solver_choice
from optid.errors import DataWarning, LookupFailed, SolverRefused, StructureError
from optid.program.solution import Status
from optid.registry import FORMULATIONS, defaults, find_entry_points, formulation
from optid.solving.steps import choose_solvers, takers
from optid.solving.steps import steps as declare_steps

ARGUMENTS = {
    "arx": {"na": 1, "nb": 1, "nk": 1}, "fir": {"nb": 5},
    "hammerstein_arx": {"na": 1, "nb": 2, "basis": "polynomial:2"},
    "hammerstein_ss": {"nx": 1, "basis": "polynomial:2"}, "subspace": {"nx": 1, "weight": 100.0}, "ss": {"nx": 1},
    "oe": {"na": 1, "nb": 1, "nk": 1}, "hammerstein_oe": {"na": 1, "nb": 1, "nk": 1, "basis": "polynomial:2"},
    "armax": {"na": 1, "nb": 1, "nk": 1, "nc": 1}, "bj": {"na": 1, "nb": 1, "nk": 1, "nc": 0, "nd": 1},
    "hammerstein_armax": {"na": 1, "nb": 1, "nk": 1, "nc": 1, "basis": "polynomial:2"},
    "hammerstein_bj": {"na": 1, "nb": 1, "nk": 1, "nc": 0, "nd": 1, "basis": "polynomial:2"},
    "lfr": {"nx": 1, "tries": 1}, "wiener_ss": {"nx": 1}, "hammerstein_wiener_ss": {"nx": 1, "basis": "polynomial:2"},
    "process": {"process": "P1D", "initial": "free"},
    "physical": {"equations": optid.Equations(lambda v: {"x": v["a"] * v["x"] + v["b"] * v["u"], "y": v["x"]},
                                              {"x": 0.1}, {"a": 0.5, "b": 1.0}, time="discrete")},
}
NAMES = sorted(find_entry_points(FORMULATIONS))
SOLVERS = sorted(name for name, one in back_ends().items() if one.installed)
JUDGED = {Status.OPTIMAL, Status.LOCAL, Status.INACCURATE, Status.LIMIT}


def record(n=70, seed=0):
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, n), np.zeros(n)
    for k in range(1, n):
        y[k] = 0.6 * y[k - 1] + u[k - 1] + 0.3 * u[k - 1] ** 2
    return Data(u, y + 0.05 * rng.standard_normal(n))


def whole(name, **more):
    pose = formulation(name)[1]
    return pose, {**defaults(pose), **ARGUMENTS[name.partition(".")[0]], **more}


def fitted(name, solver, data=None, **more):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        return optid.fit(record() if data is None else data, name, solver=solver, raises=False, prove=False,
                         **{**ARGUMENTS[name.partition(".")[0]], **more})


@pytest.mark.parametrize("constraints", [(), ("stable:0.9",), ("gain:1",)])
@pytest.mark.parametrize("name", NAMES)
def test_every_step_is_taken_by_two_solvers(name, constraints):
    pose, arguments = whole(name, constraints=tuple(map(optid.registry.named_constraint, constraints)))
    declared = pose.steps(arguments)
    assert declared and all(len(takers(step)) >= 2 for step in declared.values()), declared


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", NAMES)
def test_a_solver_is_refused_early_or_its_answer_judged(name, solver):
    pose, arguments = whole(name)
    try:
        solvers = choose_solvers(name, pose, arguments, solver)
    except SolverRefused as refusal:
        with pytest.raises(SolverRefused) as raised:
            fitted(name, solver, Data(np.zeros(3), np.zeros(3)))  # a record from which nothing can be fitted
        assert str(raised.value) == str(refusal)
        return
    fit = fitted(name, solver)
    assert {step for step, _ in fit.steps} <= set(pose.steps(arguments))
    used = {step: {s.solver for name, s in fit.steps if name == step} for step, _ in fit.steps}
    assert any(solver in several for several in used.values()) or solvers.skips_main
    assert solvers.skips_main or used[solvers.main] == {solver}
    assert all(s.status in {*JUDGED, Status.FAILED} for _, s in fit.steps)


def test_every_step_that_runs_is_declared_under_constraints_too():
    for name, rules in {"hammerstein_ss.sid": ["stable:0.5"], "ss.exact": ["stable:0.5"], "oe.exact": ["stable:0.5"],
                        "hammerstein_ss.exact": ["monotone:increasing"], "arx": ["gain:2"]}.items():
        pose, arguments = whole(name, constraints=tuple(map(optid.registry.named_constraint, rules)))
        fit = fitted(name, "auto", constraints=rules)
        assert {step for step, _ in fit.steps} <= set(pose.steps(arguments))


@pytest.mark.parametrize("solver", ["clarabel", "scs"])
def test_the_objective_is_that_of_the_main_step(solver):
    fit = fitted("subspace.nuclear", solver)
    by_step = dict(fit.steps)
    assert fit.solution.objective == by_step["low rank"].objective != by_step["split"].objective
    assert fit.problem.name == "low rank" and fit.solution.solver == solver and set(fit.values) >= {"yhat", "output"}
    assert fit.solution.status is Status.LOCAL
    assert fit.solution.objective == pytest.approx(fitted("subspace.nuclear", "admm").solution.objective, rel=1e-6)
    lines = str(fit).partition("Steps\n")[2].splitlines()[1:4]
    assert lines[0].split()[:4] == ["low", "rank", "1", solver] and lines[1].split()[:3] == ["split", "1", solver]


def test_one_word_serves_the_steps_that_take_it_and_the_others_are_listed():
    fit = fitted("hammerstein_ss.exact", "osqp")
    used = {step: solution.solver for step, solution in fit.steps}
    assert used == {"split": "gauss_newton", "hammerstein_ss.exact": "osqp"}
    assert fit.solution.solver == "osqp"


def test_a_step_has_a_solver_of_its_own():
    fit = fitted("hammerstein_ss.sid", {"split": "ipopt", "shift": "scs"}, basis="polynomial:2",
                 constraints=["stable:0.5"])
    used = {step: solution.solver for step, solution in fit.steps}
    assert used["split"] == "ipopt" and used["shift"] == "scs" and used["shift with fixed P"] == "clarabel"


def test_native_options_are_those_of_the_named_solver():
    fit = optid.fit(record(), "hammerstein_ss.exact", nx=1, basis="polynomial:2", solver="clarabel",
                    solver_options={"max_iter": 150})
    assert {s.solver for step, s in fit.steps if step == "split"} == {"gauss_newton"}


@pytest.mark.parametrize("name, solver, error, words", [
    ("subspace.nuclear", "gauss_newton", SolverRefused, "'low rank' is taken by admm, clarabel"),
    ("arx", "gauss_newton", SolverRefused, "does not take the step 'arx' of 'arx'"),
    ("hammerstein_ss.sid", {"shfit": "scs"}, LookupFailed, "no step 'shfit'. Did you mean 'shift'"),
    ("hammerstein_ss.sid", {"shift": "osqp"}, SolverRefused, "'osqp' does not take the step 'shift'"),
    ("hammerstein_ss.sid", {"shift": "nothing"}, LookupFailed, "no solver is called 'nothing'"),
    ("oe.exact", "clarabell", LookupFailed, "clarabel"),
])
def test_refusals_before_the_record_is_looked_at(name, solver, error, words):
    refuses(error, words, fitted, name, solver, Data(np.zeros(3), np.zeros(3)))


def test_a_solver_that_a_constraint_of_the_user_excludes_is_refused():
    import cvxpy as cp

    with pytest.raises(SolverRefused, match="SOCP"):
        fitted("arx", "osqp", nb=2, constraints=[lambda v: {"short": cp.norm(v["b"]) <= 0.5}])


def test_formulations_without_declared_steps_are_refused_by_their_programmes():
    def bare(data, *, na=1, nb=1, nk=1):
        return formulation("arx")[1](data, na=na, nb=nb, nk=nk)

    refuses(SolverRefused, "gauss_newton", optid.fit, record(), bare, solver="gauss_newton")
    refuses(SolverRefused, "declares no steps", optid.fit, record(), bare, solver={"arx": "scs"})
    marked = declare_steps(lambda given: {"arx": "QP linear"})(bare)
    assert optid.fit(record(), marked, solver={"arx": "scs"}).solution.solver == "scs"


def test_a_back_end_of_the_user_serves_a_step():
    lstsq = back_ends()["lstsq"]
    mine = BackEnd("mine", lstsq.classes, lstsq.run, form=lstsq.form, takes=lstsq.takes)
    fit = fitted("hammerstein_ss.sid", {"split": mine}, basis="linear")
    assert fit.solution.solver == "mine"
    assert fitted("hammerstein_ss.sid", mine, basis="linear").solution.solver == "mine"


def test_the_command_line_names_steps():
    assert solver_choice("scs") == "scs"
    assert solver_choice("shift with fixed P=scs, split=ipopt") == {"shift with fixed P": "scs", "split": "ipopt"}
    refuses(StructureError, "'shift' twice", solver_choice, "shift=scs,shift=clarabel")

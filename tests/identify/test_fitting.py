"""fit: settings, failures as values and as errors, solvers of one's own."""

import os
import time

import numpy as np
import pytest
from problems import BASIS, record
from refusals import refuses
from zoo import anything

import optid
from formulations import hammerstein_arx
from optid.backends import Answer, BackEnd
from optid.core.statement import statement_of
from optid.errors import DataError, DataWarning, LookupFailed, RankError, SolverFailed, StructureError
from optid.program.solution import Status

STRUCTURE = {"na": 2, "nb": 2, "basis": BASIS}


def mine(run):
    return BackEnd("mine", frozenset({"NLP", "QP", "SDP"}), run, takes=anything)


def truth(program, settings):
    """The answer of the own Gauss-Newton, to be spoiled."""
    from optid.backends import find

    return find("gauss_newton").run(program, settings)


def liar(program, settings):
    variables = statement_of(program).variables
    return Answer(Status.OPTIMAL, "all well", {name: 3.0 * np.ones(v.shape) for name, v in variables.items()})


def lazy(program, settings):
    stated = statement_of(program)
    values = dict(program.start) | {"residual": np.zeros(stated.variables["residual"].shape)}
    return Answer(Status.LOCAL, "all well", values,
                  {name: np.zeros(sum(c.size for c in group)) for name, group in stated.constraints.items()})


def crashing(program, settings):
    raise RuntimeError("segment lost")


def dying(program, settings):
    os._exit(3)


def slow(program, settings):
    time.sleep(60)


def empty(program, settings):
    return Answer(Status.OPTIMAL, "done")


def infinite(program, settings):
    variables = statement_of(program).variables
    return Answer(Status.OPTIMAL, "done", {name: np.full(v.shape, np.nan) for name, v in variables.items()})


@pytest.mark.parametrize("run, words", [
    (liar, "claims success, but constraint 'gauge' is violated"),
    (crashing, "RuntimeError: segment lost"),
    (empty, "gave no usable answer"),
    (infinite, "non-finite"),
])
def test_a_bad_solver_is_an_error_for_people_and_a_value_for_studies(run, words):
    refuses(SolverFailed, words, optid.fit, record(), solver=mine(run), **STRUCTURE)
    fit = optid.fit(record(), solver=mine(run), raises=False, **STRUCTURE)
    assert fit.solution.status is Status.FAILED and not fit.solution.proof


def test_a_plain_function_is_a_solver():
    refuses(SolverFailed, "crashing gave no usable answer", optid.fit, record(), solver=crashing, **STRUCTURE)


def test_a_solver_that_dies_is_an_outcome():
    fit = optid.fit(record(), solver=mine(dying), isolate=True, raises=False, **STRUCTURE)
    assert fit.solution.status is Status.FAILED


@pytest.mark.slow
def test_the_time_limit_is_kept():
    started = time.perf_counter()
    fit = optid.fit(record(), solver=mine(slow), time_limit=1.0, raises=False, **STRUCTURE)
    assert time.perf_counter() - started < 50  # the solver takes 60
    assert fit.solution.status is Status.LIMIT and fit.model is None
    with pytest.raises(SolverFailed, match="mine gave no usable answer"):
        optid.fit(record(), solver=mine(slow), time_limit=1.0, **STRUCTURE)


def test_a_point_that_is_not_stationary_is_not_called_a_solution():
    with pytest.warns(DataWarning, match="not stationary"):
        fit = optid.fit(record(noise=2.0, count=60), solver=mine(lazy), **STRUCTURE)
    assert fit.solution.status is Status.INACCURATE


def test_the_verdict_does_not_depend_on_who_solves():
    own = optid.fit(record(), **STRUCTURE)
    other = optid.fit(record(), solver=mine(truth), **STRUCTURE)
    assert other.solution.status is Status.OPTIMAL and other.solution.solver == "mine"
    assert other.solution.objective == pytest.approx(own.solution.objective, rel=1e-12)


def test_a_callable_formulation_and_its_name_are_the_same():
    one = optid.fit(record(), hammerstein_arx.exact, **STRUCTURE)
    other = optid.fit(record(), "hammerstein_arx.exact", **STRUCTURE)
    assert one.solution.objective == other.solution.objective
    assert (one.formulation, other.formulation) == ("exact", "hammerstein_arx.exact")


def test_proofs_can_be_left_out():
    fit = optid.fit(record(), prove=False, **STRUCTURE)
    assert fit.solution.bound is None and fit.solution.status is Status.LOCAL and not fit.solution.proof


def test_the_fit_carries_its_evidence():
    data = record()
    fit = optid.fit(data, **STRUCTURE)
    assert fit.figures["rows"] == fit.figures["candidates"] == 148
    assert fit.figures["condition"] >= 1 and fit.figures["method"] in ("gram", "qr")
    assert fit.solution.status is Status.OPTIMAL and fit.solution.gap < 1e-8
    assert fit.data is data and fit.arguments["na"] == 2
    assert fit.seconds >= fit.solution.times.solve > 0
    assert [name for name, _ in fit.steps] == ["hammerstein_arx.exact"]
    simulated = fit.model.simulate(data, x0="fit")
    expected = 100 * (1 - np.linalg.norm(data.y - simulated) / np.linalg.norm(data.y - data.y.mean()))
    assert fit.simulation_fit[0] == pytest.approx(expected)


def test_missing_rows_are_counted():
    data = record(count=300)
    y = data.y.copy()
    y[50] = np.nan
    fit = optid.fit(optid.Data(u=data.u, y=y), **STRUCTURE)
    assert fit.figures["candidates"] - fit.figures["rows"] == 3  # the sample and the two rows that look back at it


def test_the_caller_s_arrays_are_not_touched():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 200), rng.normal(size=200)
    kept = u.copy(), y.copy()
    optid.fit(optid.Data(u=u, y=y), constraints=["monotone:increasing"], **STRUCTURE)
    assert np.array_equal(u, kept[0]) and np.array_equal(y, kept[1])


def test_fits_are_deterministic():
    one, other = (optid.fit(record(noise=1.0), constraints=["monotone:increasing"], **STRUCTURE) for _ in range(2))
    assert np.array_equal(one.model.a, other.model.a) and one.solution.objective == other.solution.objective


def test_the_model_of_a_flipped_sign_keeps_its_units():
    """On scaled data the sign that a constraint gave to b survives the way back to raw units."""
    data = record(-1.0, noise=0.2)
    raw = optid.Data(u=5 * data.u, y=0.1 * data.y)
    rules = [lambda v: {"rising": v.bases["u"].increments() @ v["mu"] >= 0}, "sign:b,negative"]
    fit = optid.fit(raw.scale(), na=2, nb=2, basis="triangular:6", constraints=rules)
    assert np.all(fit.model.b[0] < 0)


@pytest.mark.parametrize("change, error, words", [
    ({"nbb": 2}, StructureError, "takes no argument 'nbb'. Did you mean 'nb'"),
    ({"constraints": ["monoton"]}, LookupFailed, "Did you mean 'monotone'"),
    ({"solver": "clarabell"}, LookupFailed, "Did you mean 'clarabel'"),
    ({"solver": "clarabel"}, StructureError, "is not convex and is taken by alternating.*gauss_newton, ipopt"),
])
def test_requests_that_cannot_be_met(change, error, words):
    refuses(error, words, optid.fit, record(), **(STRUCTURE | change))


def test_unknown_formulation():
    with pytest.raises(LookupFailed, match="Did you mean 'hammerstein_arx.exact'"):
        optid.fit(record(), "hammerstein_arx.exat", **STRUCTURE)
    refuses(StructureError, "needs na, nb, basis", optid.fit, record())


def test_nonconvex_constraints_are_refused_by_convex_formulations():
    import cvxpy as cp

    with pytest.raises(StructureError, match="constraint 'ring' is not convex.*exact formulation"):
        optid.fit(record(), "hammerstein_arx.nuclear", **STRUCTURE,
                  constraints=[lambda v: {"ring": cp.sum_squares(v["a"]) >= 1}])


@pytest.mark.parametrize("data, error, words", [
    (np.ones(9), DataError, r"takes optid.Data, not ndarray: fit"),
    (record(count=24), RankError, "21 rows for 27 parameters.*longer record"),
])
def test_records_that_will_not_do(data, error, words):
    refuses(error, words, optid.fit, data, **(STRUCTURE | {"nb": 4}))


# numbers that are none

BAD = [
    ("hammerstein_arx.exact", STRUCTURE, {
        "na": [np.inf, np.nan, 10**20, 10**400, 10**5000, -10**5000, 1.5, True, np.array(2.0), 1j],
        "nb": [np.inf, 1e400, 10**5000, np.array(2.0), [1, np.nan]], "nk": [np.nan, 10**5000, np.array(0.0)],
        "ridge": [np.inf, np.nan, 10**400, 10**5000, np.float32(np.inf), True, 1j],
        "curvature": [np.float32(np.inf), -1],
        "accuracy": [0, 1, -1, np.inf, np.nan, 10**5000, "x", None, np.float32(np.inf)],
        "time_limit": [0, -1, np.nan, -np.inf, -10**5000, "x", True], "gauge": [np.array([1, 2]), 3, np.nan],
        "basis": [10**5000, np.nan, np.inf, np.array([1, 2])], "loss": [np.nan, 10**5000]}),
    ("armax.exact", {"na": 1, "nb": 1, "nc": 1}, {
        "seed": [-1, np.inf, 10**5000, 1.5], "starts": [10**5000], "offset": ["x"], "nc": [[1, 2], np.array([1, 2])]}),
    ("ss.exact", {"nx": 1}, {
        "feedthrough": [0, np.nan, None], "initial": [3, ["x"], None], "block_rows": [np.inf, "x", 6.5],
        "iterations": [np.inf], "nx": [np.array([1, 2])]})]


@pytest.mark.parametrize(("formulation", "structure", "name", "values"), [
    (formulation, structure, name, values) for formulation, structure, bad in BAD for name, values in bad.items()])
def test_a_value_that_is_no_number_or_too_large_is_named(formulation, structure, name, values):
    for value in values:
        refuses(StructureError, name, optid.fit, record(count=100), formulation, **{**structure, name: value})


def test_what_an_annotation_excludes_is_said_in_words():
    refuses(StructureError, "seed=1.5: it must be an integer", optid.fit, record(), "oe.exact", na=1, nb=1, seed=1.5)
    refuses(StructureError, "level=nan: it must be a finite number or None", optid.fit, record(),
            own, level=np.nan)
    assert optid.fit(record(), own, level=None).model is not None


def own(data, *, level: float | None = 1.0, na: int = 1):
    """A formulation that does not check its arguments."""
    return hammerstein_arx.exact(data, na=na, nb=1, basis=BASIS)


@pytest.mark.parametrize("limit", [np.inf, 1e400, 10**400])
def test_an_infinite_time_limit_is_none(limit):
    assert optid.fit(record(), time_limit=limit, **STRUCTURE).solution.proof

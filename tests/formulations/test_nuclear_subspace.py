"""Nuclear-norm subspace fits: recovery, missing samples, experiments, feedback, back ends, and refusals."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

import optid
from formulations.nuclear_subspace import low_rank
from optid.backends import Answer, find
from optid.backends.choice import choose
from optid.certificate.dual_points import certify_low_rank
from optid.core.low_rank import LowRankForm
from optid.core.problem import Problem
from optid.core.statement import for_solvers
from optid.core.terms import Squares
from optid.errors import DataWarning, InfeasibleError, RankError, SolverFailed, StructureError
from optid.identify.subspace.low_rank import held_out_fit, structure
from optid.identify.subspace.plan import Plan
from optid.program.solution import Status
from optid.solving.solve import solve

A = np.array([[0.8, 0.4], [-0.4, 0.8]])
B, C = np.array([[1.0, 0.2], [0.5, -0.7]]), np.array([[1.0, 0.3], [-0.2, 0.8]])
D = np.array([[0.3, 0.0], [0.0, -0.4]])


def record(count=120, *, inputs=1, outputs=1, noise=0.0, seed=0, offset=2.0, x0=0.0, f=lambda u: u):
    rng = np.random.default_rng(seed)
    u, x, y = rng.uniform(-1.5, 1.5, (count, inputs)), x0 * rng.normal(size=2), np.zeros((count, outputs))
    for k in range(count):
        y[k] = C[:outputs] @ x + D[:outputs, :inputs] @ f(u[k]) + offset
        x = A @ x + B[:, :inputs] @ f(u[k])
    return u, y + noise * rng.normal(size=y.shape), y


def data(**arguments):
    u, y, _ = record(**arguments)
    return optid.Data(u=u, y=y, dt=0.5)


def poles(model):
    return np.sort_complex(np.asarray(model.poles))


TRUE = np.sort_complex(np.linalg.eigvals(A))


@pytest.mark.parametrize("form", ["predictor", "projection", "instruments"])
@pytest.mark.parametrize("inputs, outputs", [(1, 1), (2, 2)])
def test_without_noise_the_system_is_found(form, inputs, outputs):
    fit = optid.fit(data(inputs=inputs, outputs=outputs, x0=1.0), "subspace.nuclear", form=form, nx=2, block_rows=5,
                    weight=1e6)
    assert np.allclose(poles(fit.model), TRUE, atol=1e-3)
    assert np.min(fit.simulation_fit) > 99.9
    assert fit.figures["its relative gap"] < 1e-5
    assert fit.figures["objective of the convex programme"] >= fit.figures["its dual bound"]


@pytest.mark.parametrize("form", ["projection", "instruments"])
def test_weight_and_order_are_chosen_on_the_part_held_out(form):
    fit = optid.fit(data(noise=0.2, outputs=2, inputs=2), "subspace.nuclear", form=form, block_rows=6)
    figures = fit.figures
    assert figures["weights tried"] > 5 and fit.model.nx == figures["order"]
    _, _, clean = record(noise=0.2, outputs=2, inputs=2)
    simulated = fit.model.simulate(fit.data, x0="fit")
    assert np.linalg.norm(simulated - clean) < 0.15 * np.linalg.norm(clean - clean.mean(axis=0))
    assert figures["simulation fit on the part held out in %"] > 75


def test_the_missing_outputs_are_estimated():
    u, y, clean = record(noise=0.02, count=100, outputs=2)
    gone = np.zeros(y.shape, bool)
    gone[20:23] = gone[50] = True
    gone[70, 1] = True
    measured = np.where(gone, np.nan, y)
    plan = Plan("subspace.nuclear", optid.Data(u=u, y=measured, dt=1.0), 2, 6, "linear", None, "projection")
    structured = structure(plan)
    solution = solve(low_rank(structured, structured.penalty(300.0)))
    estimated = solution.values["yhat"] * structured.scale + structured.centre
    assert np.max(np.abs(estimated - clean)[gone]) < 0.25 and np.std(clean[gone]) > 0.5
    fit = optid.fit(plan.data, "subspace.nuclear", form="projection", nx=2, block_rows=6, weight=300.0)
    assert fit.figures["missing outputs estimated"] == 9
    assert np.allclose(poles(fit.model), TRUE, atol=0.02)


@pytest.mark.parametrize("form", ["predictor", "projection", "instruments"])
def test_missing_inputs_and_several_experiments(form):
    u, y, _ = record(noise=0.01, count=160)
    u[40], y[90] = np.nan, np.nan
    v, z, _ = record(noise=0.01, count=90, seed=1, x0=2.0)
    several = optid.Data(u=[u, v], y=[y, z], dt=0.5)
    fit = optid.fit(several, "subspace.nuclear", form=form, nx=2, block_rows=5, weight=1e3)
    assert np.allclose(poles(fit.model), TRUE, atol=0.03)
    assert held_out_fit(fit.model, data(count=100, seed=5)) > 97


def test_a_hammerstein_system_with_nonlinear_feedback_in_predictor_form():
    rng = np.random.default_rng(0)
    u, x, y = rng.uniform(-2, 2, (220, 1)), np.zeros(2), np.zeros((220, 1))
    for k in range(220):
        y[k] = x[0] + 0.02 * rng.normal()
        x = np.array([[0.7, 0.3], [-0.3, 0.7]]) @ x + np.array([1.0, 0.5]) * (u[k] + 0.4 * u[k] ** 2)
        x = x - np.array([0.25, -0.2]) * y[k] ** 2 / 2
    fit = optid.fit(optid.Data(u=u, y=y, dt=1.0), "subspace.nuclear", nx=2, block_rows=6, basis="polynomial:2",
                    feedback_basis="polynomial:3", weight=300.0)
    assert len(fit.model.feedback) == 1
    simulated = fit.model.simulate_measured_feedback(fit.data, x0="fit")
    assert 100 * (1 - np.linalg.norm(simulated - y) / np.linalg.norm(y - y.mean())) > 93
    linear = optid.fit(optid.Data(u=u, y=y, dt=1.0), "subspace.nuclear", nx=2, block_rows=6, weight=300.0)
    assert np.mean(linear.simulation_fit) < 80


@pytest.mark.sampled(2)
@pytest.mark.parametrize("form", ["predictor", "projection", "instruments"])
@pytest.mark.parametrize("missing", [False, True])
def test_every_back_end_ends_at_the_same_objective(form, missing):
    u, y, _ = record(count=40, noise=0.2, outputs=2)
    if missing:
        y[[7, 20], 0] = np.nan
    plan = Plan("subspace.nuclear", optid.Data(u=u, y=y, dt=1.0), 2, 4, "linear", None, form)
    structured = structure(plan)
    own = solve(low_rank(structured, structured.penalty(20.0)), "admm")
    assert own.status is Status.OPTIMAL and own.proof and own.gap < 1e-6
    for solver, accuracy in (("clarabel", 1e-8), ("scs", 1e-6)):
        other = solve(low_rank(structured, structured.penalty(20.0)), solver, accuracy=accuracy)
        assert other.objective == pytest.approx(own.objective, rel=1e-4)
        assert own.bound.value <= other.objective * (1 + 1e-6)
        assert other.bound.value == pytest.approx(own.bound.value, rel=1e-3)


def programme(**arguments):
    plan = Plan("subspace.nuclear", data(count=50, noise=0.2), 2, 4, "linear", None, "projection")
    structured = structure(plan)
    return structured, for_solvers(low_rank(structured, structured.penalty(20.0), **arguments))


def test_the_bound_is_recomputed_whatever_a_solver_says():
    structured, program = programme()
    own = solve(program, "admm")
    rng = np.random.default_rng(0)
    for scale in (0.0, 1e-3, 1.0, 1e6):
        wrong = {"structure": own.duals["structure"] + scale * rng.normal(size=own.duals["structure"].size)}
        bound = certify_low_rank(program, LowRankForm.of(program), own.values, wrong)
        assert bound.value <= own.objective * (1 + 1e-9)
        assert bound.proved or scale
        assert np.linalg.norm(bound.multipliers, 2) <= 1 + 1e-9

    def lying(program, settings):
        answer = find("admm").run(program, settings)
        return Answer(Status.OPTIMAL, "optimal", {"yhat": 1.01 * answer.values["yhat"]}, answer.duals)

    found = solve(program, lying)
    assert found.status is Status.INACCURATE and not found.proof and "bound" in found.reason


def test_the_programme_chooses_the_admm_unless_something_else_is_asked_of_it():
    _, program = programme()
    assert choose(program)[0].name == "admm"
    bounded = for_solvers(program.subject_to(lambda view: {"ceiling": view["output"] <= 4.0}))
    assert choose(bounded)[0].name == "clarabel"
    assert "takes no further constraints ('ceiling')" in find("admm").refuses(bounded)
    assert "admm solves nuclear" in find("admm").refuses(for_solvers(Problem("other", {"x": np.zeros(2)}, (
        Squares(np.eye(2), np.ones(2), 0.0, ("x",)),))))
    free, held = solve(program), solve(bounded)
    assert held.status in (Status.OPTIMAL, Status.LOCAL) and held.objective >= free.objective - 1e-7


def test_weights_are_changed_in_one_problem():
    structured, program = programme()
    first = solve(program)
    second = solve(program.under_weights(weight=structured.penalty(200.0)))
    assert second.objective > first.objective
    again = solve(low_rank(structured, structured.penalty(200.0)))
    assert again.objective == pytest.approx(second.objective, rel=1e-6)


def test_an_iteration_limit_is_reported():
    def hasty(program, settings):
        if LowRankForm.of(program) is None:
            return find("clarabel").run(program, settings)
        return find("admm").run(program, replace(settings, options={"limit": 3}))

    with pytest.warns(DataWarning, match="nuclear-norm programme: iteration limit at a relative gap"):
        fit = optid.fit(data(noise=0.2), "subspace.nuclear", form="projection", nx=2, block_rows=5, weight=30.0,
                        solver=hasty)
    assert fit.solution.status is Status.LIMIT


def test_constraints_on_poles_and_coefficients():
    rules = ["stable:0.7", "gain:0.5"]
    fit = optid.fit(data(noise=0.1), "subspace.nuclear", form="projection", nx=2, block_rows=5, weight=300.0,
                    constraints=rules)
    assert np.max(np.abs(fit.model.poles)) <= 0.7 + 1e-6
    gain = fit.model.C @ np.linalg.solve(np.eye(2) - fit.model.A, fit.model.B) + fit.model.D
    assert gain[0, 0] == pytest.approx(0.5, abs=1e-5)
    assert fit.figures["suboptimality of A under the pole constraints"] > 0


def test_contradicting_regions_are_named():
    with pytest.raises(InfeasibleError, match="disc:0,0.3.*strip:0.5,0.9|strip:0.5,0.9.*disc:0,0.3"):
        optid.fit(data(noise=0.1), "subspace.nuclear", form="projection", nx=2, block_rows=5, weight=300.0,
                  constraints=["disc:0.0,0.3", "strip:0.5,0.9"])


def test_the_order_is_the_number_of_singular_values_that_count():
    one = structure(Plan("subspace.nuclear", data(count=50, noise=0.2), 2, 4, "linear", None, "projection"))
    found = [replace(one, problem=replace(one.problem, rows=rows), size=1.0) for rows in (10, 40, 5)]
    assert found[0].order(np.array([10.0, 5.0, 0.02, 0.009, 0.0])) == 3
    assert found[1].order(np.full(30, 1.0)) == 10 and found[2].order(np.full(30, 1.0)) == 4


def test_scales_and_offsets_of_the_channels_do_not_matter():
    u, y, _ = record(noise=0.1, outputs=2)
    plain = optid.fit(optid.Data(u=u, y=y, dt=1.0), "subspace.nuclear", form="projection", nx=2, block_rows=5,
                      weight=100.0)
    moved = optid.fit(optid.Data(u=1e3 * u, y=y * [1e-4, 50.0] + [7.0, -3e4], dt=1.0), "subspace.nuclear",
                      form="projection", nx=2, block_rows=5, weight=100.0)
    assert np.allclose(poles(plain.model), poles(moved.model), atol=1e-4)
    assert np.allclose(plain.simulation_fit, moved.simulation_fit, atol=1e-3)


@pytest.mark.parametrize("arguments, error, words", [
    ({"form": "n2sid"}, StructureError, "form='n2sid'"),
    ({"form": "projection", "feedback_basis": "polynomial:3"}, StructureError, "use form='predictor'"),
    ({"weight": -1.0}, StructureError, "a positive number, several, or 'auto'"),
    ({"weight": "best"}, StructureError, "weight='best'"),
    ({"noise": 0.0}, StructureError, "positive standard deviation"),
    ({"noise": 0.1, "weight": 3.0}, StructureError, "takes the place of weight="),
    ({"hold_out": 1.0}, StructureError, "hold_out"),
    ({"nx": 6, "block_rows": 5}, StructureError, "5 block rows for order 6"),
    ({"block_rows": 60, "weight": 1.0}, RankError, "usable windows"),
    ({"nx": 4, "block_rows": 6, "weight": 1e-4, "form": "projection"}, SolverFailed, "has rank .* larger weight")])
def test_bad_requests(arguments, error, words):
    refuses(error, words, optid.fit, data(noise=0.1), "subspace.nuclear", **{"form": "projection"} | arguments)


def test_a_long_record_is_refused():
    with pytest.raises(StructureError, match="6000 output samples.*hammerstein_ss.asivid"):
        optid.fit(data(count=6000, noise=0.1), "subspace.nuclear", nx=2, weight=1.0)


@pytest.mark.skipif(not os.environ.get("OPTID_DATA"), reason="OPTID_DATA names no folder with real data")
def test_the_arm_of_the_cd_player_in_a_hundred_samples():
    path = Path(os.environ["OPTID_DATA"]) / "daisy_cdplayer.csv"
    whole = optid.read(path, inputs=["u1", "u2"], outputs=["y1", "y2"]).experiments[0]
    train, rest = (optid.Data(u=whole.u[part], y=whole.y[part], dt=1.0) for part in (slice(100), slice(100, 400)))
    with pytest.warns(DataWarning):  # few lines in the inputs; an estimate of A that needs the stability step
        fit = optid.fit(train, "subspace.nuclear", form="projection", noise=0.27, block_rows=15)
    assert fit.model.nx == 2 and fit.figures["its relative gap"] < 1e-6
    assert held_out_fit(fit.model, rest) > 73

"""The constrained shift step: poles where they were wanted, bounds that hold, and the true optimum by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from scipy.optimize import minimize

import optid
import optid.identify.subspace.shift
from formulations.constraints.poles import damped, disc, sector, stable, strip
from formulations.hammerstein_ss import SUBSPACE
from optid.backends import Answer, find
from optid.certificate.infeasibility import explain
from optid.errors import DataWarning, StructureError
from optid.program.solution import Status
from optid.solving.solve import Evidence, run


def constrained_shift(up, down, rules=()):
    """The step with the problems of the formulation."""
    return optid.identify.subspace.shift.constrained_shift(up, down, rules, (SUBSPACE.shift, SUBSPACE.centre))


def observability(matrix, outputs, rows, rng, noise=0.0):
    """(up, down) of a noisy observability matrix with orthonormal columns."""
    blocks = [rng.normal(size=(outputs, len(matrix)))]
    for _ in range(rows - 1):
        blocks.append(blocks[-1] @ matrix)
    gamma = np.vstack(blocks)
    gamma = np.linalg.svd(gamma + noise * rng.normal(size=gamma.shape), full_matrices=False)[0]
    return gamma[:-outputs], gamma[outputs:]


def unstable(n, rng, size=1.02):
    matrix = rng.normal(size=(n, n))
    return matrix * size / np.max(np.abs(np.linalg.eigvals(matrix)))


def solved(up, down, rules, solver="auto"):
    """Run the step inside a procedure that also works where it poses nothing."""
    step = constrained_shift(up, down, rules)
    try:
        first = next(step)
    except StopIteration as stop:
        return stop.value, None

    def procedure():
        solution = yield first
        while True:
            try:
                program = step.send(solution)
            except StopIteration as stop:
                return stop.value
            solution = yield program

    outcome = run(procedure(), solver)
    return outcome.model, outcome


REGIONS = [stable(1.0), stable(0.8), damped(0.3), strip(-0.2, 0.8), sector(1.2), disc(0.3, 0.6)]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("rule", REGIONS, ids=lambda rule: rule.name)
@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_poles_lie_where_they_were_wanted(rule, n):
    rng = np.random.default_rng(n)
    applied = 0
    for _ in range(4):
        shift, _ = solved(*observability(unstable(n, rng), 2, 10, rng, 0.02), [rule])
        assert shift.status in (Status.OPTIMAL, Status.LOCAL) or "not stationary" in shift.reason, shift.reason
        assert rule.verify(type("Model", (), {"poles": np.linalg.eigvals(shift.a)})) == ""
        assert shift.suboptimality >= -1e-12
        applied += shift.applied
    assert applied or n == 1


def test_the_residual_is_measured_and_the_certificate_proves_the_poles():
    rng = np.random.default_rng(3)
    up, down = observability(unstable(4, rng), 2, 10, rng, 0.02)
    shift, outcome = solved(up, down, [stable(0.95)])
    assert shift.residual == pytest.approx(np.linalg.norm(up @ shift.a - down))
    assert shift.bound == pytest.approx(np.linalg.norm(up @ np.linalg.lstsq(up, down)[0] - down))
    change = np.linalg.qr(up, mode="r")
    inner = change @ shift.a @ np.linalg.inv(change)
    p = [solution.values["P"] for _, solution in outcome.steps if "P" in solution.values][-1]
    whole = np.block([[0.95 * p, inner @ p], [(inner @ p).T, 0.95 * p]])
    assert np.min(np.linalg.eigvalsh(p)) > 0 and np.min(np.linalg.eigvalsh(whole)) > -1e-7
    falls = [s.objective for name, s in outcome.steps if name == "shift with fixed P"]
    assert np.all(np.diff(falls) <= 1e-7)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("radius", [1.0, 0.8])
def test_close_to_the_best_stable_matrix_of_a_search(radius):
    """With two states, |eigenvalues| < r is the triangle of trace and determinant: searched from many starts."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        up, down = observability(unstable(2, rng, 1.1), 2, 8, rng, 0.05)
        shift, _ = solved(up, down, [stable(radius)])
        if not shift.applied:
            continue

        def slack(x):
            a = x.reshape(2, 2) / radius
            trace, determinant = np.trace(a), np.linalg.det(a)
            return np.array([1 - determinant, 1 + determinant - trace, 1 + determinant + trace])

        found = []
        for start in [shift.a, 0.5 * np.linalg.lstsq(up, down)[0], *(0.3 * rng.normal(size=(2, 2)) for _ in range(8))]:
            got = minimize(lambda x, u=up, d=down: float(np.sum((u @ x.reshape(2, 2) - d) ** 2)), start.ravel(),
                           method="SLSQP", constraints={"type": "ineq", "fun": slack},
                           options={"maxiter": 500, "ftol": 1e-14})
            if np.min(slack(got.x)) > -1e-7:
                found.append(np.sqrt(got.fun))
        assert shift.bound <= min(found) + 1e-7
        assert min(found) - 1e-5 <= shift.residual <= 1.05 * min(found) + 0.02 * (min(found) - shift.bound)


def test_nothing_is_posed_where_least_squares_obeys():
    rng = np.random.default_rng(0)
    shift, outcome = solved(*observability(unstable(3, rng, 0.7), 1, 8, rng), [stable(0.99), sector(np.pi / 2)][:1])
    assert outcome is None and not shift.applied and shift.suboptimality == 0 and shift.status is Status.OPTIMAL


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["scs", "cvxopt"])
def test_any_semidefinite_back_end_gives_the_same_matrix(solver):
    rng = np.random.default_rng(5)
    up, down = observability(unstable(3, rng), 2, 10, rng, 0.02)
    one, _ = solved(up, down, [stable(0.95)])
    other, _ = solved(up, down, [stable(0.95)], solver)
    assert other.residual == pytest.approx(one.residual, rel=2e-3)


def spread_poles(n, outside, rng):
    """A matrix with well separated pairs of poles, some of them outside the unit circle."""
    sizes, angles = rng.uniform(0.4, 0.9, n // 2), np.linspace(0.2, 2.9, n // 2)
    sizes[:outside] = rng.uniform(1.001, 1.02, outside)
    matrix = np.zeros((n, n))
    for i, (size, angle) in enumerate(zip(sizes, angles)):
        turn = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
        matrix[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = size * np.array(turn)
    return matrix


def posed_orders(outcome):
    return {len(solution.values["P"]) for _, solution in outcome.steps if "P" in solution.values}


@pytest.mark.parametrize(("n", "outside"), [(24, 2), (60, 7)])
def test_of_a_large_order_only_the_poles_that_disobey_are_moved(n, outside):
    """One programme for order 60 takes gigabytes and minutes."""
    rng = np.random.default_rng(n)
    up, down = observability(spread_poles(n, outside, rng), 28, 6, rng, 1e-4)
    free = np.linalg.eigvals(np.linalg.lstsq(up, down, rcond=None)[0])
    moved = np.abs(free) > 0.999
    shift, outcome = solved(up, down, [stable(0.999)])
    assert 2 * outside == moved.sum() and max(posed_orders(outcome)) <= 8
    poles = np.linalg.eigvals(shift.a)
    assert np.max(np.abs(poles)) <= 0.999
    assert max(np.min(np.abs(poles - pole)) for pole in free[~moved]) < 1e-8
    assert shift.status is Status.LOCAL
    assert shift.residual == pytest.approx(np.linalg.norm(up @ shift.a - down))
    # moving the same poles radially, nothing else changed, costs more
    values, vectors = np.linalg.eig(np.linalg.lstsq(up, down)[0])
    radial = np.real((vectors * (values * np.minimum(1, 0.999 / np.abs(values)))) @ np.linalg.inv(vectors))
    assert 0 < shift.suboptimality < np.linalg.norm(up @ radial - down) - shift.bound


@pytest.mark.slow
@pytest.mark.parametrize("rule", [stable(0.8), sector(1.2), disc(0.3, 0.6)], ids=lambda rule: rule.name)
def test_a_deflated_step_is_nearly_as_good_as_the_whole(rule, monkeypatch):
    ratios = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        up, down = observability(unstable(6, rng), 2, 10, rng, 0.02)
        whole, _ = solved(up, down, [rule])
        with monkeypatch.context() as patch:
            patch.setattr(optid.identify.subspace.shift, "LARGEST", 3)
            patch.setattr(optid.identify.subspace.shift, "AT_ONCE", 3)
            deflated, _ = solved(up, down, [rule])
        assert rule.verify(type("Model", (), {"poles": np.linalg.eigvals(deflated.a)})) == ""
        assert deflated.bound == pytest.approx(whole.bound, rel=1e-12)
        ratios.append(deflated.residual / whole.residual)
    assert np.median(ratios) < 1.25


def test_a_rule_about_all_poles_together_is_not_deflated(monkeypatch):
    rng = np.random.default_rng(3)
    up, down = observability(unstable(4, rng), 2, 10, rng, 0.02)
    together = replace(stable(0.9), verify=lambda model: "too large" if len(model.poles) == 4 and np.max(
        np.abs(model.poles)) > 0.9 else "")
    monkeypatch.setattr(optid.identify.subspace.shift, "LARGEST", 2)
    _, outcome = solved(up, down, [together])
    assert posed_orders(outcome) == {4}


def test_scales_of_the_states_do_not_matter():
    rng = np.random.default_rng(6)
    up, down = observability(unstable(3, rng), 2, 10, rng, 0.02)
    scales = np.diag([1.0, 1e-4, 1e3])
    shift, _ = solved(up @ scales, down @ scales, [stable(0.9)])
    assert shift.applied and shift.status in (Status.OPTIMAL, Status.LOCAL)
    assert np.max(np.abs(np.linalg.eigvals(shift.a))) < 0.9 + 1e-6


def test_regions_that_exclude_each_other_are_named():
    rng = np.random.default_rng(0)
    step = constrained_shift(*observability(unstable(3, rng), 2, 10, rng), [disc(0.0, 0.3), stable(0.99),
                                                                            strip(0.5, 0.9)])

    def procedure():
        shift = yield from step
        return Evidence(shift.a, shift.residual, None, shift.status, shift.reason)

    outcome = run(procedure())
    assert outcome.model is None and outcome.solution.status is Status.INFEASIBLE
    text = explain(outcome.problem)
    assert "disc:0,0.3" in text and "strip:0.5,0.9" in text and "stable" not in text


def test_an_inaccurate_semidefinite_programme_is_reported():
    def sloppy(program, settings):
        answer = find("clarabel").run(program, settings)
        values = {name: value * (1.003 if name in ("Q", "A") else 1.0) for name, value in answer.values.items()}
        return Answer(Status.OPTIMAL, "fine", values, answer.duals)

    rng = np.random.default_rng(3)
    up, down = observability(unstable(4, rng), 2, 10, rng, 0.02)
    shift, _ = solved(up, down, [stable(0.8)], sloppy)
    assert shift.status in (Status.INACCURATE, Status.FAILED)
    assert "pole" in shift.reason or "violated" in shift.reason or "stationary" in shift.reason


def test_a_back_end_without_an_answer_is_reported():
    rng = np.random.default_rng(3)
    up, down = observability(unstable(4, rng), 2, 10, rng, 0.02)
    shift, _ = solved(up, down, [stable(0.8)], lambda program, settings: Answer(Status.FAILED, "numbers ran out"))
    assert shift.a is None and shift.status is Status.FAILED and "numbers ran out" in shift.reason


@pytest.mark.parametrize("up, down, words", [(np.ones((2, 3)), np.ones((2, 3)), "as many rows as states"),
                                             (np.ones((4, 2)), np.ones((3, 2)), "one shape"),
                                             (np.ones((4, 2)), np.ones((4, 2)), "rank below 2")])
def test_bad_matrices(up, down, words):
    refuses(StructureError, words, solved, up, down, [strip(2.0, 3.0)])


def slow_record():
    rng = np.random.default_rng(2)
    u, x, y = rng.normal(size=(300, 1)), np.zeros(2), np.zeros((300, 1))
    for k in range(300):
        y[k] = x[0] + 0.05 * rng.normal()
        x = np.array([[0.9, 0.3], [-0.3, 0.9]]) @ x + u[k]
    return optid.Data(u=u, y=y, dt=1.0)


@pytest.mark.parametrize("word, inside", [
    ("stable:0.8", lambda z: abs(z) <= 0.8 + 1e-5), ("disc:0.4,0.5", lambda z: abs(z - 0.4) <= 0.5 + 1e-5),
    ("strip:high=0.7", lambda z: z.real <= 0.7 + 1e-5), ("sector:0.2", lambda z: abs(np.angle(z)) <= 0.2 + 1e-4),
    ("damped:0.6", lambda z: abs(z) <= np.exp(-0.75 * abs(np.angle(z))) + 1e-5)])
def test_every_region_holds_in_a_fit(word, inside):
    fit = optid.fit(slow_record(), "hammerstein_ss.sid", nx=2, block_rows=8, constraints=[word])
    assert all(inside(z) for z in fit.model.poles)
    assert fit.figures["suboptimality of A under the pole constraints"] > 0
    assert [price.name for price in fit.prices] == [fit.arguments["constraints"][0].name]


def test_a_fit_says_so_where_the_semidefinite_programme_was_inaccurate():
    def sloppy(program, settings):
        answer = find("clarabel").run(program, settings)
        if not program.name.startswith("shift"):
            return answer
        values = {name: value * (1.0005 if name in ("Q", "A") else 1.0) for name, value in answer.values.items()}
        return Answer(answer.status, answer.word, values, answer.duals)

    with pytest.warns(DataWarning) as caught:
        fit = optid.fit(slow_record(), "hammerstein_ss.sid", nx=2, block_rows=8, constraints=["stable:0.8"],
                        solver=sloppy)
    assert fit.solution.status is Status.INACCURATE
    assert any("inaccurate" in str(w.message) for w in caught)

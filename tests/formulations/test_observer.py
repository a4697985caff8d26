"""The step for B, D, E and x0, its signals and simulated instruments, against models simulated sample by sample."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses

from optid.bases import Linear, Polynomial, Triangular
from optid.data.record import Data
from optid.errors import RankError
from optid.identify.noise import observer_gain
from optid.identify.subspace.instruments import simulate_clipped
from optid.identify.subspace.realisation import StepMatrices, observer_problem
from optid.identify.subspace.regressors import ObserverForm
from optid.statistics.expansion import expand

A = np.array([[0.8, 0.3], [-0.3, 0.7]])
C = np.array([[1.0, 0.4], [0.2, -1.0]])
NAMES = ["valve", "pump"], ["level", "heat"]


def records_of(rng, lengths, holes=0):
    """Random channels: the step is least squares whatever made them."""
    records = [rng.uniform(-1, 1, (n, 4)) for n in lengths]
    for _ in range(holes):
        records[rng.integers(len(records))][rng.integers(5, min(lengths)), rng.integers(0, 4)] = np.nan
    return records


def expansion_of(records, feedback=True):
    bases = [Polynomial(2).with_interval(-1, 1), Linear()]
    return expand(data_of(records), bases, [Polynomial(3).with_interval(-1, 1), None] if feedback else None)


def data_of(records):
    return Data([r[:, :2] for r in records], [r[:, 2:4] for r in records], inputs=NAMES[0], outputs=NAMES[1])


def gram(step):
    return step.problem.root.T @ step.problem.root


def energy(step):
    return step.problem.value(np.zeros(len(step.problem.target)))


def simulated(form, record, z, x0=None):
    """Outputs of the observer form for unknowns z, by the recursion itself; NaN where the target is missing."""
    n, l, x = form.n, form.l, form.expansion  # noqa: E741
    signals, y = x(record), record[:, 2:4]
    bu, du, ez = np.zeros((n, x.p)), np.zeros((l, x.p)), np.zeros((n, x.q))
    start = 0
    for i, (p, b) in enumerate(form.blocks):
        theta = form.thetas(z)[i]
        if i < 2:
            bu[:, start : start + p] = theta[:, :n].T
            du[:, start : start + p] = theta[:, n:].T if b > n else 0.0
        else:
            ez[:, start - x.p : start - x.p + p] = theta.T
        start += p
    d = z[form.experiments * n : form.linear] if form.offset else np.zeros(l)
    state = np.zeros(n) if x0 is None else x0
    found = np.empty((len(record), l))
    for k in range(len(record)):
        eta, zeta = signals[k, : x.p], signals[k, x.p : x.p + x.q]
        found[k] = form.c @ state + du @ eta + d
        injected = y[k] - found[k] if np.any(form.gain) else np.zeros(l)
        state = form.a @ state + bu @ eta + ez @ zeta + form.gain @ injected
    return found


def columns(form, record, experiment):
    """Regressors and target of one experiment, by simulation with every unknown at one in turn."""
    base = np.zeros(form.size)
    zero = simulated(form, record, base)
    cols = []
    for j in range(form.size):
        z, x0 = base.copy(), np.zeros(form.n)
        z[j] = 1.0
        if j < form.experiments * form.n:
            x0[j % form.n] = float(j // form.n == experiment)
        cols.append((simulated(form, record, z, x0) - zero) * form.weights)
    return np.stack(cols, axis=-1), (record[:, 2:4] - zero) * form.weights


@pytest.mark.parametrize("gain", [False, True])
@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.parametrize("offset", [False, True])
def test_step_is_least_squares_on_the_recursion(gain, feedback, offset, monkeypatch):
    monkeypatch.setattr("optid.identify.subspace.regressors.CHUNK", 20)
    records = records_of(np.random.default_rng(0), [60, 45])
    expansion = expansion_of(records, feedback)
    form = ObserverForm(A, C, observer_gain(A, C, 1.0) if gain else np.zeros((2, 2)), expansion, 2,
                        (True, False), offset, np.array([1.0, 3.0]))
    step = observer_problem(records, form, None)
    parts = [columns(form, record, e) for e, record in enumerate(records)]
    phi = np.concatenate([p.reshape(-1, form.size) for p, _ in parts])
    y = np.concatenate([t.ravel() for _, t in parts])
    np.testing.assert_allclose(gram(step), phi.T @ phi, atol=1e-9)
    np.testing.assert_allclose(step.problem.root.T @ step.problem.target, phi.T @ y, atol=1e-9)
    assert energy(step) == pytest.approx(y @ y) and step.rows == len(y)
    best = np.linalg.lstsq(phi, y, rcond=None)[0]
    np.testing.assert_allclose(step.least_squares(), best, atol=1e-8)
    bu, du, ez, d, x0 = step.matrices(best)
    assert not du[:, 2].any() and x0.shape == (2, 2) and ez.shape == (2, expansion.q) and bu.shape == (2, 3)
    assert np.array_equal(d, best[4:6]) if offset else not d.any()


@pytest.mark.parametrize("kind", ["noisy", "injected", "exact"])
def test_many_rows_enter_by_their_gram_matrix_unless_digits_are_lost(monkeypatch, kind):
    records = records_of(np.random.default_rng(6), [900, 700], holes=0 if kind == "exact" else 4)
    gain = observer_gain(A, C, 1.0) if kind == "injected" else np.zeros((2, 2))
    form = ObserverForm(A, C, gain, expansion_of(records, kind != "exact"), 2, (True, True), True, np.array([1.0, 3.0]))
    if kind == "exact":  # the Gram matrix would know half the digits of what remains
        z = np.random.default_rng(7).normal(size=form.size)
        for e, record in enumerate(records):
            record[:, 2:4] = simulated(form, record, z, z[2 * e : 2 * e + 2])
    step = observer_problem(records, form, None)
    monkeypatch.setattr("optid.identify.subspace.regressors.MANY", np.inf)
    stacked = observer_problem(records, form, None)
    scale = np.sqrt(np.outer(np.diag(gram(stacked)), np.diag(gram(stacked))))
    np.testing.assert_allclose(gram(step) / scale, gram(stacked) / scale, atol=1e-11)
    np.testing.assert_allclose(step.least_squares(), stacked.least_squares(), atol=1e-10)
    assert step.problem.remainder == pytest.approx(stacked.problem.remainder, rel=1e-9)
    assert (step.problem.remainder < 1e-24 * energy(step)) == (kind == "exact")
    assert step.rows == stacked.rows and energy(step) == pytest.approx(energy(stacked))


def test_missing_outputs_without_feedback_leave_the_state_alone():
    records = records_of(np.random.default_rng(1), [60])
    expansion = expansion_of(records, False)
    records[0][20:25, 2] = np.nan
    form = ObserverForm(A, C, np.zeros((2, 2)), expansion, 1, (True, True), True, np.ones(2))
    step = observer_problem(records, form, None)
    phi, y = columns(form, records[0], 0)
    present = ~np.isnan(y)
    np.testing.assert_allclose(gram(step), phi[present].T @ phi[present], atol=1e-9)
    assert step.rows == 115


def test_gaps_restart_the_state_and_eliminate_it():
    records = records_of(np.random.default_rng(2), [80])
    expansion = expansion_of(records)
    records[0][30, 0] = np.nan
    form = ObserverForm(A, C, np.zeros((2, 2)), expansion, 1, (True, True), True, np.ones(2))
    step = observer_problem(records, form, None)
    first, second = records[0][:30], records[0][31:]
    two = ObserverForm(A, C, np.zeros((2, 2)), expansion, 2, (True, True), True, np.ones(2))
    parts = [columns(two, part, e) for e, part in enumerate((first, second))]
    phi = np.concatenate([p.reshape(-1, two.size) for p, _ in parts])
    y = np.concatenate([t.ravel() for _, t in parts])
    best = np.linalg.lstsq(phi, y, rcond=None)[0]
    np.testing.assert_allclose(step.least_squares(), np.delete(best, [2, 3]), atol=1e-8)


def test_an_experiment_may_begin_with_a_gap():
    records = records_of(np.random.default_rng(2), [60, 50])
    expansion = expansion_of(records)
    form = ObserverForm(A, C, np.zeros((2, 2)), expansion, 2, (True, True), True, np.ones(2))
    expected = observer_problem([records[0], records[1][3:]], form, None).least_squares()
    records[1][:3, 1] = np.nan
    np.testing.assert_allclose(observer_problem(records, form, None).least_squares(), expected, atol=1e-10)


def test_instruments_are_two_stage_least_squares():
    rng = np.random.default_rng(3)
    records = [np.hstack([record, rng.uniform(-1, 1, (len(record), 2))]) for record in records_of(rng, [90, 70])]
    expansion = replace(expansion_of(records), simulated=True)
    form = ObserverForm(A, C, np.zeros((2, 2)), expansion, 2, (True, True), True, np.ones(2), instrumented=True)
    step = observer_problem(records, form, None)
    parts = [columns(form, record, e) for e, record in enumerate(records)]
    phi = np.concatenate([p.reshape(-1, form.size) for p, _ in parts])
    y = np.concatenate([t.ravel() for _, t in parts])
    swapped = [np.hstack([record[:, :2], record[:, 4:], record[:, 4:]]) for record in records]
    z = np.concatenate([columns(form, record, e)[0].reshape(-1, form.size) for e, record in enumerate(swapped)])
    projected = z @ np.linalg.lstsq(z, phi, rcond=None)[0]
    np.testing.assert_allclose(step.least_squares(), np.linalg.lstsq(projected, y, rcond=None)[0], atol=1e-7)
    assert form.extra


def test_what_the_record_does_not_determine_is_named():
    records = records_of(np.random.default_rng(4), [60])
    expansion = expansion_of(records, False)
    records[0][:, 1] = 0.0
    form = ObserverForm(A, C, np.zeros((2, 2)), expansion, 1, (True, True), True, np.ones(2))
    with pytest.raises(RankError, match="function 1 of pump"):
        observer_problem(records, form, None).least_squares()
    refuses(RankError, "equations for", observer_problem, [records[0][:6]], form, None)


def test_feedback_functions_are_orthonormal_on_the_record_and_lose_what_is_linear():
    rng = np.random.default_rng(5)
    y = rng.standard_normal((500, 2)) @ np.array([[1.0, 0.3], [0.0, 2.0]]) + [3.0, -1.0]
    record = np.hstack([rng.uniform(-1, 1, (500, 2)), y])
    for basis in (Polynomial(4), Triangular(6)):
        fitted = basis.with_interval(float(y[:, 0].min()), float(y[:, 0].max()))
        expansion = expand(data_of([record[:200], record[200:]]), Linear(), [fitted, None])
        family = expansion.feedback[0]
        values = expansion(record)[:, list(expansion.zeta)]
        np.testing.assert_allclose(values.T @ np.column_stack([np.ones(500), y]), 0.0, atol=1e-8)
        np.testing.assert_allclose(values.T @ values / 500, np.eye(family.size), atol=1e-10)
        assert family.size == fitted.size - 1  # the straight line
        assert len(expansion.names) == expansion(record).shape[1]
        straight = np.linspace(*fitted.interval, 7)
        rebuilt = fitted.values(straight) @ family.vectors - family.intercept
        level = family.values(np.column_stack([straight, np.zeros(7)]))
        np.testing.assert_allclose(level, rebuilt - np.outer(straight, family.slope[:, 0]), atol=1e-12)


def test_clipped_simulation_follows_the_model_and_stays_inside():
    rng = np.random.default_rng(6)
    records = records_of(rng, [300])
    expansion = expansion_of(records)
    bu, du = rng.standard_normal((2, 3)), 0.1 * rng.standard_normal((2, 3))
    ez, d = 0.1 * rng.standard_normal((2, expansion.q)), np.array([0.1, -0.1])
    low, high = records[0][:, 2:].min(axis=0), records[0][:, 2:].max(axis=0)
    low, high = low - 0.2 * (high - low), high + 0.2 * (high - low)
    step = StepMatrices(0.1 * bu, du, ez, d, np.zeros((1, 2)))
    (found,) = simulate_clipped(records, expansion, 0.3 * A, C, step)
    x, eta = np.zeros(2), expansion.without_feedback()(records[0])[:, :3]
    for k in range(300):
        y = np.clip(C @ x + du @ eta[k] + d, low, high)
        np.testing.assert_allclose(found[k], y, atol=1e-6)  # the feedback is read from a table
        x = 0.3 * A @ x + 0.1 * bu @ eta[k] + ez @ expansion.feedback[0].values(y[None])[0]
    silent = records[0].copy()
    silent[:, 2] = np.nan  # an experiment without the output: its range is that of the others
    step = step._replace(bu=bu)
    np.testing.assert_array_equal(simulate_clipped([records[0], silent], expansion, A, C, step)[1],
                                  simulate_clipped(records, expansion, A, C, step)[0])
    (wild,) = simulate_clipped(records, expansion, 2 * A, C, step._replace(ez=50 * ez))
    assert np.all(wild >= low - 1e-12) and np.all(wild <= high + 1e-12)


def test_block_rows_fit_the_record():
    rng = np.random.default_rng(8)
    long, short = records_of(rng, [5000]), records_of(rng, [120])
    assert expansion_of(long).block_rows(long, None) == 10
    assert expansion_of(long).block_rows(long, 8) == 16
    assert expansion_of(short).block_rows(short, 2) < 6

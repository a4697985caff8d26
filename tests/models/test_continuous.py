"""Sampled models and continuous ones, both ways, against closed forms and an integrator of differential equations."""

from dataclasses import fields, replace

import numpy as np
import pytest
from refusals import refuses
from sample_fits import feedback_fit
from scipy.integrate import solve_ivp
from scipy.linalg import eigvals
from systems import BASES, inputs, mimo, nonlinearity, siso

import optid
from optid.bases import Linear
from optid.errors import DataError, StructureError
from optid.models import HammersteinSS, HammersteinTF, Nonlinearity
from optid.models.continuous import ContinuousModel
from optid.models.held_inputs import held_step
from optid.models.roots import invariant_zeros

LINE = Nonlinearity(Linear(), np.ones(1))


def process(poles=(-1 / 30, -1 / 8), gain=2.0, delay=0.0, **fields):
    """gain exp(-delay s) / prod(1 - s / pole), as a chain of sections."""
    A = np.diag(poles) - np.diag(poles[1:], -1)
    C = np.eye(1, len(poles), k=len(poles) - 1) * gain
    return ContinuousModel(A, -np.eye(len(poles), 1) * poles[0], C, [[0.0]], (LINE,), (0,), [delay],
                           np.zeros(len(poles)), [0.0], **fields)


def first_order(theta, tau=30.0, gain=2.0):
    """Sample gain exp(-theta s) / (1 + tau s) every second, from its formula."""
    whole, rest = int(theta), theta % 1
    pole, part = np.exp(-1 / tau), np.exp(-(1 - rest) / tau)
    b = [gain * (1 - part), gain * (part - pole)]
    return HammersteinTF([-pole], (np.array(b if rest else b[:1]),), (LINE,), (whole + 1,), [0.0])


def random_system(seed):
    r = np.random.default_rng(seed)
    n, m, outputs = r.integers(1, 7), r.integers(1, 4), r.integers(1, 4)
    A = r.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + r.uniform(0.02, 0.5)) * np.eye(n)
    dt = 0.8 * np.pi / np.abs(np.linalg.eigvals(A)).max()
    return A, r.normal(size=(n, m)), r.normal(size=(outputs, n)), r.normal(size=(outputs, m)), dt, r


def test_sampled_and_back_is_the_same_to_1e_10():
    """200 stable systems, several inputs and outputs, one in four with an integrator; the aim is the equations."""
    for seed in range(200):
        A, B, C, D, dt, r = random_system(seed)
        if seed % 4 == 0:
            A[0] = 0
        Phi, Gamma = held_step(A, np.column_stack([B, np.ones(len(A))]), dt)
        model = HammersteinSS(Phi, Gamma[:, :-1], C, D, dt=dt, offset_x=Gamma[:, -1], offset_y=r.normal(size=len(C)))
        found = model.to_continuous()
        again = found.to_discrete(dt)
        assert max(np.abs(found.A - A).max(), np.abs(found.B - B).max(), np.abs(found.offset_x - 1).max()) < 1e-10
        for name in ("A", "B", "C", "D", "offset_x", "offset_y"):
            assert np.abs(getattr(again, name) - getattr(model, name)).max() < 1e-10


@pytest.mark.parametrize("model", [siso(nk=0), siso(nk=1), siso(nk=4), siso(nk=1, b=([1.0],)), siso(BASES[3], nk=2),
                                   siso(nk=0, b=([1.0, 0.5, 0.3],)), siso(a=[], b=([2.0],)),
                                   siso(nk=1, c=[-0.6, 0.25], d=[-0.5, 0.1, 0.3])])
def test_all_ways_to_simulate_a_transfer_function_agree(model):
    u = inputs(model)
    found, expected = model.to_continuous(), model.simulate(u)
    close = dict(abs=1e-11 * np.abs(expected).max())
    assert found.simulate(u, model.dt) == pytest.approx(expected, **close)
    assert found.simulate(u, times=5 + model.dt * np.arange(len(u))) == pytest.approx(expected, **close)
    assert found.to_discrete(model.dt).simulate(u) == pytest.approx(expected, **close)


def test_several_inputs_have_their_own_dead_times():
    a = [[[-0.9, 0.1], [0.2, -0.5]], [[0.3, 0.0], [-0.1, 0.1]]]
    b = ([[1.0, 0.5], [0.4, -0.2]], [[0.0, 1.0]], [[0.3, 0.1], [0.2, 0.2], [-0.1, 0.4]])
    model = HammersteinTF(a, b, tuple(nonlinearity(BASES[k], k) for k in (0, 2, 6)), (1, 4, 0), [0.2, -0.4], dt=0.5)
    u, found = inputs(model), model.to_continuous()
    assert found.dead_time.tolist() == [0, 1.5, 0]
    assert found.simulate(u, 0.5) == pytest.approx(model.simulate(u), abs=1e-11)
    assert found.static_gain([0.1, 0.2, 0.3]) == pytest.approx(model.static_gain([0.1, 0.2, 0.3]), abs=1e-12)


def test_linear_output_injection_is_part_of_the_equations():
    model = HammersteinSS([[0.5]], [[1.0]], [[2.0]], [[0.3]], L=[[0.1]], offset_x=[0.2], offset_y=[0.4], dt=0.1)
    u = np.random.default_rng(0).normal(size=50)
    assert model.to_continuous().simulate(u, 0.1) == pytest.approx(model.simulate(u), abs=1e-12)
    assert model.pole_table[0].time_constant == pytest.approx(-0.1 / np.log(0.7))
    assert model.to_continuous().pole_table[0].time_constant == pytest.approx(-0.1 / np.log(0.7))


@pytest.mark.parametrize("theta", [0.0, 1e-4, 0.3, 1.24, 2.0, 2.7])
def test_gain_time_constant_and_any_dead_time_are_found(theta):
    found = first_order(theta).to_continuous()
    assert found.dead_time[0] == pytest.approx(theta, abs=1e-9)
    assert -1 / found.A[0, 0] == pytest.approx(30, abs=1e-9)
    assert found.static_gain(0.0) == pytest.approx(2, abs=1e-10)


def sampled_with_delay(true):
    """Return the transfer function of a plant sampled every second, from its response to a pulse."""
    n, theta = len(true.poles), float(true.dead_time[0])
    a = np.real(np.poly(np.exp(true.poles)))
    b = np.convolve(true.simulate(np.eye(1, 30)[0], 1.0), a)[int(theta) + 1 :][: n + bool(theta % 1)]
    return HammersteinTF(a[1:], (b,), (LINE,), (int(theta) + 1,), [0.0])


def test_every_input_has_its_own_part_of_a_sample():
    first, second = first_order(1.24), first_order(3.7, gain=-1.0)
    model = HammersteinTF(first.a, (*first.b, *second.b), (LINE, nonlinearity(BASES[0])), (2, 4), [0.3])
    found, u = model.to_continuous(), inputs(model)
    assert found.dead_time == pytest.approx([1.24, 3.7], abs=1e-9)
    assert found.simulate(u, 1.0) == pytest.approx(model.simulate(u), abs=1e-10)


@pytest.mark.parametrize("lead", [0.5, 2.0])
@pytest.mark.parametrize("theta", [0.0, 1.37, 3.0, 5.9])
def test_a_fractional_dead_time_is_found_beside_two_poles_and_a_zero(lead, theta):
    true = replace(process((-0.4, -0.1), delay=theta), C=[[lead, 1.0]])
    found = sampled_with_delay(true).to_continuous()
    assert found.dead_time[0] == pytest.approx(theta, abs=1e-9)
    assert found.poles == pytest.approx(true.poles, abs=1e-10) and found.zeros == pytest.approx(true.zeros, abs=1e-8)
    t = np.cumsum(np.random.default_rng(1).uniform(0.1, 1, 60))
    assert found.simulate(np.ones(60), times=t) == pytest.approx(true.simulate(np.ones(60), times=t), abs=1e-9)


def test_a_fractional_dead_time_that_the_samples_do_not_determine_is_refused():
    """Two poles without a zero are the border between two dead times and none."""
    model = sampled_with_delay(process((-0.4, -0.1), delay=1.37))
    refuses(StructureError, "no dead time within", model.to_continuous)
    lower = replace(model, b=(model.b[0] * [1, 1, 0.98],))
    refuses(StructureError, "more than one dead time within", lower.to_continuous)


@pytest.mark.parametrize("theta", [0.0, 0.5, 12.4, 1e4])
def test_steps_at_any_instants_are_their_closed_form(theta):
    t = np.sort(np.random.default_rng(0).uniform(0, 200, 500))
    late = np.maximum(t - t[0] - theta, 0)
    two = 2 * (1 - (30 * np.exp(-late / 30) - 8 * np.exp(-late / 8)) / 22)
    equal = 2 * (1 - (1 + late / 8) * np.exp(-late / 8))
    assert process(delay=theta).simulate(np.ones(500), times=t) == pytest.approx(two, abs=1e-12)
    assert process((-0.125, -0.125), delay=theta).simulate(np.ones(500), times=t) == pytest.approx(equal, abs=1e-12)


def test_a_held_input_through_a_curve_is_what_an_integrator_of_the_equations_gives():
    f, t = nonlinearity(BASES[0]), np.array([0.0, 1.5, 2.0, 4.5, 9.0])
    model = ContinuousModel([[-0.5, 0.2], [0.0, -0.3]], [[1.0], [2.0]], [[1.0, 1.0]], [[0.5]], (f,), (0,), [0.7],
                            [0.1, 0.0], [3.0])
    u, x, expected, now = np.array([0.2, 1.0, -0.4, 0.6, 0.0]), np.array([1.0, -1.0]), [], 0.0
    w = lambda s: f(u[max(np.searchsorted(t, s - 0.7, side="right") - 1, 0)])  # noqa: E731
    for end in np.sort(np.concatenate([t, (t + 0.7)[t + 0.7 < 9]])):
        if end > now:
            middle = (now + end) / 2
            x = solve_ivp(lambda _, x, m=middle: model.A @ x + model.B[:, 0] * w(m) + model.offset_x, (now, end), x,
                          rtol=1e-11, atol=1e-12).y[:, -1]
        now = end
        if end in t:
            expected.append(model.C[0] @ x + 0.5 * w(end) + 3)
    assert model.simulate(u, times=t, x0=[1.0, -1.0]) == pytest.approx(expected, abs=1e-8)


def test_many_different_intervals_are_the_same_as_regular_ones_of_their_parts():
    """More intervals than are exponentiated at a time; every input is repeated as often as the short one fits in."""
    r = np.random.default_rng(3)
    counts = r.integers(1, 9, 3000)
    jitter = np.cumsum(1 + 1e-3 * r.uniform(size=3000))
    u, model = r.normal(size=3000), process(delay=2.5)
    places = np.cumsum(counts) - counts
    fine = model.simulate(np.repeat(u, counts), 0.25)[places]
    assert model.simulate(u, times=0.25 * places) == pytest.approx(fine, abs=1e-11)
    whole = model.simulate(u, times=jitter)
    assert whole[:1000] == pytest.approx(model.simulate(u[:1000], times=jitter[:1000]), abs=1e-11)


def test_at_rest_nothing_moves():
    model = process(delay=4.2)
    assert model.simulate(np.full(30, 1.5), 1.0, x0="rest") == pytest.approx(3.0, abs=1e-12)
    refuses(StructureError, "integrator", process((0.0,)).simulate, np.ones(5), 1.0, x0="rest")
    refuses(StructureError, "integrator", process((-0.5, 0.0)).static_gain, 0.0)
    assert process((-1e7, -1e-5)).static_gain(0.0) == pytest.approx(2, rel=1e-12)
    refuses(StructureError, "'zero', 'rest'", model.simulate, np.ones(5), 1.0, x0="fit")


@pytest.mark.parametrize("theta", [0.0, 0.7, 3.0, 7.3])
def test_other_sampling_times(theta):
    """A model sampled every second, and its resampled one, at the instants that they share."""
    model = process(delay=theta)
    u = np.random.default_rng(2).normal(size=40)
    slow, fast = model.to_discrete(1.0), model.to_discrete(0.25)
    expected = fast.simulate(np.repeat(u, 4))
    assert expected[::4] == pytest.approx(slow.simulate(u), abs=1e-12)
    assert slow.poles[np.abs(slow.poles) < 1e-9].size == int(np.ceil(theta))
    if not theta:
        assert slow.to_discrete(0.25).simulate(np.repeat(u, 4)) == pytest.approx(expected, abs=1e-11)


@pytest.mark.parametrize("model, words", [
    (siso(nk=1, a=[0.5]), "negative real pole -0.5"),
    (siso(nk=1, a=[1.0, 0.25]), "half the sampling rate|negative real pole"),
    (siso(nk=1, a=[], b=([1.0],)), "nb <= na"),
    (siso(nk=2, b=([1.0, 0.2, 3.0, 0.1, 4.0],)), "3 samples further back than A"),
    (siso(nk=1, b=([1.0, 0.2, 3.0],)), "dead time within a sampling time"),
    (siso(nk=1, a=[-0.5, 0.0], b=([1.0],)), "1 pole at 0"),
    (mimo(), "nb <= na"),
    (HammersteinSS([[0.0, 1.0], [0.0, 0.5]], [[0.0], [1.0]], [[1.0, 0.0]]), "1 pole at 0"),
])
def test_what_has_no_continuous_counterpart_is_refused_with_the_reason(model, words):
    refuses(StructureError, words, model.to_continuous)
    refuses(StructureError, words, model.to_discrete, 0.01)


def test_nonlinear_feedback_and_equations_of_the_user_are_refused():
    refuses(StructureError, "Nonlinear feedback", feedback_fit().model.to_continuous)


def test_zeros_are_where_the_system_matrix_loses_rank():
    r = np.random.default_rng(1)
    for seed in range(100):
        n, m = r.integers(1, 7), r.integers(1, 4)
        A, B, C = r.normal(size=(n, n)), r.normal(size=(n, m)), r.normal(size=(m, n))
        D = r.normal(size=(m, m)) * (seed % 3 == 0)
        matrix, step = np.block([[A, B], [C, D]]), np.diag([1.0] * n + [0.0] * m)
        found, pencil = invariant_zeros(A, B, C, D), eigvals(matrix, step)
        assert len(found) == np.sum(np.isfinite(pencil) & (np.abs(pencil) < 1e5))
        for zero in found:
            assert np.linalg.svd(matrix - zero * step, compute_uv=False)[-1] < 1e-8 * (1 + abs(zero))
    shared = C[:1]
    assert np.sort_complex(invariant_zeros(A, B[:, :1], np.vstack([shared, 2 * shared]), np.zeros((2, 1)))
                           ) == pytest.approx(np.sort_complex(invariant_zeros(A, B[:, :1], shared, np.zeros((1, 1)))))
    assert siso(nk=3).zeros == pytest.approx([-0.75]) and process().zeros.size == 0


def test_the_table_of_poles_is_the_same_on_both_sides():
    model = siso(nk=1, time_unit="s")
    (pair,), (same,) = model.pole_table, model.to_continuous().pole_table
    assert pair[1:] == pytest.approx(same[1:], rel=1e-10) and pair.pole == pytest.approx(np.exp(0.1 * same.pole))
    assert pair.damping == pytest.approx(-same.pole.real / abs(same.pole))
    rows = siso(a=np.poly([1.0, 0.9, -0.5, 0.0])[1:], dt=2.0).pole_table
    assert [row.time_constant for row in rows[:2]] == pytest.approx([np.inf, -2 / np.log(0.9)])
    assert all(np.isnan(row.time_constant) for row in rows[2:])
    assert "natural frequency (rad/s)" in str(model.pole_table) and "0.362" in str(model.pole_table)
    table = process((0.0, -0.5)).pole_table
    assert np.isinf(table[0].time_constant) and table[1].time_constant == pytest.approx(2)


def test_frequency_responses_meet_where_the_sampling_is_fast():
    model, w = process(delay=3.0), np.array([1e-3, 1e-2, 0.1])
    sampled = model.to_discrete(0.02).frequency_response(w)
    held = np.exp(-0.01j * w)[:, None, None]  # a held input is half a sample late
    assert model.frequency_response(w) * held == pytest.approx(sampled, rel=1e-5)


def test_control_takes_a_dead_time_only_as_an_approximation():
    pytest.importorskip("control")
    model = process(delay=12.4, time_unit="s", inputs=("valve",))
    refuses(StructureError, "'valve' has a dead time of 12.4 s", model.to_control)
    refuses(StructureError, "pade must be an integer from 1 to 10", model.to_control, pade=0)
    system, w = model.to_control(pade=4), 0.05
    assert np.ravel(system(1j * w)) == pytest.approx(model.frequency_response(w).ravel(), abs=1e-8)
    assert system.input_labels == ["valve"] and system.dt == 0
    exact = process().to_control()
    assert np.ravel(exact(1j * w)) == pytest.approx(process().frequency_response(w).ravel(), abs=1e-12)
    late = first_order(2.0).to_control()
    assert np.sum(np.abs(late.poles()) < 1e-9) == 2


def test_scipy_takes_the_same_system():
    system, s = process(delay=2.0).to_lti(3), 0.1j
    found = system.C @ np.linalg.solve(s * np.eye(len(system.A)) - system.A, system.B) + system.D
    assert found == pytest.approx(process(delay=2.0).frequency_response(0.1)[0], abs=1e-6)


@pytest.mark.parametrize("change, words", [
    ({"u": [0.0, np.nan, 1.0], "dt": 1.0}, "Input 'u' is missing at sample 1"),
    ({"u": np.ones((3, 2)), "dt": 1.0}, "2 channels"),
    ({"dt": 0.0}, "dt = 0.0"),
    ({"times": [0.0, 1.0, 1.0]}, "instant 2 is 1 after 1"),
    ({"times": [0.0, 1.0]}, "one instant for each sample"),
    ({"times": [0.0, np.nan, 2.0]}, "instant 1 is nan"),
    ({}, "either dt= .* or times="),
])
def test_bad_records_are_named(change, words):
    refuses((DataError, StructureError), words, process().simulate, **{"u": np.ones(3), **change})


def test_an_unstable_run_ends_with_the_sample():
    refuses(DataError, "at sample [0-9]+: the model is unstable", process((1.0,)).simulate, np.ones(2000), 1.0)


@pytest.mark.parametrize("change, words", [
    ({"dead_time": [-1.0]}, "must not be negative"), ({"B": [[1.0]]}, r"B has shape \(1, 1\)"),
    ({"input_of": (2,), "inputs": ("u",)}, "one input from 0 to 0"), ({"A": [[np.nan]]}, "A contains"),
    ({"outputs": ("a", "b")}, "2 names and 1 units for 1 outputs"),
])
def test_parts_that_do_not_agree_are_refused(change, words):
    given = {one.name: getattr(process(), one.name) for one in fields(ContinuousModel)}
    refuses(StructureError, words, ContinuousModel, **{**given, "outputs": (), "output_units": (), **change})


def test_a_fitted_plant_is_read_in_seconds_and_its_dead_time_has_an_error():
    """Records of a plant whose dead time is half a sample more than one; the errors are those of the scatter."""
    found = []
    for seed in range(12):
        r = np.random.default_rng(seed)
        u = np.repeat(r.normal(size=60), 8)
        y = first_order(1.5).simulate(u) + 0.02 * r.normal(size=u.size)
        fit = optid.fit(optid.Data(u, y, dt=1.0), "oe.exact", na=1, nb=2, nk=2)
        rows = {row.name: row for row in fit.dynamics}
        model = fit.model.to_continuous()
        assert rows["dead time"].estimate == pytest.approx(model.dead_time[0], abs=1e-9)
        assert rows["time constant"].estimate == pytest.approx(model.pole_table[0].time_constant, rel=1e-9)
        assert rows["static gain"].estimate == pytest.approx(model.static_gain(0.0), rel=1e-9)
        found.append([(rows[name].estimate - true) / rows[name].error for name, true in (
            ("dead time", 1.5), ("time constant", 30), ("static gain", 2))])
    assert np.all(np.abs(found) < 3.5) and np.all(np.abs(np.std(found, axis=0) - 1) < 0.5)


@pytest.mark.parametrize("unit", [1e-90, 1e99])
def test_units_of_signals_and_states_cost_no_digits(unit):
    A, B, C, D, dt, _ = random_system(5)
    units = np.logspace(-5, 5, len(A))
    Phi, Gamma = held_step(A, np.column_stack([B, np.ones(len(A))]), dt)
    drive = unit * units[:, None] * Gamma[:, :-1]
    model = HammersteinSS(units[:, None] * Phi / units, drive, C / units, unit * D, dt=dt)
    u = np.random.default_rng(0).normal(size=(200, B.shape[1]))
    found, expected = model.to_continuous(), model.simulate(u)
    assert found.simulate(u, dt) / unit == pytest.approx(expected / unit, abs=1e-11)
    assert units[:, None] ** -1 * found.B / unit == pytest.approx(B, abs=1e-10)

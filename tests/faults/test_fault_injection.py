"""Faults are injected with the timing of the equations; the reference is a loop written out sample by sample."""

from dataclasses import replace

import numpy as np
import pytest
from fault_plants import levels, noisy, standard
from state_systems import USER, with_feedback

from optid.errors import DataError, LookupFailed, StructureError
from optid.faults import Fault, Surroundings, inject, trajectory

N = 60


def small(**changes):
    A = np.array([[0.8, 0.2, 0.0], [-0.1, 0.7, 0.1], [0.0, 0.0, 0.5]])
    B = np.array([[1.0, 0.3], [0.0, -0.5], [0.4, 0.2]])
    C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -0.3]])
    how = {"D": [[0.1, 0.0], [0.2, 0.3]], "offset_x": [0.1, 0.0, -0.2], "offset_y": [0.3, -0.1]} | changes
    return noisy(A, B, C, 0.01 * np.eye(3), np.diag([0.02, 0.03]), **how)


def by_hand(model, u, x0, state=None, output=None, to_x=None, to_y=None, gain=None, A=None, B=None, reading=None):
    """x(k+1) = A(k) x + B(k) state(k) + to_x(k+1), y(k) = gain(k) (C x + D output(k) + c) + to_y(k), in this order."""
    f = model.expand_inputs(u)
    state = f if state is None else state
    output = f if output is None else output
    to_x = np.vstack([np.zeros((len(u), model.nx)) if to_x is None else to_x, np.zeros(model.nx)])
    x, xs, ys = np.array(x0, dtype=float) + to_x[0], [], []
    for k in range(len(u)):
        y = model.C @ x + model.D @ output[k] + model.offset_y
        y = (1 if gain is None else gain[k]) * y + (0 if to_y is None else to_y[k])
        ys.append(y if reading is None else reading(k, y, ys))
        xs.append(x)
        g = np.array([h(ys[-1][o]) for h, o in zip(model.feedback, model.output_of)])
        x = (model.A if A is None else A[k]) @ x + (model.B if B is None else B[k]) @ state[k] + model.offset_x
        x = x + model.L @ ys[-1] + (model.E @ g if g.size else 0) + to_x[k + 1]
    return np.array(xs), np.array(ys)


def close(model, u, faults, x0=(0.1, -0.2, 0.3), **reference):
    found = trajectory(model, u, faults, surroundings=Surroundings(x0, "none"))
    x, y = by_hand(model, u, x0, **reference)
    np.testing.assert_allclose(found.x, x, atol=1e-12)
    np.testing.assert_allclose(found.y, y, atol=1e-12)
    return found


@pytest.mark.parametrize("plant", [small, with_feedback])
def test_without_faults_it_is_the_free_run(plant):
    model, u = plant(), levels(N, 0)
    np.testing.assert_allclose(inject(model, u, noise="none", x0=np.ones(3)), model.simulate(u, x0=np.ones(3)))


@pytest.mark.parametrize("onset", [0, 1, 20])
@pytest.mark.parametrize("kind", ["step", "jump", "ramp"])
def test_offsets_change_the_state_at_the_onset_and_not_before(kind, onset):
    model, u, direction = small(), levels(N, 1), np.array([0.5, -1.0, 0.2])
    since, make = np.arange(N) - onset, getattr(Fault, kind)
    course = {"step": since >= 0, "jump": since == 0, "ramp": np.maximum(since + 1, 0)}[kind].astype(float)
    found = close(model, u, make("process:load", onset, 0.7, direction=direction),
                  to_x=np.outer(course, 0.7 * direction))
    healthy = trajectory(model, u, surroundings=Surroundings((0.1, -0.2, 0.3), "none"))
    np.testing.assert_array_equal(found.x[:onset], healthy.x[:onset])
    np.testing.assert_allclose(found.x[onset] - healthy.x[onset], 0.7 * direction)
    close(model, u, make("state", onset, direction), to_x=np.outer(course, direction))
    close(model, u, make("sensor:y2", onset, -0.4), to_y=np.outer(course, [0.0, -0.4]))
    if kind != "jump":
        close(model, u, make("sensor:y2", onset, -0.4, end=25), to_y=np.outer(course * (since < 25 - onset), [0, -0.4]))
    close(model, u, make("actuator:u2", onset, 0.3),
          to_x=np.outer(course, 0.3 * model.B[:, 1]), to_y=np.outer(course, 0.3 * model.D[:, 1]))


@pytest.mark.parametrize("fault, value", [
    (Fault.loss("actuator:u1", 20, 0.3, bias=0.2), lambda v, u: 0.7 * v + 0.2),
    (Fault.hard_over("actuator:u1", 20), lambda v, u: 0.0),
    (Fault.stuck("actuator:u1", 20, 0.6), lambda v, u: 0.6),
    (Fault.hard_over("actuator:u1", 20, 1.2), lambda v, u: 1.2),
    (Fault.stuck("actuator:u1", 20), lambda v, u: u[18]),
    (Fault.frozen("actuator:u1", 20), lambda v, u: u[18]),
], ids=lambda part: str(part) if isinstance(part, Fault) else "value")
def test_a_broken_actuator_drives_the_state_at_the_onset(fault, value):
    model, u = small(), np.random.default_rng(3).normal(size=(N, 2))
    state, output = u.copy(), u.copy()
    state[19:, 0], output[20:, 0] = value(u[19:, 0], u[:, 0]), value(u[20:, 0], u[:, 0])
    close(model, u, fault, state=state, output=output)


def test_a_stuck_actuator_stops_every_function_of_its_input():
    model = with_feedback()
    u = 0.5 * np.random.default_rng(3).normal(size=(N, 2))
    f = model.expand_inputs(u)
    stop = [model.nonlinearities[i](0.2) for i in (1, 2)]
    state, output = f.copy(), f.copy()
    state[19:, 1:], output[20:, 1:] = stop, stop
    close(model, u, Fault.stuck("actuator:u2", 20, 0.2), state=state, output=output)


def test_broken_sensors():
    model, u, gain, shift = small(), levels(N, 4), np.ones((N, 2)), np.zeros((N, 2))
    gain[20:, 1], shift[20:, 1] = 0.6, 0.1
    close(model, u, Fault.loss("sensor:y2", 20, 0.4, bias=0.1), gain=gain, to_y=shift)
    gain[20:, 1] = 0.0
    close(model, u, Fault.hard_over("sensor:y2", 20), gain=gain)
    close(model, u, Fault.stuck("sensor:y1", 20, 5.0), reading=lambda k, y, ys: np.array([5.0, y[1]]) if k >= 20 else y)
    close(model, u, Fault.frozen("sensor:y1", 20),
          reading=lambda k, y, ys: np.array([ys[-1][0], y[1]]) if k >= 20 else y)
    noisy_record = inject(model, u, Fault.frozen("sensor:y1", 20, end=40))
    assert np.unique(noisy_record[19:40, 0]).size == 1 and np.unique(noisy_record[40:, 0]).size > 10


def test_scheduled_matrices_as_arrays_and_as_functions():
    model, u, rng = small(), levels(N, 5), np.random.default_rng(0)
    A = model.A + 0.05 * rng.normal(size=(N, 3, 3))
    B = model.B + 0.5 * rng.normal(size=(N, 3, 2))
    ramp = 0.2 * np.arange(1, N + 1)
    to_x = np.einsum("kir,r,k->ki", np.concatenate([model.B[None], B[:-1]]), [0.0, 1.0], ramp)
    to_y = np.outer(ramp, model.D[:, 1])
    close(model, u, [Fault.schedule(A=A, B=B), Fault.ramp("actuator:u2", 0, 0.2)], A=A, B=B, to_x=to_x, to_y=to_y)
    late = np.where(np.arange(N)[:, None, None] >= 29, A, model.A)
    found = close(model, u, Fault.schedule(30, A=lambda k: A[k]), A=late)
    healthy = trajectory(model, u, surroundings=Surroundings((0.1, -0.2, 0.3), "none"))
    np.testing.assert_array_equal(found.x[:30], healthy.x[:30])
    assert not np.allclose(found.x[30], healthy.x[30])


def test_several_faults_at_once_with_feedback():
    model = with_feedback()
    u = 0.5 * np.random.default_rng(3).normal(size=(N, 2))
    f = model.expand_inputs(u)
    state, output, to_y, gain, to_x = f.copy(), f.copy(), np.zeros((N, 2)), np.ones((N, 2)), np.zeros((N, 3))
    state[9:, 0] *= 0.5
    output[10:, 0] *= 0.5
    to_y[30:, 0], to_y[30:, 1], gain[30:, 1] = 0.4, 0.0, 0.8
    to_x[25] = [0.1, 0.2, 0.3]
    faults = [Fault.step("sensor:p", 30, 0.4), Fault.loss("actuator:u1", 10, 0.5), Fault.loss("sensor:q", 30, 0.2),
              Fault.jump("state", 25, [0.1, 0.2, 0.3])]
    close(model, u, faults, state=state, output=output, to_y=to_y, gain=gain, to_x=to_x)
    true = inject(model, u, faults[0], noise="none", feedback="true")
    np.testing.assert_allclose(true - inject(model, u, noise="none"), np.outer(np.arange(N) >= 30, [0.4, 0.0]))


def test_noise_has_the_covariances_of_the_model_and_grows_where_it_is_told():
    model, count = small(), 200_000
    u, e = np.zeros((count, 2)), np.array([1.0, 2.0, 0.0])
    onset = count // 2
    healthy = trajectory(model, u, seed=1)
    rest = healthy.x[1:] - healthy.x[:-1] @ model.A.T - model.offset_x
    np.testing.assert_allclose(np.cov(rest.T), model.noise.Q, atol=3e-4)
    reading = healthy.y - healthy.x @ model.C.T - model.offset_y
    np.testing.assert_allclose(np.cov(reading.T), model.noise.R, atol=5e-4)
    broken = trajectory(model, u, [Fault.process_noise("process:load", onset, scale=3.0, direction=e),
                                   Fault.sensor_noise("sensor:y1", onset, std=0.5)], seed=1)
    np.testing.assert_array_equal(broken.y[:onset], healthy.y[:onset])
    later = broken.x[1:] - broken.x[:-1] @ model.A.T - model.offset_x
    np.testing.assert_array_equal(np.flatnonzero(np.any(later != rest, axis=1))[0], onset - 1)
    grown = model.noise.Q + 8 * 0.01 / 5 * np.outer(e, e)  # the noise along e has variance 0.01 / |e|^2
    np.testing.assert_allclose(np.cov(later[onset:].T), grown, rtol=0.03, atol=1e-3)
    reading = broken.y - broken.x @ model.C.T - model.offset_y
    np.testing.assert_allclose(np.cov(reading[onset:].T), model.noise.R + np.diag([0.25, 0]), rtol=0.03, atol=1e-3)


def test_cross_covariance_of_the_noises():
    model = with_feedback(feedback=(), E=None, output_of=())
    found = trajectory(model, np.zeros((200_000, 2)), seed=2)
    offset = model.expand_inputs(np.zeros((1, 2)))[0]
    w = found.x[1:] - found.x[:-1] @ model.A.T - found.y[:-1] @ model.L.T - model.offset_x - model.B @ offset
    v = found.y - found.x @ model.C.T - model.offset_y - model.D @ offset
    together = np.block([[model.noise.Q, model.noise.S], [model.noise.S.T, model.noise.R]])
    np.testing.assert_allclose(np.cov(np.hstack([w, v[:-1]]).T), together, atol=0.03 * np.abs(together).max())


def test_seeds_experiments_and_rest():
    model, u = small(), levels(N, 0)
    assert np.array_equal(inject(model, u, seed=3), inject(model, u, seed=3))
    assert not np.array_equal(inject(model, u, seed=3), inject(model, u, seed=4))
    first, second = inject(model, [u, u[:30]], Fault.step("sensor:y1", 20, 1.0), seed=3)
    assert first.shape == (N, 2) and second.shape == (30, 2) and not np.allclose(first[:30], second)
    still = inject(model, np.ones((N, 2)), x0="rest", noise="none")
    np.testing.assert_allclose(still, np.broadcast_to(model.equilibrium(np.ones(2))[1], still.shape))


def test_the_standard_plant_keeps_its_figures(real_data):
    model, load = standard(real_data)
    np.testing.assert_allclose(np.abs(model.poles), [0.907, 0.907, 0.78, 0.55], atol=0.03)
    y = inject(model, levels(1000, 0), Fault.process_noise("process:load", 900, scale=4), process={"load": load})
    assert np.isfinite(y).all()


@pytest.mark.parametrize("error, words, act", [
    (LookupFailed, "u3", lambda m, u: inject(m, u, Fault.step("actuator:u3", 1, 1.0))),
    (LookupFailed, "direction", lambda m, u: inject(m, u, Fault.step("process:load", 1, 1.0))),
    (StructureError, "columns", lambda m, u: inject(m, u, Fault.step("sensor:y1", 1, [1.0, 2.0]))),
    (StructureError, "columns", lambda m, u: inject(m, u, Fault.step("state", 1, 1.0))),
    (DataError, "beyond the record", lambda m, u: inject(m, u, Fault.step("sensor:y1", N, 1.0))),
    (DataError, "missing at sample 3", lambda m, u: inject(m, np.where(np.arange(N)[:, None] == 3, np.nan, u))),
    (StructureError, "noise=", lambda m, u: inject(m, u, noise="white")),
    (StructureError, "feedback=", lambda m, u: inject(m, u, feedback="none")),
    (StructureError, "x0=", lambda m, u: inject(m, u, x0="fit")),
    (StructureError, "begins with", lambda m, u: Fault.step("u1", 1, 1.0)),
    (StructureError, "begins with", lambda m, u: Fault.loss("process:load", 1, 1.0)),
    (StructureError, "onset", lambda m, u: Fault.step("sensor:y1", -1, 1.0)),
    (StructureError, "onset", lambda m, u: Fault.step("sensor:y1", 1.5, 1.0)),
    (StructureError, "end", lambda m, u: Fault.step("sensor:y1", 5, 1.0, end=5)),
    (StructureError, "finite", lambda m, u: Fault.step("sensor:y1", 5, np.nan)),
    (StructureError, "share", lambda m, u: Fault.loss("actuator:u1", 5, 1.5)),
    (StructureError, "one of", lambda m, u: Fault.sensor_noise("sensor:y1", 5)),
    (StructureError, "from 1", lambda m, u: Fault.sensor_noise("sensor:y1", 5, scale=0.5)),
    (StructureError, "semidefinite", lambda m, u: Fault.process_noise("process", 5, covariance=-np.eye(3))),
    (StructureError, "A, B", lambda m, u: Fault.schedule(3)),
    (StructureError, "shape", lambda m, u: inject(m, u, Fault.schedule(3, A=np.eye(2)))),
    (DataError, "range of numbers", lambda m, u: inject(m, np.tile(u, (40, 1)), Fault.schedule(3, A=3 * np.eye(3)))),
    (StructureError, "no noise", lambda m, u: inject(replace(m, noise=None), u)),
    (StructureError, "compiled", lambda m, u: inject(with_feedback(USER), u)),
])
def test_bad_input(error, words, act):
    with pytest.raises(error, match=words):
        act(small(), levels(N, 0))

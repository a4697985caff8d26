"""Simulation of a plant with faults."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, compact, one_or_all
from optid.errors import DataError, StructureError
from optid.faults.faults import ADDITIVE, Fault, channel_of, functions_of, matrices_of, place_of
from optid.models.experiments import check_inputs, records_of, state_like
from optid.models.kalman import NoiseCovariances

if TYPE_CHECKING:
    from optid.models import HammersteinSS


class Trajectory(NamedTuple):
    """A simulated record of a plant with faults.

    Attributes:
        y: (N, l) readings.
        x: (N, n) states.
    """

    y: Array
    x: Array


class Sensors(NamedTuple):
    """The sensors of a record: a reading is gain * output + shift + noise, unless it is fixed or held."""

    gain: Array  # (N, l)
    shift: Array  # (N, l)
    noise: Array  # (N, l)
    fixed: Array  # (N, l) reading that replaces the output; NaN for none
    hold: Array  # (N, l) whether the reading of the sample before is repeated

    @classmethod
    def healthy(cls, noise: Array) -> "Sensors":
        """Return sensors without a fault."""
        return cls(np.ones(noise.shape), np.zeros(noise.shape), noise, np.full(noise.shape, np.nan),
                   np.zeros(noise.shape, dtype=bool))


class _Plan(NamedTuple):
    """Signals of a record with faults."""

    state: Array  # (N, r) functions of the inputs in the next state
    output: Array  # (N, r) those in the output
    jolt: Array  # (N, n) added to the next state
    start: Array  # (n,) added to the first one
    w: Array  # (N, n) process noise
    sensors: Sensors
    A: Array  # (N, n, n)
    B: Array  # (N, n, r)


def inject(
    model: "HammersteinSS", u: Any, faults: Fault | Sequence[Fault] = (), *, seed: int | None = 0, x0: Any = "zero",
    noise: NoiseCovariances | str = "model", process: Mapping[str, ArrayLike] | None = None, feedback: str = "measured",
) -> Any:
    """Simulate a plant with one or several faults.

    The noise of the healthy plant is the same with and without faults for the same seed. Losses and stuck actuators act
    in the order given, offsets are added after them.

    Args:
        model: the plant.
        u: inputs (N,) or (N, m), or a list of such arrays, or Data; no sample missing.
        faults: one or several; none for the healthy plant.
        seed: of the noise.
        x0: "zero", "rest" (the equilibrium at the first input) or the state (n,), of every experiment.
        noise: "model" for `model.noise`, "none", or covariances (the one of the innovations is not used).
        process: directions (n,) by name for faults "process:<name>" without one.
        feedback: signal of a nonlinear feedback and of the output injection L: "measured" (the readings, as of a
            controller), or "true" (the outputs with their noise, but without the sensor faults).

    Returns:
        (N, l) readings; a tuple of such arrays for several experiments.

    Raises:
        DataError: a missing input, an onset beyond the record, an output that overflows.
        LookupFailed: a channel or direction that the model does not have.
        StructureError: sizes that do not fit, no noise covariances, functions of the user in the feedback.
    """
    how: dict[str, Any] = {"x0": x0, "noise": noise, "process": process, "feedback": feedback}
    records, _ = records_of(model, u)
    seeds = np.random.SeedSequence(seed).spawn(len(records)) if len(records) > 1 else [seed]
    return one_or_all([
        trajectory(model, inputs, faults, seed=own, **how).y for (inputs, _, _), own in zip(records, seeds)
    ])


def trajectory(
    model: "HammersteinSS", u: ArrayLike, faults: Fault | Sequence[Fault] = (), *, seed: Any = 0, x0: Any = "zero",
    noise: NoiseCovariances | str = "model", process: Mapping[str, ArrayLike] | None = None, feedback: str = "measured",
) -> Trajectory:
    """Simulate one record as `inject` does and return the states, too."""
    from optid.faults.kernels import march_faulty
    from optid.models.state_kernels import INSIDE, REFUSED

    if feedback not in ("measured", "true"):
        raise StructureError(f"feedback={feedback!r}: use 'measured' or 'true'.")
    if not model.parts.tables.compiled:
        raise StructureError(
            "The feedback has functions of the user, which cannot be compiled. Fit them by another basis first."
        )
    inputs = records_of(model, [np.asarray(u)])[0][0][0]
    check_inputs(model, inputs, "")
    broken = [faults] if isinstance(faults, Fault) else list(faults)
    plan = _planned(model, inputs, broken, _covariances(model, noise), seed, process or {})
    drive = plan.jolt + model.offset_x + np.einsum("kir,kr->ki", plan.B, plan.state, optimize=True)
    direct = plan.output @ model.D.T + model.offset_y
    x = _started(model, x0, inputs) + plan.start
    table = plan.A[:1] if plan.A.strides[0] == 0 else plan.A
    ended, at, states, readings = march_faulty(
        model.parts, compact(table), drive + plan.w, direct, plan.sensors, feedback == "true", x)
    if ended != INSIDE:
        raise DataError(
            f"At sample {at} the output leaves the interval of a feedback basis with outside='error'."
            if ended == REFUSED else f"The faulty plant leaves the range of numbers at sample {at}: it is unstable."
        )
    return Trajectory(readings, states)


def _planned(
    model: "HammersteinSS", u: Array, faults: list[Fault], covariances: NoiseCovariances | None, seed: Any,
    process: Mapping[str, ArrayLike],
) -> _Plan:
    count, n, l = len(u), model.nx, model.l  # noqa: E741
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    healthy, *streams = (np.random.default_rng(s) for s in root.spawn(len(faults) + 1))
    f, drawn = model.expanded(u), np.zeros((count, n + l))
    if covariances is not None:
        drawn = _draw(healthy, count, np.block([[covariances.Q, covariances.S], [covariances.S.T, covariances.R]]))
    w, v = np.ascontiguousarray(drawn[:, :n]), np.ascontiguousarray(drawn[:, n:])
    plan = _Plan(
        f, f.copy(), np.zeros((count, n)), np.zeros(n), w, Sensors.healthy(v),
        np.broadcast_to(model.A, (count, n, n)), np.broadcast_to(model.B, (count, n, f.shape[1])),
    )
    for fault, stream in sorted(zip(faults, streams), key=lambda pair: pair[0].kind in ADDITIVE):
        now = fault.active(count)
        before = slice(max(now.start - 1, 0), now.stop - 1)
        if fault.kind in ADDITIVE:
            _add(model, plan, fault, now, before, process)
        elif fault.kind == "schedule":
            for word, given in (("A", fault.A), ("B", fault.B)):
                if given is not None:
                    changed = np.array(getattr(plan, word))
                    changed[before] = matrices_of(
                        "schedule", word, given, range(before.start, before.stop), getattr(model, word), count)
                    plan = plan._replace(**{word: changed})
        elif fault.kind in ("process_noise", "sensor_noise"):
            state, output = place_of(model, fault.name, fault.direction, process)
            where, target, samples, word = (output, plan.sensors.noise, now, "R") if fault.kind == "sensor_noise" else (
                state, plan.w, before, "Q")
            spread = _added(fault, where, None if covariances is None else getattr(covariances, word))
            target[samples] += _draw(stream, samples.stop - samples.start, spread) @ where.T
        elif fault.place == "actuator":
            _break_actuator(model, plan, fault, now, before, u)
        else:
            _break_sensor(model, plan.sensors, fault, now)
    return plan


def _add(
    model: "HammersteinSS", plan: _Plan, fault: Fault, now: slice, before: slice, process: Mapping[str, ArrayLike]
) -> None:
    into_state, into_output = place_of(model, fault.name, fault.direction, process)
    size = np.asarray(fault.size)
    if size.shape != (into_state.shape[1],):
        raise StructureError(
            f"{fault.name}: size of shape {size.shape}; this place has {into_state.shape[1]} columns: give one entry "
            "for each."
        )
    course = np.zeros(len(plan.jolt))
    course[now] = np.arange(1, now.stop - now.start + 1) if fault.kind == "ramp" else 1.0
    if fault.kind == "jump":
        course[now.start + 1 :] = 0.0
    if fault.place == "actuator":  # through B(k), which may be scheduled
        columns = functions_of(model, fault.name)
        plan.output[:, columns] += np.outer(course, size)
        plan.state[:-1, columns] += np.outer(course[1:], size)
    else:
        plan.sensors.shift[:] += np.outer(course, into_output @ size)
        plan.jolt[:-1] += np.outer(course[1:], into_state @ size)
    plan.start[:] += course[0] * (into_state @ size)


def _break_actuator(model: "HammersteinSS", plan: _Plan, fault: Fault, now: slice, before: slice, u: Array) -> None:
    c, size = channel_of(model.inputs, fault.name), fault.size
    stop = u[max(now.start - 2, 0), c] if size == "last" else size
    for values, samples in ((plan.output, now), (plan.state, before)):
        for i in functions_of(model, fault.name):
            if fault.kind == "loss":
                values[samples, i] = (1.0 - np.asarray(size)) * values[samples, i] + fault.bias
            else:
                values[samples, i] = 0.0 if size is None else model.nonlinearities[i](stop)


def _break_sensor(model: "HammersteinSS", sensors: Sensors, fault: Fault, now: slice) -> None:
    o = channel_of(model.outputs, fault.name)
    if fault.kind == "loss":
        sensors.gain[now, o] *= 1.0 - np.asarray(fault.size)
        sensors.shift[now, o] += fault.bias
    elif fault.size is None:
        sensors.gain[now, o] = 0.0
    elif fault.size == "last":
        sensors.hold[now, o] = True
    else:
        sensors.fixed[now, o] = fault.size


def _covariances(model: "HammersteinSS", noise: NoiseCovariances | str) -> NoiseCovariances | None:
    if isinstance(noise, NoiseCovariances):
        if noise.S.shape != (model.nx, model.l):
            raise StructureError(f"noise: S has shape {noise.S.shape}; it must be {(model.nx, model.l)}.")
        return noise
    if noise == "none":
        return None
    if noise != "model":
        raise StructureError(f"noise={noise!r}: use 'model', 'none' or NoiseCovariances.")
    if model.noise is None:
        raise StructureError(
            "The model has no noise covariances: estimate them with optid.noise.with_noise(model, data), or pass "
            "noise='none' for a run without noise."
        )
    return model.noise


def _draw(rng: np.random.Generator, count: int, covariance: Array) -> Array:
    """Draw (count, d) Gaussian samples of a covariance that may be singular."""
    sizes, axes = np.linalg.eigh(covariance)
    if sizes[0] < -1e-8 * max(sizes[-1], 0.0):
        raise StructureError("The covariance of the noise is not positive semidefinite.")
    return rng.standard_normal((count, len(covariance))) @ (axes * np.sqrt(np.maximum(sizes, 0.0))).T


def _added(fault: Fault, where: Array, present: Array | None) -> Array:
    """Return the covariance (d, d) of the added noise along the columns of `where`."""
    d = where.shape[1]
    if fault.covariance is not None:
        if fault.covariance.shape != (d, d):
            raise StructureError(
                f"{fault.name}: covariance of shape {fault.covariance.shape}; it must be ({d}, {d})."
            )
        return fault.covariance
    if fault.std is not None:
        return fault.std**2 * np.eye(d)
    assert fault.scale is not None
    if present is None:
        raise StructureError(f"{fault.name}: scale multiplies the noise of the model, which has none: give std.")
    along = np.linalg.pinv(where)
    return (fault.scale**2 - 1) * along @ present @ along.T


def _started(model: "HammersteinSS", x0: Any, u: Array) -> Array:
    if not isinstance(x0, str):
        return np.array(state_like(x0, (model.nx,)))
    if x0 == "zero":
        return np.zeros(model.nx)
    if x0 != "rest":
        raise StructureError(f"x0={x0!r}: use 'zero', 'rest' or an array ({model.nx},).")
    return np.array(model.equilibrium(u[0])[0])

"""Simulation of a plant with faults."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array, compact, one_or_all
from optid.errors import DataError, StructureError
from optid.faults.faults import Fault
from optid.faults.faulty_plant import FaultyPlant
from optid.models import HammersteinSS
from optid.models.experiments import check_inputs, records_of, state_like
from optid.models.kalman import NoiseCovariances


class Trajectory(NamedTuple):
    """A simulated record of a plant with faults."""

    y: Array  # (N, l) readings
    x: Array  # (N, n) states


class Surroundings(NamedTuple):
    """What a plant is simulated with beside its faults; the attributes are arguments of `inject`."""

    x0: Any = "zero"
    noise: NoiseCovariances | str = "model"
    process: Mapping[str, ArrayLike] | None = None
    feedback: str = "measured"


def inject(model: HammersteinSS, u: Any, faults: Fault | Sequence[Fault] = (), *, seed: int | None = 0,
           x0: Any = "zero", noise: NoiseCovariances | str = "model", process: Mapping[str, ArrayLike] | None = None,
           feedback: str = "measured") -> Any:
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
    surroundings = Surroundings(x0, noise, process, feedback)
    records, _ = records_of(model, u)
    seeds = np.random.SeedSequence(seed).spawn(len(records)) if len(records) > 1 else [seed]
    return one_or_all([
        trajectory(model, inputs, faults, seed=own, surroundings=surroundings).y
        for (inputs, _, _), own in zip(records, seeds)])


def trajectory(model: HammersteinSS, u: ArrayLike, faults: Fault | Sequence[Fault] = (), *, seed: Any = 0,
               surroundings: Surroundings | None = None) -> Trajectory:
    """Simulate one record as `inject` does and return the states, too."""
    from optid.faults.kernels import march_faulty
    from optid.models.state_kernels import INSIDE, REFUSED

    x0, noise, process, feedback = surroundings or Surroundings()
    if feedback not in ("measured", "true"):
        raise StructureError(f"feedback={feedback!r}: use 'measured' or 'true'.")
    if not model.parts.tables.compiled:
        raise StructureError(
            "The feedback has functions of the user, which cannot be compiled. Fit them by another basis first.")
    inputs = records_of(model, [np.asarray(u)])[0][0][0]
    check_inputs(model, inputs, "")
    broken = [faults] if isinstance(faults, Fault) else list(faults)
    plan = _broken(model, inputs, broken, _covariances(model, noise), seed, process or {})
    drive = plan.jolt + model.offset_x + np.einsum("kir,kr->ki", plan.B, plan.state, optimize=True)
    direct = plan.output @ model.D.T + model.offset_y
    x = _started(model, x0, inputs) + plan.start
    table = plan.A[:1] if plan.A.strides[0] == 0 else plan.A
    ended, at, states, readings = march_faulty(
        model.parts, compact(table), drive + plan.w, direct, plan.sensors, feedback == "true", x)
    if ended != INSIDE:
        raise DataError(
            f"At sample {at} the output leaves the interval of a feedback basis with outside='error'."
            if ended == REFUSED else f"The faulty plant leaves the range of numbers at sample {at}: it is unstable.")
    return Trajectory(readings, states)


def _broken(model: HammersteinSS, u: Array, faults: list[Fault], covariances: NoiseCovariances | None, seed: Any,
            process: Mapping[str, ArrayLike]) -> FaultyPlant:
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    healthy, *streams = (np.random.default_rng(s) for s in root.spawn(len(faults) + 1))
    plant = FaultyPlant(model, u, covariances, process, healthy)
    for fault, stream in sorted(zip(faults, streams), key=lambda pair: pair[0].fault_kind.additive):
        fault.fault_kind.simulate(fault, plant.at(fault.active(len(u)), stream))
    return plant


def _covariances(model: HammersteinSS, noise: NoiseCovariances | str) -> NoiseCovariances | None:
    if isinstance(noise, NoiseCovariances):
        if noise.S.shape != (model.nx, model.l):
            raise StructureError(f"noise: S has shape {noise.S.shape}; it must be {(model.nx, model.l)}.")
        return noise
    if noise == "none":
        return None
    if noise != "model":
        raise StructureError(f"noise={noise!r}: use 'model', 'none' or NoiseCovariances.")
    if model.noise is None:
        raise StructureError("The model has no noise covariances: estimate them with optid.noise.with_noise(model, "
                             "data), or pass noise='none' for a run without noise.")
    return model.noise


def _started(model: HammersteinSS, x0: Any, u: Array) -> Array:
    if not isinstance(x0, str):
        return np.array(state_like(x0, (model.nx,)))
    if x0 == "zero":
        return np.zeros(model.nx)
    if x0 != "rest":
        raise StructureError(f"x0={x0!r}: use 'zero', 'rest' or an array ({model.nx},).")
    return np.array(model.equilibrium(u[0])[0])

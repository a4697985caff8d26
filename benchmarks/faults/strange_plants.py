"""Three plants that optid does not describe exactly, with faults that owe nothing to `optid.faults.inject`.

* tanks: quadruple tank (K. H. Johansson, IEEE Trans. Control Systems Technology 8, 2000), two inputs behind
  equal-percentage valves, the levels of the two lower tanks measured;
* motor: a DC motor whose driver has a dead zone, one voltage that never changes its sign, current and speed measured;
* heater: a heater whose power is the square of its voltage, under a PI controller that reads the faulty sensor.

Every plant is integrated between samples with its own physics, faults included. The model is identified by optid from
3,000 healthy samples; `strange_figures.py` measures what is then said.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

import optid

SAMPLES = 3000
"""Healthy samples for the identification."""


class Failure(NamedTuple):
    """A fault of a simulated plant.

    Attributes:
        part: "actuator:NAME", "sensor:NAME" or "process:leak".
        kind: loss, stuck or bias of an actuator; bias, drift, frozen, dead, gain (of reading and noise), early gain (of
            the reading before its noise) or noise of a sensor; leak.
        onset: first sample with it.
        size: share lost, level stuck at, offset, slope per sample, gain, factor of the noise, strength of the leak.
    """

    part: str
    kind: str
    onset: int
    size: float = 0.0


@dataclass(frozen=True)
class Plant:
    """A plant between two samples.

    Attributes:
        name, inputs, outputs: what it is called.
        dt: sampling time, s.
        start: state at rest.
        flow: (x, u, leak) -> dx/dt.
        measure: (x, u) -> readings.
        spans: per input the range of the levels of the experiment.
        hold: largest number of samples a level is held.
        noise: standard deviation of each reading.
        unrest: standard deviation of the random walk of the state per sample.
        order: number of states of the identified model.
        leaking: strength of a leak that is plainly there.
        steps: integration steps per sample.
        controlled: whether the input follows a PI controller; its span is then that of the reference.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    start: tuple[float, ...]
    flow: Callable[[np.ndarray, np.ndarray, float], np.ndarray]
    measure: Callable[[np.ndarray, np.ndarray], np.ndarray]
    spans: tuple[tuple[float, float], ...]
    hold: int
    noise: tuple[float, ...]
    unrest: tuple[float, ...]
    order: int
    leaking: float
    steps: int = 4
    controlled: bool = False


def _tank_flow(x: np.ndarray, u: np.ndarray, leak: float) -> np.ndarray:
    areas, holes, g = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057]), 981.0
    q = 26.0 * 12.0 ** (u - 1)  # equal-percentage valves, rangeability 12
    out = holes * np.sqrt(2 * g * np.maximum(x, 0.0))
    into = np.array([0.7 * q[0] + out[2] - leak, 0.6 * q[1] + out[3], 0.4 * q[1], 0.3 * q[0]])
    return (into - out) / areas


def _motor_flow(x: np.ndarray, u: np.ndarray, leak: float) -> np.ndarray:
    voltage = np.sign(u[0]) * max(abs(u[0]) - 1.0, 0.0)
    current, speed = x
    return np.array([(voltage - 2.0 * current - 0.1 * speed) / 0.15, (0.1 * current - 0.004 * speed - leak) / 0.002])


def _heater_flow(x: np.ndarray, u: np.ndarray, leak: float) -> np.ndarray:
    power = u[0] ** 2
    return np.array([(power - 4.0 * (x[0] - x[1])) / 60.0, (4.0 * (x[0] - x[1]) - 1.2 * x[1] - leak) / 150.0])


PLANTS = {
    p.name: p for p in (
        Plant("tanks", ("v1", "v2"), ("h1", "h2"), 5.0, (12.0, 12.0, 1.5, 1.5), _tank_flow, lambda x, u: x[:2],
              ((0.62, 0.82), (0.62, 0.82)), 20, (0.05, 0.05), (0.03, 0.03, 0.02, 0.02), 4, 4.0),
        Plant("motor", ("u",), ("i", "w"), 0.02, (0.5, 12.0), _motor_flow, lambda x, u: x.copy(), ((0.3, 4.3),), 12,
              (0.03, 0.3), (0.004, 0.05), 2, 0.02),
        Plant("heater", ("v",), ("T",), 4.0, (30.0, 20.0), _heater_flow, lambda x, u: x[1:], ((14.0, 26.0),), 60,
              (0.08,), (0.05, 0.02), 2, 4.0, controlled=True),
    )
}

FAILURES: dict[str, tuple[Failure, ...]] = {
    "tanks": (Failure("actuator:v1", "loss", 0, 0.5), Failure("actuator:v2", "stuck", 0, 0.8),
              Failure("sensor:h1", "bias", 0, 0.6), Failure("sensor:h2", "drift", 0, 0.01),
              Failure("sensor:h1", "frozen", 0), Failure("sensor:h2", "dead", 0), Failure("sensor:h1", "gain", 0, 0.5),
              Failure("sensor:h2", "noise", 0, 4.0), Failure("process:leak", "leak", 0)),
    "motor": (Failure("actuator:u", "loss", 0, 0.4), Failure("actuator:u", "stuck", 0, 2.0),
              Failure("sensor:i", "bias", 0, 0.3), Failure("sensor:w", "drift", 0, 0.02),
              Failure("sensor:w", "frozen", 0),
              Failure("sensor:i", "dead", 0), Failure("sensor:w", "gain", 0, 0.5), Failure("sensor:i", "noise", 0, 4.0),
              Failure("process:leak", "leak", 0)),
    "heater": (Failure("actuator:v", "loss", 0, 0.4), Failure("actuator:v", "stuck", 0, 5.0),
               Failure("sensor:T", "bias", 0, 1.0), Failure("sensor:T", "drift", 0, 0.02),
               Failure("sensor:T", "frozen", 0), Failure("sensor:T", "dead", 0),
               Failure("sensor:T", "gain", 0, 0.5), Failure("sensor:T", "noise", 0, 4.0),
               Failure("process:leak", "leak", 0)),
}
"""Faults of each plant; the onset is set by the run."""


def simulate(plant: Plant | str, samples: int, seed: int, failure: Failure | None = None, *, pole: float = 0.0,
             reach: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs as commanded (N, m) and readings (N, l); NaN is a missing reading.

    Args:
        plant: or its name.
        samples: N.
        seed: of levels and noise.
        failure: the fault, if any.
        pole: of the sensor noise, which is autoregressive of order one; its variance does not depend on it.
        reach: of the levels, in half ranges of the identification.
    """
    p = PLANTS[plant] if isinstance(plant, str) else plant
    rng = np.random.default_rng([seed, sum(map(ord, p.name))])
    levels, l = _levels(p, samples, rng, reach), len(p.outputs)  # noqa: E741
    unrest = rng.standard_normal((samples, len(p.start))) * p.unrest
    fresh = rng.standard_normal((samples, l)) * p.noise
    x, noise, integral = np.array(p.start), np.zeros(l), 0.0
    given, readings = np.empty((samples, len(p.inputs))), np.empty((samples, l))
    last, warm = np.array(p.measure(x, levels[0])), 5.0
    for k in range(-200, samples):
        live = failure if failure is not None and k >= failure.onset else None
        i = max(k, 0)
        if p.controlled:
            error = levels[i, 0] - last[0]
            integral = np.clip(integral + 0.01 * error, -8.0, 8.0)
            command = np.clip(warm + 0.25 * error + integral, 0.0, 10.0)[None]
        else:
            command = levels[i]
        acting = _actuator(command, p, live)
        noise = pole * noise + np.sqrt(1 - pole**2) * fresh[i]
        leak = (live.size or p.leaking) if live is not None and live.kind == "leak" else 0.0
        clean = np.asarray(p.measure(x, acting), dtype=float)
        reading = _sensor(clean + noise, noise, last, p, live, k)
        if k >= 0:
            given[k], readings[k] = command, reading
        last = np.where(np.isnan(reading), last, reading)
        for _ in range(p.steps):
            x = x + p.dt / p.steps * p.flow(x, acting, leak)
        x = x + unrest[i]
    return given, readings


def _levels(p: Plant, samples: int, rng: np.random.Generator, reach: float) -> np.ndarray:
    result = np.empty((samples, len(p.spans)))
    for j, (low, high) in enumerate(p.spans):
        k, middle, half = 0, (low + high) / 2, (high - low) / 2 * reach
        while k < samples:
            hold = int(rng.integers(p.hold // 3, p.hold + 1))
            result[k : k + hold, j] = middle + half * rng.uniform(-1, 1)
            k += hold
    return result


def _actuator(command: np.ndarray, p: Plant, failure: Failure | None) -> np.ndarray:
    acting = command.copy()
    if failure is None or not failure.part.startswith("actuator"):
        return acting
    j = p.inputs.index(failure.part.partition(":")[2])
    if failure.kind == "loss":  # a share of the effect is lost
        effect, zero = _effects(p.name)
        acting[j] = zero((1 - failure.size) * effect(command[j]))
    elif failure.kind == "stuck":
        acting[j] = failure.size
    else:
        acting[j] += failure.size
    return acting


def _effects(name: str) -> tuple[Callable[[float], float], Callable[[float], float]]:
    """What an input does, and the input that does so much."""
    if name == "tanks":
        return lambda v: 12.0 ** (v - 1), lambda q: 1 + np.log(q) / np.log(12.0)
    if name == "motor":
        return lambda v: max(v - 1.0, 0.0), lambda q: q + 1.0
    return lambda v: v**2, np.sqrt


def _sensor(reading: np.ndarray, noise: np.ndarray, last: np.ndarray, p: Plant, failure: Failure | None, k: int
            ) -> np.ndarray:
    reading = reading.copy()
    if failure is None or not failure.part.startswith("sensor"):
        return reading
    o = p.outputs.index(failure.part.partition(":")[2])
    if failure.kind == "bias":
        reading[o] += failure.size
    elif failure.kind == "drift":
        reading[o] += failure.size * (k - failure.onset + 1)
    elif failure.kind == "frozen":
        reading[o] = last[o]
    elif failure.kind == "dead":
        reading[o] = np.nan
    elif failure.kind == "gain":
        reading[o] *= failure.size
    elif failure.kind == "early gain":
        reading[o] = failure.size * (reading[o] - noise[o]) + noise[o]
    elif failure.kind == "noise":
        reading[o] += (failure.size - 1) * noise[o]
    return reading


def identify(plant: Plant | str, seed: int, samples: int = SAMPLES, **settings: Any) -> tuple[optid.Fit, optid.Data]:
    """Identify a plant from a healthy record: the fit, and the record."""
    p = PLANTS[plant] if isinstance(plant, str) else plant
    data = record(p, *simulate(p, samples, seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        how = {**HOW[p.name], **settings}
        return optid.fit(data, how.pop("formulation"), **how), data


def record(plant: Plant | str, u: np.ndarray, y: np.ndarray) -> optid.Data:
    """Return a record with the names and the sampling time of a plant."""
    p = PLANTS[plant] if isinstance(plant, str) else plant
    return optid.Data(u, y, dt=p.dt, inputs=p.inputs, outputs=p.outputs)


_STATES: dict[str, Any] = {"formulation": "hammerstein_ss.asivid"}
HOW: dict[str, dict[str, Any]] = {
    "tanks": {**_STATES, "nx": 4, "basis": "polynomial:3"},
    "motor": {**_STATES, "nx": 2, "basis": "triangular:7"},
    "heater": {**_STATES, "nx": 2, "basis": "polynomial:2"},
}
"""How each plant is identified; the instruments allow for the closed loop of the heater."""

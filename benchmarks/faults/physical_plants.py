"""Six plants that optid does not describe exactly, with faults that owe nothing to `optid.faults.inject`.

Under PI controllers with limited inputs, which act on the readings, faults included:

* reactor: a stirred reactor; coolant and feed behind equal-percentage valves; concentration and temperature measured;
* greenhouse: heater and fan act on temperature and humidity of the air; the weather outside changes slowly;
* drive: a servo valve with a dead zone feeds a motor; pressure and speed are measured;
* heater: a heater whose power is the square of its voltage, and one temperature.

Without a controller:

* tanks: quadruple tank (K. H. Johansson, IEEE Trans. Control Systems Technology 8, 2000), two inputs behind
  equal-percentage valves, the levels of the two lower tanks measured;
* motor: a DC motor whose driver has a dead zone, one voltage that never changes its sign, current and speed measured.

Set-points and inputs are levels that are held. A healthy record begins with the start-up from rest. Every plant is
integrated with its own physics between samples, and a share lost of an actuator is a share of its physical effect.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

import optid

SAMPLES, START = 4000, 300
"""Samples of the record of the identification, the start-up of so many included."""

PERIOD = 3000
"""Samples of a period of the weather."""


class Failure(NamedTuple):
    """A fault.

    Attributes:
        part: "actuator:NAME", "sensor:NAME" or "process:leak".
        kind: loss, stuck (at the size, or where it is at the onset) or offset of an actuator; bias, drift, frozen,
            dead, gain (of reading and noise), early gain (of the reading before its noise) or noise of a sensor; leak.
        onset: first sample with it.
        size: share of the effect lost, level stuck at, offset as a share of the usual effect, bias or slope in standard
            deviations of the noise, gain, factor of the noise, strength of the leak.
    """

    part: str
    kind: str
    onset: int
    size: float = 0.0


@dataclass(frozen=True)
class Plant:
    """A plant, for many runs at once.

    Attributes:
        name, inputs, outputs: what it is called.
        dt: sampling time, s.
        rest: state before the start-up.
        effect: inputs (M, m) -> effects (M, m).
        flow: (x, effects, weather or leak) -> dx/dt, all (M, n).
        measured: the states that are measured.
        targets: per loop (controlled state, input, lowest and highest set-point); per input without a controller
            (None, input, lowest and highest level).
        gains: per loop (proportional, integral per sample), in inputs per unit of the output.
        warm: input that the controllers begin with, or the usual one.
        limits: per input (lowest, highest) that a controller gives.
        hold: most samples for which a level is held.
        noise: standard deviation of each reading.
        unrest: of the random walk of the states, per sample.
        how: how it is identified.
        wider: range of the levels in the record of the identification, relative to that of operation.
        steps: integration steps per sample.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    rest: tuple[float, ...]
    effect: Callable[[np.ndarray], np.ndarray]
    flow: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    measured: tuple[int, ...]
    targets: tuple[tuple[int | None, int, float, float], ...]
    gains: tuple[tuple[float, float], ...]
    warm: tuple[float, ...]
    limits: tuple[tuple[float, float], ...]
    hold: int
    noise: tuple[float, ...]
    unrest: tuple[float, ...]
    how: dict[str, Any]
    wider: float = 1.5
    steps: int = 4


def _reactor(x: np.ndarray, v: np.ndarray, weather: np.ndarray) -> np.ndarray:
    c, T = x.T
    rate = 0.03 * np.exp(0.04 * (T - 60.0)) * c
    return np.stack([0.02 * v[:, 1] * (2.0 - c) - rate, 0.02 * v[:, 1] * (25.0 + weather - T) + 60.0 * rate
                     - 0.6 * v[:, 0]], axis=1)


def _greenhouse(x: np.ndarray, v: np.ndarray, weather: np.ndarray) -> np.ndarray:
    air, ground, wet = x.T
    out = 8.0 + weather
    vent = 0.01 * v[:, 1]
    return np.stack([0.12 * v[:, 0] - (vent + 0.01) * (air - out) + 0.01 * (ground - air), 0.002 * (air - ground),
                     0.06 - (vent + 0.002) * (wet - 6.0)], axis=1)


def _drive(x: np.ndarray, v: np.ndarray, weather: np.ndarray) -> np.ndarray:
    pressure, speed = x.T
    return np.stack([4.0 * (v[:, 0] - 0.05 * speed - 0.02 * pressure), 1.2 * pressure - 0.25 * speed - 3.0 - weather],
                    axis=1)


def _tanks(x: np.ndarray, v: np.ndarray, leak: np.ndarray) -> np.ndarray:
    areas, holes, g = np.array([28.0, 32.0, 28.0, 32.0]), np.array([0.071, 0.057, 0.071, 0.057]), 981.0
    out = holes * np.sqrt(2 * g * np.maximum(x, 0.0))
    into = np.stack([0.7 * v[:, 0] + out[:, 2] - leak, 0.6 * v[:, 1] + out[:, 3], 0.4 * v[:, 1], 0.3 * v[:, 0]], axis=1)
    return (into - out) / areas


def _motor(x: np.ndarray, v: np.ndarray, leak: np.ndarray) -> np.ndarray:
    current, speed = x.T
    return np.stack([(v[:, 0] - 2.0 * current - 0.1 * speed) / 0.15, (0.1 * current - 0.004 * speed - leak) / 0.002],
                    axis=1)


def _heater(x: np.ndarray, v: np.ndarray, leak: np.ndarray) -> np.ndarray:
    hot, T = x.T
    return np.stack([(v[:, 0] - 4.0 * (hot - T)) / 60.0, (4.0 * (hot - T) - 1.2 * T - leak) / 150.0], axis=1)


def _exact(order: int) -> dict[str, Any]:
    return {"formulation": "hammerstein_ss.exact", "nx": order, "basis": "polynomial:2", "criterion": "prediction",
            "feedthrough": False, "prove": False}


def _subspace(order: int, basis: str) -> dict[str, Any]:
    return {"formulation": "hammerstein_ss.asivid", "nx": order, "basis": basis}


PLANTS = {p.name: p for p in (
    Plant("reactor", ("coolant", "feed"), ("c", "T"), 5.0, (0.6, 45.0), lambda u: (30.0**u - 1) / 29 * [3.0, 3.0],
          _reactor, (0, 1), ((1, 0, 58.0, 62.0), (0, 1, 0.75, 0.85)), ((-0.02, -0.002), (0.5, 0.03)), (0.75, 0.7),
          ((0.0, 1.0), (0.0, 1.0)), 80, (0.004, 0.1), (0.001, 0.03), _exact(2)),
    Plant("greenhouse", ("heater", "fan"), ("air", "humidity"), 10.0, (12.0, 12.0, 12.0),
          lambda u: np.stack([np.clip(u[:, 0], 0, 1) ** 1.5 * 3, 1.6 * np.maximum(u[:, 1] - 0.1, 0.0)], axis=1),
          _greenhouse, (0, 2), ((0, 0, 19.0, 21.0), (2, 1, 12.0, 13.5)), ((0.1, 0.01), (-0.1, -0.01)), (0.5, 0.5),
          ((0.0, 1.0), (0.1, 1.0)), 80, (0.05, 0.05), (0.01, 0.005, 0.02), _exact(3), steps=8),
    Plant("drive", ("valve",), ("p", "n"), 0.3, (0.0, 0.0), lambda u: np.maximum(u - 0.4, 0.0) * 1.2, _drive, (0, 1),
          ((1, 0, 40.0, 60.0),), ((0.03, 0.002),), (3.0,), ((0.4, 10.0),), 60, (0.15, 0.25), (0.03, 0.05), _exact(2),
          steps=6),
    Plant("heater", ("v",), ("T",), 4.0, (30.0, 20.0), lambda u: u**2, _heater, (1,), ((1, 0, 14.0, 26.0),),
          ((0.25, 0.01),), (5.0,), ((0.0, 10.0),), 60, (0.08,), (0.05, 0.02), _subspace(2, "polynomial:2"), 1.0),
    Plant("tanks", ("v1", "v2"), ("h1", "h2"), 5.0, (12.0, 12.0, 1.5, 1.5), lambda u: 26.0 * 12.0 ** (u - 1), _tanks,
          (0, 1), ((None, 0, 0.62, 0.82), (None, 1, 0.62, 0.82)), (), (0.72, 0.72), (), 20, (0.05, 0.05),
          (0.03, 0.03, 0.02, 0.02), _subspace(4, "polynomial:3"), 1.0),
    Plant("motor", ("u",), ("i", "w"), 0.02, (0.5, 12.0), lambda u: np.sign(u) * np.maximum(np.abs(u) - 1.0, 0.0),
          _motor, (0, 1), ((None, 0, 0.3, 4.3),), (), (2.3,), (), 12, (0.03, 0.3), (0.004, 0.05),
          _subspace(2, "triangular:7"), 1.0),
)}


def simulate(plant: str, samples: int, seed: int, failures: Sequence[Failure | tuple[Failure, ...] | None] = (None,), *,
             start: bool = False, season: float = 0.0, pole: float = 0.0, reach: float = 1.0
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return commanded inputs (M, N, m) and readings (M, N, l), one run for each entry of `failures`.

    Args:
        plant: its name.
        samples: N.
        seed: of set-points and noise.
        failures: none, one or several at once.
        start: whether the record begins with the start-up.
        season: amplitude of the weather, in the units of the flow.
        pole: of the noise of the readings, autoregressive of order one.
        reach: of the set-points, in half ranges.
    """
    p, M = PLANTS[plant], len(failures)
    rng = np.random.default_rng([seed, sum(map(ord, plant))])
    lead = 0 if start else START
    total, m, l, n = samples + lead, len(p.inputs), len(p.outputs), len(p.rest)  # noqa: E741
    sets = np.stack([[_levels(total, lo, hi, p.hold, reach, rng) for _, _, lo, hi in p.targets] for _ in range(M)])
    unrest = rng.standard_normal((total, M, n)) * p.unrest
    fresh, noise = rng.standard_normal((total, M, l)), np.zeros((M, l))
    x, u = np.tile(p.rest, (M, 1)), np.tile(p.warm, (M, 1))
    integral = np.zeros((M, len(p.targets)))
    given, readings = np.empty((M, samples, m)), np.empty((M, samples, l))
    held, last = np.full((M, m), np.nan), np.zeros((M, l))
    index = {o: i for i, o in enumerate(p.measured)}
    for k in range(total):
        live = [(run, f) for run, several in enumerate(failures) for f in _listed(several) if k - lead >= f.onset]
        clean = x[:, p.measured]
        noise = pole * noise + np.sqrt(1 - pole**2) * fresh[k]
        y = clean + noise * p.noise
        for run, f in live:
            if f.part.startswith("sensor"):
                o = p.outputs.index(f.part.partition(":")[2])
                y[run, o] = _read(f, k - lead, clean[run, o], noise[run, o] * p.noise[o], p.noise[o], last[run, o])
        last = np.where(np.isnan(y), last, y)
        for j, (o, c, _, _) in enumerate(p.targets):
            if o is None:
                u[:, c] = sets[:, j, k]
                continue
            (kp, ki), (low, high) = p.gains[j], p.limits[c]
            error = sets[:, j, k] - last[:, index[o]]
            wanted = p.warm[c] + kp * error + integral[:, j] + ki * error
            integral[:, j] += np.where((wanted > low) & (wanted < high), ki * error, 0.0)
            u[:, c] = np.clip(wanted, low, high)
        if k >= lead:
            given[:, k - lead], readings[:, k - lead] = u, y
        acting, hidden = u.copy(), np.full(M, season * np.sin(2 * np.pi * (k - lead) / PERIOD))
        lost, added = np.zeros((2, M, m))
        for run, f in live:
            if f.part.startswith("process"):
                hidden[run] += f.size
            if not f.part.startswith("actuator"):
                continue
            c = p.inputs.index(f.part.partition(":")[2])
            if f.kind == "stuck":
                held[run, c] = (f.size or u[run, c]) if np.isnan(held[run, c]) else held[run, c]
                acting[run, c] = held[run, c]
            elif f.kind == "offset":
                added[run, c] = f.size * p.effect(np.array([p.warm]))[0, c]
            else:
                lost[run, c] = f.size
        v = (1 - lost) * p.effect(acting) + added
        for _ in range(p.steps):
            x = x + p.dt / p.steps * p.flow(x, v, hidden)
        x = x + unrest[k]
    return given, readings


def _read(f: Failure, k: int, clean: float, noise: float, spread: float, last: float) -> float:
    """Return what a faulty sensor reads at a sample."""
    return {"bias": clean + noise + f.size * spread, "drift": clean + noise + f.size * spread * (k - f.onset + 1),
            "frozen": last, "dead": np.nan, "gain": f.size * (clean + noise), "early gain": f.size * clean + noise,
            "noise": clean + f.size * noise}[f.kind]


def _listed(several: Failure | tuple[Failure, ...] | None) -> tuple[Failure, ...]:
    return () if several is None else (several,) if isinstance(several, Failure) else several


def _levels(count: int, low: float, high: float, hold: int, reach: float, rng: np.random.Generator) -> np.ndarray:
    result, k = np.empty(count), 0
    while k < count:
        width = int(rng.integers(hold // 3, hold + 1))
        result[k : k + width] = (low + high) / 2 + (high - low) / 2 * reach * rng.uniform(-1, 1)
        k += width
    return result


def record(plant: str, u: np.ndarray, y: np.ndarray) -> optid.Data:
    """Return one run as a record with the names and the sampling time of the plant."""
    p = PLANTS[plant]
    return optid.Data(u, y, dt=p.dt, inputs=p.inputs, outputs=p.outputs)


@cache
def identified(plant: str, seed: int = 0, samples: int = SAMPLES) -> tuple[Any, optid.Data]:
    """Identify a plant from a healthy record that begins with its start-up, of which the first samples are left out."""
    p = PLANTS[plant]
    u, y = simulate(plant, samples, 100 + seed, start=True, reach=p.wider)
    data = record(plant, u[0, START:], y[0, START:])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        how = dict(p.how)
        return optid.fit(data, how.pop("formulation"), **how), data

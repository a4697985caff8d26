"""Three plants under control that optid does not describe exactly: a reactor, a greenhouse and a hydraulic drive.

* reactor: a stirred reactor; coolant and feed behind equal-percentage valves; concentration and temperature measured;
* greenhouse: heater and fan act on temperature and humidity of the air; the weather outside changes slowly;
* drive: a servo valve with a dead zone feeds a motor; pressure and speed are measured.

PI controllers with limited inputs act on the readings, faults included. Set-points are levels that are held. A healthy
record begins with the start-up from rest. Every plant is integrated with its own physics between samples, and a share
lost of an actuator is a share of its physical effect beyond its zero: nothing here comes from `optid.faults.inject`.
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


WIDER = 1.5
"""Range of the set-points in the record of the identification, relative to that of operation."""


class Failure(NamedTuple):
    """A fault.

    Attributes:
        part: "actuator:NAME" or "sensor:NAME".
        kind: loss, stuck (at the size, or where it is at the onset) or offset of an actuator; bias, drift or frozen of
            a sensor.
        onset: first sample with it.
        size: share of the effect lost, offset as a share of the usual effect, bias or slope in standard deviations of
            the noise.
    """

    part: str
    kind: str
    onset: int
    size: float = 0.0


@dataclass(frozen=True)
class Plant:
    """A plant under control, for many runs at once.

    Attributes:
        name, inputs, outputs: what it is called.
        dt: sampling time, s.
        rest: state before the start-up.
        zeros: inputs at which the actuators have no effect.
        effect: inputs (M, m) -> effects (M, m).
        inverse: effects -> inputs.
        flow: (x, effects, weather) -> dx/dt, all (M, n).
        measured: the states that are measured.
        targets: per controlled output (output, input, lowest and highest set-point).
        gains: per loop (proportional, integral per sample), in inputs per unit of the output.
        warm: input that the controllers begin with.
        hold: most samples for which a set-point is held.
        noise: standard deviation of each reading.
        unrest: of the random walk of the states, per sample.
        season: amplitude of the weather; its period is 3,000 samples.
        order, basis: of the identified model.
        steps: integration steps per sample.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dt: float
    rest: tuple[float, ...]
    zeros: tuple[float, ...]
    effect: Callable[[np.ndarray], np.ndarray]
    inverse: Callable[[np.ndarray], np.ndarray]
    flow: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    measured: tuple[int, ...]
    targets: tuple[tuple[int, int, float, float], ...]
    gains: tuple[tuple[float, float], ...]
    warm: tuple[float, ...]
    hold: int
    noise: tuple[float, ...]
    unrest: tuple[float, ...]
    season: float
    order: int
    basis: Any
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


PLANTS = {p.name: p for p in (
    Plant("reactor", ("coolant", "feed"), ("c", "T"), 5.0, (0.6, 45.0), (0.0, 0.0),
          lambda u: (30.0**u - 1) / 29 * [3.0, 3.0], lambda v: np.log1p(29 * v / [3.0, 3.0]) / np.log(30.0), _reactor,
          (0, 1), ((1, 0, 58.0, 62.0), (0, 1, 0.75, 0.85)), ((-0.02, -0.002), (0.5, 0.03)), (0.75, 0.7), 80,
          (0.004, 0.1), (0.001, 0.03), 0.0, 2, "polynomial:2"),
    Plant("greenhouse", ("heater", "fan"), ("air", "humidity"), 10.0, (12.0, 12.0, 12.0), (0.0, 0.1),
          lambda u: np.stack([np.clip(u[:, 0], 0, 1) ** 1.5 * 3, 1.6 * np.maximum(u[:, 1] - 0.1, 0.0)], axis=1),
          lambda v: np.stack([(v[:, 0] / 3) ** (2 / 3), v[:, 1] / 1.6 + 0.1], axis=1), _greenhouse, (0, 2),
          ((0, 0, 19.0, 21.0), (2, 1, 12.0, 13.5)), ((0.1, 0.01), (-0.1, -0.01)), (0.5, 0.5), 80, (0.05, 0.05),
          (0.01, 0.005, 0.02), 0.0, 3, "polynomial:2", 8),
    Plant("drive", ("valve",), ("p", "n"), 0.3, (0.0, 0.0), (0.4,),
          lambda u: np.maximum(u - 0.4, 0.0) * 1.2, lambda v: v / 1.2 + 0.4, _drive, (0, 1), ((1, 0, 40.0, 60.0),),
          ((0.03, 0.002),), (3.0,), 60, (0.15, 0.25), (0.03, 0.05), 0.0, 2, "polynomial:2", 6),
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
    given, readings, clean = np.empty((M, samples, m)), np.empty((M, samples, l)), np.zeros((M, l))
    held, last = np.full((M, m), np.nan), np.zeros((M, l))
    index = {o: i for i, o in enumerate(p.measured)}
    for k in range(total):
        clean = x[:, p.measured]
        noise = pole * noise + np.sqrt(1 - pole**2) * fresh[k]
        y = clean + noise * p.noise
        for run, several in enumerate(failures):
            for f in _listed(several):
                if f.part.startswith("sensor") and k - lead >= f.onset:
                    o = p.outputs.index(f.part.partition(":")[2])
                    y[run, o] = {"bias": y[run, o] + f.size * p.noise[o], "frozen": last[run, o],
                                 "drift": y[run, o] + f.size * p.noise[o] * (k - lead - f.onset + 1)}[f.kind]
        last = y.copy()
        for j, ((o, c, _, _), (kp, ki)) in enumerate(zip(p.targets, p.gains)):
            error = sets[:, j, k] - y[:, index[o]]
            wanted = p.warm[c] + kp * error + integral[:, j] + ki * error
            inside = (wanted > p.zeros[c]) & (wanted < 1.0 if p.name != "drive" else wanted < 10.0)
            integral[:, j] += np.where(inside, ki * error, 0.0)
            u[:, c] = np.clip(wanted, p.zeros[c], 1.0 if p.name != "drive" else 10.0)
        if k >= lead:
            given[:, k - lead], readings[:, k - lead] = u, y
        acting = u.copy()
        lost, added = np.zeros((2, M, m))
        for run, several in enumerate(failures):
            for f in _listed(several):
                if f.part.startswith("actuator") and k - lead >= f.onset:
                    c = p.inputs.index(f.part.partition(":")[2])
                    if f.kind == "stuck":
                        held[run, c] = (f.size or u[run, c]) if np.isnan(held[run, c]) else held[run, c]
                        acting[run, c] = held[run, c]
                    elif f.kind == "offset":
                        added[run, c] = f.size * p.effect(np.array([p.warm]))[0, c]
                    else:
                        lost[run, c] = f.size
        v = (1 - lost) * p.effect(acting) + added
        weather = np.full(M, season * np.sin(2 * np.pi * (k - lead) / 3000))
        for _ in range(p.steps):
            x = x + p.dt / p.steps * p.flow(x, v, weather)
        x = x + unrest[k]
    return given, readings


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
def identified(plant: str, seed: int = 0) -> tuple[Any, optid.Data]:
    """Identify a plant from a healthy record that begins with its start-up, of which the first samples are left out."""
    u, y = simulate(plant, SAMPLES, 100 + seed, start=True, reach=WIDER)
    data = record(plant, u[0, START:], y[0, START:])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return optid.fit(data, "hammerstein_ss.exact", nx=PLANTS[plant].order, basis=PLANTS[plant].basis,
                         criterion="prediction", feedthrough=False, prove=False), data

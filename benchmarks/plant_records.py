"""Ordinary plant records, simulated: steps, bumps, staircases with dead time, loops, inputs that act on nothing.

`record(kind, seed)` returns a record and the plants behind it; `KINDS` are the recipes by name. Everything is a
function of kind and seed. Noise is 1 to 10 % of the standard deviation of the output without noise, white or
autoregressive with a pole of 0.9 unless the recipe says otherwise; levels and spans are those of engineering units,
sampling times lie between 0.01 s and an hour.

    python benchmarks/plant_records.py            # the kinds and what is drawn in each
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any
from zlib import crc32

import numpy as np
from scipy.signal import lfilter
from simulated_plants import PID, Array, Curve, Linear, Plant, Relay, Units, run_loop

import optid
from optid import signals

DTS = (0.01, 0.1, 1.0, 5.0, 10.0, 60.0, 3600.0)
UNITS = (Units(0.0, 1.0, 0.0, 1.0), Units(35.0, 5.0, 71.3, 4.0), Units(20.0, 10.0, 288.15, 15.0),
         Units(50.0, 20.0, 1.013e5, 2e3), Units(1450.0, 150.0, 0.8, 0.05), Units(4e-3, 1e-3, 7.0, 0.4))
OPEN, CLOSED, REGULATED = "open", "closed", "regulated"
BEFORE = 300  # samples for which a plant was in motion before its record, where it was not at rest

CURVES: dict[str, Curve] = {
    "saturation": lambda v: np.minimum(v, 0.3),
    "dead zone": lambda v: np.sign(v) * np.maximum(np.abs(v) - 0.25, 0.0),
    "square root": lambda v: np.sqrt(np.maximum(v + 1.2, 0.0)) - np.sqrt(1.2),
    "soft saturation": lambda v: np.tanh(1.5 * v),
    "quadratic": lambda v: v + 0.5 * v**2,
}


@dataclass(frozen=True)
class Recipe:
    """How records of a kind are drawn.

    Attributes:
        input: word of `excite`; "" where a controller drives the plant.
        plant: word of `draw_linear`, or "" for an input that acts on nothing.
        curve: name of a static function before the dynamics, "any", or "".
        other: "Wiener", "Wiener-Hammerstein", "feedback", "drift", or "".
        samples: smallest and largest length.
        dead: smallest and largest dead time in samples; whole ones when both are integers.
        noise: "white", "AR(.9)", or "either".
        share: standard deviation of the noise relative to that of the output without it, smallest and largest.
        sensor: "quantised", "drift", or "".
        controller: "PI", "P", "PID", "relay", "cascade", "late PI", "limited PI", or "".
        setpoint: "steps", "random", "filtered", or "constant".
        own: what an output does on which the input does not act: "AR", "trend", "transient", "oscillation", "walk".
        twist: a change of the columns, a word of `TWISTS`, or "".
    """

    input: str = "staircase"
    plant: str = "first order"
    curve: str = ""
    other: str = ""
    samples: tuple[int, int] = (600, 1000)
    dead: tuple[float, float] = (0.0, 15.5)
    noise: str = "either"
    share: tuple[float, float] = (0.01, 0.1)
    sensor: str = ""
    controller: str = ""
    setpoint: str = ""
    own: str = ""
    twist: str = ""


@dataclass(frozen=True, eq=False)
class PlantRecord:
    """A record and its truth.

    Attributes:
        kind, seed: what it was drawn from.
        data: the record.
        plants: of every input; None for an input that acts on nothing.
        loop: "open", "closed", or "regulated": closed, and nothing moved it from outside.
        noise: standard deviation of the noise relative to the output without it.
    """

    kind: str
    seed: int
    data: optid.Data
    plants: tuple[Plant | None, ...]
    loop: str
    noise: float


def record(kind: str, seed: int) -> PlantRecord:
    """Return the record of a kind with a seed."""
    recipe, rng = KINDS[kind], np.random.default_rng([seed, crc32(kind.encode())])
    n = int(rng.integers(recipe.samples[0], recipe.samples[1] + 1))
    units, dt = UNITS[rng.integers(len(UNITS))], float(rng.choice(DTS))
    draw = _draw_loop if recipe.controller else _draw_without_effect if recipe.own else _draw_open
    u, y, plant, noise = draw(rng, recipe, n, units)
    loop = OPEN if not recipe.controller else REGULATED if recipe.setpoint == "constant" and recipe.controller not in (
        "relay", "cascade") else CLOSED
    u, y, plants = TWISTS[recipe.twist](rng, u, y, plant)
    return PlantRecord(kind, seed, optid.Data(u, y, dt, name=f"{kind} {seed}"), plants, loop, noise)


# -- dynamics ----------------------------------------------------------------------------------------------------------


def draw_linear(rng: np.random.Generator, kind: str, n: int, dead: tuple[float, float]) -> Linear:
    """Draw a transfer function: gain 0.5 to 3 of either sign, time constants of 5 to 30 samples, of N / 12 at most."""
    gain = rng.choice([-1, 1]) * rng.uniform(0.5, 3.0)
    slowest = rng.uniform(5.0, min(30.0, max(n / 12, 6.0)))
    whole = all(isinstance(one, int) for one in dead)
    delay = float(rng.integers(int(dead[0]), int(dead[1]) + 1)) if whole else float(rng.uniform(*dead))
    zero = [1.0]
    if kind == "resonant":
        damping, natural = rng.uniform(0.1, 0.6), 1.0 / rng.uniform(2.0, 6.0)
        factors, slowest = [np.array([1 / natural**2, 2 * damping / natural, 1.0])], 1 / (damping * natural)
    else:
        order = {"first order": 1, "second order": 2, "third order": 3, "fourth order": 4, "inverse response": 2,
                 "integrating": 1}[kind]
        taus = slowest * np.concatenate([[1.0], np.sort(rng.uniform(0.2, 0.8, order - 1))[::-1]])
        factors, slowest = [np.array([tau, 1.0]) for tau in taus], float(np.sum(taus))
    if kind == "inverse response":
        zero = [-rng.uniform(0.3, 0.8) * slowest, 1.0]
    if kind == "integrating":
        gain, factors = gain / 30.0, [np.array([1.0, 0.0])]
    denominator = np.ones(1)
    for factor in factors:
        denominator = np.convolve(denominator, factor)
    return Linear(gain * np.atleast_1d(zero), denominator, delay, int(np.ceil(delay + 4 * slowest)))


def draw_plant(rng: np.random.Generator, recipe: Recipe, n: int, units: Units) -> Plant:
    """Draw a plant of a recipe."""
    linear = draw_linear(rng, recipe.plant, n, recipe.dead)
    names = list(CURVES)
    curve = names[rng.integers(len(names))] if recipe.curve == "any" else recipe.curve
    plant = Plant(linear, units, CURVES.get(curve, np.asarray))
    size = 1.5 / abs(float(linear.numerator[-1] / linear.denominator[-1])) if not linear.integrates else 1.0
    if recipe.other.startswith("Wiener"):
        plant = replace(plant, output=lambda x: np.tanh(size * x) / size)
    if recipe.other == "Wiener-Hammerstein":
        plant = replace(plant, last=replace(draw_linear(rng, "first order", n, (0, 0)), numerator=np.ones(1)))
    if recipe.other == "feedback":
        sign = np.sign(linear.numerator[-1])  # negative feedback for a gain of either sign
        plant = replace(plant, feedback=lambda x: 0.5 * sign * np.clip(size * x, -2, 2) ** 3)
    if recipe.other == "drift":
        t, phase, size = np.linspace(0, 1, n), rng.uniform(), rng.uniform(0.3, 0.8)
        course = (np.sin(2 * np.pi * (t + phase)), t, np.where(t > 0.2 + 0.6 * phase, 1.0, 0.0))[rng.integers(3)]
        plant = replace(plant, drift=1 + size * course)
    return plant


# -- inputs and noises -------------------------------------------------------------------------------------------------


def excite(rng: np.random.Generator, kind: str, n: int) -> Array:
    """Draw an input (N,) within -1 and 1; steps and bumps begin at 0."""
    k, seed = np.arange(n), int(rng.integers(2**31))
    if kind == "one step":
        return np.where(k < n * rng.uniform(0.05, 0.2), 0.0, rng.choice([-1.0, 1.0]))
    if kind == "several steps":
        places = np.sort(rng.choice(np.arange(n // 20, 9 * n // 10, max(n // 20, 1)), int(rng.integers(3, 7)), False))
        return np.concatenate([[0.0], rng.uniform(-1, 1, len(places))])[np.searchsorted(places, k, side="right")]
    if kind == "bump":
        first, last = n * rng.uniform(0.08, 0.2), n * rng.uniform(0.45, 0.65)
        return np.where((k >= first) & (k < last), rng.choice([-1.0, 1.0]), 0.0)
    if kind == "staircase":
        return signals.uniform_levels(n, hold=int(rng.integers(15, 41)), seed=seed)
    if kind == "PRBS":
        return signals.prbs(n, hold=int(rng.integers(4, 13)), seed=seed)
    if kind == "smooth":
        return signals.band_limited_noise(n, cutoff=rng.uniform(0.01, 0.05), seed=seed)
    if kind == "sine":
        return signals.sinusoid(n, frequency=rng.uniform(0.01, 0.05), phase=rng.uniform(0, 6))
    if kind == "few sines":
        lines = np.sort(rng.choice(np.arange(n // 100, n // 20), 3, False))
        return signals.multisine(n, lines=lines, phases="random", seed=seed)
    if kind == "time":
        return np.linspace(-1, 1, n)
    if kind == "slow set-points":  # ramps of some samples between levels
        levels = signals.uniform_levels(n, hold=int(rng.integers(60, 121)), seed=seed)
        width = int(rng.integers(20, 50))
        return np.convolve(np.concatenate([np.full(width - 1, levels[0]), levels]), np.full(width, 1 / width), "valid")
    if kind == "last sample":
        return np.where(k < n - 1, 0.0, 1.0)
    raise ValueError(f"no input {kind!r}")


def draw_noise(rng: np.random.Generator, kind: str, n: int, size: float) -> Array:
    """Draw white or autoregressive noise (N,) of a standard deviation, stationary from the first sample."""
    pole = {"white": 0.0, "AR(.9)": 0.9, "either": 0.9 * float(rng.integers(2))}[kind]
    return autoregression(rng, n, pole, size)


def autoregression(rng: np.random.Generator, n: int, pole: float, size: float) -> Array:
    """Draw stationary first-order autoregressive noise (N,) of a standard deviation."""
    e = rng.standard_normal(n)
    e[1:] *= np.sqrt(1 - pole**2)
    return size * np.asarray(lfilter([1.0], [1.0, -pole], e))


# -- records -----------------------------------------------------------------------------------------------------------


def _draw_open(rng: np.random.Generator, recipe: Recipe, n: int, units: Units) -> tuple[Array, Array, Plant, float]:
    rests = recipe.input.endswith(("step", "steps", "bump", "sample"))  # before the record; else it begins in motion
    before = 0 if rests else BEFORE
    plant = draw_plant(rng, recipe, n + before, units)
    u = units.u0 + units.du * excite(rng, recipe.input, n + before)
    clean = (plant.respond(u) + units.dy * rng.uniform(-1, 1))[before:]  # it rests at another level than the units say
    share = float(np.exp(rng.uniform(*np.log(recipe.share))))
    moves = float(np.std(clean))
    size = share * (moves if moves > 1e-6 * units.dy else units.dy)
    y = clean + draw_noise(rng, recipe.noise, n, size)
    if recipe.sensor == "quantised":
        step = 10.0 ** np.round(np.log10(size * rng.uniform(1.0, 3.0)))
        y = np.round(y / step) * step
    elif recipe.sensor == "drift":
        walk = np.cumsum(rng.standard_normal(n))
        y = y + rng.uniform(0.02, 0.1) * moves * walk / np.std(walk)
    return u[before:], y, plant, share


def _draw_without_effect(rng: np.random.Generator, recipe: Recipe, n: int, units: Units
                         ) -> tuple[Array, Array, None, float]:
    """Draw an input and an output on which it does not act."""
    u, t = units.u0 + units.du * excite(rng, recipe.input, n), np.arange(n)
    noise = {"AR": lambda: autoregression(rng, n, rng.uniform(0.5, 0.98), 1.0),
             "walk": lambda: np.cumsum(rng.standard_normal(n)) / np.sqrt(n)}.get(
                 recipe.own, lambda: draw_noise(rng, recipe.noise, n, rng.uniform(0.02, 0.3)))()
    own = {"trend": lambda: t / n, "transient": lambda: np.exp(-t / rng.uniform(0.02 * n, 0.3 * n)),
           "oscillation": lambda: np.sin(rng.uniform(0.02, 0.3) * t + rng.uniform(0, 6))}.get(recipe.own, lambda: 0.0)()
    return u, units.y0 + units.dy * (own * rng.choice([-1, 1]) + noise), None, 1.0


def _draw_loop(rng: np.random.Generator, recipe: Recipe, n: int, units: Units) -> tuple[Array, Array, Plant, float]:
    """Draw a loop whose set-point moves by about one, with an autoregressive disturbance and white sensor noise."""
    linear = draw_linear(rng, recipe.plant, n, recipe.dead)
    gain = float(linear.numerator[-1] / (linear.denominator[-1] or 1.0))
    lag, inner = (linear.memory - linear.dead) / 4, rng.uniform(0.3, 0.8) if recipe.controller == "cascade" else 0.0
    late = linear.dead + 1 + inner / (1 - inner) + (0.3 * lag if linear.order > 1 else 0.0)
    closed = late + rng.uniform(0.3, 1.0) * lag
    tight = 0.6 if linear.order > 1 else 1.0
    proportional = tight * (lag / gain if not linear.integrates else 1 / gain) / (closed + late)
    integral = proportional / (min(lag, 4 * (closed + late)) if not linear.integrates else 4 * (closed + late))
    controller = {
        "PI": lambda: PID(proportional, integral),
        "late PI": lambda: PID(proportional, integral),
        "limited PI": lambda: PID(proportional, integral, limit=1.5 / abs(gain)),
        "P": lambda: PID(proportional),
        "PID": lambda: PID(proportional, integral, 0.3 * late, rng.uniform(0.5, 0.9)),
        "relay": lambda: Relay(2.0 / gain, rng.uniform(0.05, 0.2)),
        "cascade": lambda: PID(proportional, integral),
    }[recipe.controller]()
    hold = int(rng.integers(50, 101))
    r = {"constant": lambda: np.zeros(n),
         "steps": lambda: np.repeat(rng.choice([-1.0, 0.0, 1.0, 2.0], n // hold + 1), hold)[:n],
         "random": lambda: np.repeat(rng.uniform(-1.5, 1.5, n // hold + 1), hold)[:n],
         "filtered": lambda: lfilter([0.1], [1, -0.9], np.repeat(rng.uniform(-2, 2, n // hold + 1), hold)[:n]),
         }[recipe.setpoint]()
    size = float(np.exp(rng.uniform(*np.log((0.03, 0.3)))))
    disturbance = autoregression(rng, n, rng.uniform(0.8, 0.97), size)
    sensor = rng.uniform(0.005, 0.03) * rng.standard_normal(n)
    upset = autoregression(rng, n, 0.8, rng.uniform(0.02, 0.1) / abs(gain)) if recipe.controller == "cascade" else None
    v, x = run_loop(linear, controller, r, disturbance, sensor, int(recipe.controller == "late PI"), inner, upset)
    if recipe.sensor == "quantised":  # as a historian stores them
        v, x = (np.round(one / np.std(one) * 50) * np.std(one) / 50 for one in (v, x))
    u, y = units.u0 + units.du * v, units.y0 + units.dy * x
    if recipe.twist == "set-point as input":
        u = units.y0 + units.dy * r
    return u, y, Plant(linear, units), size


Twist = Callable[[np.random.Generator, Array, Array, Plant | None], tuple[Array, Array, tuple[Plant | None, ...]]]


def _with_idle(rng: np.random.Generator, u: Array, y: Array, plant: Plant | None) -> Any:
    idle = excite(rng, str(rng.choice(["staircase", "PRBS", "smooth", "several steps"])), len(u))
    return np.column_stack([u, 20.0 + 5.0 * idle]), y, (plant, None)


TWISTS: dict[str, Twist] = {
    "": lambda rng, u, y, plant: (u, y, (plant,)),
    "an idle input": _with_idle,
    "moving together": lambda rng, u, y, plant: (np.column_stack([u, 3.0 - 0.5 * u]), y, (plant, None)),
    "output as input": lambda rng, u, y, plant: (np.roll(y, int(rng.choice([-1, 1])))[1:-1], y[1:-1], (None,)),
    "set-point as input": lambda rng, u, y, plant: (u, y, (None,)),
    "swapped": lambda rng, u, y, plant: (y, u, (None,)),
}

# -- kinds -------------------------------------------------------------------------------------------------------------

ORDERS = ("first order", "second order", "third order", "fourth order")
NOISES = ("white", "AR(.9)")
SHORT = (150, 600)

OPEN_KINDS = {
    **{f"open: {one}": Recipe(one) for one in ("staircase", "PRBS", "smooth", "several steps", "slow set-points",
                                               "sine", "few sines", "time")},
    **{f"open: {one}": Recipe(one, samples=(150, 400)) for one in ("one step", "bump")},
    **{f"open: {one}": Recipe("staircase", one) for one in (*ORDERS[1:], "resonant", "inverse response",
                                                            "integrating")},
    "open: PRBS, dead time 30": Recipe("PRBS", dead=(25, 31)),
    "open: dead time 100": Recipe("staircase", dead=(100, 100), samples=(1500, 2500)),
    "open: saturation": Recipe("staircase", curve="saturation"), "open: any curve": Recipe("smooth", curve="any"),
    "open: Wiener": Recipe("smooth", other="Wiener"), "open: nonlinear feedback": Recipe("smooth", other="feedback"),
    "open: gain drift": Recipe("PRBS", other="drift"), "open: quantised": Recipe("staircase", sensor="quantised"),
    "open: sensor drift": Recipe("staircase", sensor="drift"),
}
_LOOP = Recipe("", samples=(1200, 1800), dead=(0.0, 8.0))
MOVED_KINDS = {
    **{f"moved: {controller}, {setpoint}": replace(_LOOP, controller=controller, setpoint=setpoint)
       for controller, setpoint in product(("PI", "PID"), ("steps", "random"))},
    "moved: P, steps": replace(_LOOP, controller="P", setpoint="steps"),
    "moved: limited PI, steps": replace(_LOOP, controller="limited PI", setpoint="steps"),
    "moved: late PI, steps": replace(_LOOP, controller="late PI", setpoint="steps"),
    "moved: cascade, steps": replace(_LOOP, controller="cascade", setpoint="steps"),
    "moved: PI, filtered": replace(_LOOP, controller="PI", setpoint="filtered"),
    "moved: PI, second order": replace(_LOOP, controller="PI", setpoint="steps", plant="second order"),
    "moved: PI, integrating": replace(_LOOP, controller="PI", setpoint="steps", plant="integrating"),
    "moved: PI, quantised": replace(_LOOP, controller="PI", setpoint="steps", sensor="quantised"),
    "moved: relay, steps": replace(_LOOP, controller="relay", setpoint="steps"),
}
OUTSIDE_KINDS = {  # the set-point is constant, yet a relay or the inner loop's disturbance moves the plant
    "constant: relay": replace(_LOOP, controller="relay", setpoint="constant"),
    "constant: cascade": replace(_LOOP, controller="cascade", setpoint="constant"),
}
REGULATED_KINDS = {
    **{f"regulated: {one}": replace(_LOOP, controller=one, setpoint="constant")
       for one in ("PI", "P", "PID", "late PI")},
    "regulated: PI, second order": replace(_LOOP, controller="PI", setpoint="constant", plant="second order"),
    "regulated: PI, integrating": replace(_LOOP, controller="PI", setpoint="constant", plant="integrating"),
    "regulated: PI, 300 samples": replace(_LOOP, controller="PI", setpoint="constant", samples=(300, 300)),
}
LOGGED_KINDS = {"regulated: PI, quantised": replace(_LOOP, controller="PI", setpoint="constant", sensor="quantised")}
IDLE_KINDS = {f"idle: {one}, {own}": Recipe(one, "", own=own, samples=(200, 1000)) for one, own in product(
    ("one step", "bump", "staircase", "PRBS", "smooth", "slow set-points"),
    ("AR", "trend", "transient"))}
HARD_IDLE_KINDS = {f"idle: {one}, {own}": Recipe(one, "", own=own, samples=(200, 1000)) for one, own in product(
    ("one step", "staircase", "PRBS", "smooth"), ("oscillation", "walk"))}
TWO_KINDS = {f"two inputs: {one}": Recipe(one, twist="an idle input") for one in ("staircase", "PRBS", "smooth")}
WEAK_KINDS = {f"weak: {one}, {noise}": Recipe(one, plant, samples=(1000, 1000), noise=noise, share=(10**0.5, 10**0.5))
              for one, plant, noise in product(("staircase", "PRBS", "smooth"), ("first order",), NOISES)}
DEAD_KINDS = {
    **{f"dead time: {one}, {plant}, {noise}": Recipe(one, plant, dead=(0, 30), noise=noise)
       for one, plant, noise in product(("staircase", "PRBS"), ORDERS[:2], NOISES)},
    **{f"dead time 100: {one}, first order": Recipe(one, dead=(100, 100), samples=(1500, 2500))
       for one in ("staircase", "PRBS")},
    **{f"dead time: {one}, first order, fractional": Recipe(one, dead=(0.0, 30.0)) for one in ("staircase", "PRBS")},
    **{f"dead time: {one}, saturation": Recipe(one, dead=(0, 30), curve="saturation")
       for one in ("staircase", "smooth")},
}
STEP_KINDS = {f"dead time: one step, first order, {noise}": Recipe("one step", dead=(0, 30), samples=(200, 400),
                                                                   noise=noise) for noise in NOISES}
HARD_DEAD_KINDS = {f"dead time: {one}, {plant}": Recipe(one, plant, dead=(0, 30), samples=(400, 1000))
                   for one, plant in (("one step", "second order"), ("staircase", "third order"),
                                      ("staircase", "fourth order"), ("staircase", "resonant"),
                                      ("PRBS", "integrating"))}
SIZE_KINDS = {
    **{f"size: {one}, {plant}, {noise}": Recipe(one, plant, samples=SHORT, noise=noise)
       for one, plant, noise in product(("one step", "bump", "staircase", "PRBS"), ORDERS[:2], NOISES)},
    **{f"size: {one}, {plant}": Recipe(one, plant, samples=SHORT) for one, plant in (
        ("several steps", "third order"), ("staircase", "resonant"), ("PRBS", "resonant"),
        ("staircase", "fourth order"), ("staircase", "inverse response"), ("PRBS", "integrating"),
        ("several steps", "first order"), ("smooth", "second order"))},
    **{f"size: {one}, any curve": Recipe(one, curve="any", samples=SHORT)
       for one in ("staircase", "several steps", "smooth", "bump")},
    "size: staircase, quantised": Recipe("staircase", sensor="quantised", samples=SHORT),
}
POWER_KINDS = {
    "power: Wiener, smooth": Recipe("smooth", other="Wiener", samples=(2000, 2000)),
    "power: nonlinear feedback": Recipe("smooth", other="feedback", samples=(2000, 2000)),
    "power: gain drift": Recipe("staircase", other="drift", samples=(2000, 2000)),
    "power: Wiener-Hammerstein": Recipe("smooth", other="Wiener-Hammerstein", samples=(2000, 2000)),
}
BAD_KINDS = {
    "bad: output as input": Recipe(twist="output as input"), "bad: swapped": Recipe(twist="swapped"),
    "bad: moving together": Recipe(twist="moving together"), "bad: time": Recipe("time"),
    "bad: last sample": Recipe("last sample"),
    "bad: set-point as input": replace(_LOOP, controller="PI", setpoint="steps", twist="set-point as input"),
}
LONG_KINDS = {f"long: {one}": Recipe(one, plant, samples=(3000, 3000), curve=curve) for one, plant, curve in (
    ("staircase", "second order", "saturation"), ("PRBS", "second order", ""), ("one step", "first order", ""),
    ("smooth", "resonant", ""))} | {f"long: PI loop, {one}": replace(_LOOP, controller="PI", setpoint=one,
                                                                     samples=(3000, 3000))
                                    for one in ("steps", "constant")}

KINDS: dict[str, Recipe] = {
    **OPEN_KINDS, **MOVED_KINDS, **OUTSIDE_KINDS, **REGULATED_KINDS, **LOGGED_KINDS, **IDLE_KINDS, **HARD_IDLE_KINDS,
    **TWO_KINDS, **WEAK_KINDS, **DEAD_KINDS, **STEP_KINDS, **HARD_DEAD_KINDS, **SIZE_KINDS, **POWER_KINDS, **BAD_KINDS,
    **LONG_KINDS}
"""The recipes by name."""


def main() -> None:
    for kind in KINDS:
        one = record(kind, 0)
        plant = next((p for p in one.plants if p is not None), None)
        drawn = f"order {plant.linear.order}, nk {plant.linear.nk}, settles in {plant.memory}" if plant else "no plant"
        print(f"{kind:<44}N = {one.data.n_samples:<6}dt {one.data.dt:<8g}{one.loop:<11}{drawn}; noise {one.noise:.2g}")


if __name__ == "__main__":
    main()

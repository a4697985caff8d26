"""Records for searches: ordinary plants of ten kinds, and five that resemble known laboratory and plant records.

Every record comes in two parts of the same kind; what the plant does without noise in the second is known.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from plant_records import autoregression
from scipy.signal import cheby1, cheby2, lfilter
from simulated_plants import PID, Linear, run_loop

import optid

Array = np.ndarray
LINEAR, INPUTS, FEEDBACK, LATENT = "linear", "input functions", "feedback", "latent signals"


@dataclass(frozen=True, eq=False)
class Record:
    """A record of a known plant.

    Attributes:
        train: what a search sees.
        test: what it is judged on: inputs, and outputs with noise.
        clean: (N, l) outputs of the second part without noise.
        classes: of models that are right.
    """

    train: optid.Data
    test: optid.Data
    clean: Array
    classes: tuple[str, ...]

    def error(self, model: object) -> float:
        """Return the RMS error of a free run over the deviation of the output, of the worst output."""
        run = np.asarray(model.simulate(self.test, x0="fit")).reshape(self.clean.shape)  # type: ignore[attr-defined]
        off = np.sqrt(np.mean((run - self.clean) ** 2, axis=0))
        return float(np.max(off / np.std(self.clean, axis=0)))


def record(kind: str, seed: int) -> Record:
    """Return a record of a kind."""
    return (ORDINARY | LIKENESSES)[kind](np.random.default_rng([seed, *kind.encode()]))


def _cut(u: Array, x: Array, noise: Array, samples: int, classes: tuple[str, ...], dt: float = 1.0) -> Record:
    """Return the first samples as the part for the search, the rest as the part to be judged on."""
    u, x, noise = (one.reshape(len(u), -1) for one in (u, x, noise))
    y = x + noise
    return Record(optid.Data(u[:samples], y[:samples], dt=dt), optid.Data(u[samples:], y[samples:], dt=dt), x[samples:],
                  classes)


def _noise(rng: np.random.Generator, x: Array, low: float = 0.01, high: float = 0.05) -> Array:
    """Return white or coloured noise of 1 to 5 % of the deviation of the output."""
    return autoregression(rng, len(x), float(rng.choice([0.0, 0.9])), float(rng.uniform(low, high) * np.std(x)))


def _held(rng: np.random.Generator, n: int, least: int, most: int) -> Array:
    """Return levels between -1 and 1 that are held for so many samples."""
    spans = rng.integers(least, most + 1, n // least + 1)
    return np.repeat(rng.uniform(-1, 1, len(spans)), spans)[:n]


def _smooth(rng: np.random.Generator, n: int, pole: float) -> Array:
    u = lfilter([1 - pole], [1, -pole], rng.standard_normal(n + 200))[200:]
    return np.asarray(u / np.std(u))


def _lag(rng: np.random.Generator, order: int, low: float, high: float, dead: float) -> Linear:
    """Return real poles with time constants in samples, of gain one."""
    taus = rng.uniform(low, high, order)
    return Linear(np.array([1.0]), np.poly(-1 / taus) * np.prod(taus), dead, int(4 * taus.sum() + dead))


# -- ten ordinary kinds ------------------------------------------------------------------------------------------------


def _dead_time(rng: np.random.Generator) -> Record:
    n = int(rng.integers(600, 1500))
    plant = _lag(rng, 2, 4, 12, float(rng.integers(3, 21)))
    u = _held(rng, n + 500, 5, 40)
    x = rng.uniform(0.5, 4) * plant.respond(u)
    return _cut(u, x, _noise(rng, x), n, (LINEAR,))


def _step(rng: np.random.Generator) -> Record:
    n = int(rng.integers(200, 400))
    plant = _lag(rng, 1, 10, 30, float(rng.integers(0, 20)))
    u = np.tile(np.where(np.arange(n) < 20, 0.0, 1.0), 2)
    x = np.tile(rng.uniform(0.5, 4) * plant.respond(u[:n]), 2)
    return _cut(u, x, _noise(rng, x), n, (LINEAR,))


def _integrator(rng: np.random.Generator) -> Record:
    n = int(rng.integers(600, 1500))
    tau = rng.uniform(2, 8)
    plant = Linear(np.array([0.05]), np.array([tau, 1.0, 0.0]), float(rng.integers(0, 10)), 200)
    half = rng.integers(6, 25, n)
    u = np.concatenate([np.repeat([s, -s], k) for k, s in zip(half, rng.choice([-1.0, 1.0], n))])[: n + 400]
    x = plant.respond(u)
    return _cut(u, x, _noise(rng, x, 0.005, 0.02), n, (LINEAR,))


CURVES: tuple[Callable[[Array], Array], ...] = (
    lambda v: np.tanh(2.5 * v), lambda v: np.sign(v) * np.maximum(np.abs(v) - 0.3, 0), lambda v: np.maximum(v, 0.0),
    lambda v: v + 2 * v**3)


def _hammerstein(rng: np.random.Generator) -> Record:
    plant = _lag(rng, 2, 2, 8, float(rng.integers(0, 6)))
    u = _held(rng, 2000, 3, 12)
    x = plant.respond(CURVES[rng.integers(len(CURVES))](u))
    return _cut(u, x, _noise(rng, x), 1500, (INPUTS,))


def _wiener(rng: np.random.Generator) -> Record:
    plant = _lag(rng, 2, 2, 6, 0.0)
    u = _smooth(rng, 2500, 0.7)
    v = plant.respond(u)
    v = v / np.std(v)
    x = np.tanh(v) if rng.random() < 0.5 else v + 0.3 * v**2
    return _cut(u, x, _noise(rng, x, 0.01, 0.03), 2000, (LATENT,))


def _both(rng: np.random.Generator) -> Record:
    plant = _lag(rng, 2, 2, 6, 0.0)
    u = _smooth(rng, 3500, 0.5)
    v = plant.respond(np.tanh(1.5 * u))
    x = np.tanh(1.2 * v / np.std(v))
    return _cut(u, x, _noise(rng, x, 0.01, 0.02), 3000, (LATENT,))


def _fed_back(rng: np.random.Generator) -> Record:
    radius, angle = rng.uniform(0.5, 0.9), rng.uniform(0.2, 1.2)
    a = np.poly([radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]).real
    u, gain = rng.uniform(-1, 1, 2000), rng.uniform(0.8, 1.2)
    x = np.zeros(2000)
    for k in range(2, 2000):
        x[k] = gain * (u[k - 1] + 0.5 * u[k - 2]) - a[1] * x[k - 1] - a[2] * x[k - 2] - 0.5 * np.tanh(x[k - 1]) ** 3
    return _cut(u, x, _noise(rng, x, 0.01, 0.02), 1500, (FEEDBACK, LATENT))


def _duffing(rng: np.random.Generator) -> Record:
    """A spring that hardens, sampled at about 12 times its frequency."""
    damping, cubic, h = rng.uniform(0.05, 0.15), rng.uniform(0.5, 1.5), 0.05
    u = 0.5 * _smooth(rng, 3500, 0.6)
    x, state = np.zeros(len(u)), np.zeros(2)

    def slope(s: Array, force: float) -> Array:
        return np.array([s[1], force - 2 * damping * s[1] - s[0] - cubic * s[0] ** 3])

    for k, force in enumerate(u):
        x[k] = state[0]
        for _ in range(10):
            middle = state + h / 2 * slope(state, force)
            state = state + h * slope(middle, force)
    return _cut(u, x, _noise(rng, x, 0.005, 0.02), 3000, (FEEDBACK, LATENT))


def _loop(rng: np.random.Generator) -> Record:
    n, tau, dead = 2000, rng.uniform(5, 15), float(rng.integers(1, 6))
    plant = Linear(np.array([rng.uniform(0.5, 3)]), np.array([tau, 1.0]), dead, int(4 * tau + dead))
    gain = float(plant.numerator[0])
    kp = 0.5 * tau / (gain * (tau / 2 + dead + 1))
    r = _held(rng, n, 30, 120)
    disturbance = autoregression(rng, n, 0.9, 0.05)
    u, _ = run_loop(plant, PID(kp, kp / tau), r, disturbance, np.zeros(n), 1)
    x = plant.respond(u)
    fresh = _held(rng, 500, 20, 60)
    clean = plant.respond(fresh)
    return Record(optid.Data(u, x + disturbance), optid.Data(fresh, clean), clean[:, None], (LINEAR,))


def _many(rng: np.random.Generator) -> Record:
    n = 2000
    u = np.column_stack([_held(rng, n, 3, 20) for _ in range(2)])
    plants = [[_lag(rng, int(rng.integers(1, 3)), 3, 12, 0.0) for _ in range(2)] for _ in range(2)]
    gains = rng.uniform(0.5, 2, (2, 2)) * rng.choice([-1, 1], (2, 2))
    x = np.column_stack([sum(gains[i, j] * plants[i][j].respond(u[:, j]) for j in range(2)) for i in range(2)])
    noise = np.column_stack([_noise(rng, one) for one in x.T])
    return _cut(u, x, noise, 1500, (LINEAR,))


ORDINARY: dict[str, Callable[[np.random.Generator], Record]] = {
    "dead time": _dead_time, "step": _step, "integrator": _integrator, "Hammerstein": _hammerstein, "Wiener": _wiener,
    "Hammerstein-Wiener": _both, "feedback": _fed_back, "Duffing": _duffing, "closed loop": _loop, "MIMO": _many}


# -- likenesses of known records ---------------------------------------------------------------------------------------


def _exchanger(rng: np.random.Generator) -> Record:
    """Outlet temperature of water that steam heats, five cells in cascade, over its flow; slow disturbances."""
    n, cells = 3800, 5
    flow = 0.3 + 0.25 * np.clip(_smooth(rng, n, 0.8), -1.0, 2.2)
    temperature, x = np.full(cells, 100.0), np.zeros(n)
    for k in range(n):
        x[k] = temperature[-1]
        for _ in range(4):
            before = np.concatenate([[20.0], temperature[:-1]])
            rate = flow[k] * (before - temperature) + 0.12 * flow[k] ** 0.6 * (120.0 - temperature)
            temperature = temperature + 0.25 * rate
    noise = autoregression(rng, n, 0.97, 0.07 * np.std(x)) + 0.03 * np.std(x) * rng.standard_normal(n)
    return _cut(flow[200:], x[200:], noise[200:], 2600, (LATENT,))


def _circuit(rng: np.random.Generator) -> Record:
    """Chebyshev filters of third order on both sides of a diode, a noise of 60 dB; in V."""
    n = 120_000
    u = 0.6 * _smooth(rng, n, 0.9)
    v = np.asarray(lfilter(*cheby1(3, 0.5, 4.4 / 25.6), u))
    w = np.where(v > 0, 0.55 * np.log1p(np.maximum(v, 0) / 0.55), v)
    x = np.asarray(lfilter(*cheby2(3, 40, 5.0 / 25.6), w))
    return _cut(u, x, 0.001 * np.std(x) * rng.standard_normal(n), 100_000, (LATENT,), 1 / 51_200)


def _drive(rng: np.random.Generator) -> Record:
    """Two motors and a belt with a spring; a tachometer measures the magnitude of the speed."""
    n = 750
    u = _held(rng, n, 5, 20) * 1.5
    a = np.poly([0.94, 0.9 * np.exp(0.35j), 0.9 * np.exp(-0.35j)]).real
    speed = np.asarray(lfilter([0.0, 0.02, 0.03, 0.01], a, u))
    speed = speed / np.std(speed)
    return _cut(u, np.abs(speed), 0.02 * rng.standard_normal(n), 500, (LATENT,), 0.02)


def _boiler(rng: np.random.Generator) -> Record:
    """Four inputs and four outputs of a boiler: pressure, oxygen, level that integrates slowly, steam flow."""
    n = 9000
    u = np.column_stack([_held(rng, n, 40, 200) for _ in range(4)])
    valve = np.column_stack([np.tanh(1.5 * u[:, 0]), u[:, 1], u[:, 2], u[:, 3] + 0.4 * u[:, 3] ** 2])
    x = np.zeros((n, 4))
    for i in range(4):
        for j in range(4):
            if i == j or rng.random() < 0.6:
                plant = _lag(rng, int(rng.integers(1, 3)), 10, 120 if i == 2 else 40, 0.0)
                x[:, i] += rng.uniform(0.4, 1.5) * rng.choice([-1, 1]) * plant.respond(valve[:, j])
    noise = np.column_stack([autoregression(rng, n, 0.98, 0.15 * np.std(one)) + 0.12 * np.std(one)
                             * rng.standard_normal(n) for one in x.T])
    return _cut(u, x, noise, 6000, (INPUTS,), 3.0)


def _tanks(rng: np.random.Generator) -> Record:
    """Two tanks in cascade with square-root outflow; the upper one overflows, partly into the lower one."""
    n = 2048
    u = np.interp(np.arange(n), np.arange(0, n + 20, 10), rng.uniform(0.5, 5.5, n // 10 + 3))
    upper, lower, x = 4.0, 4.0, np.zeros(n)
    for k in range(n):
        x[k] = lower
        for _ in range(4):
            out = 0.55 * np.sqrt(max(upper, 0.0))
            upper += 0.25 * (0.4 * u[k] - out) * 0.9
            spill = max(upper - 10.0, 0.0)
            upper -= spill
            lower += 0.25 * (out - 0.5 * np.sqrt(max(lower, 0.0))) * 0.9 + 0.6 * spill
            lower = min(lower, 10.0)
    return _cut(u, x, 0.02 * np.std(x) * rng.standard_normal(n), 1024, (FEEDBACK, LATENT), 4.0)


LIKENESSES: dict[str, Callable[[np.random.Generator], Record]] = {
    "heat exchanger": _exchanger, "circuit": _circuit, "drive": _drive, "boiler": _boiler, "two tanks": _tanks}

"""Free-run fits of state-space models with functions of inputs, outputs and latent signals.

    python benchmarks/state_space.py [--seeds 25] [--only duffing silverbox ...]

Simulated plants, 3000 samples to estimate from and as many to test on, white noise of 1 % at the output: an oscillator
with a hardening spring (Duffing), two tanks with square-root outflow, a Hammerstein-Wiener system, a Wiener system, and
two inputs and two outputs with two latent signals. Printed is the error of the free run on the test part, in standard
deviations of the noise (1 is what the truth leaves), the share of seeds below 1.2, and the CPU seconds of a fit. Then
records of 100,000 samples of Wiener-Hammerstein systems, noise of 0.1 %, in the same figures.

Real records, with OPTID_DATA (free run on the test part, initial state from its first 50 samples): Silverbox with
output feedback and with a latent signal, and cascaded tanks, their structure chosen by cross-validation in four blocks
of the record to estimate from; then the tanks by equations from physics: square-root outflow, and what is soft beyond a
threshold: a pump that starts at a voltage, rims that water spills over, and a sensor that ends at 10 V.
"""

import argparse
import itertools
import os
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.signal import butter, lfilter, sosfilt

import optid
from optid.errors import OptidError

SAMPLES = 3000
NOISE = 0.01
GOAL = 1.2


def slow_input(rng: np.random.Generator, samples: int, channels: int = 1, hold: int = 10) -> np.ndarray:
    """Levels held for `hold` samples, with ramps between them."""
    levels = rng.uniform(-1, 1, (samples // hold + 2, channels))
    at = np.arange(samples) / hold
    return np.column_stack([np.interp(at, np.arange(len(levels)), column) for column in levels.T])


def duffing(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """X'' + 0.3 x' + x + 0.4 x^3 = 1.5 u in semi-implicit steps of 0.3; the parameters vary by 20 %."""
    damping, spring, gain = np.array([0.3, 0.4, 1.5]) * rng.uniform(0.8, 1.2, 3)

    def run(u: np.ndarray) -> np.ndarray:
        x, v, y = 0.0, 0.0, np.zeros((len(u), 1))
        for k in range(len(u)):
            y[k] = x
            v += 0.3 * (gain * u[k, 0] - damping * v - x - spring * x**3)
            x += 0.3 * v
        return y

    return run


def tanks(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Two tanks in a row with square-root outflow and a pump whose gain falls with the level of the first."""
    out, between, pump = np.array([0.12, 0.1, 0.16]) * rng.uniform(0.8, 1.2, 3)

    def run(u: np.ndarray) -> np.ndarray:
        h1, h2, y = 1.5, 1.5, np.zeros((len(u), 1))
        for k in range(len(u)):
            y[k] = h2
            flow = between * np.sqrt(max(h1, 0.0))
            h1, h2 = h1 + pump * (1 + 0.6 * u[k, 0]) * (1 - 0.1 * h1) - flow, h2 + flow - out * np.sqrt(max(h2, 0.0))
        return y

    return run


def block(rng: np.random.Generator, front: bool, back: bool) -> Callable[[np.ndarray], np.ndarray]:
    """A second-order system between a cubic of the input and a saturation of the output, as far as asked for."""
    radius, angle = rng.uniform(0.6, 0.9), rng.uniform(0.2, 1.0)
    a = radius * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    b, c = rng.normal(size=2), rng.normal(size=2)
    c = c / np.abs(c @ np.linalg.solve(np.eye(2) - a, b))

    def run(u: np.ndarray) -> np.ndarray:
        f = u[:, 0] + 0.4 * u[:, 0] ** 2 - 0.2 * u[:, 0] ** 3 if front else u[:, 0]
        x, z = np.zeros(2), np.zeros((len(u), 1))
        for k in range(len(u)):
            z[k] = c @ x
            x = a @ x + b * f[k]
        return z + 0.3 * z**2 - 0.15 * z**3 if back else z

    return run


def two_by_two(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Four states and two latent signals that act on the states; stable near rest and far from it."""
    b, c = rng.normal(size=(4, 2)), rng.normal(size=(2, 4))
    while True:
        a = np.diag([0.85, 0.7, 0.6, 0.4]) + 0.05 * rng.normal(size=(4, 4))
        rows, effect = rng.normal(size=(2, 4)) / 4, 0.5 * rng.normal(size=(4, 2))
        far = a - np.outer(effect[:, 0], rows[0])  # tanh(z) - z far from zero
        if max(np.abs(np.linalg.eigvals(matrix)).max() for matrix in (a, far)) < 0.95:
            break

    def run(u: np.ndarray) -> np.ndarray:
        x, y = np.zeros(4), np.zeros((len(u), 2))
        for k in range(len(u)):
            y[k] = c @ x
            z = rows @ x
            x = a @ x + b @ u[k] + effect @ np.array([np.tanh(z[0]) - z[0], z[1] ** 2 / (1 + z[1] ** 2)])
        return y

    return run


CASES: dict[str, tuple[Callable[..., Any], int, str, dict[str, Any]]] = {
    "duffing": (duffing, 1, "lfr.exact", {"nx": 2, "latent": "states"}),
    "tanks": (tanks, 1, "lfr.exact", {"nx": 2, "channels": 2, "direct": True}),
    "hammerstein-wiener": (lambda rng: block(rng, True, True), 1, "hammerstein_wiener_ss.exact", {"nx": 2}),
    "wiener": (lambda rng: block(rng, False, True), 1, "wiener_ss.exact", {"nx": 2}),
    "two by two": (two_by_two, 2, "lfr.exact", {"nx": 4, "channels": 2, "latent": "states",
                                                "latent_basis": "bspline:8"}),
}


def simulated(name: str, seed: int) -> tuple[float, float, str]:
    """Return the error on the test part over the noise, the CPU seconds of the fit, and its status."""
    plant, channels, formulation, arguments = CASES[name]
    rng = np.random.default_rng(seed)
    run = plant(rng)
    u = slow_input(rng, 2 * SAMPLES, channels)
    y = run(u)
    sigma = NOISE * y.std(axis=0)
    y = y + sigma * rng.normal(size=y.shape)
    record, test = (optid.Data(u[part], y[part]) for part in (slice(SAMPLES), slice(SAMPLES, None)))
    started = time.process_time()
    try:
        fit = optid.fit(record, formulation, **arguments)
        spent = time.process_time() - started
        error = np.asarray(fit.model.simulate(test, x0="fit")) - test.y
        return float(np.sqrt(np.mean((error / sigma) ** 2))), spent, fit.solution.status.value
    except OptidError as error:
        return np.inf, time.process_time() - started, f"{type(error).__name__}: {error}"


def free_run(model: Any, u: np.ndarray, y: np.ndarray, dt: float) -> float:
    """Root mean square of the free run's error, initial state from the first 50 samples, which do not count."""
    x0 = model.initial_state(optid.Data(u[:50], y[:50], dt=dt))
    found = np.asarray(model.simulate(optid.Data(u, y, dt=dt), x0=x0)).ravel()
    return float(np.sqrt(np.mean((found - y)[50:] ** 2)))


def cross_validated(u: np.ndarray, y: np.ndarray, dt: float, arguments: dict[str, Any], blocks: int = 4) -> float:
    """Root mean square error of free runs over blocks of a record that the model has not seen."""
    edges, total = np.linspace(0, len(u), blocks + 1).astype(int), 0.0
    for first, last in zip(edges[:-1], edges[1:]):
        rest = [slice(a, b) for a, b in ((0, first), (last, len(u))) if b > a]
        record = optid.Data([u[part] for part in rest], [y[part] for part in rest], dt=dt)
        try:
            model = optid.fit(record, "lfr.exact", **arguments).model
            total += free_run(model, u[first:last], y[first:last], dt) ** 2 / blocks
        except OptidError:
            return np.inf
    return float(np.sqrt(total))


def real(folder: Path) -> Iterator[tuple[str, str, float, str]]:
    """Yield (record, structure, CPU seconds, errors)."""
    with np.load(folder / "nlb_silverbox.npz") as box:
        u, y = box["u"], box["y"]
    cut = 40650 + int(0.75 * (127400 - 40650))
    record = optid.Data(u[40650:cut], y[40650:cut])
    parts = {"multisine": (u[cut:127400], y[cut:127400]), "arrow": (u[100:40575], y[100:40575])}
    fed = {"feedback_basis": "polynomial:3:outside=extrapolate", "basis": "linear"}
    for name, formulation, arguments in (
        ("output feedback", "hammerstein_ss.exact", fed), ("latent, degree 3", "lfr.exact", {}),
        ("latent, degree 5", "lfr.exact", {"latent_basis": "polynomial:5"}),
    ):
        started = time.process_time()
        model = optid.fit(record, formulation, nx=2, **arguments).model
        spent = time.process_time() - started
        errors = ", ".join(f"{word} {1e3 * free_run(model, *part, 1.0):.3f} mV" for word, part in parts.items())
        yield "Silverbox", name, spent, errors
    table = np.genfromtxt(folder / "nlb_cascaded_tanks.csv", delimiter=",", skip_header=1)
    record = optid.Data(table[:, 0], table[:, 2], dt=4.0)
    started, candidates = time.process_time(), []
    for channels, direct, basis in itertools.product((1, 2), (False, True), ("polynomial:3", "bspline:4")):
        arguments = {"nx": 2, "channels": channels, "direct": direct, "latent_basis": basis}
        error = cross_validated(table[:, 0], table[:, 2], 4.0, arguments)
        candidates.append((error, f"{channels} latent, {basis}{', direct' * direct}", arguments))
    error, name, arguments = min(candidates, key=lambda one: one[0])
    model = optid.fit(record, "lfr.exact", **arguments).model
    spent = time.process_time() - started
    found = free_run(model, table[:, 1], table[:, 3], 4.0)
    yield "cascaded tanks", name, spent, f"{found:.3f} V (cross-validated {error:.3f} V)"
    started = time.process_time()
    fit = optid.fit(record, "physical", equations=CASCADE)
    spent, error = time.process_time() - started, free_run(fit.model, table[:, 1], table[:, 3], 4.0)
    yield "cascaded tanks", "physical equations", spent, f"{error:.3f} V ({fit.solution.status.value})"


def beyond(x: Any, width: float) -> Any:
    """Return what exceeds zero, rounded over a width."""
    return width * cp.logistic(x / width)


def cascade(v: Any) -> dict[str, Any]:
    """Return the level changes of two tanks, the upper of which spills into the lower, and the voltage shown."""
    down = v["upper"] * v["h1"] ** 0.5 + beyond(v["h1"] - v["rim1"], 0.3)
    out = v["lower"] * v["h2"] ** 0.5 + beyond(v["h2"] - v["rim2"], 0.3)
    return {"h1": v["pump"] * beyond(v["u"] - v["dead"], 0.1) - down, "h2": down - out,
            "y": 10 - beyond(10 - v["h2"] - v["offset"], 0.1)}


CASCADE = optid.Equations(
    cascade, states={"h1": 5.0, "h2": 5.0}, bounds={"h1": (1e-3, None), "h2": (1e-3, None)},
    parameters={"pump": 0.05, "upper": 0.05, "lower": 0.05, "dead": 0.5, "offset": 0.1, "rim1": 10.0, "rim2": 10.0})


def wiener_hammerstein(seed: int, samples: int = 100_000) -> tuple[float, float, str]:
    """Return error over noise on as many new samples, CPU seconds and status of a fit to a long record of 60 dB."""
    rng = np.random.default_rng(seed)

    def linear(u: np.ndarray) -> np.ndarray:
        pole = rng.uniform(0.5, 0.85) * np.exp(1j * rng.uniform(0.2, 0.9))
        a = np.real(np.poly([pole, pole.conj(), rng.uniform(0.3, 0.8)]))
        y = np.asarray(lfilter([0.0, *rng.normal(size=3)], a, u))
        return y / y.std()

    u = np.asarray(sosfilt(butter(3, 0.5, output="sos"), rng.normal(size=2 * samples)))
    x, sigma = linear(u), 1e-3
    y = linear(np.tanh(1.2 * x) + 0.15 * x**2 / (1 + x**2)) + sigma * rng.normal(size=x.size)
    record, test = (optid.Data(u[part], y[part]) for part in (slice(samples), slice(samples, None)))
    started = time.process_time()
    fit = optid.fit(record, "lfr.exact", nx=6, direct=True, latent_basis="bspline:24")
    spent = time.process_time() - started
    error = np.asarray(fit.model.simulate(test, x0="fit")) - test.y
    return float(np.sqrt(np.mean((error / sigma) ** 2))), spent, fit.solution.status.value


def main() -> None:
    """Print all tables."""
    words = [*CASES, "wiener-hammerstein", "real"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--only", nargs="+", choices=words, default=words)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{'plant':<20}{'median':>8}{'90 %':>8}{'below ' + str(GOAL):>12}{'CPU s':>8}")
    for name in CASES:
        if name in options.only:
            rows = [simulated(name, seed) for seed in range(options.seeds)]
            errors = np.array([error for error, _, _ in rows])
            spent = np.median([seconds for _, seconds, _ in rows])
            print(f"{name:<20}{np.median(errors):8.3f}{np.quantile(errors, 0.9, method='higher'):8.3f}"
                  f"{100 * np.mean(errors <= GOAL):10.0f} %{spent:8.2f}", flush=True)
            for failure in sorted({status for error, _, status in rows if not np.isfinite(error)}):
                print(f"    {failure}")
    for seed in range(min(options.seeds, 5)) if "wiener-hammerstein" in options.only else ():
        error, spent, status = wiener_hammerstein(seed)
        print(f"Wiener-Hammerstein, 100,000 samples, seed {seed}: {error:.3f}, {spent:.1f} CPU s, {status}", flush=True)
    folder = os.environ.get("OPTID_DATA")
    if "real" in options.only and folder:
        for record, structure, spent, errors in real(Path(folder)):
            print(f"{record}, {structure}: {errors}; {spent:.1f} CPU s", flush=True)


if __name__ == "__main__":
    main()

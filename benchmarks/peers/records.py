"""The records of the comparison, simulated once: the same arrays for every peer.

Every record is a dictionary of arrays: ``u`` (N, m) and ``y`` (N, l) to estimate from, ``test_u`` and ``test_y`` to
score on, and what the user is told of the plant beforehand, the same for all: orders, delay, basis, constraints.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

Array = np.ndarray
Record = dict[str, Array]

TEST = 2100
"""Samples to score on, the first of which are run-in (`judging.RUN_IN`)."""


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        name: the name of its files.
        title: what the table calls it.
        kind: the function of a peer's file that answers it.
        simulate: seed to record.
    """

    name: str
    title: str
    kind: str
    simulate: Callable[[int], Record]


def equation_error(a: Array, b: Array, f: Callable[[Array], Array], u: Array, share: float, rng: np.random.Generator
                   ) -> Array:
    """A y = B f(u) + e from rest, nk = 1; e white, its deviation the given share of that of the noise-free output."""
    drive = np.convolve(f(u), np.concatenate([[0.0], b]))[: len(u)]
    noise = share * np.std(_recursion(a, drive)) * rng.standard_normal(len(u))
    return _recursion(a, drive + noise)


def _recursion(a: Array, drive: Array) -> Array:
    return lfilter([1.0], [1.0, *a], drive)


CUBIC_A, CUBIC_B = np.array([-1.5, 0.7]), np.array([1.0, 0.6])


def cubic(u: Array) -> Array:
    """The nonlinearity that every basis and every polynomial package holds exactly."""
    return u + 0.5 * u**2 - 0.4 * u**3


def hammerstein(seed: int, count: int = 1000, lost: float = 0.0) -> Record:
    """Equation-error Hammerstein system with a cubic; of the outputs to estimate from the share `lost` is NaN."""
    rng = np.random.default_rng([seed, count])
    u = rng.uniform(-1, 1, count + TEST)
    y = np.concatenate([equation_error(CUBIC_A, CUBIC_B, cubic, part, 0.05, rng)
                        for part in (u[:count], u[count:])])
    record = _split(u[:, None], y[:, None], count) | {
        "na": np.array(2), "nb": np.array(2), "nk": np.array(1), "degree": np.array(3)}
    record["y"][rng.uniform(size=count) < lost] = np.nan
    return record


STATE_A = np.array([[0.7, 0.35, 0, 0], [-0.35, 0.7, 0.1, 0], [0, 0, 0.5, 0.2], [0, 0, 0, -0.4]])
STATE_B = np.array([[1, 0.2], [0, 0.8], [0.5, -0.6], [0.3, 1.0]])
STATE_C = np.array([[1, 0, 0.5, 0.2], [0, 1, -0.3, 0.6]])
STATE_K = np.array([[0.4, 0.1], [-0.1, 0.3], [0.2, 0.0], [0.0, 0.1]])


def state_space(seed: int, count: int = 2000) -> Record:
    """Linear system in innovation form, 2 inputs, 2 outputs, 4 states, no direct effect."""
    rng = np.random.default_rng([seed, count, 4])
    u = rng.uniform(-1, 1, (count + TEST, 2))
    e = 0.2 * rng.standard_normal((count + TEST, 2))
    y, x = np.zeros_like(u), np.zeros(4)
    for k in range(len(u)):
        y[k] = STATE_C @ x + e[k]
        x = STATE_A @ x + STATE_B @ u[k] + STATE_K @ e[k]
    return _split(u, y, count) | {"nx": np.array(4), "block_rows": np.array(10)}


CELLS = 9
NODES = np.linspace(-1, 1, CELLS + 1)
FREE_A, FREE_B = np.array([-1.2, 0.4]), np.array([0.12, 0.08])


def saturation(u: Array) -> Array:
    """A saturating curve, linear between the nodes, with slope one in the middle cell."""
    values = np.tanh(2 * NODES)
    return np.interp(u, NODES, values * (NODES[CELLS // 2 + 1] / values[CELLS // 2 + 1]))


def constrained(seed: int, count: int = 300) -> Record:
    """Short and noisy: f is increasing, the static gain of the plant in the middle cell is one."""
    rng = np.random.default_rng([seed, count, 9])
    u = rng.uniform(-1, 1, count + TEST)
    y = np.concatenate([equation_error(FREE_A, FREE_B, saturation, part, 0.15, rng)
                        for part in (u[:count], u[count:])])
    return _split(u[:, None], y[:, None], count) | {
        "na": np.array(2), "nb": np.array(2), "nk": np.array(1), "nodes": NODES}


def _split(u: Array, y: Array, count: int) -> Record:
    return {"u": u[:count].copy(), "y": y[:count].copy(), "test_u": u[count:].copy(), "test_y": y[count:].copy()}


ROWS = (
    Row("hammerstein", "Hammerstein-ARX, N = 1000", "hammerstein", hammerstein),
    Row("state_space", "state space, 2 x 2, n = 4, N = 2000", "state_space", state_space),
    Row("long", "Hammerstein-ARX, N = 100,000", "hammerstein", lambda seed: hammerstein(seed, 100_000)),
    Row("missing", "10 % of the outputs missing, N = 1000", "missing", lambda seed: hammerstein(seed, lost=0.1)),
    Row("constrained", "monotone, unit gain, N = 300", "constrained", constrained),
    Row("long_state_space", "state space, 2 x 2, n = 4, N = 100,000", "state_space",
        lambda seed: state_space(seed, 100_000)),
)


def bad_records() -> dict[str, Record]:
    """Records that something is wrong with, for the entry that answers the first row."""
    good = hammerstein(0)
    lost = {**good, "y": good["y"].copy()}
    lost["y"][500] = np.nan
    constant = {**good, "u": np.full_like(good["u"], 0.5)}
    constant["y"] = _driven(CUBIC_A, constant["u"][:, 0], 1)
    growing = {**good, "y": _driven(np.array([-1.5, 0.49]), good["u"][:, 0], 2),  # a pole at 1.02
               "test_u": good["test_u"][:400], "test_y": _driven(np.array([-1.5, 0.49]), good["test_u"][:400, 0], 3)}
    short = {**good, "y": good["y"][:-1]}
    return {"one NaN": lost, "constant input": constant, "unstable plant": growing, "y one shorter": short}


def _driven(a: Array, u: Array, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    drive = np.convolve(cubic(u), np.concatenate([[0.0], CUBIC_B]))[: len(u)]
    return _recursion(a, drive + 0.1 * rng.standard_normal(len(u)))[:, None]


def write(folder: Path, row: Row, seed: int) -> Path:
    """Simulate a record unless its file is there; return the file."""
    path = folder / f"{row.name}-{seed}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(path.with_suffix(".part.npz"), **row.simulate(seed))
        path.with_suffix(".part.npz").rename(path)
    return path

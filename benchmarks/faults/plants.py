"""The standard plant of the benchmarks of faults, its input, and windows of its records with and without a fault."""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta

from optid import Data
from optid.bases import UserFunctions
from optid.faults import Dictionary, Fault, inject, whiten
from optid.faults.whitening import Whitened
from optid.models import HammersteinSS, NoiseCovariances, Nonlinearity
from optid.models.kalman import kalman_gain

PLANT = Path(os.environ.get("OPTID_DATA", ".")) / "fault_plant.json"

REACH = 1.2
"""Largest input."""

BEFORE = 100
"""Samples before a window, after which the Kalman filter is steady."""


def standard_plant(path: Path = PLANT) -> tuple[HammersteinSS, np.ndarray]:
    """Return the plant of fault_plant.json and the direction (4,) of its load."""
    content = json.loads(Path(path).read_text())
    A, B, C, D, E, Q, R = (np.array(content[name]) for name in "ABCDEQR")
    shapes = [lambda u: u + 0.25 * u**3, lambda u: np.tanh(1.5 * u) + 0.15 * u]
    functions = tuple(
        Nonlinearity(UserFunctions((f,), interval=(-REACH, REACH), outside="extrapolate", names=(f"f{i}",)), np.ones(1))
        for i, f in enumerate(shapes, 1)
    )
    steady = kalman_gain(A, C, Q, R)
    noise = NoiseCovariances(Q, R, np.zeros((4, 2)), steady.innovation)
    return HammersteinSS(A, B, C, D=D, K=steady.K, noise=noise, nonlinearities=functions), E[:, 0]


def levels(count: int, rng: np.random.Generator | int, m: int = 2, hold: int = 5, mean: float = 0.0,
           reach: float = REACH) -> np.ndarray:
    """Return inputs (N, m) uniform on mean - reach to mean + reach, cut at the largest input, every level held."""
    drawn = np.random.default_rng(rng).uniform(mean - reach, mean + reach, (-(-count // hold), m))
    return np.repeat(np.clip(drawn, -REACH, REACH), hold, axis=0)[:count]


class Window(NamedTuple):
    """A window of a record.

    Attributes:
        u: (N, m) its inputs.
        whitened: its innovations.
        start: sample of the record at which it begins.
    """

    u: np.ndarray
    whitened: Whitened
    start: int


def cut(whitened: Whitened, first: int, last: int | None = None) -> Whitened:
    """Return the samples from first on (to before last)."""
    here = slice(first, last)
    return replace(whitened, r=whitened.r[here], innovations=whitened.innovations[here],
                   present=whitened.present[here],
                   states=None if whitened.states is None else whitened.states[here])


def windows(model: HammersteinSS, faults: Sequence[Any], window: int = 200, *, load: np.ndarray | None = None,
            seed: int = 0, before: int = BEFORE) -> Iterator[Window]:
    """Yield one window for every entry of faults: a Fault, a list of them, or () for a healthy one.

    The record begins at rest `before` samples earlier, so that the onsets of the faults count from there.
    """
    for run, fault in enumerate(faults):
        u = levels(before + window, np.random.default_rng([seed, run, 1]))
        y = inject(model, u, fault, seed=int(np.random.default_rng([seed, run, 2]).integers(2**31)),
                   process=None if load is None else {"load": load})
        yield Window(u[before:], cut(whiten(model, Data(u, y), x0="zero"), before), before)


def deflected(found: Dictionary, label: str, window: int, onset: int, d: float, rng: np.random.Generator,
              u: np.ndarray | None = None, before: int = BEFORE) -> tuple[Fault, np.ndarray]:
    """Return a fault of deflection d in a window, and its magnitudes; in a random direction where it has several."""
    candidate = found[label]
    trace = found.signature(candidate, window, onset, u=u).reshape(window * found.model.l, -1)
    values, axes = np.linalg.eigh(trace.T @ trace)
    drawn = rng.standard_normal(values.size)
    size = d * axes @ (drawn / np.linalg.norm(drawn) / np.sqrt(values))
    at = before + onset
    if candidate.kind == "loss":
        return Fault.loss(candidate.name, at, float(abs(size[0]))), np.abs(size)
    make = {"bias": Fault.step, "jump": Fault.jump, "drift": Fault.ramp}[candidate.kind]
    return make(candidate.name, at, size), size


def interval(successes: int, runs: int, level: float = 0.95) -> tuple[float, float]:
    """Return the exact binomial interval (Clopper and Pearson)."""
    tail = (1 - level) / 2
    low = 0.0 if successes == 0 else float(beta.ppf(tail, successes, runs - successes + 1))
    high = 1.0 if successes == runs else float(beta.ppf(1 - tail, successes + 1, runs - successes))
    return low, high


def rate(successes: int, runs: int) -> str:
    """Say a rate with its interval."""
    low, high = interval(successes, runs)
    return f"{successes / runs:.4f} [{low:.4f}, {high:.4f}] of {runs}"

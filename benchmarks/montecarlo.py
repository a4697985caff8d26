"""What the Monte Carlo benchmarks share: the simulation example with its truth in the basis, and a pool of workers."""

import multiprocessing
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.stats import binomtest

import optid

A = np.array([-1.5, 0.7])
B = np.array([0.8, 0.6])  # norm one: the gauge in which models are reported
BASIS = optid.Triangular(8, interval=(-1.0, 1.0))
NODES = np.linspace(-1.0, 1.0, 9)
STRUCTURE = {"na": 2, "nb": 2, "basis": BASIS}
SNR = 22.0

TRUTHS: dict[str, np.ndarray] = {
    "dead zone": 4 / 3 * np.sign(NODES) * np.maximum(np.abs(NODES) - 0.25, 0.0),
    "strictly monotone": 4 / 3 * (NODES + 0.3 * NODES * np.abs(NODES)),
    "saturation": 4 / 3 * np.clip(NODES, -0.5, 0.5),
    "non-odd": NODES + 0.8 * NODES**2,
}
"""Values of f at the nodes of the basis; between them f is linear, so that it lies in the span."""


def energy(b: Any) -> float:
    """Variance gain of B / A for a white input."""
    return float(np.sum(lfilter(b, np.r_[1.0, A], np.eye(1, 2000)[0]) ** 2))


def noise_level(values: np.ndarray) -> float:
    """Standard deviation of e for which the variances of noise-free output and noise e / A have the ratio `SNR`."""
    fine = np.interp(np.linspace(-1.0, 1.0, 20001), NODES, values)
    return float(np.sqrt(np.var(fine) * energy(B) / SNR / energy([1.0])))


def record(values: np.ndarray, n: int, seed: int, sigma: float | None = None) -> optid.Data:
    """Simulate A y = B f(u) + e with u white and uniform on [-1, 1]."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1.0, 1.0, n)
    e = (noise_level(values) if sigma is None else sigma) * rng.standard_normal(n)
    right = lfilter(B, [1.0], np.interp(u, NODES, values)) + e
    return optid.Data(u=u, y=lfilter([1.0], np.r_[1.0, A], right), dt=0.1)


def share(count: int, of: int) -> str:
    """Write a share with its 95 % interval (Clopper and Pearson), in %."""
    low, high = binomtest(count, of).proportion_ci(0.95, "exact")
    return f"{100 * count / of:5.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def coverage(values: Any, errors: Any, covered: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the share of runs (first axis) whose intervals contain the truth, in %, and printed over true scatter."""
    true = np.std(values, axis=0, ddof=1)
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / np.where(true > 1e-9, true, np.nan)
    return 100 * np.mean(covered, axis=0), ratio


def worker_pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of processes with one thread each."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[name] = "1"
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def mapped(function: Callable[[Any], Any], jobs: Iterable[Any], workers: int) -> list[Any]:
    """Apply a function to all jobs in processes with one thread each; results in order."""
    with worker_pool(workers) as pool:
        return list(pool.map(function, jobs, chunksize=10))

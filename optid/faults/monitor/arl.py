"""Thresholds of a running search from the mean time between false alarms (ARL0), by simulation.

The whitened innovations of a healthy plant are white with unit covariance, so that the search itself runs on random
numbers, without the plant; the effect of an uncertain model on them is added.
"""

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from optid.arrays import Array
from optid.errors import DataError, StructureError
from optid.faults.false_alarms import COMMON, EXCEEDING, Calibration, equalised
from optid.faults.monitor.columns import Window
from optid.models import HammersteinSS

ALARMS = 60  # false alarms of a simulation by default: their rate is then known to 13 %
LONGEST = 1_000_000  # samples simulated at most by default
CHUNK = 20_000  # samples simulated at a time
INPUTS, HOLD = 20_000, 5  # samples of simulated inputs, and samples per level
RUNS = 4  # simulations that may run in parallel; the result does not depend on how many do
NODES = 80  # nodes of the quadrature, for ten digits of the run lengths of the usual charts

_KNOWN: dict[bytes, Calibration] = {}


def reference_inputs(model: HammersteinSS, u: ArrayLike | None, window: int, seed: int | None) -> Array:
    """Return the functions (T, r) of inputs (T, m) typical of a healthy plant; of levels over its range by default.

    Raises:
        DataError: fewer inputs than the model has, fewer samples than the window, or a missing one.
    """
    if u is not None:
        inputs = np.asarray(u, dtype=float).reshape(len(np.asarray(u)), -1)
        if inputs.shape[1] != model.m or not np.isfinite(inputs).all() or len(inputs) < window:
            raise DataError(f"u has shape {np.shape(u)}; give {window} samples or more of {model.m} inputs.")
        return model.expand_inputs(inputs)
    spans = [(-1.0, 1.0)] * model.m
    for c, nonlinearity in zip(model.input_of, model.nonlinearities):
        spans[c] = nonlinearity.basis.interval or spans[c]
    low, high = np.array(spans).T
    drawn = np.random.default_rng(seed).uniform(low, high, (INPUTS // HOLD, model.m))
    return model.expand_inputs(np.repeat(drawn, HOLD, axis=0))


def calibrate(search: Window, f: Array, arl0: float, *, samples: int | None = None, seed: int | None = 0,
              extrapolate: bool = False, effect: Array | None = None) -> Calibration:
    """Return the thresholds of a search, simulated once in a process; errors as of `Monitor`.

    Args:
        search: its candidates, its predictor and its length.
        f: (T, r) functions of the input of a healthy plant, repeated as often as needed.
        arl0: samples between false alarms.
        samples: samples to simulate; enough for `ALARMS` false alarms by default, `LONGEST` at most.
        seed: of the simulation.
        extrapolate: whether the tail may be extrapolated where the simulation is too short.
        effect: of uncertain parameters on the innovations along f, as of `parameter_effect`.
    """
    columns, steady, window = search.columns, search.steady, search.length
    if not (np.isfinite(arl0) and arl0 >= window):
        raise StructureError(f"arl0={arl0!r}: it must be at least the window, {window} samples.")
    wanted = int(min(max(ALARMS * arl0, 200 * window), LONGEST)) if samples is None else int(samples)
    extrapolated = wanted < EXCEEDING * arl0
    if extrapolated and not extrapolate:
        raise DataError(f"{wanted} simulated samples cannot support a false alarm every {arl0:g}: {EXCEEDING} alarms "
                        f"are needed. Simulate {int(np.ceil(EXCEEDING * arl0))} samples (samples=), use a lower arl0, "
                        "or extrapolate the tail (extrapolate=True).")
    labels = tuple(c.label for c in columns.candidates)
    key = hashlib.sha256(repr((labels, float(arl0), seed, window, wanted)).encode())
    for part in (f, np.array([]) if effect is None else effect, columns.into_state, columns.into_output,
                 columns.course, *(part for pair in columns.losses for part in pair), *search.matrices):
        key.update(np.ascontiguousarray(part).tobytes())
    if known := _KNOWN.get(key.digest()):
        return known
    l, period = len(steady.C), max(len(f), 1)  # noqa: E741
    length = max(min(CHUNK, wanted) // window, 1) * window
    count = max(1, -(-wanted // (RUNS * length)))

    def run(seeds: np.random.SeedSequence, parts: int = count, scale: float = 1.0) -> Array:
        found, place = [], int(np.random.default_rng(seeds).integers(period))
        for part in np.random.SeedSequence(seeds.entropy, spawn_key=seeds.spawn_key).spawn(count)[:parts]:
            rng = np.random.default_rng(part)
            rows = (place + np.arange(-1, length + window)) % period
            r = rng.standard_normal((length + window, l))
            if effect is not None:  # every stretch has a model of its own
                r += scale * effect[rows[1:]] @ np.append(rng.standard_normal(effect.shape[2] - 1), 1.0)
            inputs = f[rows] if len(f) else np.zeros((len(rows), f.shape[1]))
            _, statistic, _ = Window(columns, window, len(steady.A), steady).advance(
                columns.signals(inputs[:-1], inputs[1:]), r, np.full(len(columns.size), np.inf))
            found.append(statistic.reshape(-1, window, len(columns.size)).max(axis=1)[1:])
            place = int(rows[-1]) + 1
        return np.vstack(found)

    seeds = np.random.SeedSequence(seed).spawn(RUNS)
    with ThreadPoolExecutor(min(RUNS, os.cpu_count() or 1)) as pool:
        exact = pool.map(lambda one: run(one, 1, 0.0), seeds if effect is not None else [])
        largest = np.vstack(list(pool.map(run, seeds)))
        without = list(exact)
    spreads = np.ones(len(columns.size))
    if without:
        often, exactly = (np.quantile(part, 1 - COMMON, axis=0) for part in (largest, np.vstack(without)))
        spreads = np.maximum(often / exactly, 1.0)
    q, alarms = equalised(largest, window, arl0)
    common = float(np.quantile(np.max(largest / q, axis=1), 1 - COMMON))
    _KNOWN[key.digest()] = Calibration(labels, q, float(arl0), window, len(largest) * window, alarms, seed, spreads,
                                       extrapolated, common)
    return _KNOWN[key.digest()]


def cusum_arl(shift: float, k: float = 0.5, h: float = 5.0, *, two_sided: bool = True) -> float:
    """Return the mean number of samples until S = max(0, S + x - k) exceeds h, for x ~ N(shift, 1) and S = 0 at first.

    The integral equation of E. S. Page (Biometrika 41, 1954) is solved by Gauss-Legendre quadrature. The rates of the
    two sides of a two-sided chart add up (K. W. Kemp, J. R. Stat. Soc. B 23, 1961).

    Args:
        shift: mean of the samples, in standard deviations; 0 gives the time between false alarms.
        k: reference value.
        h: threshold.
        two_sided: whether -x is charted, too.

    Raises:
        StructureError: a threshold that is not positive.
    """
    if not (np.isfinite(h) and h > 0 and np.isfinite(k) and np.isfinite(shift)):
        raise StructureError(f"shift={shift!r}, k={k!r}, h={h!r}: they must be finite, and h positive.")
    if two_sided:
        return 1 / sum(1 / cusum_arl(mean, k, h, two_sided=False) for mean in (shift, -shift))
    from scipy.special import ndtr

    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    nodes, weights = (nodes + 1) * h / 2, weights * h / 2
    starts = np.concatenate([[0.0], nodes])  # the sum may stay at zero, which has its own probability
    kernel = np.empty((starts.size, starts.size))
    kernel[:, 0] = ndtr(k - starts - shift)
    step = nodes[None, :] - starts[:, None] + k - shift
    kernel[:, 1:] = weights * np.exp(-(step**2) / 2) / np.sqrt(2 * np.pi)
    return float(np.linalg.solve(np.eye(starts.size) - kernel, np.ones(starts.size))[0])

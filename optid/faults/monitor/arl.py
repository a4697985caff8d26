"""Thresholds of a running search from the mean time between false alarms (ARL0), by simulation.

The whitened innovations of a healthy plant are white with unit covariance, so that the search itself runs on random
numbers, without the plant; the effect of an uncertain model on them is added. The largest statistics of blocks as long
as the window are kept. An alarm is a block that exceeds a threshold after one that did not, and the rate of alarms
while there is none is

    1 / ARL0 = -log(1 - alarms / blocks without an alarm before) / length of a block.

All candidates have the same rate, such that together they have the rate 1 / ARL0.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from optid.arrays import Array
from optid.errors import DataError, StructureError
from optid.faults.monitor.columns import Window

ALARMS = 60  # false alarms of a simulation by default: their rate is then known to 13 %
FEWEST = 50  # with fewer alarms than this the threshold is extrapolated, or refused
LONGEST = 1_000_000  # samples simulated at most by default
CHUNK = 20_000  # samples simulated at a time
RUNS = 4  # simulations that may run in parallel; the result does not depend on how many do
COMMON = 0.1  # share of blocks by whose energies a healthy record is compared with the simulation
NODES = 80  # nodes of the quadrature, for ten digits of the run lengths of the usual charts


@dataclass(frozen=True, eq=False)
class Calibration:
    """Thresholds and their basis.

    Attributes:
        labels: the candidates.
        q: (C,) their thresholds.
        arl0: requested mean number of samples between false alarms.
        window: samples of the window.
        samples: samples simulated.
        alarms: false alarms among them at these thresholds.
        seed: of the simulation.
        spreads: (C,) factors of the energies of the candidates, and of the variances of their sizes, because the
            parameters of the model are uncertain or the healthy record is noisier than the model.
        extrapolated: whether the simulation was too short for this ARL0 and the tail was extrapolated.
        common: largest energy over its threshold that a tenth of the simulated blocks reach; NaN without a simulation.
    """

    labels: tuple[str, ...]
    q: Array
    arl0: float
    window: int
    samples: int
    alarms: int
    seed: int | None
    spreads: Array
    extrapolated: bool = False
    common: float = float("nan")

    def __str__(self) -> str:
        """Return the thresholds and the simulation behind them."""
        tail = ", the tail extrapolated" if self.extrapolated else ""
        lines = [f"false alarm every {self.arl0:g} samples: {self.alarms} alarms in {self.samples} simulated{tail}"]
        if not self.samples:
            lines = ["thresholds as given"]
        return "\n".join(lines + [f"  {label:<40} {q:7.2f}" for label, q in zip(self.labels, self.q)])

    def to_dict(self) -> dict[str, Any]:
        """Describe it in JSON types."""
        return {**self.__dict__, "labels": list(self.labels), "q": [float(q) for q in self.q],
                "spreads": [float(spread) for spread in self.spreads]}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> "Calibration":
        """Return the calibration of a description by `to_dict`."""
        arrays = {word: np.array(content[word], dtype=float) for word in ("q", "spreads")}
        return cls(**{**content, "labels": tuple(content["labels"]), **arrays})


def calibrate(
    search: Window, f: Array, arl0: float, *, samples: int | None = None, seed: int | None = 0,
    extrapolate: bool = False, effect: Array | None = None,
) -> Calibration:
    """Return the thresholds of a search; errors as of `Monitor`.

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
    extrapolated = wanted < FEWEST * arl0
    if extrapolated and not extrapolate:
        raise DataError(
            f"{wanted} simulated samples cannot support a false alarm every {arl0:g}: {FEWEST} alarms are needed. "
            f"Simulate {int(np.ceil(FEWEST * arl0))} samples (samples=), use a lower arl0, or extrapolate the tail "
            "(extrapolate=True).")
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
        spreads = np.maximum(np.quantile(largest, 1 - COMMON, axis=0) / np.quantile(np.vstack(without), 1 - COMMON,
                                                                                     axis=0), 1.0)
    q, alarms = equalised(largest, window, arl0)
    labels = tuple(c.label for c in columns.candidates)
    common = float(np.quantile(np.max(largest / q, axis=1), 1 - COMMON))
    return Calibration(labels, q, float(arl0), window, len(largest) * window, alarms, seed, spreads, extrapolated,
                       common)


def equalised(largest: Array, length: int, arl0: float) -> tuple[Array, int]:
    """Return thresholds (C,) of equal rates, together 1 / ARL0, and the number of alarms.

    The largest statistics (B, C) are those of blocks of `length` samples.
    """
    goal = -np.expm1(-length / arl0)
    level = goal / largest.shape[1]  # for independent candidates
    few = goal * len(largest) < 0.9 * FEWEST  # too few to count: this level is conservative
    for _ in range(30):
        q = np.array([tail(column, level) for column in largest.T])
        above = np.any(largest > q, axis=1)
        alarms, quiet = int(np.sum(above[1:] & ~above[:-1])), int(np.sum(~above[:-1]))
        share = alarms / max(quiet, 1)  # of the blocks that follow a block without an alarm
        if few or not alarms or abs(share / goal - 1) < 0.005:
            break
        level *= goal / share
    return q, alarms


def tail(column: Array, level: float) -> float:
    """Return the statistic that a share `level` of the blocks exceeds, from an exponential tail where they are few."""
    count = len(column)
    ordered = np.sort(column)
    exceed = level * count
    base = min(count // 10, max(500, int(4 * exceed)))
    if exceed >= 500 or base < 20:
        return float(np.quantile(ordered, 1 - level))
    start = ordered[count - base - 1]
    scale = float(np.mean(ordered[count - base :] - start))
    return float(start + scale * np.log(base / exceed))


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

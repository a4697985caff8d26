"""Latency per sample and throughput of the monitor; 6 candidates, two of them losses of two numbers, a jump of four.

Latency: every call of `Monitor.step` is timed, by the clock on the wall and by the processor time of the thread (on a
machine that does other things at the same time the first counts what others take); once with functions of the user
(Python), once with functions of optid (compiled). The same search in plain NumPy, without missing readings and carried
faults, is timed beside it and must give the same statistics. Goal at W = 100: p99 at most 1 ms.

Throughput: `optid monitor --follow FILE --until-end` on a file of the standard plant, the start of the process taken
out by the difference of two lengths. Goal: at least 100,000 samples/s on one core.

    python benchmarks/faults/latency.py [--samples 30000] [--rows 200000]
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from plants import levels, standard_plant
from streams import standard_dictionary, stream

from optid.bases import BSpline, Polynomial
from optid.faults import Dictionary, Monitor, inject
from optid.faults.search.sweeps import inverse_roots
from optid.models import HammersteinSS, Nonlinearity

THRESHOLD = 60.0
"""High enough for no alarm: every sample costs the same."""


def compiled_plant() -> tuple[HammersteinSS, np.ndarray]:
    """Return the standard plant with its functions in bases that a file holds, and the direction of its load."""
    model, load = standard_plant()
    grid = np.linspace(-1.2, 1.2, 400)
    functions = []
    for f, basis in zip(model.nonlinearities, (Polynomial(3, (-1.2, 1.2)), BSpline(24, interval=(-1.2, 1.2)))):
        functions.append(Nonlinearity(basis, np.linalg.lstsq(basis.values(grid), f(grid), rcond=None)[0]))
    return replace(model, nonlinearities=tuple(functions)), load


class NumpySearch:
    """The search of a window without missing readings, by matrix products."""

    def __init__(self, found: Dictionary, window: int) -> None:
        self.found, self.window, self.model, steady = found, window, found.model, found.predictor
        n, l = self.model.nx, self.model.l  # noqa: E741
        jolts, directs = [steady.root @ steady.C], [steady.root]
        for _ in range(window - 1):
            directs.append(-jolts[-1] @ steady.K)
            jolts.append(jolts[-1] @ steady.F)
        self.responses = np.concatenate([np.array(jolts[::-1]), np.array(directs[::-1])], axis=2)  # (W, l, n + l)
        self.steady, self.x, self.before = steady, np.zeros(n), np.zeros(self.model.B.shape[1])
        self.bases = [function.basis for function in self.model.nonlinearities]  # one function of the user in each
        self.losses = [c for c in found.candidates if c.columns]
        self.others = [c for c in found.candidates if not c.columns]
        self.columns = [list(c.columns) for c in self.losses]
        shapes, self.parts, traces, self.roots, first = {}, {}, [], {}, 0
        for c in found.candidates:
            part = c.into_state if not c.columns else c.into_state[:, : len(c.columns)]
            trace = self.responses @ np.vstack([part, c.into_output])
            shapes[c.label] = trace if c.kind == "jump" else np.cumsum(trace[::-1], axis=0)[::-1]
        for c in self.others:
            trace = shapes[c.label]
            grams = np.cumsum(np.einsum("koi,koj->kij", trace, trace)[::-1], axis=0)[::-1]
            self.roots[c.label] = inverse_roots(grams, np.linalg.eigvalsh(grams)[:, -1])
            self.parts[c.label] = slice(first, first := first + c.dimension)
            traces.append(np.moveaxis(trace, 1, 0))
        self.fixed = np.concatenate(traces, axis=2)  # (l, W, numbers)
        self.b = np.zeros(self.fixed.shape[1:])
        self.rest = np.array([shapes[c.label][:, :, 0] for c in self.losses])  # a loss has a constant beside it
        self.drive = np.zeros((len(self.losses), window, n + l, 1))
        self.loss_b, self.loss_G = np.zeros((2, len(self.losses), window)), np.zeros((3, len(self.losses), window))
        self.seen = 0

    def step(self, u: np.ndarray, y: np.ndarray) -> dict[str, float]:
        """Take in one sample; return the largest statistics."""
        model, steady = self.model, self.steady
        f = np.array([basis.functions[0](u[c]) for basis, c in zip(self.bases, model.input_of)])
        innovation = y - model.C @ self.x - model.D @ f - model.offset_y
        r = steady.root @ innovation
        self.seen += 1
        count, lines = min(self.seen, self.window), {}
        self.b[:-1] = self.b[1:]
        self.b[-1] = 0.0
        self.b += np.tensordot(r, self.fixed, 1)
        for c in self.others:
            scores = (self.roots[c.label] @ self.b[:, self.parts[c.label], None])[:, :, 0]
            lines[c.label] = np.sum(scores * scores, axis=1)
        for lines_of_losses in (self.loss_b, self.loss_G):
            lines_of_losses[:, :, :-1] = lines_of_losses[:, :, 1:]
            lines_of_losses[:, :, -1] = 0.0
        self.drive[:, :-1] = self.drive[:, 1:]
        for drive, c, columns in zip(self.drive, self.losses, self.columns):
            drive[-1, :, 0] = -np.concatenate([c.into_state @ self.before[columns], c.into_output @ f[columns]])
        moved = np.cumsum((self.responses @ self.drive)[:, ::-1, :, 0], axis=1)[:, ::-1]  # (losses, W, l)
        self.loss_b[0] += moved @ r
        self.loss_b[1] += self.rest @ r
        self.loss_G[0] += np.sum(moved * moved, axis=2)
        self.loss_G[1] += np.sum(moved * self.rest, axis=2)
        self.loss_G[2] += np.sum(self.rest * self.rest, axis=2)
        (b, e), (g, cross, h) = self.loss_b, self.loss_G
        rest = g * h - cross**2
        there = rest > 1e-9 * (g + h) ** 2
        both = (h * b**2 - 2 * cross * b * e + g * e**2) / np.where(there, rest, 1)
        along = (g * b**2 + 2 * cross * b * e + h * e**2) / (g + h + 1e-150) ** 2
        lines.update(zip((c.label for c in self.losses), np.where(there, both, along)))
        found = {}
        for c in self.found.candidates:
            early = 1 if c.columns and self.seen <= self.window else 0  # nothing is known of the input before
            first, last = self.window - count + early, self.window - (-(-c.dimension // model.l) - 1)
            found[c.label] = float(np.max(lines[c.label][first:last], initial=0.0))
        self.x = model.A @ self.x + model.B @ f + model.offset_x + steady.K @ innovation
        self.before = f
        return found


def timed(step, u: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time every call, on the wall and on the processor, in microseconds."""
    for k in range(500):
        step(u[k], y[k])
    wall, processor = np.empty(len(u) - 500), np.empty(len(u) - 500)
    for k in range(500, len(u)):
        a, b = time.perf_counter_ns(), time.thread_time_ns()
        step(u[k], y[k])
        processor[k - 500], wall[k - 500] = time.thread_time_ns() - b, time.perf_counter_ns() - a
    return wall / 1e3, processor / 1e3


def latencies(samples: int) -> None:
    print(f"latency in us over {samples} samples      wall p50    p99  p99.9    max   processor p50    p99  p99.9")

    def show(name: str, window: int, step, u: np.ndarray, y: np.ndarray, goal: str = "") -> None:
        wall, processor = timed(step, u, y)
        marks = np.percentile(wall, [50, 99, 99.9, 100]), np.percentile(processor, [50, 99, 99.9])
        print(f"{name:<22} W = {window:<4} {'':>8}" + "".join(f"{v:>9.1f}" for v in marks[0]) + f"{'':>7}"
              + "".join(f"{v:>8.1f}" for v in marks[1]) + f"   {goal}", flush=True)

    for name, (model, load) in (("functions of optid", compiled_plant()), ("functions of the user", standard_plant())):
        found = standard_dictionary(model, load)
        for window in (50, 100, 200):
            monitor = Monitor(model, found, window=window, thresholds=np.full(6, THRESHOLD), x0="zero")
            u, y = stream(model, samples, 1)
            show(name, window, monitor.step, u, y, "p99 <= 1000" if window == 100 else "")
    model, load = standard_plant()
    found = standard_dictionary(model, load)
    u, y = stream(model, 6000, 2)
    plain = NumpySearch(found, 100)
    show("plain NumPy", 100, plain.step, u, y)
    plain, monitor = NumpySearch(found, 100), Monitor(model, found, thresholds=np.full(6, THRESHOLD), x0="zero")
    worst = 0.0
    for now, reading in zip(u[:400], y[:400]):
        monitor.step(now, reading)
        for label, value in plain.step(now, reading).items():
            worst = max(worst, abs(monitor.statistics[label] - value) / max(value, 1e-3))
    print(f"largest difference of the statistics, compiled and NumPy: {worst:.1e} (goal 1e-9)")
    print()


def throughput(rows: int) -> None:
    model, load = compiled_plant()
    with tempfile.TemporaryDirectory() as folder:
        plant, table, thresholds = (Path(folder) / name for name in ("plant.json", "rows.csv", "thresholds.json"))
        model.save(plant)
        u = levels(rows, 5)
        np.savetxt(table, np.hstack([u, inject(model, u, seed=6)]), "%.9g", ",", header="u1,u2,y1,y2", comments="")
        command = [sys.executable, "-m", "optid", "monitor", str(plant), "--until-end", "--thresholds", str(thresholds),
                   "--kinds", "bias", "loss", "--arl0", "1000000", "--extrapolate", "--load",
                   "load=" + ",".join(map(str, load)), "--follow"]
        short = Path(folder) / "short.csv"
        with table.open() as file:
            short.write_text("".join(line for line, _ in zip(file, range(1001))))
        found = []
        for path in (short, short, table, short, table):
            before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            subprocess.run([*command, str(path)], check=True, capture_output=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            found.append((spent, time.perf_counter() - begun))
        start, whole = np.min(found[1::2], axis=0), np.min([found[2], found[4]], axis=0)
    processor, wall = (rows - 1000) / (whole - start)
    print(f"throughput from a file of {rows} rows, W = 100, candidates: two biases and losses of actuators, two biases "
          f"of sensors, load, jump:\n{processor:,.0f} samples/s of processor time, {wall:,.0f} on the wall "
          f"(start of the process {start[0]:.1f} s); goal 100,000; load of the machine {os.getloadavg()[0]:.1f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=30_000)
    parser.add_argument("--rows", type=int, default=200_000)
    given = parser.parse_args()
    latencies(given.samples)
    throughput(given.rows)


if __name__ == "__main__":
    main()

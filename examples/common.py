"""A plant that can break, the inputs that hold its outputs, and the picture of both, for faults_end_to_end.py."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import optid
from optid.bases import Triangular
from optid.faults import allocate, inject
from optid.models import HammersteinSS, NoiseCovariances, Nonlinearity
from optid.models.kalman import kalman_gain

ONSET = 400
LOST = 0.6


def plant(left: float = 1.0) -> HammersteinSS:
    """Return a plant with two actuators; of the second so much is left."""
    A = np.array([[0.85, 0.15, 0.0], [-0.15, 0.8, 0.1], [0.0, 0.0, 0.6]])
    B, C = np.array([[0.9, 0.1], [0.2, -0.8], [0.4, 0.5]]), np.array([[1.0, 0.0, 0.3], [0.1, 1.0, -0.2]])
    Q, R = 4e-4 * np.eye(3), 2.5e-3 * np.eye(2)
    steady, basis = kalman_gain(A, C, Q, R), Triangular(6, (-1.2, 1.2))
    u = np.delete(basis.nodes, basis.dropped)
    functions = (Nonlinearity(basis, u + 0.25 * u**3), Nonlinearity(basis, left * np.tanh(1.5 * u)))
    return HammersteinSS(A, B, C, K=steady.K, nonlinearities=functions,
                         noise=NoiseCovariances(Q, R, np.zeros((3, 2)), steady.innovation))


def levels(count: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).uniform(-1.2, 1.2, (-(-count // 5), 2))
    return np.repeat(drawn, 5, axis=0)[:count]


def held(true: HammersteinSS, believed: HammersteinSS, r: np.ndarray, count: int = 60) -> np.ndarray:
    """Return the outputs (N, l) of a plant under the inputs that hold a reference according to a model of it."""
    u = np.tile(allocate(believed).attainable(r).u, (count, 1))
    return inject(true, u, seed=0)


def fit(truth: np.ndarray, simulated: np.ndarray) -> float:
    return float(100 * (1 - np.linalg.norm(truth - simulated) / np.linalg.norm(truth - truth.mean(axis=0))))


def draw(path: Path, record: tuple[np.ndarray, np.ndarray], events: list, rebuilt: optid.faults.Reformulation,
         courses: dict[str, np.ndarray], r: np.ndarray) -> None:
    """Draw the stream with its events, the nonlinearity before and now, what can be held, and outputs that are."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    stream, shape, reach, control = figure.subplots(2, 2).ravel()
    shown = slice(ONSET - 60, None)
    k = np.arange(len(record[1]))[shown]
    for o, colour in enumerate(("tab:blue", "tab:green")):
        stream.plot(k, record[1][shown, o], color=colour, linewidth=1, label=f"y{o + 1}")
    stream.axvline(ONSET, color="black", linestyle=":", label="it breaks")
    for event, colour in zip([e for e in events if e.sample >= ONSET], ("tab:red", "tab:orange")):
        name = event.kind + (f": {event.candidates[0][0]}" if event.kind == "isolated" else "")
        stream.axvline(event.sample, color=colour, label=name)
    stream.set(title="monitor", xlabel="sample", ylim=(None, 1.9 * np.max(np.abs(record[1][shown]))))
    stream.legend(fontsize=8, ncols=2, loc="upper left")

    if rebuilt.schedule is not None:
        one = rebuilt.schedule.values[0]
        shape.plot(one.nodes, one.healthy, "--", color="gray", label="before")
        shape.errorbar(one.nodes, one.values, 2 * one.std, fmt="o-", color="tab:orange", capsize=3, label="refitted")
        ratio = (one.healthy[-1] - one.healthy[0]) / (2 * np.tanh(1.8))  # gauge of the identified model
        shape.plot(one.nodes, (1 - LOST) * ratio * np.tanh(1.5 * one.nodes), color="black", linewidth=1, label="truth")
    shape.set(title="actuator u2", xlabel="input", ylabel="effect")
    shape.legend(fontsize=8)

    for allocation, colour, label in ((allocate(rebuilt.healthy), "gray", "before"),
                                      (allocate(rebuilt.model), "tab:orange", "now")):
        corners = allocation.corners()
        reach.fill(*corners.T, color=colour, alpha=0.25, label=label)
    reach.plot(*r, "k*", markersize=11, label="reference")
    reach.set(title="attainable outputs", xlabel="y1", ylabel="y2")
    reach.legend(fontsize=8)

    for (name, course), colour in zip(courses.items(), ("gray", "tab:orange")):
        control.plot(course[:, 0], color=colour, label=f"y1, {name}")
        control.plot(course[:, 1], color=colour, linestyle="--", label=f"y2, {name}")
    for value in r:
        control.axhline(value, color="black", linewidth=0.6)
    control.set(title="outputs of the damaged plant", xlabel="sample")
    control.legend(fontsize=8, ncols=2)
    figure.savefig(path, dpi=120)

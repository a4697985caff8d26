"""Faults behind a controller that is not known: false alarms and isolation beside open loop.

The standard plant follows references (levels held 25 samples) under a PI controller with limited inputs, which acts on
the readings, faults included, and of which the search knows nothing: it sees inputs and outputs. The innovations of the
right predictor stay white under feedback, so that thresholds and isolation should be those of open loop. Printed:
whiteness, false alarms of the nominal 1 %, and isolation of one fault of deflection 7, 10 and 20 (candidates, onsets
and windows as in isolation.py) in both loops. Then the same with losses of actuators among the candidates, whose
signature depends on what the controller does with the inputs, and thresholds for the inputs of every window.

    python benchmarks/faults/closed_loop.py [--runs 1200] [--losses 200] [--plant $OPTID_DATA/fault_plant.json]
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from plants import BEFORE, PLANT, REACH, Window, cut, deflected, levels, rate, standard_plant, windows

from optid import Data
from optid.faults import Dictionary, Fault, dictionary, health, inject, scan, thresholds, whiten
from optid.faults.places import place_of
from optid.models import HammersteinSS

WINDOW = 200
HOLD = 25
PROPORTIONAL, INTEGRAL = 0.08, 0.03


def controlled(model: HammersteinSS, faults: list[Fault | None], load: np.ndarray, seed: int, count: int,
               noise: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Simulate runs of the closed loop, all at once: inputs (M, N, m) and readings (M, N, l).

    u(k) is decided from the readings up to k - 1.
    """
    runs, rng = len(faults), np.random.default_rng(seed)
    assert model.noise is not None
    w = noise * rng.multivariate_normal(np.zeros(model.nx), model.noise.Q, (runs, count))
    v = noise * rng.multivariate_normal(np.zeros(model.l), model.noise.R, (runs, count))
    references = np.stack([levels(count, rng, hold=HOLD) for _ in range(runs)]) * [1.2, 0.35]
    to_state, to_output = np.zeros((runs, count, model.nx)), np.zeros((runs, count, model.l))
    kept = np.ones((runs, count + 1, model.m))
    for run, fault in enumerate(faults):
        if fault is None:
            continue
        if fault.kind == "loss":
            kept[run, fault.onset :, model.inputs.index(fault.channel)] -= float(fault.size)
            continue
        into_state, into_output = place_of(model, fault.name, fault.direction, {"load": load})
        samples = slice(fault.onset, fault.onset + 1) if fault.kind == "jump" else slice(fault.onset, None)
        to_state[run, samples], to_output[run, samples] = into_state @ fault.size, into_output @ fault.size
    gain = np.linalg.inv(model.static_gain(np.zeros(2)))
    x, total = np.zeros((runs, model.nx)), np.zeros((runs, model.l))
    u, y = np.zeros((runs, count, model.m)), np.zeros((runs, count, model.l))
    for k in range(count):
        if k:
            error = references[:, k] - y[:, k - 1]
            wanted = (PROPORTIONAL * error + INTEGRAL * (total + error)) @ gain.T
            u[:, k] = np.clip(wanted, -REACH, REACH)
            total += np.where(np.all(np.abs(wanted) < REACH, axis=1)[:, None], error, 0.0)  # no windup
        f = model.expand_inputs(u[:, k])
        x = x + to_state[:, k]
        y[:, k] = x @ model.C.T + (kept[:, k] * f) @ model.D.T + to_output[:, k] + v[:, k]
        x = x @ model.A.T + (kept[:, k + 1] * f) @ model.B.T + w[:, k]
    return u, y


def closed(model: HammersteinSS, faults: list[Fault | None], load: np.ndarray, seed: int) -> Iterator[Window]:
    """Yield one window of the closed loop for every entry of faults."""
    for u, y in zip(*controlled(model, faults, load, seed, BEFORE + WINDOW)):
        yield Window(u[BEFORE:], cut(whiten(model, Data(u, y), x0="zero"), BEFORE), BEFORE)


def opened(model: HammersteinSS, faults: list[Fault | None], load: np.ndarray, seed: int) -> Iterator[Window]:
    """Yield one window of open loop for every entry of faults."""
    return windows(model, [() if f is None else f for f in faults], WINDOW, load=load, seed=seed)


def answers(found: Dictionary, stream: Iterator[Window], q: object = None) -> list[str | None]:
    """Return the candidate accused in every window; None without an alarm. q None: thresholds of every window."""
    said: list[str | None] = []
    for window in stream:
        limits = thresholds(found, WINDOW, u=window.u, draws=5000) if q is None else q
        gains = scan(found, window.whitened, window.u).gains(limits)  # type: ignore[arg-type]
        c, at = np.unravel_index(np.nanargmax(gains), gains.shape)
        said.append(found.labels[c] if gains[c, at] > 0 else None)
    return said


def drawn(found: Dictionary, d: float, runs: int, seed: int) -> tuple[list[str], list[Fault | None]]:
    """Draw faults of a deflection: candidates in turn, onsets from 60 to 140."""
    rng = np.random.default_rng(seed)
    labels = [found.labels[run % len(found.labels)] for run in range(runs)]
    return labels, [deflected(found, label, WINDOW, int(rng.integers(60, 140)), d, rng)[0] for label in labels]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1200, help="windows per deflection and loop")
    parser.add_argument("--losses", type=int, default=200, help="windows with losses among the candidates")
    parser.add_argument("--plant", type=Path, default=PLANT)
    options = parser.parse_args()
    model, load = standard_plant(options.plant)
    found = dictionary(model, process={"load": load})
    limits = thresholds(found, WINDOW, draws=50_000)

    step = Fault.step("actuator:u1", 150, 0.3)
    for fault in (step, Fault.loss("actuator:u2", 150, 0.5), Fault.jump("state", 150, np.ones(4))):
        (u,), (y,) = controlled(model, [fault], load, 0, 300, noise=0.0)
        assert np.allclose(inject(model, u, fault, noise="none"), y), "the loop and inject must agree on the plant"

    healthy = list(closed(model, [None] * (2 * options.runs), load, 1))
    p = np.array([health(w.whitened).p_value for w in healthy])
    moved = np.mean([np.std(w.u, axis=0) for w in healthy], axis=0)
    false = sum(label is not None for label in answers(found, iter(healthy), limits))
    print(f"closed loop: inputs of size {moved[0]:.2f}, {moved[1]:.2f}; p-value of whiteness below .05 in "
          f"{np.mean(p < 0.05):.3f} of the windows, below .001 in {np.mean(p < 0.001):.4f}")
    print(f"35 false alarms, closed loop   {rate(false, len(healthy))}   (nominal .01, budget .02)\n", flush=True)
    for d in (7, 10, 20):
        shares = []
        for word, loop in (("open", opened), ("closed", closed)):
            labels, faults = drawn(found, d, options.runs, d)
            said = answers(found, loop(model, faults, load, 10 * d), limits)
            detected = sum(s is not None for s in said)
            right = sum(s == label for s, label in zip(said, labels))
            shares.append(right / detected)
            print(f"deflection {d:>2}, {word:<6} loop: detected {rate(detected, len(said))}, named rightly of those "
                  f"{rate(right, detected)}", flush=True)
        print(f"35 isolation, closed less open loop {100 * (shares[1] - shares[0]):+.1f} points   (goal within 5)\n",
              flush=True)
    if not options.losses:
        return
    wide = dictionary(model, kinds=["bias", "loss"], process={"load": load})
    broken: list[Fault | None] = [Fault.loss(f"actuator:u{1 + run % 2}", BEFORE + 60 + run % 80, 0.5)
                                  for run in range(options.losses)]
    for word, loop in (("open", opened), ("closed", closed)):
        false = sum(s is not None for s in answers(wide, loop(model, [None] * options.losses, load, 7)))
        said = answers(wide, loop(model, broken, load, 8))
        detected = sum(s is not None for s in said)
        right = sum(s == f"{f.name} loss" for s, f in zip(said, broken) if f is not None)
        print(f"with losses, {word:<6} loop: false alarms {rate(false, options.losses)}; losses of 50 % detected "
              f"{detected / len(said):.3f}, named rightly of those {right / max(detected, 1):.3f}", flush=True)


if __name__ == "__main__":
    main()

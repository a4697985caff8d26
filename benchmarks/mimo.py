"""Hammerstein state-space models with two inputs, two outputs and four states against the systems they come from.

    python benchmarks/mimo.py --systems 20

Random systems (poles with moduli in [0.3, 0.95], one random cubic per input, measurement noise of a tenth of the mean
modulus of the output, process noise of 3 % of what drives the states) give N = 2000 samples to estimate from and as
many to score on. The fit in % per output is 100 (1 - |y - yhat| / |y - mean y|), averaged over outputs:

* one step: `predict` of the model fitted by prediction error, beside that of the true system with its Kalman gain;
* simulation: `simulate` of the models fitted by prediction error and by simulation error, beside that of the true
  system; initial states are fitted for all.

Goal: within 0.15 points of the true system's own score.
"""

import argparse
import time
import warnings
from dataclasses import replace

import numpy as np

import optid
from optid.models import HammersteinSS, Nonlinearity
from optid.models.kalman import kalman_gain

GOAL = 0.15
BASIS = optid.Polynomial(3, interval=(-2.0, 2.0))


def random_system(rng: np.random.Generator, n: int = 4) -> HammersteinSS:
    """Return a random stable system with one cubic per input; its K is not set."""
    A = np.zeros((n, n))
    for i in range(0, n, 2):
        radius, angle = rng.uniform(0.3, 0.95), rng.uniform(0, np.pi)
        if rng.uniform() < 0.5:
            A[i : i + 2, i : i + 2] = np.diag(rng.uniform(0.3, 0.95, 2))
        else:
            c, s = radius * np.cos(angle), radius * np.sin(angle)
            A[i : i + 2, i : i + 2] = [[c, s], [-s, c]]
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    functions = tuple(Nonlinearity(BASIS, np.array([1.0, *rng.uniform(-0.6, 0.6, 2)])) for _ in range(2))
    return HammersteinSS(turn @ A @ turn.T, rng.normal(size=(n, 2)), rng.normal(size=(2, n)),
                         0.5 * rng.normal(size=(2, 2)), functions, offset_y=rng.normal(size=2)).balance()


def simulated(model: HammersteinSS, rng: np.random.Generator, count: int, process: float
              ) -> tuple[HammersteinSS, optid.Data]:
    """Return the system with its Kalman gain, and a noisy record."""
    u = rng.uniform(-2, 2, (count, 2))
    clean = model.simulate(u)
    size = np.abs(clean - clean.mean(axis=0)).mean(axis=0)
    R = np.diag((0.1 * size) ** 2)
    root = process * rng.normal(size=(model.nx, model.nx)) @ np.diag(np.std(model.expand_inputs(u) @ model.B.T, axis=0))
    gain = kalman_gain(model.A, model.C, root @ root.T, R).K
    noisy = HammersteinSS(model.A, root, model.C, np.zeros((2, model.nx)), dt=model.dt)
    noise = noisy.simulate(rng.normal(size=(count, model.nx)))
    y = clean + noise + rng.normal(size=clean.shape) @ np.sqrt(R)
    return replace(model, K=gain), optid.Data(u, y)


def score(y: np.ndarray, found: np.ndarray) -> float:
    """Return the fit in %, averaged over outputs."""
    rest = np.linalg.norm(y - found, axis=0) / np.linalg.norm(y - y.mean(axis=0), axis=0)
    return float(np.mean(100 * (1 - rest)))


def main() -> None:
    """Parse the arguments and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=20)
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--process", type=float, default=0.03, help="process noise, as a share of what drives states")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print("points lost to the true system   one step (true)   simulation (true)   by simulation error   seconds")
    lost = []
    for seed in range(arguments.seed, arguments.seed + arguments.systems):
        rng = np.random.default_rng(seed)
        truth, record = simulated(random_system(rng), rng, 2 * arguments.samples, arguments.process)
        estimation, validation = record.split(arguments.samples)
        clock, models = time.process_time(), {}
        for criterion in ("prediction", "simulation"):
            models[criterion] = optid.fit(estimation, "hammerstein_ss.exact", nx=4, basis=BASIS, criterion=criterion,
                                          raises=False).model
        y = validation.y
        best = score(y, truth.predict(validation)), score(y, truth.simulate(validation, x0="fit"))
        row = (best[0] - score(y, models["prediction"].predict(validation)),
               best[1] - score(y, models["prediction"].simulate(validation, x0="fit")),
               best[1] - score(y, models["simulation"].simulate(validation, x0="fit")))
        lost.append(row)
        print(f"system {seed:3d}                      {row[0]:7.3f} ({best[0]:6.2f})  {row[1]:7.3f} ({best[1]:6.2f})   "
              f"     {row[2]:7.3f}            {time.process_time() - clock:5.1f}", flush=True)
    names = "one step", "simulation, by prediction error", "simulation, by simulation error"
    for name, values in zip(names, np.array(lost).T):
        print(f"{name:32s} mean {values.mean():6.3f}   median {np.median(values):6.3f}   worst {values.max():6.3f}   "
              f"within {GOAL}: {np.count_nonzero(values <= GOAL)} of {len(values)}")


if __name__ == "__main__":
    main()

"""Subspace methods with nonlinear feedback against published results, and their rate of convergence.

Prints, beside the goals,
* item 4: noise-free Example 1: distance of eig(A) (1e-10), second over first singular value of [Bu; Du] (1e-10);
* item 5: condition of R11 over the length of the record, with simulated feedback (bounded) and with past outputs and
  future inputs as instruments (grows);
* item 6: Van der Pol, error with measured feedback over p = q: 2 fails (> 70 %), 3 and 4 pass (< 5 %, noise free);
* item 7: reaction wheel pendulum under the chirp: angle error of ASIVID at order 3 at least 5 times smaller than that
  of the linear method;
* the relative error of the feedback Markov parameters of Example 1 over N = 3k .. 48k under white and under AR(0.9)
  measurement noise, medians over seeds, and the slope of its logarithm over that of N (goal: -1/2, at most -0.4).

Example 1 is `optid.plants.EXAMPLE1`: three states, two inputs, two outputs; sd 0.5 of the noise, each seed its own
input.
"""

import argparse
import warnings

import numpy as np

from optid import Polynomial, UserFunctions, fit
from optid.errors import DataWarning
from optid.plants import EXAMPLE1, pendulum, pendulum_input, van_der_pol

INPUTS = [UserFunctions((lambda u: u, lambda u: u**3)), UserFunctions((lambda u: np.tanh(2 * u),))]
FEEDBACK = [UserFunctions((lambda y: -np.sin(y),)), UserFunctions((lambda y: -y * np.abs(y) / (1 + y * y),))]
KNOWN = {"nx": 3, "block_rows": 5, "basis": INPUTS, "feedback_basis": FEEDBACK}


def example(count: int, seed: int, measurement: float = 0.0, colour: float = 0.0):
    """A record of Example 1 under uniform inputs."""
    u = np.random.default_rng(1000 + seed).uniform(-2, 2, (count, 2))
    return EXAMPLE1.record(u, seed, measurement=measurement, colour=colour)


def markov(a, c, b, count=10):
    return np.array([c @ np.linalg.matrix_power(a, k) @ b for k in range(count)])


def pole_distance(model) -> float:
    """Distance of the eigenvalues of A, the linear part of the feedback back in g, from the true ones."""
    found, true = np.linalg.eigvals(model.A + model.L @ model.C), np.linalg.eigvals(EXAMPLE1.a)
    return float(max(np.min(np.abs(true - z)) for z in found))


def feedback_error(model) -> float:
    """Relative error of the Markov parameters of the orthogonalised feedback, whatever the gauge, in %."""
    a, found, true = model.A + model.L @ model.C, [], []
    for j, own in enumerate(model.feedback):
        found.append(markov(a, model.C, model.E[:, [j]]) * own.mu[0])
        true.append(markov(EXAMPLE1.a, EXAMPLE1.c, EXAMPLE1.e[:, [j]]))
    found, true = np.concatenate(found, axis=2), np.concatenate(true, axis=2)
    return 100 * float(np.linalg.norm(found - true) / np.linalg.norm(true))


def measured_feedback_error(model, data) -> np.ndarray:
    """Error of the simulation with measured feedback in % of every output's root mean square."""
    errors = model.simulate_measured_feedback(data, x0="fit") - data.y
    return 100 * np.linalg.norm(errors, axis=0) / np.linalg.norm(data.y, axis=0)


def exactness() -> None:
    found = fit(example(3000, 0), "hammerstein_ss.asivid", **KNOWN)
    ratio = found.figures["second over first singular value, channel u1"]
    print(f"4. noise-free Example 1: eig(A) to {pole_distance(found.model):.1e} (goal 1e-10), second over first "
          f"singular value {ratio:.1e} (goal 1e-10)")


def conditions(lengths) -> None:
    print("5. condition of R11 over N:")
    kinds = {"simulated feedback": {}, "future inputs, past outputs": {"noise": "white", "iterations": 0}}
    for name, more in kinds.items():
        fits = [fit(example(n, 0, 0.5), "hammerstein_ss.asivid", prove=False, **KNOWN, **more) for n in lengths]
        row = [found.figures["condition of R11"] for found in fits]
        print(f"   {name:<30}" + "".join(f"{n:>7}: {value:8.1f}" for n, value in zip(lengths, row)))


def oscillator(seeds: int) -> None:
    print(f"6. Van der Pol, N = 6000 + 1000, 6 block rows, error with measured feedback in %, {seeds} seeds, medians:")
    for process, measurement in ((0.0, 0.0), (0.005, 0.02)):
        row = []
        for degree in (2, 3, 4):
            errors = []
            for seed in range(seeds):
                u = np.random.default_rng(seed).uniform(-2, 2, 7000)
                estimation, validation = van_der_pol(u, seed, process=process, measurement=measurement).split(6000)
                found = fit(estimation, "hammerstein_ss.asivid", nx=2, block_rows=6, basis=Polynomial(degree),
                            feedback_basis=Polynomial(degree), noise="white", prove=False)
                errors.append(measured_feedback_error(found.model, validation)[0])
            row.append(f"p = q = {degree}: {np.median(errors):6.2f}")
        print(f"   process {process}, measurement {measurement}: {', '.join(row)}"
              + ("   (goal > 70, < 5, < 5)" if not process else "   (reference 73, 7, 7)"))


def wheel() -> None:
    data = pendulum(pendulum_input("chirp", 5000), 0)
    estimation, validation = data.split(4000)
    common = {"nx": 3, "block_rows": 10, "prove": False}
    linear = measured_feedback_error(fit(estimation, "hammerstein_ss.sid", **common).model, validation)
    found = fit(estimation, "hammerstein_ss.asivid", basis="polynomial:4", feedback_basis="polynomial:4", noise="white",
                iterations=0, **common)
    full = measured_feedback_error(found.model, validation)
    print(f"7. pendulum, chirp, order 3, angle / speed error in %: linear {linear[0]:.2f} / {linear[1]:.2f}, "
          f"ASIVID {full[0]:.2f} / {full[1]:.2f}: {linear[0] / full[0]:.1f} times better (goal >= 5)")


def convergence(lengths, seeds: int) -> None:
    print(f"8. relative error of the feedback Markov parameters in %, sd 0.5, medians of {seeds} seeds:")
    for colour in (0.0, 0.9):
        for name, more in (("simulated feedback", {}), ("past outputs", {"noise": "white", "iterations": 0})):
            row = []
            for n in lengths:
                errors = [feedback_error(fit(example(n, seed, 0.5, colour), "hammerstein_ss.asivid", prove=False,
                                             **KNOWN, **more).model) for seed in range(seeds)]
                row.append(float(np.median(errors)))
            slope = np.polyfit(np.log(lengths), np.log(row), 1)[0]
            values = "".join(f"{n:>7}: {value:6.2f}" for n, value in zip(lengths, row))
            goal = "(goal -0.5, at most -0.4)" if not more else "(for comparison)"
            print(f"   AR({colour}), {name:<20}{values}   slope {slope:.2f} {goal}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--lengths", type=int, nargs="+", default=[3000, 6000, 12000, 24000, 48000])
    options = parser.parse_args()
    warnings.simplefilter("ignore", DataWarning)
    exactness()
    conditions(options.lengths)
    oscillator(max(3, options.seeds // 4))
    wheel()
    convergence(options.lengths, options.seeds)


if __name__ == "__main__":
    main()

"""Does the structure test tell Hammerstein from Wiener systems?

Random systems: linear dynamics of order 1 to 3 with a delay of 0 to 2 samples, ten nonlinearities (two of them even),
five inputs (white uniform and Gaussian, first-order autoregression, levels held for three samples, band-limited), and
white, autoregressive (pole 0.9) or moving-average noise added at the output; noise-free output over noise: variance
ratio 20. Goal: at least 95 % of the Wiener systems and at most 5 % of the Hammerstein systems are rejected, and
nlid_mod1, a Wiener system, is. Every share stands with its 95 % interval (Clopper and Pearson).

    python benchmarks/structure.py [--systems 100] [--samples 500 1000 2000 4000] [--seed 0]
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
from montecarlo import share
from scipy.signal import butter, lfilter

import optid
from optid.identify.validation.structure import structure_test

FUNCTIONS = {
    "saturation": lambda x: np.tanh(1.5 * x),
    "dead zone": lambda x: np.sign(x) * np.maximum(np.abs(x) - 0.5, 0),
    "cubic": lambda x: x + 0.5 * x**3,
    "x |x|": lambda x: x * np.abs(x),
    "quadratic": lambda x: x + 0.5 * x**2,
    "rectifier": lambda x: np.maximum(x, 0),
    "absolute": np.abs,
    "exponential": lambda x: np.exp(0.8 * x),
    "clipped": lambda x: np.clip(x, -0.5, 1),
    "square": lambda x: x**2,
}
INPUTS = ("white uniform", "white Gaussian", "autoregressive", "held levels", "band-limited")
NOISES = {"white": ([1.0], [1.0]), "autoregressive": ([1.0], [1.0, -0.9]), "moving average": ([1.0, 0.8, 0.5], [1.0])}
SETTLING = 200


def dynamics(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw numerator (with its delay) and denominator."""
    order, poles = int(rng.integers(1, 4)), []
    while len(poles) < order:
        if order - len(poles) >= 2 and rng.uniform() < 0.6:
            pole = rng.uniform(0.5, 0.92) * np.exp(1j * rng.uniform(0.2, 2.5))
            poles += [pole, pole.conjugate()]
        else:
            poles.append(rng.choice([-1, 1], p=[0.2, 0.8]) * rng.uniform(0.3, 0.92))
    numerator = rng.normal(size=rng.integers(1, order + 2))
    return np.concatenate([np.zeros(rng.integers(0, 3)), numerator]), np.real(np.poly(poles))


def excitation(rng: np.random.Generator, kind: str, n: int) -> np.ndarray:
    if kind == "white uniform":
        return rng.uniform(-2, 2, n)
    if kind == "held levels":
        return np.repeat(rng.uniform(-2, 2, n // 3 + 1), 3)[:n]
    e = rng.normal(size=n + SETTLING)
    if kind == "autoregressive":
        e = np.sqrt(1 - 0.49) * lfilter([1.0], [1.0, -0.7], e)
    elif kind == "band-limited":
        e = lfilter(*butter(4, 0.5), e)
        e = np.clip(e / e[SETTLING:].std(), -2.5, 2.5)
    return e[SETTLING:]


def system(seed: int, wiener: bool, n: int, ratio: float = 20.0) -> tuple[optid.Data, str]:
    """Simulate a random system; also what it is made of."""
    rng = np.random.default_rng(seed)
    numerator, denominator = dynamics(rng)
    name = list(FUNCTIONS)[seed % len(FUNCTIONS)]
    kind, noise = INPUTS[rng.integers(len(INPUTS))], list(NOISES)[rng.integers(len(NOISES))]
    u = excitation(rng, kind, n + SETTLING)
    if wiener:
        x = lfilter(numerator, denominator, u)
        y = FUNCTIONS[name](x / x[SETTLING:].std())
    else:
        y = lfilter(numerator, denominator, FUNCTIONS[name](u / u.std()))
    v = lfilter(*NOISES[noise], rng.normal(size=n + SETTLING))
    y = y + v / v[SETTLING:].std() * y[SETTLING:].std() / np.sqrt(ratio)
    return optid.Data(u[SETTLING:], y[SETTLING:]), f"{name}, {kind}, {noise} noise, order {denominator.size - 1}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", type=int, default=100)
    parser.add_argument("--samples", type=int, nargs="+", default=[500, 1000, 2000, 4000])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{options.systems} systems of each kind, variance ratio 20\n")
    print(f"{'samples':>8}  {'Hammerstein rejected (<= 5)':<30}{'Wiener rejected (>= 95)':<28}{'ms per test':>12}")
    for n in options.samples:
        rejected, start = {}, time.process_time()
        for wiener in (False, True):
            seeds = range(options.seed, options.seed + options.systems)
            rejected[wiener] = [seed for seed in seeds if not structure_test(system(seed, wiener, n)[0]).passed]
        spent = 1e3 * (time.process_time() - start) / (2 * options.systems)
        counts = [share(len(rejected[wiener]), options.systems) for wiener in (False, True)]
        print(f"{n:>8}  {counts[0]:<30}{counts[1]:<28}{spent:12.0f}")
        for seed in rejected[False]:
            print(f"{'':10}rejected: {system(seed, False, 10)[1]} (seed {seed})")
        for seed in sorted(set(seeds) - set(rejected[True])):
            print(f"{'':10}not rejected: {system(seed, True, 10)[1]} (seed {seed})")
    folder = os.environ.get("OPTID_DATA")
    if folder is None:
        print("\nOPTID_DATA is not set: nlid_mod1 and nlid_reflex are left out")
        return
    print()
    for name, dt, truth in (("nlid_mod1", 0.001, "a Wiener system"), ("nlid_reflex", 0.005, "a measured reflex")):
        data = optid.read(Path(folder) / f"{name}.csv", inputs=["u"], outputs=["y"], dt=dt)
        found = structure_test(data)
        print(f"{name} ({truth}): {found.finding}; products p = {found.products['y']:.2g}, rank p = "
              f"{found.rank['y']:.2g}, {100 * found.saving:.2g} % saved")


if __name__ == "__main__":
    main()

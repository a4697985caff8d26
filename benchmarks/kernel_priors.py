"""What does a prior on impulse responses save? Random plants, 200 samples each, by the fit of the impulse response.

    python benchmarks/kernel_priors.py [--plants 200] [--samples 200] [--workers 2]

Stable plants of order 2 to 10 with random poles and zeros, white input, white noise at the output of a variance that
leaves a signal-to-noise ratio (of variances) of 3 to 10. The fit is 100 (1 - ‖g - estimate‖ / ‖g - mean g‖) over the
first 100 samples. Without a prior the orders come from cross-validation: two thirds of the record to estimate from, the
one-step error on the rest to choose by, and all of it to fit again. Printed: quartiles, and how often the prior is
better.
"""

import argparse
import warnings

import numpy as np
from montecarlo import mapped
from scipy.signal import lfilter

import optid

ORDERS, LENGTHS = range(1, 13), (5, 10, 15, 20, 30, 40, 50)
LAGS = 100


def plant(rng: np.random.Generator) -> np.ndarray:
    """Impulse response of a random stable plant, delayed by a sample, of unit energy."""
    order = int(rng.integers(2, 11))
    poles: list[complex] = []
    while len(poles) < order:
        radius, angle = rng.uniform(0.2, 0.95), rng.uniform(0, np.pi)
        pair = order - len(poles) > 1 and rng.random() < 0.6
        poles += [radius * np.exp(1j * angle), radius * np.exp(-1j * angle)] if pair else [radius * rng.choice([-1, 1])]
    b = rng.normal(size=order)
    g = lfilter(np.r_[0.0, b], np.real(np.poly(poles)), np.r_[1.0, np.zeros(LAGS - 1)])
    return g / np.linalg.norm(g)


def run(job: tuple[int, int]) -> list[float]:
    """Fits of one plant: ARX by cross-validation, with a prior; impulse response by cross-validation, with priors."""
    seed, samples = job
    warnings.simplefilter("ignore")
    rng = np.random.default_rng([seed, 5])
    g, u = plant(rng), rng.normal(size=samples)
    clean = lfilter(g, 1.0, u)
    noise = np.std(clean) / np.sqrt(rng.uniform(3, 10))
    data = optid.Data(u, clean + noise * rng.normal(size=samples))
    parts = data.split(2 * samples // 3)

    def score(name: str, **arguments: object) -> float:
        h = optid.fit(data, name, **arguments).model.impulse_response(LAGS)[:, 0, 0]
        return 100 * (1 - float(np.linalg.norm(h - g) / np.linalg.norm(g - g.mean())))

    def chosen(name: str, candidates: list[dict[str, object]]) -> float:
        errors = []
        for one in candidates:
            rest = parts[1].y - np.asarray(optid.fit(parts[0], name, **one).model.predict(parts[1]))
            errors.append(np.nanmean(rest[LENGTHS[-1] :] ** 2))
        return score(name, **candidates[int(np.argmin(errors))])

    return [chosen("arx", [{"na": n, "nb": n, "nk": 1} for n in ORDERS]),
            *(score("arx", na=20, nb=20, nk=1, prior=word) for word in ("tc", "dc", "ss")),
            chosen("fir", [{"nb": n, "nk": 1, "prior": "none"} for n in LENGTHS]),
            *(score("fir", nb=50, nk=1, prior=word) for word in ("tc", "dc", "ss"))]


NAMES = ("arx, orders by cross-validation", "arx 20, tc", "arx 20, dc", "arx 20, ss",
         "fir, length by cross-validation", "fir 50, tc", "fir 50, dc", "fir 50, ss")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    found = np.array(mapped(run, [(seed, options.samples) for seed in range(options.plants)], options.workers))
    print(f"{options.plants} plants, {options.samples} samples")
    print(f"{'':34}{'25 %':>8}{'median':>8}{'75 %':>8}{'better':>8}")
    for i, name in enumerate(NAMES):
        low, middle, high = np.percentile(found[:, i], [25, 50, 75])
        plain = 0 if i < 4 else 4
        share = "" if i == plain else f"{100 * np.mean(found[:, i] > found[:, plain]):.0f} %"
        print(f"{name:34}{low:8.1f}{middle:8.1f}{high:8.1f}{share:>8}")


if __name__ == "__main__":
    main()

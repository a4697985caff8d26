"""Are outliers found, and what do they cost a fit with loss="huber"?

    python benchmarks/outliers.py [--problems 20] [--records 400]

Three tables. First, of how many records of 500 samples every outlier is named and no other, per signal, number of
outliers and size in standard deviations of the signal; the column of 0 counts false alarms. Second, fits of random
second-order Hammerstein systems whose outputs are read wrong by 50 (standard deviation of the output 1 to 3): fit in
points, on new data without noise, of least squares on the sound record less that of the loss on the record read wrong;
largest over the problems. The last column is what marking the wrong readings as missing costs least squares. Third, the
variance of the estimates on sound Gaussian records relative to least squares.
"""

import argparse
import warnings

import numpy as np
from montecarlo import STRUCTURE, TRUTHS, record
from scipy.signal import lfilter

import optid
from optid.errors import DataWarning
from optid.identify.outliers import find_outliers

SIGNALS = {
    "white": lambda rng: rng.normal(size=500),
    "uniform": lambda rng: rng.uniform(-1, 1, 500),
    "binary": lambda rng: np.sign(rng.normal(size=500)),
    "stairs": lambda rng: np.repeat(3 * rng.normal(size=13), 40)[:500] + 0.1 * rng.normal(size=500),
    "resonance": lambda rng: lfilter([1], [1, -1.5, 0.7], rng.normal(size=500)),
    "Student, 3 degrees": lambda rng: rng.standard_t(3, 500),
}
CASES = ((0, 0), (1, 30), (8, 20), (20, 20), (50, 20), (20, 8))


def named(make, count: int, size: float, runs: int = 100) -> int:
    """Count the records in which the outliers are named and no others."""
    hits = 0
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        x = make(rng)
        places = rng.choice(500, count, replace=False)
        x[places] += size * x.std() * rng.choice([-1, 1], count)
        hits += np.array_equal(find_outliers([x])[0], np.sort(places))
    return hits if count else runs - hits


def system(seed: int) -> tuple[optid.Data, np.ndarray, np.ndarray]:
    """Simulate a random system: a record with noise, and new inputs with their noise-free outputs."""
    rng = np.random.default_rng(seed)
    pair = rng.uniform(0.3, 0.85) * np.exp(1j * rng.uniform(0.2, 2))
    poles = [pair, pair.conj()] if rng.uniform() < 0.5 else rng.uniform(-0.3, 0.85, 2)
    b, slope, spread = rng.normal(size=2), rng.uniform(0.5, 3), rng.uniform(1, 3)
    u, new = rng.uniform(-1, 1, (2, 500))
    right = [lfilter(b, [1], np.tanh(slope * x)) for x in (u, new)]
    noise = 0.1 * right[0].std() * rng.normal(size=500)
    y, shown = (lfilter([1], np.poly(poles).real, part) for part in (right[0] + noise, right[1]))
    scale = spread / y.std()
    return optid.Data(u, scale * y), new, scale * shown


def fits(model, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """One-step and simulation fit in %, the first samples left out."""
    shown = (model.predict(optid.Data(u, y)), model.simulate(u))
    return np.array([100 * (1 - np.linalg.norm((y - np.ravel(s))[5:]) / np.linalg.norm((y - y.mean())[5:]))
                     for s in shown])


def costs(formulation: str, loss: str, count: int, signs: list[int], problems: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest loss of fit over the problems, of the loss and of marking the readings as missing."""
    structure = {"na": 2, "nb": 2, "prove": False}
    if formulation != "arx":
        structure["basis"] = optid.Triangular(6, interval=(-1.0, 1.0))
    lost = []
    for seed in range(problems):
        data, u, y = system(seed)
        rng = np.random.default_rng([seed, 9])
        places = rng.choice(500, count, replace=False)
        wrong, missing = data.y.copy(), data.y.copy()
        wrong[places, 0] += 50 * rng.choice(signs, count)
        missing[places] = np.nan
        found = [fits(optid.fit(optid.Data(data.u, part), formulation, loss=word, **structure).model, u, y)
                 for part, word in ((data.y, "squares"), (wrong, loss), (missing, "squares"))]
        lost.append([found[0] - found[1], found[0] - found[2]])
    worst = np.max(lost, axis=0)
    return worst[0], worst[1]


def ratio(formulation: str, records: int) -> np.ndarray:
    """Variance of a and b with loss="huber" relative to least squares."""
    found = {"squares": [], "huber": []}
    structure = {"na": 2, "nb": 2} if formulation == "arx" else STRUCTURE
    for seed in range(records):
        data = record(TRUTHS["strictly monotone"], 500, seed)
        for loss, rows in found.items():
            model = optid.fit(data, formulation, loss=loss, prove=False, **structure).model
            rows.append(np.concatenate([model.a, model.b[0]]))
    return np.var(found["huber"], axis=0) / np.var(found["squares"], axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", type=int, default=20)
    parser.add_argument("--records", type=int, default=400)
    options = parser.parse_args()
    warnings.simplefilter("ignore", DataWarning)
    print(f"{'100 records each':<20}" + "".join(f"{f'{count} of {size}':>10}" for count, size in CASES))
    for name, make in SIGNALS.items():
        print(f"{name:<20}" + "".join(f"{named(make, *case):>10}" for case in CASES), flush=True)
    print(f"\n{'largest loss of points':<34}{'loss':>7}{'wrong':>7}{'signs':>7}{'one step':>10}{'simul.':>8}"
          f"{'missing, simul.':>17}")
    for formulation in ("hammerstein_arx.exact", "hammerstein_arx.overparametrised", "arx"):
        for loss, count, signs in (("huber", 8, [1]), ("huber", 8, [-1, 1]), ("huber", 20, [-1, 1]), ("l1", 8, [1])):
            lost, marked = costs(formulation, loss, count, signs, options.problems)
            print(f"{formulation:<34}{loss:>7}{count:>7}{len(signs):>7}{lost[0]:>10.2f}{lost[1]:>8.2f}{marked[1]:>17.2f}",
                  flush=True)
    print("\nvariance with huber over that of least squares, sound records, a1 a2 b0 b1")
    for formulation in ("hammerstein_arx.exact", "arx"):
        print(f"{formulation:<34}" + " ".join(f"{r:.3f}" for r in ratio(formulation, options.records)), flush=True)


if __name__ == "__main__":
    main()

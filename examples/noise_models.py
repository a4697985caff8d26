"""One plant, four noise models: what the choice does to the poles, and to predictions several steps ahead.

The noise of this record is slow: it has a pole at 0.95 that the plant does not have. Equation error (ARX) moves the
poles of the plant to explain it, output error leaves it unexplained, ARMAX shares the poles of the plant with it, and
only Box-Jenkins has room for both.
"""

import numpy as np
from scipy.signal import lfilter

import optid

STRUCTURE = {"na": 2, "nb": 2, "nk": 1}
MODELS = {"hammerstein_arx.exact": {}, "hammerstein_oe.exact": {}, "hammerstein_armax.exact": {"nc": 1},
          "hammerstein_bj.exact": {"nc": 0, "nd": 1}}
HORIZONS = (1, 5, 20)


def record(count: int, seed: int) -> optid.Data:
    """Simulate poles at 0.8 +- 0.4i behind a dead zone, with first-order noise of a pole at 0.95."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, count)
    f = np.sign(u) * np.maximum(np.abs(u) - 0.25, 0.0)
    noise = lfilter([1.0], [1.0, -0.95], 0.1 * rng.standard_normal(count))
    return optid.Data(u, lfilter([0.0, 1.0, 0.5], [1.0, -1.6, 0.8], f) + noise)


def main() -> dict[str, float]:
    """Return the error of the poles and the fit at every horizon on fresh data, for every noise model."""
    train, fresh = record(3000, seed=0), record(3000, seed=1)
    y = fresh.y[100:, 0]
    print(f"{'model':<31}{'error of a':>12}" + "".join(f"{f'{h} ahead %':>12}" for h in HORIZONS))
    found = {}
    for name, orders in MODELS.items():
        model = optid.fit(train, name, **STRUCTURE, basis=optid.Triangular(8), **orders).model
        found[f"{name} error"] = float(np.linalg.norm(model.a - [-1.6, 0.8]))
        for horizon in HORIZONS:
            rest = y - model.predict(fresh, horizon=horizon)[100:, 0]
            found[f"{name} {horizon}"] = float(100 * (1 - np.linalg.norm(rest) / np.linalg.norm(y - y.mean())))
        figures = "".join(f"{found[f'{name} {horizon}']:12.2f}" for horizon in HORIZONS)
        print(f"{model.title:<31}{found[f'{name} error']:12.4f}{figures}")
    return found


if __name__ == "__main__":
    main()

"""Several experiments of unequal length with lost samples: write NaN where a sample is missing, that is all.

Rows that touch a missing sample leave the sums; nothing is interpolated. The same record is then taken in sample by
sample by the recursion, which gives the same estimate and can be stopped, saved and continued.
"""

import tempfile
from pathlib import Path

import numpy as np

import optid
from optid.examples import example


def main() -> dict[str, float]:
    """Return the estimates of a from complete, gappy and recursive data, the rows kept and the largest difference."""
    rng = np.random.default_rng(0)
    parts = [example("dead_zone", seed=seed, n=n).data for seed, n in enumerate((900, 500, 250))]
    complete = optid.Data.join(*parts)
    gappy = optid.Data(
        [np.where(rng.random(u.shape) < 0.03, np.nan, u) for u in complete.u],
        [np.where(rng.random(y.shape) < 0.05, np.nan, y) for y in complete.y], dt=complete.dt)
    print(gappy)
    structure = {"na": 2, "nb": 2, "basis": optid.Triangular(8, (-1.0, 1.0))}
    fits = {"complete": optid.fit(complete, **structure), "gappy": optid.fit(gappy, **structure)}
    for name, fit in fits.items():
        print(f"{name:<9} rows {fit.figures['rows']:5d} of {fit.figures['candidates']}, a = {fit.model.a}, "
              f"one-step fit {fit.one_step_fit[0]:.1f} %")

    relaxed = optid.fit(gappy, "hammerstein_arx.overparametrised", **structure).model
    state = optid.RecursiveARX.like(gappy, **structure)
    first, *others = gappy.experiments
    state.update(first.u[:400], first.y[:400])
    with tempfile.TemporaryDirectory() as scratch:  # stop here, and continue another day
        state = optid.RecursiveARX.load(state.save(Path(scratch) / "state.npz"))
    state.update(first.u[400:], first.y[400:])
    for experiment in others:
        state.restart()
        state.update(experiment.u, experiment.y)
    difference = float(np.abs(state.model().theta() - relaxed.theta()).max())
    print(f"{state}\nlargest difference from the batch estimate: {difference:.1e}")
    return {"a1 complete": fits["complete"].model.a[0], "a1 gappy": fits["gappy"].model.a[0],
            "kept": fits["gappy"].figures["rows"] / fits["gappy"].figures["candidates"], "difference": difference}


if __name__ == "__main__":
    main()

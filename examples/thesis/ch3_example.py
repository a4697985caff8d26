"""Section 3.4: the dead zone before second-order dynamics, identified with the triangular and the trigonometric basis.

Run: python ch3_example.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import BETA, bases, last_error, panels, recursion, run, save, table, with_style

import optid
from optid.examples import example

RECORDS = 40


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return a, b, s_2/s_1 and E_200 of both bases; save the last 8 s and the nonlinearities."""
    record, found = example("dead_zone", seed=0), {}
    data, u, true = record.data, np.linspace(-1, 1, 401), record.truth["f"][0]
    figure, grid = panels(2, 2, width_ratios=[1.4, 1])
    for (name, basis), (left, right), hint in zip(bases(-1, 1).items(), grid, (0.0207, 0.0206)):
        fit = optid.fit(data, "hammerstein_arx.overparametrised", na=2, nb=2, basis=basis, svd="plain")
        best = optid.fit(data, "hammerstein_arx.exact", na=2, nb=2, basis=basis)
        sizes = np.linalg.svd(fit.values["Theta"], compute_uv=False)
        predicted, f, b = fit.model.predict(data), BETA * fit.model.f(u), fit.model.b[0] / BETA
        errors = []
        for other in (example("dead_zone", seed=seed).data for seed in range(RECORDS)):
            state = recursion(other, basis)  # Algorithm 3.2
            state.read(other)
            errors.append(last_error(other.y, state.model("plain").predict(other)))
        found |= {f"{name} E_200": last_error(data.y, predicted), f"{name} mean E_200": float(np.mean(errors)),
                  f"{name} ratio": sizes[1] / sizes[0], f"{name} a1": fit.model.a[0], f"{name} a2": fit.model.a[1],
                  f"{name} b0": b[0], f"{name} b1": b[1], f"{name} error of f": np.sqrt(np.mean((f - true(u)) ** 2)),
                  f"{name} loss": np.nansum((data.y - predicted) ** 2) / best.solution.objective}
        table(f"{name} basis, Algorithm 3.1 with the plain SVD, beta = {BETA}", [
            ("a", fit.model.a, "(-1.50, 0.70), truth (-1.5, 0.7)"),
            ("b = v_1 / beta", b, "(1.07, 0.79), truth (1.0667, 0.8)"),
            ("s_2 / s_1", sizes[1] / sizes[0], "0.02 to 0.04 (triangular)"),
            ("E_200 of this record", found[f"{name} E_200"], "lost"),
            (f"E_200, mean of {RECORDS} records", np.mean(errors), f"{hint}"),
            ("variance of e, RMSE of f on [-1, 1]", [record.truth["sigma"] ** 2, found[f"{name} error of f"]], ""),
            ("squared error over that of the exact fit", found[f"{name} loss"], "1.002 (N 2000), 1.016 (N 200)"),
        ])
        left.plot(data.time[-80:], data.y[-80:], ".", color="0.4", label="y")
        left.plot(data.time[-80:], predicted[-80:], label="one-step prediction")
        left.set(title=f"{name}: last 8 s", xlabel="time (s)", ylabel="y", ylim=(-6.5, 4.5))
        right.plot(u, true(u), "--", color="0.4", label="true f")
        right.plot(u, f, label="identified f")
        right.set(title=f"{name}: nonlinearity", xlabel="u", ylabel="f(u)")
        left.legend(loc="lower right", ncols=2)
        right.legend()
    save(figure, folder, "ch3_example.png")
    return found


if __name__ == "__main__":
    run(main)

"""The accuracy figures of the Monte Carlo study, from its database: python monte_carlo.py [monte_carlo.sqlite].

Root mean square errors over the Cramer-Rao bound (gauge norm of b one), and the trigonometric coefficients of Table 3.1
of the dissertation (gauge beta = 0.75) with their spread.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.signal import lfilter

import optid
from optid.studies.sources.systems import SYSTEMS, simulate

A, B = np.array([-1.5, 0.7]), np.array([0.8, 0.6])
NODES = np.linspace(-1, 1, 9)
MU = np.delete(4 / 3 * np.sign(NODES) * np.maximum(np.abs(NODES) - 0.25, 0), 4)
TRUTH = np.concatenate([A, [0.0], MU, B])


def energy(b: np.ndarray) -> float:
    """Variance gain of B / A for a white input."""
    return float(np.sum(lfilter(b, np.r_[1.0, A], np.eye(1, 2000)[0]) ** 2))


def bound(samples: int, seed: int) -> np.ndarray:
    """Diagonal of (J'J)^-1 at the truth, J the Jacobian of the predictions, in the tangent space of norm one."""
    data = simulate("dead_zone_in_span", samples, seed=seed)[0]
    values = optid.Triangular(8, interval=(-1.0, 1.0)).values(data.u[:, 0])
    f, y = values @ MU, data.y[:, 0]
    k = np.arange(2, samples)
    jacobian = np.column_stack([-y[k - 1], -y[k - 2], np.ones(k.size), B[0] * values[k] + B[1] * values[k - 1],
                                f[k], f[k - 1]])
    free = null_space(np.r_[np.zeros(11), B][None])
    return np.diag(free @ np.linalg.inv((jacobian @ free).T @ (jacobian @ free)) @ free.T)


def main(study: Any, db: Any, workers: int | None = None) -> dict[str, float]:
    """Run what is left of the study; return and print the figures."""
    rows, found = study.run(db, workers=workers), {}
    sigma = SYSTEMS["dead_zone_in_span"].noise * np.sqrt(np.var(np.interp(np.linspace(-1, 1, 20001), NODES, np.insert(
        MU, 4, 0.0))) * energy(B) / energy(np.ones(1)))
    for (label, n), group in rows[rows["data"] == "in the span"].groupby(["formulation", "samples"]):
        values = [json.loads(text) for text in group["parameters"]]
        errors = np.array([[p["a1"], p["a2"], p["offset"], *p["mu[u]"], p["b0"], p["b1"]] for p in values]) - TRUTH
        bounds = np.mean([bound(int(n), int(seed)) for seed in group["seed"]], axis=0)
        ratio = np.sqrt(np.mean(errors**2, axis=0) / bounds) / sigma
        found[f"{label}, N = {n}"] = float(np.sqrt(np.mean(ratio**2)))
        print(f"{label}, N = {n}: {len(group)} seeds, RMSE over the bound {found[f'{label}, N = {n}']:.3f}")
    for n, group in rows[rows["data"] == "Table 3.1"].groupby("samples"):
        mu = 0.75 * np.array([json.loads(text)["mu[u]"] for text in group["parameters"]])
        found |= {f"cosine, N = {n}": float(np.abs(mu[:, 0::2].mean(axis=0)).max()),
                  f"spread, N = {n}": float(mu[:, 0::2].std(axis=0).max())}
        print(f"Table 3.1, N = {n}: sines {np.round(mu[:, 1::2].mean(axis=0), 4)}, largest mean cosine "
              f"{found[f'cosine, N = {n}']:.5f}, spread {found[f'spread, N = {n}']:.4f}")
    return found


if __name__ == "__main__":
    here = Path(__file__).with_suffix("")
    main(optid.Study.from_toml(here.with_suffix(".toml")), *sys.argv[1:2] or [here.with_suffix(".sqlite").name])

"""Eq. (3.22): are the models of the two bases the same? Ratios of their parts over time, and one gauge-free distance.

The dissertation regularises |x| as sqrt(x^2 + 0.1^2). As printed this loses signs, which flip inside the dead zone, and
there the ratio of the signals w = f(u) tends to one whatever the models are; the distance has neither fault.
python ch3_equivalence.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import BETA, bases, panels, recursion, run, save, table, with_style

from optid.examples import example

EPS = 0.1


def ratio(top: np.ndarray, bottom: np.ndarray, signs: bool) -> np.ndarray:
    """|top|_eps / |bottom|_eps; with the signs kept, b_0 > 0 in both models fixes theirs."""
    sign = np.where(top * bottom < 0, -1.0, 1.0) if signs else 1.0
    return sign * np.sqrt(top**2 + EPS**2) / np.sqrt(bottom**2 + EPS**2)


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return the medians of the ratios over the last 20 s in both readings, and the distance; save the curves."""
    data, u = example("dead_zone", seed=0).data, np.linspace(-1, 1, 401)
    b, w, f = {}, {}, {}
    for name, basis in bases(-1, 1).items():
        trace = recursion(data, basis).trace(data.u, data.y)
        mu, b[name], _ = trace.split(beta=BETA)
        c0 = trace.theta[:, -1, 0] / b[name].sum(axis=1)  # the offset of f, from that of the model
        w[name] = np.sum(basis.values(data.u[:, 0]) * mu, axis=1) + c0
        f[name] = mu @ basis.values(u).T + c0[:, None]
    (b_t, b_f), (w_t, w_f), (f_t, f_f) = (list(part.values()) for part in (b, w, f))
    parts = [f_t[:, :, None] * b_t[:, None], f_f[:, :, None] * b_f[:, None]]  # f(u) b_j over u and j: no gauge in it
    distance = np.linalg.norm(parts[0] - parts[1], axis=(1, 2)) / np.linalg.norm(parts[0] + 1e-30, axis=(1, 2))
    found = {"relative L2 distance of f b, at the end": float(distance[-1])}
    figure, grid = panels(1, 3)
    for panel, reading in zip(grid[0], ("as printed", "signs kept")):
        signs = reading == "signs kept"
        b0, b1 = ratio(b_f, b_t, signs).T
        curves = {"wT / wF": ratio(w_t, w_f, signs), "b0F / b0T": b0, "b1F / b1T": b1}
        for (label, curve), style in zip(curves.items(), ("k.", "-", "-")):
            panel.plot(data.time[20:], curve[20:], style, label=label, markersize=1.5)
            found[f"{label}, {reading}, median"] = float(np.median(curve[-200:]))
            found[f"{label}, {reading}, spread"] = float(np.ptp(curve[-200:]))
        panel.set(title=f"(3.22), {reading}", xlabel="time (s)", ylim=(-2.2, 2.2))
        panel.legend(loc="center right")
    grid[0, 2].semilogy(data.time[20:], distance[20:])
    grid[0, 2].set(title="distance of f(u) b", xlabel="time (s)", ylabel="relative L2 norm")
    rows = [(name, value, "close to one" if "median" in name else "bounded") for name, value in found.items()]
    table("Equivalence of the models of the two bases, last 20 s", [*rows[1:], (*rows[0][:2], "0 for equal models")])
    save(figure, folder, "ch3_equivalence.png")
    return found


if __name__ == "__main__":
    run(main)

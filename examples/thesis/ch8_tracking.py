"""Chapter 8: subspace tracking theorems, their geometry, and reconstruction after the loss of a sensor.

The chapter has no tables; a covariance with eigenvalues 5, 3, 1, 0.5, 0.3, 0.1 shows its theorems: every invariant
subspace is stationary, all but the dominant one are saddles. python ch8_tracking.py [folder for the figure]
"""

from pathlib import Path

import numpy as np
from common import panels, run, save, table, with_style

from optid import tracking as tr

VALUES, N, LOSS, STEP, LOST = np.array([5, 3, 1, 0.5, 0.3, 0.1]), 8000, 4000, 50, 2
LOSSES, CURVATURES = (1.9, 3.9, 4.4, 5.9, 6.4, 8.4), (0, -4, -5, -8, -9, -9)


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return losses, curvatures and errors; save the angles of both trackers through the loss of a sensor."""
    rng = np.random.default_rng(8)
    u = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    c, x = u * VALUES @ u.T, rng.normal(size=(N, 6)) * np.sqrt(VALUES) @ u.T
    points = tr.stationary_points(c, 2, among=range(4))
    table("J and smallest curvature at the invariant subspaces",
          [(f"eigenvectors {p.indices[0] + 1}, {p.indices[1] + 1}: {p.kind}", [p.loss, p.curvatures[0]], f"{j}, {h}")
           for p, j, h in zip(points, LOSSES, CURVATURES)])
    zero = tr.stationary_point(c, np.zeros((6, 2)))
    found = {f"J {i}": p.loss for i, p in enumerate(points)} | {"gradient at W = 0": zero.gradient}
    found |= {f"curvature {i}": p.curvatures[0] for i, p in enumerate(points)}
    x[LOSS:, LOST] = 0
    best, left = tr.optimal_reconstruction(c, 2), tr.constrained_reconstruction(c, 2, within=tr.surviving(6, [LOST]))
    figure, ((axis,),) = panels(1, 1)
    for method in ("past", "opast"):
        tracker, angles = tr.SubspaceTracker(6, 2, method=method, forgetting=0.995), []
        for start in range(0, N, STEP):
            tracker.update(x[start : start + STEP])
            angles.append(np.degrees(tracker.angles((best if start < LOSS else left).basis)[-1]))
            if start + STEP == LOSS:
                found[f"{method} error"] = np.linalg.norm(tracker.projector - best.projector)
                found[f"{method} creep"] = np.linalg.norm(tracker.W.T @ tracker.W - np.eye(2))
                found[f"{method} gap"] = tr.fantope_certificate(c, tracker.basis).relative_gap
        found[f"{method} error after"] = np.linalg.norm(tracker.projector - left.projector)
        axis.semilogy(np.arange(STEP, N + 1, STEP), angles, label=method.upper())
    table(f"Tracking: {LOSS} samples, then coordinate {LOST + 1} is lost", [
        (f"{method} {name}", found[f"{method} {name}"], text) for method in ("past", "opast")
        for name, text in (("error", "about 0.11"), ("creep", "0.002 / 0"), ("gap", "0"), ("error after", "0"))])
    print(f"\n{best}\n{left}")
    axis.set(xlabel="samples", ylabel="angle, degrees", title="to the best subspace")
    axis.legend()
    save(figure, folder, "ch8_tracking.png")
    return found


if __name__ == "__main__":
    run(main)

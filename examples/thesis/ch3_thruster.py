"""Section 3.5: a marine thruster, current to thrust, with both bases; n_b = 1, so the problem is linear.

The tank data are not public; the rig is simulated (`optid.examples.thruster`).
python ch3_thruster.py [folder for the figures]
"""

from pathlib import Path

import numpy as np
from common import bases, panels, recursion, run, save, table, with_style

import optid
from optid.examples import example


@with_style
def main(folder: Path) -> dict[str, float]:
    """Return a, b_0, output error and error of f of both bases; save output, nonlinearity and traces."""
    record, found = example("thruster", seed=0), {}
    data, true = record.data, record.truth["f"][0]
    u = np.linspace(data.u.min(), data.u.max(), 401)
    figure, grid = panels(2, 3)
    for (name, basis), (output, curve, traces) in zip(bases(u[0], u[-1]).items(), grid):
        fit = optid.fit(data, "hammerstein_arx.exact", na=2, nb=1, basis=basis, gauge="gain")
        model = fit.model
        simulated, clean = model.simulate(data, x0="fit"), record.truth["noise_free"]
        trace = recursion(data, basis, nb=1).trace(data.u, data.y)
        b0 = 1 + trace.a.sum(axis=1)  # the gauge: unit static gain
        found |= {f"{name} a1": model.a[0], f"{name} a2": model.a[1], f"{name} b0": model.b[0][0],
                  f"{name} error of f": float(np.sqrt(np.mean((model.f(u) - true(u)) ** 2))),
                  f"{name} output error": float(np.mean((data.y - simulated) ** 2)),
                  f"{name} against clean": float(np.mean((clean - simulated) ** 2)),
                  f"{name} recursive b0": b0[-1]}
        table(f"{name} basis, unit static gain, proved optimal: {fit.solution.proof}", [
            ("a", model.a, "(-1.2, 0.40)"),
            ("b_0", model.b[0], "0.2"),
            ("a, recursive", trace.a[-1], "(-1.2, 0.40)"),
            ("b_0, recursive", b0[-1], "0.2"),
            ("mean square output error (N^2)", found[f"{name} output error"], f"{np.mean((data.y - clean) ** 2):.4f}"),
            ("the same against the noise-free output", found[f"{name} against clean"], "0"),
            ("RMSE of f (N)", found[f"{name} error of f"], "")])
        output.plot(data.time, data.y, color="0.6", label="measured")
        output.plot(data.time, simulated, label="simulated", linewidth=1.0)
        output.set(title=f"{name}: thrust", xlabel="time (s)", ylabel="thrust (N)", xlim=(0, 30))
        curve.plot(u, true(u), "--", color="0.4", label="true f")
        curve.plot(u, model.f(u), label="identified f")
        curve.set(title="nonlinearity", xlabel="current (A)", ylabel="f (N)")
        for value, truth, word in zip((*trace.a.T, b0), (-1.2, 0.4, 0.2), ("a1", "a2", "b0")):
            line, = traces.plot(data.time, value, label=word)
            traces.axhline(truth, color=line.get_color(), linestyle="--", linewidth=0.8)
        traces.set(title="recursive estimates", xlabel="time (s)", ylim=(-1.6, 0.8))
        for panel in (output, curve, traces):
            panel.legend()
    save(figure, folder, "ch3_thruster.png")
    return found


if __name__ == "__main__":
    run(main)

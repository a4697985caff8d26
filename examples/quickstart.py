"""From a CSV file to a constrained model with a proof: read, fit, look, validate, save, load.

Run: python quickstart.py [folder for the figures]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

import optid
from formulations.constraints import shape
from optid.examples import example


def write_csv(path: Path) -> Path:
    """Write a simulated record of a marine thruster, in place of a file of your own."""
    rig = example("thruster").data
    columns = np.column_stack([rig.time, rig.u, rig.y])
    np.savetxt(path, columns, delimiter=",", header="time,current,thrust", comments="")
    return path


def main(folder: Path) -> dict[str, float]:
    """Return one-step fit, simulation fit on new data and the gap of the proof."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        data = optid.read(write_csv(Path(scratch) / "thruster.csv"), inputs=["current"], outputs=["thrust"], dt=0.1)
        train, test = data.split(0.7)

        fit = optid.fit(train, "hammerstein_arx.exact", na=2, nb=2, nk=0, basis=optid.Triangular(10, (-1.5, 1.5)),
                        constraints=[shape.monotone("increasing")], solver="auto")
        print(fit)

        report = optid.validate(fit.model, test)
        print(report)
        optid.plots.overview(fit, test).savefig(folder / "quickstart.png", dpi=150)

        path = fit.model.save(Path(scratch) / "thruster.json")
        again = optid.load(path).simulate(test.u)
        print("loaded model simulates the same:", np.array_equal(again, fit.model.simulate(test.u)))
    return {"one-step fit": report.one_step["thrust"].fit, "simulation fit": report.simulation["thrust"].fit,
            "gap": fit.solution.gap, "proved": float(fit.solution.proof)}


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "figures"))

"""Step tests and process models: from a dated table to gain, time constant, dead time and PI settings.

The settings are those of the SIMC rule (Skogestad, J. Process Control 13, 2003), with the interval that the record
leaves for each. Run: python step_tests.py.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import optid
from optid.models.process import ProcessModel, process_model


def record(truth: ProcessModel, u: np.ndarray, path: Path, seed: int) -> optid.Data:
    """Write a simulated step test as a table with dates, and read it as one would read an export of a historian."""
    y = truth.respond(u[:, None]) + 0.05 * np.random.default_rng(seed).normal(size=len(u))
    optid.Data(u, y, truth.dt, inputs="valve", outputs="temperature", input_units="%", output_units="K",
               start="2024-05-01T08:00").to_csv(path)
    return optid.read(path, inputs="valve", outputs="temperature")


def simc(model: Any) -> np.ndarray:
    """Return [Kc, Ti] of a PI controller for a closed loop as slow as the dead time."""
    one, gain = model.processes[0], model.nonlinearities[0].mu[0]
    closed = 2 * one.dead_time
    if one.structure.integrator:
        return np.array([1 / (gain * closed), 4 * closed])
    return np.array([one.value("tau") / (gain * closed), min(one.value("tau"), 4 * closed)])


def main() -> dict[str, float]:
    """Return what two step tests gave: of a heated stream, and of a level that integrates with a known gain."""
    t, found = 5.0 * np.arange(240), {}
    step, pulse = np.where(t >= 60, 60.0, 50.0), np.where((t >= 60) & (t < 300), 60.0, 50.0)
    heater = process_model("P1D", K=0.4, tau=150.0, dead_time=32.0, level=20.0, dt=5.0)
    tank = process_model("P1DI", K=0.01, tau=20.0, dead_time=15.0, level=20.0, dt=5.0)
    with TemporaryDirectory() as folder:
        for name, truth, u, known in (("heater", heater, step, []), ("tank", tank, pulse, ["K:0.01"])):
            data = record(truth, u, Path(folder) / f"{name}.csv", 1 + 2 * len(known))
            fit = optid.fit(data, "process.exact", process=truth.processes[0].structure.word, constraints=known)
            settings = fit.uncertainty.of(simc)
            print(fit.params, *zip(("Kc", "Ti"), settings.value, settings.lower, settings.upper), sep="\n")
            found |= {f"{name} {key}": fit.params[key].estimate for key in ("K", "tau", "dead_time")}
            found |= {f"{name} proved": float(fit.solution.proof), f"{name} Kc": float(settings.value[0])}
    return found


if __name__ == "__main__":
    main()

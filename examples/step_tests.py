"""Step tests and process models: from a dated table to gain, time constants, dead time and PI settings.

A step of a valve is recorded; the process behind it is fitted in continuous time, its type chosen where it is not
known, and a controller tuned by the SIMC rule (Skogestad, J. Process Control 13, 2003), with the interval that the
record leaves for every setting. Run: python step_tests.py.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import optid
from optid.models.process import ProcessModel, process_model

RANGES = {"valve": 100.0, "temperature": 200.0}  # of the transmitters, in % and K


def record(truth: ProcessModel, u: np.ndarray, path: Path, seed: int) -> optid.Data:
    """Write a simulated step test as a table with dates, and read it as one would read an export of a historian."""
    y = truth.respond(u[:, None]) + 0.05 * np.random.default_rng(seed).normal(size=len(u))
    optid.Data(u, y, truth.dt, inputs="valve", outputs="temperature", input_units="%", output_units="K",
               start="2024-05-01T08:00").to_csv(path)
    return optid.read(path, inputs="valve", outputs="temperature")


def simc(model: Any) -> np.ndarray:
    """Return [Kc, Ti] of a PI controller for closed-loop time constants equal to the dead time, [Kc, Ti, Td] of a PID.

    Of two time constants the second one is the derivative time of a PID controller in series form.
    """
    one, gain = model.processes[0], model.nonlinearities[0].mu[0]
    closed = 2 * one.dead_time
    if one.structure.integrator:
        return np.array([1 / (gain * closed), 4 * closed])
    taus = one.p[: one.structure.real]
    settings = [taus[0] / (gain * closed), min(taus[0], 4 * closed), *taus[1:2]]
    return np.array(settings)


def tuned(fit: optid.Fit) -> np.ndarray:
    """Print the settings of a controller with 95 % intervals, and return them."""
    found = fit.uncertainty.of(simc)
    for name, value, low, high in zip(("Kc", "Ti", "Td"), found.value, found.lower, found.upper):
        print(f"  {name} = {value:.3g} (95 %: {low:.3g} to {high:.3g}) {'%/K' if name == 'Kc' else 's'}")
    return found.value


def main() -> dict[str, float]:
    """Return what the three step tests gave."""
    t, found = 5.0 * np.arange(240), {}
    step, pulse = np.where(t >= 60, 60.0, 50.0), np.where((t >= 60) & (t < 300), 60.0, 50.0)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "step.csv"

        # one time constant and dead time: proved to be the best of all
        first = process_model("P1D", K=0.4, tau=150.0, dead_time=32.0, level=20.0, dt=5.0)
        fit = optid.fit(record(first, step, file, 1), "process.exact", process="P1D")
        print(fit)
        share = fit.params["K"].estimate * RANGES["valve"] / RANGES["temperature"]
        print(f"the gain is {100 * share:.3g} % of the range of the temperature for 100 % of that of the valve")
        settings = tuned(fit)
        found |= {"K": fit.params["K"].estimate, "tau": fit.params["tau"].estimate,
                  "dead time": fit.params["dead_time"].estimate, "proved": float(fit.solution.proof), "Kc": settings[0]}

        # a type that is not known: compared by the Bayesian information criterion
        second = process_model("P2D", K=0.4, tau1=150.0, tau2=40.0, dead_time=32.0, level=20.0, dt=5.0)
        fit = optid.fit(record(second, step, file, 2), "process.exact", order="auto")
        print(f"\n{fit.figures['process type']}: {fit.model}")
        settings = tuned(fit)
        found |= {"two time constants": float(fit.model.orders == {"process": "P2D"}), "Ti": settings[1]}

        # a level that integrates, with a gain that is known from the area of the tank
        tank = process_model("P1DI", K=0.01, tau=20.0, dead_time=15.0, level=20.0, dt=5.0)
        fit = optid.fit(record(tank, pulse, file, 3), "process.exact", process="P1DI", constraints=["K:0.01"])
        print(f"\n{fit.model}\nprice of the gain: {fit.prices[0].fit_points:.3g} points of fit per unit")
        settings = tuned(fit)
    return {**found, "integrator Kc": settings[0], "integrator Ti": settings[1]}


if __name__ == "__main__":
    main()

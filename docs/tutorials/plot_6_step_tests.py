"""
Step tests and process models
=============================

From a dated table of one step to gain, time constant and dead time in seconds, and to the settings of a controller.
"""

# %%
# A valve is opened from 50 to 60 %. What a historian exports is a table with dates, here one that optid writes itself.
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import optid
from optid.models.process import process_model

truth = process_model("P1D", K=0.4, tau=150.0, dead_time=32.0, level=20.0, dt=5.0)
valve = np.where(np.arange(240) < 12, 50.0, 60.0)
noise = 0.05 * np.random.default_rng(1).normal(size=240)
temperature = truth.respond(valve[:, None]) + noise
with TemporaryDirectory() as folder:
    table = Path(folder) / "step.csv"
    optid.Data(valve, temperature, 5.0, "valve", "temperature",
               ["%"], ["K"], start="2024-05-01T08:00").to_csv(table)
    data = optid.read(table, inputs="valve", outputs="temperature")
data

# %%
# A process with one time constant and dead time ("P1D", as procest calls it). The dead time need not be a multiple of
# the sampling time, and the proof says that no other time constant and dead time fit better.
fit = optid.fit(data, "process.exact", process="P1D")
fit.dynamics

# %%
# Where the type is not known, ``order="auto"`` compares types by the Bayesian information criterion.
auto = optid.fit(data, "process.exact", order="auto")
auto.figures["process type"]


# %%
# Historians store a value when it changes, and loggers jitter. A process is exact at any times: those of the samples
# are handed over with them, or kept by ``optid.read(..., gaps="stamps")``, which ``optid fit`` does by itself.
kept = np.sort(np.random.default_rng(2).permutation(240)[:150])
late = optid.Data(valve[kept], temperature[kept], 5.0, "valve", "temperature", ["%"], ["K"],
                  times=5.0 * kept)
optid.fit(late, "process.exact", process="P1D").dynamics

# %%
# With several outputs there is a process for every pair of input and output, ``None`` where an input has no effect:
# ``process=[["P1D", "P1"], ["P2", None]]``, or ``--process P1D,P1,P2,none``. Words name the pair:
# ``"tau:high=60,channel=valve,output=level"``.

# %%
# A PI controller by the SIMC rule (Skogestad 2003), for a closed loop as slow as the dead time. The uncertainty of the
# model is that of the settings, too.
def simc(model):
    """Return gain and integral time."""
    process, gain = model.processes[0], model.nonlinearities[0].mu[0]
    tau, closed = process.value("tau"), 2 * process.dead_time
    return np.array([tau / (gain * closed), min(tau, 4 * closed)])


settings = fit.uncertainty.of(simc)
rows = zip(["gain, %/K", "integral time, s"], settings.value, settings.lower, settings.upper)
for name, value, low, high in rows:
    print(f"{name}: {value:.3g} (95 %: {low:.3g} to {high:.3g})")

# %%
# State what you know in the terms of the plant: here the gain, from a balance. The dead time becomes sharper.
known = optid.fit(data, "process.exact", process="P1D", constraints=["K:0.4"])
known.dynamics

# %%
# The step, what the model makes of it, and its response; ``model.to_fmu``, ``to_st`` and ``to_c`` take it elsewhere.
figure = fit.plot()

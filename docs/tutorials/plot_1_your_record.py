"""
Your own record
===============

From a table with dates to a model that you can trust.
"""

# %%
# A table has a column of instants and columns of numbers; an empty field is a missing sample. This one, which
# ``optid look --example heater --csv heater.csv`` writes too, is of an electric heater.
from pathlib import Path
from tempfile import mkdtemp

import optid
from optid.examples import example

table = Path(mkdtemp()) / "heater.csv"
example("heater").data.to_csv(table)
print(*table.read_text().splitlines()[:5], sep="\n")

# %%
# The sampling time follows from the instants. What the record can tell is examined before any model is fitted: here
# that the temperature answers four samples late.
data = optid.read(table, inputs=["heater"], outputs=["temperature"])
data

# %%
# Keep the last part for validation, and let optid find the structure. The page of the fit leads with the verdict.
train, test = data.split(0.7)
found = optid.identify(train, effort="small", workers=1)
found

# %%
# Validate on the part that was held out. Errors of a simulation are coloured where noise acts on the plant itself; the
# standard errors account for it, and the verdict passes.
found.fit.validate(test)

# %%
# Where will measurements lie? The interval of a simulation accounts for the uncertain parameters and for the noise.
band = found.fit.simulate(test, interval=0.95)
inside, samples = band.counts_inside(test.y)
print(f"{inside[0]} of {samples[0]} samples inside; standard deviations of the parameters and of the noise up to "
      f"{band.parameters.max():.2f} and {band.noise.max():.2f} degC")

# %%
# A figure for a paper, with that interval; ``found.report("heater.html", test)`` writes the interactive page.
figure = found.plot(test)

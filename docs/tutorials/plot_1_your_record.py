"""
Your own record
===============

From columns of numbers to a model that you can trust.
"""

# %%
# A record consists of inputs, outputs and a sampling time; NaN means missing. Here it is a tank whose valve saturates.
import numpy as np

import optid

rng = np.random.default_rng(1)
valve = np.repeat(rng.uniform(0, 1, 160), 5)
level = np.zeros(valve.size)
for k in range(1, valve.size):
    level[k] = 0.9 * level[k - 1] + 0.4 * np.tanh(2 * valve[k - 1]) + 0.01 * rng.standard_normal()
data = optid.Data(valve, level, 1.0, ["valve"], ["level"], ["-"], ["m"], name="tank")
data

# %%
# Keep the last part for validation, and let optid find the structure.
train, test = data.split(0.7)
found = optid.identify(train, effort="small", workers=1)
found

# %%
# Validate on the part that was held out.
found.fit.validate(test)

# %%
# Where will measurements lie? The interval of a simulation accounts for the uncertain parameters and for the noise.
band = found.fit.simulate(test, interval=0.95)
inside, samples = band.counts_inside(test.y)
print(f"{inside[0]} of {samples[0]} samples inside; standard deviations of the parameters and of the noise up to "
      f"{band.parameters.max():.3f} and {band.noise.max():.3f} m")

# %%
# A figure for a paper, with that interval; ``found.report("tank.html", test)`` writes the interactive page.
figure = found.plot(test)

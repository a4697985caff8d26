"""
A constraint, a quantity, a controller of your own
==================================================

What the library does not have is a function away.
"""

# %%
# A constraint is a function of the named variables of a formulation.
import numpy as np

import optid
from optid.examples import example

data = example("thruster").data
fit = optid.fit(data, na=2, nb=1, basis="triangular:8",
                constraints=["monotone:increasing", lambda v: {"slow": v["a"][0] + v["a"][1] <= -0.7}])
print(*(f"{p.name}: {'active' if p.binding else 'not active'}" for p in fit.prices), sep="\n")

# %%
# Any function of the model has an interval.
free = optid.fit(data, na=2, nb=1, basis="bspline:6")
gain = free.uncertainty.of(lambda model: model.static_gain(0.5))
print(f"static gain at 0.5: {float(gain.value):.2f}, 95 % from {float(gain.lower):.2f} to {float(gain.upper):.2f}")

# %%
# The model goes to other tools: CasADi for predictive control, C for a loop on a microcontroller.
step = free.model.to_casadi()
x, y = step(np.zeros(step.size1_in(0)), 0.4)
assert abs(float(y) - free.simulate(np.array([0.4]))[0]) < 1e-12

# %%
# A formulation and a solver are one file each: see ``CONTRIBUTING.md``.

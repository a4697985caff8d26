"""
Your own constraint, quantity and controller
============================================

If the library lacks something you need, pass a function.
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
# optid gives an interval for any function of the model.
free = optid.fit(data, na=2, nb=1, basis="bspline:6")
gain = free.uncertainty.of(lambda model: model.static_gain(0.5))
print(f"static gain at 0.5: {float(gain.value):.2f}, 95 % from {float(gain.lower):.2f} to {float(gain.upper):.2f}")

# %%
# Export the model to other tools: CasADi for predictive control, C for a loop on a microcontroller.
step = free.model.to_casadi()
x, y = step(np.zeros(step.size1_in(0)), 0.4)
assert abs(float(y) - free.simulate(np.array([0.4]))[0]) < 1e-12

# %%
# What the constraint leaves of the free function, and the verdict: all tests pass, the fit is that of a fair model.
print(fit.verdict.word, fit.verdict.failed)
figure = optid.plots.bode(fit)

# %%
# To add a formulation or a solver, write one file: see ``CONTRIBUTING.md``.

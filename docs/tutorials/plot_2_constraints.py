"""
Constraints and their price
===========================

What is known about a plant makes a model better where data are few; every constraint reports what it costs.
"""

# %%
# The thruster is known to push harder with more current, and not to push without.
import optid
from optid.examples import example

data = example("thruster").data
fit = optid.fit(data, na=2, nb=1, basis="triangular:10", constraints=["monotone:increasing", "odd"])
for price in fit.prices:
    print(price.name, "active" if price.binding else "not active")

# %%
# The parameters with their intervals, which stay valid under active constraints.
fit.params

# %%
# Constraints that contradict each other are explained by a smallest conflicting subset.
try:
    optid.fit(data, na=2, nb=1, basis="triangular:10", constraints=["gain:3", "range:-1,1", "monotone:increasing"])
except optid.errors.InfeasibleError as error:
    print(error)

# %%
figure = optid.plots.nonlinearity(fit)

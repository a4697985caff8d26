"""
Constraints and their price
===========================

Prior knowledge of the plant improves the model where data are scarce; every constraint reports what it costs.
"""

# %%
# More current is known to give more thrust, and the characteristic to be odd.
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

# %%
# All tests of the verdict pass. The model is called fair, not good, since its free run explains less than 85 % of the
# outputs: noise that acts on the thruster itself is amplified on the way.
print(fit.verdict.word, fit.verdict.failed)

"""
Several channels in closed loop
===============================

A subspace method finds a state-space model without a starting point; an exact fit refines it.
"""

# %%
# Two inputs, two outputs, and a controller that feeds the second output back.
import numpy as np

import optid

rng = np.random.default_rng(0)
n = 1200
A = np.array([[0.8, 0.2, 0.0], [-0.2, 0.7, 0.1], [0.0, 0.1, 0.5]])
B, C = np.array([[1.0, 0.2], [0.0, 0.5], [0.3, -1.0]]), np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.2]])
x, u, y = np.zeros(3), rng.uniform(-1, 1, (n, 2)), np.zeros((n, 2))
for k in range(n):
    y[k] = C @ x + 0.05 * rng.standard_normal(2)
    u[k, 1] -= 0.2 * y[k, 1]
    x = A @ x + B @ np.tanh(u[k])
data = optid.Data(u, y, 1.0, ["steam", "feed"], ["pressure", "level"])

# %%
study = optid.order(data)
print("states:", study.nx)

# %%
# Past inputs and outputs are instruments, which remain valid in closed loop.
fit = optid.fit(data, "hammerstein_ss.asivid", nx=3, basis="polynomial:3")
print("free run, fit in %:", fit.simulation_fit.round(1))
print(*(f"{part.name}: {part.outcome}" for part in fit.verdict.parts), sep="\n")

# %%
figure = optid.plots.poles_and_response(fit)

"""
Hard data: missing samples, outliers, several experiments
=========================================================

Records with gaps and outliers can be used as they are: optid checks them before it solves anything.
"""

# %%
# Two experiments of unequal length; some outputs are missing, some are outliers.
import numpy as np

import optid

rng = np.random.default_rng(3)


def run(n):
    """Return inputs and outputs of a plant with a cubic characteristic."""
    u, y = rng.uniform(-1, 1, n), np.zeros(n)
    for k in range(1, n):
        y[k] = 0.7 * y[k - 1] + u[k - 1] + u[k - 1] ** 3 + 0.05 * rng.standard_normal()
    y[rng.integers(0, n, n // 20)] = np.nan
    return u, y


(u1, y1), (u2, y2) = run(300), run(180)
y1[[50, 171]] = 30.0
data = optid.Data([u1, u2], [y1, y2], 0.1)
data

# %%
# The Huber loss leaves out the rows that contain an outlier in an output, and names them.
fit = optid.fit(data, na=1, nb=1, nk=1, basis="polynomial:3", loss="huber")
print(*fit.findings, sep="\n")

# %%
fit.params

# %%
# The verdict counts neither missing samples nor the outliers that the loss has left out.
figure = optid.plots.fit_over_time(fit)
print(*(f"{part.name} {part.value}: {part.outcome}" for part in fit.verdict.parts), sep="\n")

# %%
# Files larger than memory are read in one pass: ``optid.fit(optid.open_stream("big.csv", ...), ...)`` takes the same
# arguments. The accumulated sums agree to the last digits on one core and on a cluster.

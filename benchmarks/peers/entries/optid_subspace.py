"""optid, subspace method alone: the task of SLICOT, SIPPY and nfoursid."""

import numpy as np

import optid
from optid.statistics.hankel import hankel_statistics
from optid.statistics.rq import rq

CANNOT = {"hammerstein": "the first entry answers it", "missing": "the first entry answers it",
          "constrained": "the first entry answers it"}


def state_space(r):
    fit = optid.fit(optid.Data(u=r["u"], y=r["y"]), "hammerstein_ss.sid", nx=r["nx"], block_rows=r["block_rows"],
                    offset=False, feedthrough=False)
    # the gain of the noise is estimated, by maximum likelihood, when the model is first asked for
    return {"later": lambda: fit.model, "one_step": lambda u, y: fit.model.predict(optid.Data(u=u, y=y)),
            "simulate": lambda u, y: fit.model.simulate(u)}


def projected(r):
    """The subspace step alone, without a model: statistics, triangular factor and singular values."""
    rows, m, width = r["block_rows"], r["u"].shape[1], r["u"].shape[1] + r["y"].shape[1]
    statistics = hankel_statistics([np.hstack([r["u"], r["y"]])], 2 * rows)
    past, future = range(rows), range(rows, 2 * rows)
    inputs = statistics.at(range(m), future)
    instruments = np.concatenate([inputs, statistics.at(range(width), past)])
    return {"values": rq(statistics, instruments, inputs, statistics.at(range(m, width), future)).decomposition[1]}

"""State-space models with states as variables: the optima of the descents, constraints on courses, refusals."""

import numpy as np
import pytest
from state_systems import linear

import optid
from formulations import state_shooting
from optid.bases import Polynomial
from optid.data.record import Data
from optid.errors import DataError, OptidError, RankError, StructureError
from optid.models import HammersteinSS, Nonlinearity
from optid.program.solution import Status

CUBE = Nonlinearity(Polynomial(3, interval=(-1.0, 1.0)), np.array([0.9, 0.3, 0.2]))
BEND = Nonlinearity(Polynomial(2, interval=(-6.0, 6.0), outside="extrapolate"), np.array([0.2, -1.0]))
CURVE = Nonlinearity(Polynomial(3, interval=(-2.0, 2.0), outside="extrapolate"), np.array([0.0, 0.4, 0.2]))
PLAIN = {"A": [[0.8, 0.3], [-0.3, 0.6]], "B": [[1.0], [0.5]], "C": [[1.0, 0.4]], "D": [[0.2]]}
PLANTS = {
    "hammerstein": HammersteinSS(**PLAIN, nonlinearities=(CUBE,)),
    "feedback": HammersteinSS(**PLAIN, nonlinearities=(CUBE,), E=[[0.2], [0.1]], feedback=(BEND,), output_of=(0,)),
    "latent": HammersteinSS(**PLAIN, latent=(CURVE,), Ez=[[0.5], [0.2]], Cz=[[0.3, 0.2]], Dz=[[0.3]], Fz=[[0.0]],
                            offset_z=[0.1]),
    "two by two": linear(n=2),
}
CASES = {
    "hammerstein": ("hammerstein_ss", {"nx": 2}),
    "feedback": ("hammerstein_ss", {"nx": 2, "feedback_basis": Polynomial(2, outside="extrapolate")}),
    "latent": ("lfr", {"nx": 2}),
    "two by two": ("ss", {"nx": 2}),
}


def record(name, counts=(300,), noise=0.05, gaps=0.0, seed=0):
    rng, model, us, ys = np.random.default_rng(seed), PLANTS[name], [], []
    for count in counts:
        u = rng.uniform(-1, 1, (count, model.m))
        y = model.simulate(u, x0=np.zeros(model.nx))
        y = y + noise * y.std(axis=0) * rng.standard_normal(y.shape)
        y[rng.uniform(size=y.shape) < gaps] = np.nan
        us.append(u)
        ys.append(y)
    return Data(us, ys) if len(counts) > 1 else Data(us[0], ys[0])


def same(data, case, solver="ipopt", **changes):
    name, options = CASES[case]
    ours = optid.fit(data, f"{name}.shooting", solver=solver, **(options | changes))
    theirs = optid.fit(data, f"{name}.exact", **options)
    assert ours.solution.status in (Status.LOCAL, Status.OPTIMAL), ours.solution.reason
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-6)
    found, expected = (fit.model.simulate(data, x0="fit") for fit in (ours, theirs))
    for one, other in zip(*((run if isinstance(run, tuple) else (run,)) for run in (found, expected))):
        assert one == pytest.approx(other, abs=1e-6 * np.abs(other).max())
    return ours, theirs


@pytest.mark.parametrize("case", CASES)
def test_ipopt_finds_the_optimum_of_the_descents(case):
    same(record(case), case)

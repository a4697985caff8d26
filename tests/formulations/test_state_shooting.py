"""State-space models with states as variables: the optima of the descents, constraints on courses, refusals."""

import warnings

import numpy as np
import pytest
from state_systems import linear

import optid
from formulations.constraints.poles import stable
from optid.bases import Polynomial
from optid.data.record import Data
from optid.errors import DataError, OptidError, RankError, StructureError
from optid.identify.uncertainty import uncertainty
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
    "two by two": linear(n=2)}
CASES = {"hammerstein": ("hammerstein_ss", {"nx": 2}),
         "feedback": ("hammerstein_ss", {"nx": 2, "feedback_basis": Polynomial(2, outside="extrapolate")}),
         "latent": ("lfr", {"nx": 2}),
         "two by two": ("ss", {"nx": 2})}


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


@pytest.mark.sampled(3)
@pytest.mark.parametrize("case", CASES)
def test_ipopt_finds_the_optimum_of_the_descents(case):
    same(record(case), case)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.filterwarnings("ignore:The functions of latent signals have no significant effect")
def test_subspace_starts_without_a_descent(case):
    data = record(case, noise=0.5, seed=1)
    name, options = CASES[case]
    weights = {"weighting": "scale"}
    ours = optid.fit(data, f"{name}.shooting", solver="ipopt", iterations=0, **options, **weights)
    theirs = optid.fit(data, f"{name}.exact", **options, **weights)
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-6)
    assert ours.problem.unit * ours.problem.value(ours.problem.start) > (1 + 1e-9) * ours.solution.objective


@pytest.mark.sampled(1)
@pytest.mark.parametrize("weighting", ["auto", "determinant"])
def test_gaps_and_several_experiments(weighting):
    data = record("two by two", (200, 150), noise=0.2, gaps=0.1)
    options = {"nx": 2, "weighting": weighting}
    ours = optid.fit(data, "ss.shooting", solver="ipopt", **options)
    theirs = optid.fit(data, "ss.exact", **options)
    assert ours.solution.objective == pytest.approx(theirs.solution.objective, rel=1e-6)
    assert ours.values["states[2]"].shape == (150, 2)
    for i, (one, other) in enumerate(zip(ours.model.simulate(data, x0="fit"), theirs.model.simulate(data, x0="fit"))):
        assert one == pytest.approx(other, abs=1e-5 * np.abs(other).max())
        course = ours.problem.named_quantities(ours.solution.values)[f"output[{i + 1}]"]
        assert course[60:] == pytest.approx(one[60:], abs=1e-5 * np.abs(one).max())  # where initial states play no part


@pytest.mark.parametrize("solver", ["uno", "fatrop"])
def test_other_back_ends(solver):
    if not optid.backends.back_ends()[solver].installed:
        pytest.skip(f"{solver} is not installed")
    same(record("hammerstein", (80,)), "hammerstein", solver)


def test_standard_errors_are_those_of_the_reduced_fit():
    ours, theirs = same(record("hammerstein"), "hammerstein")
    for quantity in (lambda model: np.abs(model.poles), lambda model: model.simulate(np.full((5, 1), 0.5))):
        one, other = (uncertainty(fit).of(quantity) for fit in (ours, theirs))
        assert one.error == pytest.approx(other.error, rel=1e-3, abs=1e-9)


def test_courses_are_in_units_of_the_record():
    data = record("hammerstein")
    data = Data(data.u, 100.0 + 40.0 * data.y)
    free = optid.fit(data, "hammerstein_ss.shooting", solver="ipopt", nx=2)
    first = float(free.problem.named_quantities(free.solution.values)["output"][0, 0])
    assert first == pytest.approx(free.model.simulate(data, x0="fit")[0, 0], rel=1e-6)


def test_a_start_that_grows_and_an_integrator_are_named():
    rng = np.random.default_rng(0)
    u, y = rng.uniform(-1, 1, 120), np.zeros(120)
    for k in range(1, 120):
        y[k] = 1.03 * y[k - 1] + u[k - 1]
    fit = optid.fit(Data(u, y), "ss.shooting", nx=1, solver="ipopt", raises=False)
    assert fit.solution.status is not Status.LOCAL or fit.model.is_stable
    fit = optid.fit(Data(u, y), "ss.shooting", nx=1, stability="free", solver="ipopt", raises=False)
    assert fit.solution.status is Status.LOCAL and abs(fit.model.poles[0]) == pytest.approx(1.03, abs=1e-6)


def test_refusals():
    data = record("hammerstein", (150,))
    lost = data.u.copy()
    lost[::2] = np.nan

    def refused(error, match, data=data, name="hammerstein_ss.shooting", **changes):
        with pytest.raises(error, match=match), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            optid.fit(data, name, solver="ipopt", **({"nx": 2} | changes))

    long = np.random.default_rng(0).uniform(-1, 1, (6000, 1))
    refused(StructureError, "6000 samples.*up to 5000.*'hammerstein_ss.exact'", Data(long, long))
    refused(DataError, "stretch|missing", Data(lost, data.y))
    refused(RankError, "samples for|needed", Data(data.u[:12], data.y[:12]))
    refused(OptidError, "samples|states|rows", nx=60)
    refused(DataError, "constant", Data(np.ones((150, 1)), data.y))
    refused(StructureError, "weighting", weighting="heavy")
    refused(StructureError, "stability", stability="maybe")
    refused(StructureError, "asks for 'state'.*states", constraints=[lambda v: v["state"] <= 1])
    refused(StructureError, "about poles.*hammerstein_ss.exact", constraints=[stable(0.9)])
    refused(StructureError, "triangular basis.*no formula", feedback_basis="triangular:4")
    refused(OptidError, ".", constraints=[lambda v: {"up": v["A"][0, 0] >= 1, "down": v["A"][0, 0] <= -1}])
    refused(StructureError, "nonnegative integer", iterations=-1)

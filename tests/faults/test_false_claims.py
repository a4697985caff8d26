"""A zoo of solvers that lie about the programmes of real formulations: none is believed, and no error is bare."""

from collections import Counter

import numpy as np
import pytest
from fault_plants import LOAD, record
from scipy.signal import lfilter
from test_fault_injection import small
from test_reformulation import ONSET, broken_record, damaged, plant
from zoo import anything

import optid
from formulations.faults.refit import actuator, parameters
from optid.backends import Answer, BackEnd
from optid.backends.choice import choose
from optid.core.statement import for_solvers
from optid.errors import OptidError
from optid.faults import (
    Fault,
    allocate,
    dictionary,
    membership,
    profile,
    scan,
    signature_estimate,
    thresholds,
    whiten,
)
from optid.faults.repair.refitting import refitting
from optid.program.solution import Status
from optid.solving import solve as solving

CLASSES = frozenset({"LP", "QP", "SOCP", "SDP", "conic", "NLP"})
BASIS = optid.Triangular(4)
ORDERS = {"na": 2, "nb": 2}
STATES = {"nx": 2, "block_rows": 8}


def above(view):
    return {"above": view["a"][0] >= -1.0}


FITS = {
    "arx": ("arx", ORDERS), "arx, a": ("arx", {**ORDERS, "constraints": [above]}),
    "exact, monotone": ("hammerstein_arx.exact", {**ORDERS, "basis": BASIS, "constraints": ["monotone:increasing"]}),
    "nuclear, a": ("hammerstein_arx.nuclear", {**ORDERS, "basis": BASIS, "weight": 2.0, "constraints": [above]}),
    "nuclear": ("hammerstein_arx.nuclear", {**ORDERS, "basis": BASIS, "weight": 2.0}),
    "exact": ("hammerstein_arx.exact", {**ORDERS, "basis": BASIS}),
    "state space, radius": ("ss.exact", {**STATES, "constraints": ["stable:0.5"]}),
    "output error, radius": ("oe.exact", {**ORDERS, "nk": 1, "constraints": ["stable:0.7"]}),
    "output error, monotone": ("hammerstein_oe.exact", {**ORDERS, "nk": 1, "basis": BASIS,
                                                        "constraints": ["monotone:increasing"]}),
    "state space, monotone": ("hammerstein_ss.exact", {**STATES, "basis": BASIS,
                                                       "constraints": ["monotone:increasing"]}),
    "subspace, radius": ("hammerstein_ss.sid", {**STATES, "basis": BASIS, "constraints": ["stable:0.5"]}),
    "shooting": ("hammerstein_oe.shooting", {**ORDERS, "nk": 1, "basis": BASIS}),
}


def honest(program, settings):
    return choose(program)[0].run(program, settings)


def altered(point=lambda v: v, duals=lambda d: d, status=Status.OPTIMAL):
    """A solver that changes an honest answer."""
    def run(program, settings):
        answer = honest(program, settings)
        return Answer(status, "solved", {k: point(np.asarray(v)) for k, v in answer.values.items()},
                      {k: duals(np.asarray(d)) for k, d in answer.duals.items()} if duals else {})

    return run


def saying(status, values=None, duals=None):
    return lambda program, settings: Answer(status, "it says so", values or {}, duals or {})


LIARS = {
    "half, no number as multiplier": altered(lambda v: 0.5 * v, lambda d: np.nan * d),
    "half, multipliers zero": altered(lambda v: 0.5 * v, lambda d: 0.0 * d),
    "half, none": altered(lambda v: 0.5 * v, None),
    "zero": altered(lambda v: 0.0 * v), "zero, none": altered(lambda v: 0.0 * v, None),
    "off by 1 %": altered(lambda v: 1.01 * v), "off by 1 %, none": altered(lambda v: 1.01 * v, None),
    "off, locally": altered(lambda v: 0.9 * v, status=Status.LOCAL),
    "off, nearly": altered(lambda v: 0.9 * v, status=Status.INACCURATE),
    "off, stopped": altered(lambda v: 0.9 * v, status=Status.LIMIT),
    "not finite": altered(lambda v: np.nan * v), "infinite": altered(lambda v: np.full_like(v, np.inf)),
    "complex": altered(lambda v: 1j * v), "words": altered(lambda v: "many"),
    "other shape": altered(lambda v: np.ones(7)),
    "huge multipliers": altered(duals=lambda d: np.full_like(d, 1e12)), "other sign": altered(duals=lambda d: -d),
    "multipliers of another shape": altered(duals=lambda d: np.ones(3)),
    "infeasible": saying(Status.INFEASIBLE), "unbounded": saying(Status.UNBOUNDED), "no point": saying(Status.OPTIMAL),
    "start": lambda program, settings: Answer(Status.OPTIMAL, "solved", dict(program.start)),
    "further variable": lambda program, settings: Answer(
        Status.OPTIMAL, "solved", {**altered(lambda v: 0.9 * v)(program, settings).values, "more": np.ones(2)}),
    "nothing": lambda program, settings: None,
    "list": lambda program, settings: Answer(Status.OPTIMAL, "solved", [1.0]),
    "word as status": lambda program, settings: Answer("optimal", "solved", honest(program, settings).values),
    "raises": lambda program, settings: 1 / 0,
}


def bent_record():
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 200)
    return optid.Data(u, lfilter([0, 1], [1, -1.2, 0.4], np.tanh(2 * u)) + 0.3 * rng.standard_normal(200))


@pytest.mark.sampled(4)
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning", "ignore::RuntimeWarning", "ignore:Casting complex")
@pytest.mark.parametrize("fit", FITS)
def test_no_lie_is_believed(fit):
    name, arguments = FITS[fit]
    data = bent_record()
    best = optid.fit(data, name, **arguments).solution.objective
    takes = None if "constraints" in arguments else anything
    for liar, run in LIARS.items():
        try:
            found = optid.fit(data, name, **arguments, raises=False,
                              solver=BackEnd("liar", CLASSES, run, takes=takes)).solution
        except OptidError:
            continue
        assert found.status not in (Status.INFEASIBLE, Status.UNBOUNDED), liar
        if found.status in (Status.OPTIMAL, Status.LOCAL):
            assert found.objective <= best * (1 + 1e-5), liar


RISING = {"constraints": ["monotone:increasing"]}
STEPS = {**FITS, **{f"{name} {' '.join(more.get('constraints', ()))}": (name, more) for name, more in (
    ("hammerstein_arx.exact", {**ORDERS, "basis": BASIS, "constraints": ["odd", "gain:low=1"]}),
    ("hammerstein_arx.exact", {**ORDERS, "basis": BASIS, "constraints": ["stable:0.6"]}),
    ("hammerstein_arx.nuclear", {**ORDERS, "basis": BASIS, "weight": 2.0, **RISING}),
    ("hammerstein_arx.overparametrised", {**ORDERS, "basis": BASIS, **RISING}),
    ("fir", {"nb": 10}), ("fir", {"nb": 6, "constraints": ["gain:low=1"]}),
    ("subspace.nuclear", {"nx": 2, "block_rows": 5}),
    ("hammerstein_ss.sid", {**STATES, "basis": BASIS, **RISING}),
    ("hammerstein_ss.asivid", {**STATES, "basis": BASIS, "constraints": ["stable:0.6"]}),
    ("hammerstein_ss.exact", {**STATES, "basis": BASIS, "constraints": ["disc:0.4,0.3", "odd"]}),
    ("hammerstein_ss.exact", {**STATES, "basis": BASIS, "constraints": ["range:low=-2,high=2"]}),
    ("armax.exact", {**ORDERS, "nc": 1, "nk": 1, "constraints": ["gain:low=6"]}),
    ("bj.exact", {**ORDERS, "nc": 1, "nd": 1, "nk": 1, "constraints": ["stable:0.6"]}),
    ("hammerstein_ss.shooting", {"nx": 2, "basis": BASIS}),
    ("physical", {"equations": optid.Equations(
        lambda v: {"x": v["a"] * v["x"] + v["b"] * v["u"], "y": v["x"]}, {"x": 0.5}, {"a": 0.5, "b": 1.0},
        time="discrete")}))}}


def searched(fault, count, **kinds):
    found = dictionary(small(), process={"load": LOAD}, **kinds)
    data = record(found.model, 1, fault, 0.0, count)
    return found, scan(found, whiten(found.model, data, x0="zero"), data.u)


def signature(**how):
    found, window = searched([Fault.step("sensor:y1", 10, 0.9), Fault.step("actuator:u2", 25, 1.5)], 40)
    signature_estimate(window, thresholds(found, 40, draws=5000), **how)


def course(prior, **how):
    profile(searched(Fault.step("sensor:y1", 20, 1.5), 60, kinds=["bias", "loss", "stuck", "noise"])[1], "sensor:y1",
            prior, **how)


def refit(state, **how):
    healthy = plant()
    data = broken_record(healthy, Fault.loss("actuator:u2", ONSET, 0.5), seed=1, count=ONSET + 30)
    solving.run(state(refitting(healthy, data, damaged(1)), **how))


FAULTS = {
    "signature": signature, "course": lambda: course("tv"), "course, sign": lambda: course("tv", sign="positive"),
    "signature, sign": lambda: signature(constraints=[lambda view: {"above": view["a[sensor:y1]"] >= 0.0}]),
    "trend": lambda: course("trend"), "walk": lambda: course("smooth"),
    "refit": lambda: refit(actuator),
    "refit, free": lambda: refit(actuator, constraints=[]), "parameters": lambda: refit(parameters),
    "membership": lambda: membership(small(), record(small(), 1, (), 0.0, 40), 3.0),
    "allocation": lambda: allocate(plant()).attainable([1.0, 1.0]),
    "allocation, NLP": lambda: allocate(plant(), route="nlp").attainable([1.0, 1.0]),
}
QUICK = ("allocation, NLP", "covariance", "fir ", "hammerstein_arx.exact odd gain:low=1")


@pytest.mark.sampled(4)
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning", "ignore::RuntimeWarning", "ignore:Casting complex")
@pytest.mark.parametrize("case", sorted({**STEPS, **FAULTS}, key=lambda case: case not in QUICK))
def test_no_lie_about_a_programme_of_a_procedure_is_believed(case, monkeypatch):
    """Every programme that a procedure poses goes to the liars, too, before the procedure goes on with the honest."""
    honestly, seen = solving.solve, Counter()

    def judged(problem, solver="auto", **settings):
        program = for_solvers(problem)
        best = honestly(program, solver, **settings)
        seen[program.name] += 1
        for liar, run in LIARS.items() if seen[program.name] <= 2 and best.has_point else ():
            try:
                found = honestly(program, BackEnd("liar", CLASSES, run, takes=anything), **settings)
            except OptidError:
                continue
            assert found.status not in (Status.INFEASIBLE, Status.UNBOUNDED), (program.name, liar)
            if found.status in (Status.OPTIMAL, Status.LOCAL):
                near = 1e-5 * abs(best.objective) + 1e-8 * found.scale
                assert found.objective <= best.objective + near, (program.name, liar)
        return best

    monkeypatch.setattr(solving, "solve", judged)
    if case in FAULTS:
        FAULTS[case]()
    else:
        name, arguments = STEPS[case]
        optid.fit(bent_record(), name, **arguments, raises=False)
    assert seen

"""A zoo of solvers that lie about the programmes of real formulations: none is believed, and no error is bare."""

import numpy as np
import pytest
from scipy.signal import lfilter
from zoo import anything

import optid
from optid.backends import Answer, BackEnd
from optid.backends.choice import choose
from optid.errors import OptidError
from optid.program.solution import Status

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


@pytest.mark.sampled(4)
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning", "ignore::RuntimeWarning", "ignore:Casting complex")
@pytest.mark.parametrize("fit", FITS)
def test_no_lie_is_believed(fit):
    name, arguments = FITS[fit]
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 200)
    data = optid.Data(u, lfilter([0, 1], [1, -1.2, 0.4], np.tanh(2 * u)) + 0.3 * rng.standard_normal(200))
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

"""The dictionary: signatures equal the difference a fault makes, groups, faults nobody sees, traces that die out."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from fault_plants import LOAD, levels, noisy, refused, standard
from state_systems import with_feedback
from test_fault_injection import small

from optid import Data
from optid.errors import DataError, DataWarning, LookupFailed, StructureError
from optid.faults import Fault, dictionary, inject, whiten

N, ONSET = 90, 30


def difference(model, u, fault, gaps=0.0):
    """What a fault changes in the whitened innovations of one and the same noise."""
    healthy, faulty = (inject(model, u, f, seed=4, process={"load": LOAD}) for f in ((), fault))
    lost = np.random.default_rng(0).random(healthy.shape) < gaps
    parts = [whiten(model, Data(u, np.where(lost, np.nan, y), dt=model.dt, outputs=model.outputs), x0="zero")
             for y in (healthy, faulty)]
    return parts[1].r - parts[0].r, ~lost


@pytest.mark.parametrize("gaps", [0.0, 0.1])
@pytest.mark.parametrize("label, fault, size", [
    ("actuator:u1", Fault.step("actuator:u1", ONSET, 0.4), [0.4]),
    ("sensor:y2", Fault.step("sensor:y2", ONSET, -0.7), [-0.7]),
    ("process:load", Fault.step("process:load", ONSET, 0.4), [0.4]),
    ("actuator:u2 drift", Fault.ramp("actuator:u2", ONSET, 0.01), [0.01]),
    ("sensor:y1 drift", Fault.ramp("sensor:y1", ONSET, 0.01), [0.01]),
    ("sensor:y1 spike", Fault.jump("sensor:y1", ONSET, 0.8), [0.8]),
    ("state", Fault.jump("state", ONSET, [1.0, -2.0, 0.5]), [1.0, -2.0, 0.5]),
    ("actuator:u1 loss", Fault.loss("actuator:u1", ONSET, 0.6), [0.6]),
    ("actuator:u1 stuck", Fault.stuck("actuator:u1", ONSET, 0.3), [1.0, 0.3]),
    ("actuator:u2 stuck", Fault.loss("actuator:u2", ONSET, 0.5, bias=0.2), [0.5, 0.2]),
], ids=str)
def test_a_signature_is_the_difference_the_fault_makes(label, fault, size, gaps):
    model, u = small(), levels(N, 2)
    found = dictionary(model, process={"load": LOAD}, kinds=["bias", "drift", "loss", "stuck", "spike"])
    change, present = difference(model, u, fault, gaps)
    signature = found.signature(label, N, ONSET, u=u, present=present)
    assert signature.shape == (N, 2, found[label].dimension)
    np.testing.assert_allclose(signature @ size, change, atol=1e-9)


def test_an_input_with_several_functions_has_one_share_lost_and_one_constant_for_each():
    model = with_feedback(feedback=(), E=None, output_of=())
    found = dictionary(model, kinds=["bias", "stuck"])
    u = 0.5 * np.random.default_rng(0).normal(size=(N, 2))
    assert [found[name].dimension for name in ("actuator:u1", "actuator:u2", "actuator:u2 stuck")] == [1, 2, 3]
    change, _ = difference(model, u, Fault.stuck("actuator:u2", ONSET, 0.4))
    size = [1.0, *(model.nonlinearities[i](0.4) for i in (1, 2))]
    np.testing.assert_allclose(found.signature("actuator:u2 stuck", N, ONSET, u=u) @ size, change, atol=1e-9)


def test_the_trap_of_the_standard_plant(real_data):
    model, load = standard(real_data)
    with warnings.catch_warnings(action="error"):
        found = dictionary(model, process={"load": load})
    assert found.labels == ("actuator:u1", "actuator:u2", "sensor:y1", "sensor:y2", "process:load", "state")
    (first, second, sine), = found.near
    assert (first, second) == ("actuator:u2", "sensor:y2") and abs(np.sqrt(1 - sine**2) - 0.975) < 0.002
    assert not found.ambiguity_groups and not found.excluded
    assert max(map(len, str(found).splitlines())) <= 80


def test_collinear_faults_become_one_answer():
    model = small(D=[[0.0, 0.0], [0.0, 0.3]])
    with pytest.warns(DataWarning, match="actuator:u1 and process:same have the same signature.*sine"):
        found = dictionary(model, process={"same": -3 * model.B[:, 0], "load": LOAD})
    assert found.ambiguity_groups == [("actuator:u1", "process:same")]
    assert "actuator:u1 | process:same" in found.labels and "process:same" not in found.labels
    assert found["process:same"] is found["actuator:u1"] and found["actuator:u1"].places[1] == "process:same"
    assert "not isolable from each other" in str(found)


def test_faults_that_no_output_sees_cannot_be_answers():
    base = small(D=None)
    A = np.block([[base.A, np.zeros((3, 1))], [np.ones((1, 3)), 0.5 * np.ones((1, 1))]])
    B, C = np.vstack([base.B, [[1.0, 2.0]]]), np.hstack([base.C, np.zeros((2, 1))])
    model = noisy(A, B, C, 0.01 * np.eye(4), np.eye(2))
    with pytest.warns(DataWarning) as heard:
        found = dictionary(model, process={"hidden": [0, 0, 0, 1.0]})
    assert [str(w.message) for w in heard][0].startswith("process:hidden: this fault affects no output")
    assert "1 of 4 directions" in str(heard[1].message)
    assert found["state"].dimension == 3 and dict(found.excluded) == {"process:hidden": "it affects no output"}
    with pytest.raises(LookupFailed, match="it affects no output"):
        found["process:hidden"]
    dead = replace(small(), B=small().B * [1.0, 0.0], D=small().D * [1.0, 0.0])
    with pytest.warns(DataWarning, match="actuator:u2: this fault affects no output"):
        assert "actuator:u2" in dictionary(dead).excluded


def test_a_trace_that_dies_out_is_flagged():
    """A disturbance before a differentiator: zero static gain, so the deflection stops growing."""
    A = np.array([[0.6, 0.0], [1.0, 0.5]])
    C = np.array([[1.0, 0.0], [0.0, 1.0]])
    model = noisy(A, np.eye(2), C, 1e-2 * np.eye(2), np.eye(2), D=[[-2.5, 0.0], [-5.0, 0.0]])
    found = dictionary(model, process={"load": [1.0, 0.0]})
    assert {c.label: c.bounded_deflection for c in found.candidates} == {
        "actuator:u1": True, "actuator:u2": False, "sensor:y1": False, "sensor:y2": False, "process:load": False,
        "state": True}
    short, long = (np.linalg.norm(found.signature("actuator:u1", n)) for n in (40, 400))
    assert abs(long / short - 1) < 1e-6
    assert "transient only" in str(found)


def test_choices_and_bad_input():
    model = small()
    chosen = dictionary(model, actuators=["u1"], sensors="sensor:y2", kinds="drift", state_jump=False)
    assert chosen.labels == ("actuator:u1 drift", "sensor:y2 drift")
    assert chosen["actuator:u1"].label == "actuator:u1 drift"
    whole, lossy = dictionary(model, kinds=["bias", "frozen", "noise"]), dictionary(model, kinds="loss")
    refused(
        (StructureError, "arbitrary waveform", lambda: whole.signature("sensor:y1 frozen", N)),
        (LookupFailed, "sensor:y2", lambda: whole["sensor:y9"]),
        (StructureError, "pass u", lambda: lossy.signature("actuator:u1 loss", N)),
        (DataError, "channels", lambda: lossy.signature("actuator:u1 loss", N, u=np.zeros((N, 3)))),
        (LookupFailed, "bend", lambda: dictionary(model, kinds="bend")),
        (LookupFailed, "u7", lambda: dictionary(model, actuators=["u7"])),
        (LookupFailed, "z", lambda: dictionary(model, sensors="z")),
        (StructureError, "direction", lambda: dictionary(model, process={"load": [1.0]})),
        (StructureError, "noise covariances", lambda: dictionary(replace(model, noise=None))))

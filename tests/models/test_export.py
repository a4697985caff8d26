"""Exports against the model's own responses and simulation."""

import ctypes
import shutil
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from refusals import refuses
from sample_fits import feedback_fit
from scipy import signal, special
from state_systems import linear
from systems import BASES, inputs, mimo, nonlinearity, siso
from test_physical import CUBIC, bent, quiet

from optid.bases import Linear, UserFunctions
from optid.errors import OptidError, StructureError
from optid.models import Nonlinearity
from optid.models.export import state_space


@pytest.mark.parametrize("model", [siso(), siso(nk=3, c=[-0.6, 0.25], d=[-0.5, 0.1, 0.3]), siso(a=[]), mimo()])
def test_dlti_has_the_impulse_responses(model):
    expected = model.impulse_response(30)
    for o in range(model.l):
        for c in range(model.m):
            system = model.to_dlti(model.outputs[o], c)
            assert system.dt == model.dt
            assert system.impulse(n=30)[1][0][:, 0] == pytest.approx(expected[:, o, c], abs=1e-12)


def test_dlti_channels():
    refuses(StructureError, "Known: u|Did you mean 'u'", siso().to_dlti, input="x")
    refuses(StructureError, "counted from 0", siso().to_dlti, output=1)
    assert isinstance(siso().to_dlti(), signal.dlti)


@pytest.mark.parametrize("make", [lambda: siso(nk=2), mimo, linear, lambda: quiet(bent(), CUBIC).model])
def test_control_has_the_frequency_response_and_the_names(make):
    pytest.importorskip("control")
    model = make()
    system, w = model.to_control(), np.array([0.01, 0.7, 3.0])
    assert system.dt == model.dt and system.output_labels == list(model.outputs)
    functions = model.nonlinearities or [Nonlinearity(Linear(), [1.0])] * model.m  # of a physical model
    assert system.input_labels == [name if f.is_linear else f"f({name})" for name, f in zip(model.inputs, functions)]
    for frequency, response in zip(w, model.frequency_response(w)):
        value = np.reshape(system(np.exp(1j * frequency * model.dt)), (model.l, model.m))
        assert value == pytest.approx(response, abs=1e-10)


@pytest.mark.parametrize("make", [linear, lambda: quiet(bent(), CUBIC).model])
def test_dlti_of_states_is_whole(make):
    model = make()
    system = model.to_dlti()
    assert all(np.array_equal(a, b) for a, b in zip((system.A, system.B, system.C, system.D), state_space(model)))


def test_control_missing_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    refuses(OptidError, r"optid\[control\]", siso().to_control)


def iterate(function, u, state):
    x, outputs = state.ravel(), []
    for row in u:
        x, y = function(x, row)
        x = np.array(x).ravel()
        outputs.append(np.array(y).ravel())
    return np.array(outputs)


@pytest.mark.parametrize("basis", BASES)
def test_casadi_equals_simulation_inside_and_outside(basis):
    model = siso(basis, nk=1)
    u = np.random.default_rng(0).uniform(-1.0, 1.6, (120, 1))
    state = np.array([[0.4], [-0.3]])
    simulated = model.simulate(u, x0=state)
    assert iterate(model.to_casadi(), u, state) == pytest.approx(simulated, abs=1e-9 * np.max(np.abs(simulated)))


def test_casadi_mimo_and_static():
    for model in (mimo(), siso(a=[], b=([2.0],)), siso(c=[-0.6, 0.25], d=[-0.5, 0.1, 0.3])):
        u = inputs(model, 80)
        state = np.random.default_rng(2).normal(size=(model.largest_lag, model.l))
        function = model.to_casadi()
        assert function.size1_in(0) == model.largest_lag * model.l and function.size1_in(1) == model.m
        assert iterate(function, u, state) == pytest.approx(model.simulate(u, x0=state), abs=1e-10)


def test_casadi_differentiates():
    model = siso(BASES[3])
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    slope = ca.Function("slope", [x, u], [ca.jacobian(model.to_casadi()(x, u)[1], u)])
    assert float(slope([0, 0], 0.4)) == pytest.approx(16 / 15 * model.nonlinearities[0].slope(0.4), abs=1e-9)


def test_casadi_in_a_predictive_controller():
    """One-step tracking through IPOPT finds an input whose simulated output is the target."""
    model = siso(BASES[2], nonlinearities=(Nonlinearity(nonlinearity(BASES[2]).basis, [1.0, 0.2, 0.1, 0.0]),))
    u = ca.MX.sym("u")
    y = model.to_casadi()(ca.DM([0.1, 0.0]), u)[1]
    solver = ca.nlpsol(
        "s", "ipopt", {"x": u, "f": (y - 0.8) ** 2}, {"print_time": 0, "ipopt": {"print_level": 0, "sb": "yes"}})
    best = float(solver(x0=0.0, lbx=-0.7, ubx=1.3)["x"])
    assert model.simulate(np.array([[best]]), x0=[0.1, 0.0])[0, 0] == pytest.approx(0.8, abs=1e-4)


def test_user_functions_are_called_with_symbols():
    functions = UserFunctions((np.tanh, lambda v: v**3 + np.exp(-v)), ("tanh", "mixed")).with_interval(-1, 1)
    model = siso(nonlinearities=(Nonlinearity(functions, [1.0, -0.4]),))
    u = np.random.default_rng(3).uniform(-1.4, 1.4, (60, 1))
    state = np.array([[0.4], [-0.3]])
    assert iterate(model.to_casadi(), u, state) == pytest.approx(model.simulate(u, x0=state), abs=1e-12)


@pytest.mark.parametrize(("function", "words"), [
    (special.j1, "CasADi scalar"), (lambda v: v * (2.0 if isinstance(v, np.ndarray) else 3.0), "other values")])
def test_a_user_function_that_symbols_do_not_pass_or_change_is_refused(function, words):
    functions = UserFunctions((function,), ("own",)).with_interval(-1, 1)
    refuses(StructureError, words, siso(nonlinearities=(Nonlinearity(functions, [1.0]),)).to_casadi)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on PATH")
@pytest.mark.parametrize("name", ["triangular", "spline", "several", "feedback"])
def test_compiled_c_equals_the_simulation(name, tmp_path):
    model = {"triangular": lambda: siso(BASES[0], nk=1), "spline": lambda: siso(BASES[3]), "several": mimo,
             "feedback": lambda: feedback_fit().model}[name]()
    source = model.to_c(tmp_path / "plant.c", "plant")
    library = tmp_path / "plant.so"
    warned = ["-Wall", "-Wextra", "-Werror"]
    subprocess.run(["gcc", "-std=c99", "-O2", *warned, "-shared", "-fPIC", str(source), "-o", str(library), "-lm"],
                   check=True)
    step = ctypes.CDLL(str(library)).plant_step
    u = np.random.default_rng(5).uniform(-1.2, 1.2, (200, model.m))
    x, y, found = np.zeros(model.to_casadi().size1_in(0)), np.zeros(model.l), []
    at = ctypes.POINTER(ctypes.c_double)
    for row in np.ascontiguousarray(u):
        step(x.ctypes.data_as(at), row.ctypes.data_as(at), y.ctypes.data_as(at))
        found.append(y.copy())
    expected = model.simulate(u)
    assert np.array(found) == pytest.approx(expected, abs=1e-12 * max(1.0, np.max(np.abs(expected))))


ODD = ["a*/ int evil; /*", "a*??/", "?????/", "a\\", "a\\ ", "*", "/", "**/", "/*/", "*/*/", "//", "\\u000a", "°C",
       "#if", "a\u200b", "\ufeffa", "%d", "a*\\", "*" * 9 + "/" * 9, "??/*"]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on PATH")
@pytest.mark.parametrize("standard", ["c99", "gnu17"])
def test_names_and_units_change_nothing_but_comments_in_c(standard, tmp_path):
    def code(*names):
        """What the compiler sees; warnings are errors."""
        fields = {field: (name,) for field, name in zip(("inputs", "outputs", "input_units", "output_units"), names)}
        source = siso(**fields).to_c(tmp_path / "plant.c", "plant")
        strict = ["gcc", f"-std={standard}", "-Wall", "-Wextra", "-Werror", str(source)]
        subprocess.run([*strict, "-fsyntax-only"], check=True)
        return subprocess.run([*strict, "-E", "-P"], check=True, capture_output=True).stdout

    plain = code("u", "y", "", "")
    for k in range(0, len(ODD), 4):
        assert code(*ODD[k : k + 4]) == plain, ODD[k : k + 4]


def test_control_characters_in_equations_are_shown_in_c(tmp_path):
    model = siso()
    model.__dict__["inputs"] = ("a\u202e\0",)  # as nothing but a program can do
    note = model.to_c(tmp_path / "a.c").read_text(encoding="utf-8").partition("*/")[0]
    assert "a(U+202E)(U+0000)" in note and all(c.isprintable() or c == "\n" for c in note)


@pytest.mark.parametrize("name", ["my-plant", "", "1st", "int", "While", "_plant", "plant_", "my__plant", "ärger",
                                  "a b", None, 3, "a\n", "a;", "nullptr"])
def test_c_refuses_a_name_that_is_none(tmp_path, name):
    refuses(StructureError, "C functions", siso().to_c, tmp_path / "a.c", name)
    assert not (tmp_path / "a.c").exists()

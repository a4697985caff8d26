"""FMUs, validated and run by FMPy, against the simulation of their models."""

import ctypes
import shutil
import subprocess
import zipfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses
from sample_fits import feedback_fit
from systems import BASES, inputs, mimo, siso
from test_continuous import process
from test_physical import CUBIC, bent, quiet

from optid.errors import OptidError, StructureError
from optid.models import fmu
from optid.models.process import process_model

fmpy = pytest.importorskip("fmpy", reason="needs FMPy: pip install fmpy")
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on PATH")

MODELS = {"direct": lambda: siso(nk=0), "delayed": lambda: siso(nk=3), "spline": lambda: siso(BASES[3], nk=1),
          "extrapolated": lambda: siso(BASES[8], nk=1), "trigonometric": lambda: siso(BASES[1]), "mimo": mimo,
          "feedback": lambda: feedback_fit().model, "static": lambda: siso(a=[], b=([2.0],)),
          "state space": lambda: mimo_states(), "process": lambda: process(delay=12.4, time_unit="s").to_discrete(1.0),
          "P2DU": lambda: process_model("P2DU", K=2.5, level=1.5, dt=0.5, T=3.0, zeta=0.3, dead_time=1.7, time_unit="s",
                                        ).to_continuous().to_discrete(0.5)}


def mimo_states():
    return process((-0.4, -0.1), delay=0.7, time_unit="s", inputs=("flow in",), outputs=("1st level",)).to_discrete(0.5)


class Slave:
    """An instance between instantiation and termination."""

    def __init__(self, path, folder, start=0.0):
        from fmpy.fmi2 import FMU2Slave, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

        self.description = fmpy.read_model_description(str(path))
        self.said = []
        self.fmu = FMU2Slave(guid=self.description.guid, unzipDirectory=fmpy.extract(str(path), str(folder)),
                             modelIdentifier=self.description.coSimulation.modelIdentifier, instanceName="plant")
        self.logger = fmi2CallbackLoggerTYPE(lambda _, __, status, category, text: self.said.append(text.decode()))
        self.callbacks = fmi2CallbackFunctions()
        self.callbacks.logger = self.logger
        self.fmu.instantiate(callbacks=self.callbacks)
        self.fmu.setupExperiment(startTime=start)
        self.fmu.enterInitializationMode()
        kinds = {"input": [], "output": [], "local": []}
        for variable in self.description.modelVariables:
            kinds[variable.causality].append(variable.valueReference)
        self.u, self.y, self.x = kinds["input"], kinds["output"], kinds["local"]

    def run(self, u, dt, step=None, start=0.0):
        """Outputs at every sample, whose inputs are set before they are read; steps of another length in between."""
        found, now = [], start
        self.fmu.exitInitializationMode()
        for row in u:
            self.fmu.setReal(self.u, row.tolist())
            found.append(self.fmu.getReal(self.y))
            for _ in range(1 if step is None else round(dt / step)):
                self.fmu.doStep(now, step or dt)
                now += step or dt
        return np.array(found)

    def close(self):
        self.fmu.terminate()
        self.fmu.freeInstance()


@needs_gcc
@pytest.mark.parametrize("name", MODELS)
def test_an_fmu_is_valid_and_runs_as_the_simulation(name, tmp_path):
    from fmpy.validation import validate_fmu

    model = MODELS[name]()
    path = model.to_fmu(tmp_path / "plant.fmu")
    assert validate_fmu(str(path)) == []
    u = np.random.default_rng(5).uniform(-1.2, 1.2, (200, model.m))
    expected = model.simulate(u)
    close = dict(abs=1e-10 * max(1.0, np.abs(expected).max()))
    with closing(Slave(path, tmp_path / "whole")) as slave:
        assert slave.run(u, model.dt) == pytest.approx(expected, **close)
    with closing(Slave(path, tmp_path / "parts", start=7.0)) as parts:
        assert parts.run(u, model.dt, step=model.dt / 4, start=7.0) == pytest.approx(expected, **close)


@needs_gcc
def test_long_steps_hold_the_input(tmp_path):
    model = siso(nk=1)
    u = np.random.default_rng(0).uniform(-0.5, 1, (30, 1))
    expected = model.simulate(np.repeat(u, 3, axis=0))[::3]
    with closing(Slave(model.to_fmu(tmp_path / "plant.fmu"), tmp_path / "run")) as slave:
        assert slave.run(u, 3 * model.dt) == pytest.approx(expected, abs=1e-12)


@needs_gcc
def test_the_master_of_fmpy_gives_the_simulation(tmp_path):
    """It reads outputs before it sets the inputs of the same instant, which matters to models with direct action."""
    model = siso(nk=1)
    path = model.to_fmu(tmp_path / "plant.fmu")
    u, t = inputs(model)[:, 0], 0.1 * np.arange(200)
    signal = np.array(list(zip(t, u)), dtype=[("time", float), ("u", float)])
    found = fmpy.simulate_fmu(str(path), stop_time=t[-1], output_interval=0.1, input=signal, output=["y"])
    assert found["y"] == pytest.approx(model.simulate(u), abs=1e-12)


@needs_gcc
def test_states_are_set_stored_and_restored(tmp_path):
    model = siso(nk=1)
    state, u = np.array([[0.4], [-0.3]]), inputs(model, 40)
    expected = model.simulate(u, x0=state)
    with closing(Slave(model.to_fmu(tmp_path / "given.fmu", x0=state), tmp_path / "given")) as given:
        assert given.run(u, model.dt) == pytest.approx(expected, abs=1e-12)
    slave = Slave(model.to_fmu(tmp_path / "plant.fmu"), tmp_path / "plant")
    slave.fmu.setReal(slave.x, state.ravel().tolist())
    slave.run(u[:15], model.dt)
    kept = slave.fmu.serializeFMUstate(slave.fmu.getFMUstate())
    ends = []
    for _ in range(2):
        slave.fmu.setFMUstate(slave.fmu.deSerializeFMUstate(kept))
        now, y = 15 * model.dt, []
        for row in u[15:]:
            slave.fmu.setReal(slave.u, row.tolist())
            y.append(slave.fmu.getReal(slave.y))
            slave.fmu.doStep(now, model.dt)
            now += model.dt
        ends.append(y)
    assert np.array(ends[0]) == pytest.approx(expected[15:], abs=1e-12) and ends[0] == ends[1]
    slave.fmu.reset()
    slave.fmu.setupExperiment(startTime=0.0)
    slave.fmu.enterInitializationMode()
    assert slave.run(u, model.dt) == pytest.approx(model.simulate(u), abs=1e-12)
    slave.close()


@needs_gcc
def test_what_a_master_does_wrong_is_an_error_with_words(tmp_path):
    slave = Slave(siso(nk=1).to_fmu(tmp_path / "plant.fmu"), tmp_path / "run")

    def fails(words, function, *arguments):
        with pytest.raises(Exception, match="status 3|fmi2Error|error"):
            function(*arguments)
        assert words in slave.said[-1]

    fails("out of order", slave.fmu.enterInitializationMode)
    fails("belongs between", slave.fmu.doStep, 0.0, 0.1)
    slave.fmu.exitInitializationMode()
    fails("the model is at 0", slave.fmu.doStep, 1.0, 0.1)
    fails("cannot be set", slave.fmu.setReal, slave.y, [1.0])
    fails("cannot be set", slave.fmu.setReal, slave.x[:1], [1.0])
    fails("no variable", slave.fmu.getReal, [99])
    fails("no variables of this type", slave.fmu.getInteger, [0])
    slave.fmu.setReal(slave.u, [float("nan")])
    fails("not a finite number", slave.fmu.doStep, 0.0, 0.1)
    slave.fmu.setReal(slave.u, [0.0])
    slave.fmu.doStep(0.0, 0.1)
    slave.close()


@needs_gcc
def test_every_function_of_the_interface_is_there(tmp_path):
    path = siso().to_fmu(tmp_path / "plant.fmu")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "parts")
    (library,) = (tmp_path / "parts" / "binaries").rglob("plant.*")
    found = ctypes.CDLL(str(library))
    words = """GetTypesPlatform GetVersion SetDebugLogging Instantiate FreeInstance SetupExperiment
    EnterInitializationMode ExitInitializationMode Terminate Reset GetReal GetInteger GetBoolean GetString SetReal
    SetInteger SetBoolean SetString GetFMUstate SetFMUstate FreeFMUstate SerializedFMUstateSize SerializeFMUstate
    DeSerializeFMUstate GetDirectionalDerivative SetRealInputDerivatives GetRealOutputDerivatives DoStep CancelStep
    GetStatus GetRealStatus GetIntegerStatus GetBooleanStatus GetStringStatus""".split()
    assert all(hasattr(found, f"fmi2{word}") for word in words) and len(words) == 34
    assert not hasattr(found, "sample")


@needs_gcc
@pytest.mark.parametrize("make", [siso, mimo, lambda: siso(a=[], b=([2.0],))])
def test_the_source_compiles_alone_without_a_warning_and_against_the_headers(make, tmp_path):
    path = make().to_fmu(tmp_path / "plant.fmu", binary=False)
    with zipfile.ZipFile(path) as archive:
        assert sorted(archive.namelist()) == ["modelDescription.xml", "sources/plant.c"]
        archive.extractall(tmp_path)
    source = tmp_path / "sources" / "plant.c"
    strict = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-c"]
    subprocess.run([*strict, str(source), "-o", str(tmp_path / "plant.o")], check=True)
    names = subprocess.run(["nm", str(tmp_path / "plant.o")], check=True, capture_output=True, text=True).stdout
    assert " T plant_fmi2DoStep" in names
    frame = source.read_text(encoding="utf-8")
    first, last = frame.index("typedef void *fmi2Component"), frame.index("#ifdef _WIN32")
    headers = Path(fmpy.__file__).parent / "c-code"
    source.write_text(f'{frame[:first]}#include "fmi2Functions.h"\n{frame[last:]}', encoding="utf-8")
    subprocess.run([*strict, f"-I{headers}", "-DFMI2_OVERRIDE_FUNCTION_PREFIX", str(source), "-o",
                    str(tmp_path / "b.o")], check=True)  # every definition agrees with its declaration


ODD = {"inputs": ('a*/ "b" <&>',), "outputs": ("1st; int x;",), "input_units": ("°C",), "output_units": ('"%"',)}


@needs_gcc
def test_names_become_identifiers_and_stay_in_the_description(tmp_path):
    from fmpy.validation import validate_fmu

    path = siso(nk=1, **ODD).to_fmu(tmp_path / "my plant-2.fmu")
    assert validate_fmu(str(path)) == []
    found = fmpy.read_model_description(str(path))
    assert [v.name for v in found.modelVariables] == ["a_b", "y_1st_int_x", "x1", "x2"]
    assert [v.description for v in found.modelVariables[:2]] == [ODD["inputs"][0], ODD["outputs"][0]]
    assert [v.unit for v in found.modelVariables[:2]] == ["°C", '"%"'] and found.modelName == "my_plant_2"


def test_one_model_gives_one_file(tmp_path):
    first, again, other = (model.to_fmu(tmp_path / f"{folder}.fmu", "plant", binary=False).read_bytes()
                           for folder, model in (("a", siso()), ("b", siso()), ("c", siso(offset=0.4))))
    assert first == again != other


def test_time_is_in_seconds(tmp_path):
    path = process(time_unit="min").to_discrete(0.5).to_fmu(tmp_path / "plant.fmu", binary=False)
    assert fmpy.read_model_description(str(path)).defaultExperiment.stepSize in (30.0, "30.0")  # by version
    refuses(StructureError, "counts in 'weeks'", siso(time_unit="weeks").to_fmu, tmp_path / "a.fmu")


@needs_gcc
def test_a_physical_model_starts_from_its_start(tmp_path):
    model = quiet(bent(), CUBIC).model
    u = np.random.default_rng(0).uniform(-1, 1, (50, 1))
    with closing(Slave(model.to_fmu(tmp_path / "plant.fmu"), tmp_path / "run")) as slave:
        assert slave.run(u, model.dt) == pytest.approx(model.simulate(u), abs=1e-12)


@pytest.mark.parametrize("arguments, words", [
    (("plant.zip",), "must end in .fmu"), (("plant.fmu", "int"), "no identifier of C"),
    (("plant.fmu", "a b"), "no identifier of C"), (("plant.fmu", 3), "no identifier of C")])
def test_bad_names_are_refused(arguments, words, tmp_path):
    refuses(StructureError, words, siso().to_fmu, tmp_path / arguments[0], *arguments[1:])
    assert not list(tmp_path.iterdir())


def test_a_start_of_another_size_is_refused(tmp_path):
    refuses(StructureError, "x0", siso().to_fmu, tmp_path / "a.fmu", x0=np.zeros(5))


def test_without_a_compiler_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(fmu.shutil, "which", lambda word: None)
    refuses(OptidError, "binary=False", siso().to_fmu, tmp_path / "a.fmu")
    monkeypatch.setattr(fmu.platform, "machine", lambda: "riscv64")
    refuses(OptidError, "riscv64: pass binary=False", siso().to_fmu, tmp_path / "a.fmu")
    assert not list(tmp_path.iterdir())


def test_an_error_of_the_compiler_is_shown(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "false")
    refuses(OptidError, "false cannot build", siso().to_fmu, tmp_path / "a.fmu")

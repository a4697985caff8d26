"""Structured text, read back by a small interpreter of the statements it uses."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from refusals import refuses
from sample_fits import example_fit, feedback_fit
from systems import BASES, mimo, siso
from test_physical import CUBIC, bent, quiet
from typer.testing import CliRunner

from optid.bases import UserFunctions
from optid.cli.app import app
from optid.errors import StructureError
from optid.models import HammersteinSS, Nonlinearity
from optid.models.generated_code import identifiers

NAMES = ("sqrt", "exp", "sin", "cos", "tan", "asin", "acos", "atan")
FUNCTIONS = {name.upper(): getattr(math, name) for name in NAMES} | {
    "ABS": abs, "LN": math.log, "EXPT": pow, "MIN": min, "MAX": max, "SEL": lambda which, no, yes: yes if which else no}


class Block:
    """An instance of the function block in a file."""

    def __init__(self, path):
        text = re.sub(r"\(\*.*?\*\)", "", path.read_text(encoding="utf-8"), flags=re.S)
        head, self.name, text = re.match(r"\s*(FUNCTION_BLOCK) (\w+)\n(.*)END_FUNCTION_BLOCK\s*$", text, re.S).groups()
        sections = re.findall(r"(VAR\w*)\n(.*?)END_VAR\n", text, re.S)
        self.variables = {kind: re.findall(r"    (\w+) : (?:ARRAY\[0\.\.(\d+)\] OF )?LREAL;\n", body)
                          for kind, body in sections}
        everything = [name.lower() for found in self.variables.values() for name, _ in found]
        assert len(set(everything)) == len(everything)
        self.values = {name: np.zeros(int(last) + 1) if last else 0.0
                       for found in self.variables.values() for name, last in found}
        code = text.rpartition("END_VAR\n")[2]
        for pattern, python in ((r"LREAL#", ""), ("<>", "!="), (" AND ", " and "), (" OR ", " or "), (" = ", " == "),
                                ("x := following", "x[:] := following"), (":=", "="), (";", "")):
            code = code.replace(pattern, python)
        self.code = compile(code, self.name, "exec")

    def names(self, kind):
        return [name for name, _ in self.variables.get(kind, ())]

    def __call__(self, row):
        self.values.update(zip(self.names("VAR_INPUT"), row))
        exec(self.code, {"__builtins__": {}, **FUNCTIONS}, self.values)
        return [self.values[name] for name in self.names("VAR_OUTPUT")]


def user():
    functions = UserFunctions((np.tanh, lambda v: v**3 + np.exp(-v) + np.sin(v)), ("tanh", "mixed")).with_interval(-1,
                                                                                                                   1)
    return siso(nonlinearities=(Nonlinearity(functions, [1.0, -0.4]),), nk=1)


MODELS = {**{f"basis {k}": lambda basis=basis, k=k: siso(basis, nk=k % 2) for k, basis in enumerate(BASES)},
          "mimo": mimo, "user": user, "feedback": lambda: feedback_fit().model,
          "static": lambda: siso(a=[], b=([2.0],)), "resampled": lambda: siso(nk=4).to_discrete(0.03)}


@pytest.mark.parametrize("name", MODELS)
def test_the_function_block_computes_the_simulation(name, tmp_path):
    model = MODELS[name]()
    block = Block(model.to_st(tmp_path / "plant.st", "plant"))
    u = np.random.default_rng(5).uniform(-1.2, 1.2, (200, model.m))
    expected = model.simulate(u)
    assert np.array([block(row) for row in u]) == pytest.approx(expected, abs=1e-12 * max(1, np.abs(expected).max()))
    assert block.name == "plant"


def test_names_of_channels_become_identifiers(tmp_path):
    odd = ["1st *) (* °C", "real", "", "Real", "--", "a__b", "x", "Plant"]
    found = identifiers(odd, "u", ["real", "plant"])
    assert found == ["u_1st_C", "real_2", "u3", "Real_3", "u5", "a_b", "x", "Plant_2"]
    model = siso(inputs=("x *) y := 1; (*",), outputs=("w",), input_units=("*)",))
    block = Block(model.to_st(tmp_path / "plant.st", "plant"))
    assert block.names("VAR_INPUT") == ["x_y_1"] and block.names("VAR_OUTPUT") == ["w_2"]


@pytest.mark.parametrize("name", ["real", "my__plant", "1st", "", None, "a b", "plant_", "Function_Block", 3])
def test_a_name_that_the_language_does_not_take_is_refused(name, tmp_path):
    refuses(StructureError, "no name of a function block", siso().to_st, tmp_path / "a.st", name)
    assert not (tmp_path / "a.st").exists()


def test_a_function_that_the_language_does_not_have_is_named(tmp_path):
    functions = UserFunctions((np.floor,), ("floor",)).with_interval(-1, 1)
    model = siso(nonlinearities=(Nonlinearity(functions, [1.0]),))
    refuses(StructureError, "IEC 61131-3 has no function for floor", model.to_st, tmp_path / "a.st")
    assert model.to_c(tmp_path / "a.c").exists()


def rate(v):
    return {"x": -v["a"] * v["x"] - v["c"] * v["x"] ** 3 + v["b"] * v["u"], "y": v["x"] + v["d"]}


def test_equations_that_are_solved_by_iteration_are_refused(tmp_path):
    waiting = quiet(bent(), replace(CUBIC, right=rate, time="continuous")).model
    refuses(StructureError, "solved by iteration", waiting.to_c, tmp_path / "a.c")
    discrete = quiet(bent(), CUBIC).model
    block, u = Block(discrete.to_st(tmp_path / "a.st")), np.random.default_rng(0).uniform(-1, 1, 50)
    block.values["x"][:] = discrete.start
    assert [block([one])[0] for one in u] == pytest.approx(discrete.simulate(u), abs=1e-12)


def test_a_number_that_is_none_is_refused(tmp_path):
    model = HammersteinSS([[0.5]], [[1.0]], [[1.0]])
    object.__setattr__(model, "offset_y", np.array([np.inf]))
    refuses(StructureError, "contains inf", model.to_st, tmp_path / "a.st")


def test_the_command_line_writes_by_the_ending(tmp_path):
    for name in ("int.st", "2 plants.c"):
        done = CliRunner().invoke(app, ["fit", "--example", "thruster", "--model", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
    model = example_fit("thruster").model
    block, u = Block(tmp_path / "int.st"), example_fit("thruster").data.u[:50]
    assert block.name == "int_2" and "model_2_plants_step(" in (tmp_path / "2 plants.c").read_text(encoding="utf-8")
    assert np.array([block(row) for row in u]) == pytest.approx(model.simulate(u), abs=1e-9)

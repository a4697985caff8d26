"""Formulations and constraints by name."""

import os
import subprocess
import sys

import pytest
from problems import BASIS, record
from refusals import refuses

import optid
from formulations.constraints import poles, process, responses, shape
from optid.errors import LookupFailed, StructureError
from optid.registry import (
    CONSTRAINTS,
    FAULTS,
    FORMULATIONS,
    RENDERERS,
    check_arguments,
    find_entry_points,
    formulation,
    named_constraint,
    render,
)


def test_every_entry_point_loads_and_is_callable():
    for group in (FORMULATIONS, CONSTRAINTS, FAULTS, RENDERERS):
        assert find_entry_points(group)
        for point in find_entry_points(group).values():
            assert callable(point.load())
    assert set(find_entry_points(FORMULATIONS)) >= {"arx", "hammerstein_arx.exact", "hammerstein_arx.nuclear"}


def test_every_rule_of_the_catalogue_has_a_word():
    words = {point.value.split(":")[1] for point in find_entry_points(CONSTRAINTS).values()}
    known = {*shape.__all__, *poles.__all__, *responses.__all__, *process.__all__}
    assert words == known - {"fixed"}  # a known parameter is an array, which no word can carry


@pytest.mark.parametrize("text, name", [
    ("monotone", "monotone:increasing"),
    ("monotone:decreasing", "monotone:decreasing"),
    ("monotone:increasing,channel=valve", "monotone:increasing[valve]"),
    ("stable:0.9", "stable:0.9"),
    ("gain:2.5", "gain"),
    ("gain:low=1,high=2", "gain"),
    ("dead_zone:-0.1,0.1", "dead_zone:-0.1,0.1"),
    ("sign:b,negative", "sign:b:negative"),
    ("range:high=3", "range"),
    ("coefficients:a,low=-1,index=0", "coefficients:a"),
])
def test_words_become_rules(text, name):
    assert named_constraint(text).name == name


def test_a_word_means_what_the_function_means():
    one, other = (optid.fit(record(), na=2, nb=2, basis=BASIS, constraints=[rule]).solution.objective
                  for rule in ("gain:low=1,high=2,at=0.1", shape.gain(low=1, high=2, at=0.1)))
    assert one == pytest.approx(other, rel=1e-12)


@pytest.mark.parametrize("text, error, words", [
    ("monoton:increasing", LookupFailed, "Did you mean 'monotone'"),
    ("monotone:sideways", StructureError, "'increasing' or 'decreasing'"),
    ("gain:1,2,3,4,5,6", StructureError, "used as gain"),
    ("gain:hight=2", StructureError, "hight"),
])
def test_words_that_are_wrong(text, error, words):
    refuses(error, words, named_constraint, text)


def test_a_result_without_a_renderer_is_refused_by_name():
    refuses(LookupFailed, "Data has no form 'text'; it has figure", render, record())


@pytest.mark.parametrize("name", ["hammerstein_arx.exat", 3, None])
def test_unknown_formulations(name):
    refuses(LookupFailed, "no formulation is called", formulation, name)


def test_a_callable_is_its_own_formulation():
    def mine(data, *, order):
        return data, order

    assert formulation(mine) == ("mine", mine)
    check_arguments("mine", mine, {"order": 2})
    refuses(StructureError, "'mine' needs order", check_arguments, "mine", mine, {})
    refuses(StructureError, "no argument 'oder'. Did you mean 'order'", check_arguments, "mine", mine, {"oder": 2})
    check_arguments("open", lambda data, **anything: None, {"whatever": 1})


@pytest.mark.parametrize("text, argument", [("slope:low=a", "low"), ("gain:abc", "value"), ("dead_zone:-0.1,b", "high"),
                                            ("sector:q", "angle")])
def test_a_word_in_place_of_a_number_is_named(text, argument):
    refuses(StructureError, f"{argument} must be a number, not", named_constraint, text)


def test_another_package_of_our_name_is_told(tmp_path):
    (tmp_path / "formulations").mkdir()
    (tmp_path / "formulations" / "__init__.py").write_text("")
    program = "import optid, numpy as np; optid.fit(optid.Data(np.arange(9.0), np.arange(9.0)), 'arx', na=1, nb=1)"
    done = subprocess.run([sys.executable, "-c", program], env={**os.environ, "PYTHONPATH": str(tmp_path)},
                          capture_output=True, text=True, cwd=tmp_path)
    assert "'arx' is in the package 'formulations' of optid, which another one hides" in done.stderr, done.stderr
    assert str(tmp_path) in done.stderr

"""The concepts of the house may only become fewer, and the counts count what they say."""

import json
import textwrap

import pytest
import ratchets
from ratchets import House


def test_no_count_has_risen():
    recorded = json.loads(ratchets.RECORD.read_text())
    now = {name: count for name, count in ratchets.counts(House()).items() if not name.startswith("lines")}
    assert set(now) == set(recorded)
    assert not {name: (recorded[name], count) for name, count in now.items() if count > recorded[name]}


@pytest.fixture
def house(tmp_path):
    """Build a small house from {path: source}."""
    def build(files):
        for path, source in files.items():
            target = tmp_path / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(textwrap.dedent(source))
        (tmp_path / "pyproject.toml").write_text(
            '[project.entry-points."optid.formulations"]\n"one" = "formulations.one:one"\n'
            '[project.entry-points."optid.fault_formulations"]\n')
        return House(tmp_path)
    return build


def test_engine_names_are_counted_through_other_files_of_formulations(house):
    small = house({
        "formulations/one.py": "from formulations.helper import Program, split\nfrom optid.arrays import Array\n",
        "formulations/helper.py": "from optid.program import Program\nfrom optid.roots import roots\n"})
    assert ratchets.engine_names(small, False, False) == {"formulations.one": 2}  # Array, Program
    assert ratchets.engine_names(small, False, True) == {"formulations.one": 3}  # and roots
    assert ratchets.unreadable_formulations(small) == ["formulations.one:one"]


def test_circles_through_types_and_functions_are_circles(house):
    small = house({
        "optid/a.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from optid.b import B\n",
        "optid/b.py": "def f():\n    from optid.c import C\n", "optid/c.py": "from optid import a\n",
        "optid/d.py": "from optid.a import A\n"})
    assert ratchets.circles(small) == ["optid.a, optid.b, optid.c"]


def test_kinds_are_found_by_their_words_and_by_the_attribute(house):
    small = house({
        "optid/faults/kinds.py": "KINDS = {'loss': 1}\nx = KINDS == 'loss'\n",
        "optid/faults/a.py": "def f(x):\n    return x == 'loss'\n",
        "optid/faults/b.py": "def f(x):\n    return x.kind in y\n",
        "optid/faults/c.py": "def f(x):\n    match x.kind:\n        case z:\n            pass\n",
        "optid/faults/d.py": "def f(x):\n    return x.kind, 'loss', x == 'gain'\n"})
    assert ratchets.fault_kind_comparisons(small) == ["optid.faults.a", "optid.faults.b", "optid.faults.c"]


@pytest.mark.parametrize("name, participle", [("fitted", True), ("told", True), ("fit", False), ("feed", False),
                                              ("needed", True), ("run", False), ("fitted_to", False)])
def test_a_participle(name, participle):
    assert ratchets.is_participle(name) == participle


def test_long_signatures_and_names_with_two_meanings(house):
    small = house({
        "optid/a.py": "def f(a, b, c, /, d, e, *, g, h, i): ...\nclass One: ...\nclass _Two: ...\n",
        "optid/b.py": "def f(a, b, c, d, e, g, h): ...\nclass One: ...\nclass _Two: ...\n"})
    assert ratchets.long_signatures(small) == ["optid.a:f"]
    assert ratchets.class_names_twice(small) == ["One: optid.a, optid.b"]

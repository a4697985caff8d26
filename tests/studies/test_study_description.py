"""Studies: what they are made of, their files, the grid and its keys, simulated systems and their truth."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tasks import killed_by_options

import optid
from optid.errors import LookupFailed, StudyError
from optid.examples import EXAMPLES
from optid.studies import definition, grid, trial
from optid.studies.definition import DataEntry, FormulationEntry, SolverEntry
from optid.studies.records import load
from optid.studies.sources.systems import SYSTEMS, simulate
from optid.studies.sources.truth import Truth
from optid.studies.study import Study

SMALL = """
name = "small"
seeds = 2
solvers = ["clarabel", "gauss_newton"]

[[data]]
system = "thruster"
samples = [100, 200]
noise = [0.0, 0.1]

[[formulation]]
formulation = "arx"
na = 2
nb = 1

[[formulation]]
name = "monotone"
formulation = "hammerstein_arx.exact"
constraints = ["monotone:increasing"]
na = 2
nb = 1
basis = "triangular:6"
"""


@pytest.fixture
def rig(tmp_path):
    """A folder with a record."""
    u = np.random.default_rng(0).uniform(-1, 1, 40)
    y = np.convolve(u, [0.5, 0.2])[:40]
    rows = "\n".join(f"{a:.6f},{b:.6f}" for a, b in zip(u, y))
    (tmp_path / "rig.csv").write_text("current,thrust\n" + rows + "\n")
    return tmp_path


def problems(text, folder="."):
    """The lines of what is refused, without the heading."""
    with pytest.raises(StudyError) as caught:
        Study.from_text(text, folder)
    return [line.strip() for line in str(caught.value).splitlines()[1:]]


# -- the file ----------------------------------------------------------------------------------------------------------


def test_a_file_becomes_a_study():
    study = Study.from_text(SMALL)
    assert study.name == "small" and study.seeds == (0, 1) and study.accuracy == (1e-8,)
    assert study.data == (DataEntry("thruster", system="thruster", samples=(100, 200), noise=(0.0, 0.1)),)
    assert study.formulations[1] == FormulationEntry("monotone", "hammerstein_arx.exact", ("monotone:increasing",),
                                                     {"na": 2, "nb": 1, "basis": "triangular:6"})
    assert study.solvers == (SolverEntry("clarabel", "clarabel"), SolverEntry("gauss_newton", "gauss_newton"))


BAD = [
    ("acuracy = 1e-8", "acuracy", "Did you mean 'accuracy'"),
    ("accuracy = 2.0", "accuracy[0]", "must be less than 1"),
    ("accuracy = [1e-4,\n  'tight']", "accuracy[1]", "must be a number"),
    ("time_limit = '60'", "time_limit", "the text '60' is not"),
    ("time_limit = " + 400 * "9", "time_limit", "must be a number; a number of more than 60 digits is not"),
    ("seeds = [" + 80 * "9" + "]", "seeds[0]", "must be less than 4611686018427387904"),
    ("time_limit = inf", "time_limit", "finite number"),
    ("memory_limit = 0", "memory_limit", "greater than 0"),
    ("repetitions = 1.5", "repetitions", "must be an integer"),
    ("warm = 1", "warm", "true or false"),
    ("seeds = [1, -2]", "seeds[1]", "must be greater than or equal to 0"),
    ("seeds = 100_000_000", "seeds", "100,000,000 seeds are too many: at most 1,000,000"),
    ("seeds = [1, 2, 1]", "seeds[2]", "1 is there twice"),
    ("accuracy = [1e-4, 1e-8, 0.0001]", "accuracy[2]", "0.0001 is there twice"),
    ("[[data]]\nname = 'x'\nsystem = 'thruster'\nsamples = [100, 100]",
     "data[0].samples[1]", "100 is there twice"),
    ("[[data]]\nname = 'x'\nsystem = 'thruster'\nnoise = [0, 0.0]", "data[0].noise[1]", "0.0 is there twice"),
    ("seeds = []", "seeds", "is empty"),
    ("holdout = 1", "holdout", "must be less than 1"),
    ("name = ''", "name", "must be a text"),
    ("solvers = 'al'", "solvers[0]", "Did you mean 'all'"),
    ("solvers = ['clarabel', 'gausnewton']", "solvers[1]", "Did you mean 'gauss_newton'"),
    ("[[solver]]\nname = 'x'", "solver[0]", "needs solver"),
    ("[[solver]]\nsolver = 'scs'\nmax_iter = 3", "solver[0].max_iter", "options = { ... }"),
    ("[[solver]]\nsolver = 'scs'\noptions = 3", "solver[0].options", "must be a table"),
    ("[[solver]]\nsolver = 'scs'\noptions = { max_iters = 3, accuracy = 1e-2 }",
     "solver[0].options.accuracy", "accuracy = ... beside solver"),
    ("[[solver]]\nsolver = 'scs'\noptions.time_limit = 1", "solver[0].options.time_limit", "a key of the study"),
    ("[[solver]]\nsolver = 'scs'\n[solver.options]\nisolate = true",
     "solver[0].options.isolate", "'isolate' is none"),
    ("[[solver]]\nsolver = 'scs'\n[[solver]]\nsolver = 'scs'", "solver[1]", "two entries are called 'scs'"),
    ("[[data]]\nsystem = 'trhuster'", "data[0].system", "Did you mean 'thruster'"),
    ("[[data]]\nname = 'x'", "data[0]", "a file or a system"),
    ("[[data]]\nsystem = 'thruster'\nfile = 'x.csv'\nname='x'", "data[0]", "only one of file, system"),
    ("[[data]]\nname = 'x'\nsystem = 'thruster'\ninputs = ['u']", "data[0].inputs", "for a file"),
    ("[[data]]\nname = 'x'\nsystem = 'thruster'\nsamples = [100, 0]", "data[0].samples[1]", "must be greater than 0"),
    ("[[data]]\nname = 'x'\nsystem = 'thruster'\nnoise = -0.1", "data[0].noise[0]", "greater than or equal to 0"),
    ("[[data]]\nsystems = 'thruster'", "data[0].systems", "Did you mean 'system'"),
    ("[[data]]\nname = 'x'\nrecord = 1", "data[0].record", "unknown key 'record'"),
    ("[[data]]\nfile = 'rag.csv'", "data[0].file[0]", "rig.csv"),
    ("[[data]]\nfile = 'rig.csv'\ninputs = ['curent']\noutputs = 'thrust'",
     "data[0].inputs", "Did you mean 'current'"),
    ("[[data]]\nfile = 'rig.csv'\ninputs = ['current']\noutputs = ['trust']",
     "data[0].outputs", "Did you mean 'thrust'"),
    ("[[data]]\nfile = 'rig.csv'\ninputs = 3\noutputs = 'thrust'", "data[0].inputs", "a text or a list of texts"),
    ("[[data]]\nfile = 'rig.csv'\ninputs = 'current'\noutputs = 'thrust'\nsamples = 3",
     "data[0].samples", "simulated system"),
    ("[[formulation]]\nformulation = 'axr'", "formulation[0].formulation", "no formulation is called 'axr'"),
    ("[[formulation]]\nname = 'x'", "formulation[0]", "needs formulation"),
    ("[[formulation]]\nformulation = 'arx'\nna = 2\nnb = 1\nnc = 1\nname = 'x'",
     "formulation[0].nc", "no argument 'nc'"),
    ("[[formulation]]\nformulation = 'arx'\nna = 2\nname = 'x'", "formulation[0]", "needs nb"),
    ("[[formulation]]\nformulation = 'arx'\nna = 2.5\nnb = 1\nname = 'x'", "formulation[0].na", "must be an integer"),
    ("[[formulation]]\nformulation = 'arx'\nna = 2\nnb = 1\nname = 'x'\nconstraints = ['stabel']",
     "formulation[0].constraints[0]", "'stable'"),
    ("[[formulation]]\nformulation = 'arx'\nna = 2\nnb = 1\nname = 'x'\ndata = 'thrust'",
     "formulation[0].data[0]", "'thruster'"),
    ("[[formulation]]\nformulation = 'hammerstein_arx.exact'\nna = 2\nnb = 1\nbasis = 'triangel:8'",
     "formulation[0].basis", "'triangular'"),
    ("[[formulation]]\nformulation = 'hammerstein_arx.exact'\nna = 2\nnb = 1\nbasis = [8]",
     "formulation[0].basis", "a text"),
    ("[[formulation]]\nformulation = 'hammerstein_arx.exact'\nna = 2\nnb = 1\nbasis = 'linear'\ngauge = 'nrom'",
     "formulation[0].gauge", "must be one of 'norm', 'gain', 'b0'; 'nrom' is not"),
    ("[[formulation]]\nformulation = 'lfr.exact'\nnx = 2\nlatent_basis = 'polynomail:3'",
     "formulation[0].latent_basis", "'polynomial'"),
]


@pytest.mark.parametrize("text, key, words", BAD, ids=[text.replace("\n", " ")[:60] for text, *_ in BAD])
def test_everything_wrong_is_named_by_its_key(rig, text, key, words):
    whole = {"[[data]]": "[[data]]\nsystem = 'thruster'\n", "[[formulation]]": "[[formulation]]\nformulation = 'arx'\n"
             "na = 2\nnb = 1\n", "solver": "[[solver]]\nname = 'other'\nsolver = 'auto'\n"}
    text += "\n" + "".join(part for key, part in whole.items() if key not in text or key == "[[data]]")
    found = problems(text, rig)
    assert any(told.startswith(f"{key}: ") and words in told for told in found), found
    assert len(found) == 1 + ("a file or a system" in " ".join(found) and words != "a file or a system"), found


def test_all_problems_are_listed_at_once_and_one_that_repeats_once_with_its_number():
    found = problems("acuracy = 1\nholdout = 3\n" + SMALL.replace("thruster", "truster").replace("nb", "bn"))
    assert [line.partition(":")[0] for line in found] == [
        "acuracy", "data[0].system", "formulation[0].bn", "formulation[0]", "formulation[1].bn", "formulation[1]",
        "holdout"]
    repeated = SMALL + "".join(f'[[formulation]]\nname = "{k}"\nformulation = "arx"\nna = 0.5\nnb = 1\n'
                               for k in range(12))
    (told,) = problems(repeated)
    assert told == "formulation[2].na and 11 more: must be an integer; 0.5 is not"


def test_what_is_missing_altogether():
    found = problems("name = 'empty'")
    words = ["[[data]]", "[[formulation]]", 'solvers = "all"']
    assert len(found) == 3 and all(word in line for word, line in zip(words, found))


@pytest.mark.parametrize("text, place", [
    ("name = \n", "line 1, column 8"), ("a = 1\nb = 'x\n", "end of document"), ("[[data]\n", "line 1, column 7"),
    ("a = 1\na = 2\n", "line 2"), ("solvers = auto\n", "line 1, column 11"), ('file = "C:\\data"\n', "Unescaped"),
    ("time_limit = " + 5000 * "9", "Exceeds the limit"),
])
def test_what_is_not_toml_is_told_by_its_parser(text, place):
    (told,) = problems(text)
    assert place in told and "write texts in quotation marks" in told


def test_files_that_are_not_there_or_not_text(tmp_path):
    with pytest.raises(StudyError, match="cannot be read"):
        Study.from_toml(tmp_path / "nothing.toml")
    with pytest.raises(StudyError, match="cannot be read"):
        Study.from_toml(tmp_path)
    (tmp_path / "latin.toml").write_bytes("name = 'a'\n# f\xfcr".encode("latin-1"))
    with pytest.raises(StudyError, match="must be UTF-8.*position 14"):
        Study.from_toml(tmp_path / "latin.toml")
    (tmp_path / "windows.toml").write_bytes(b"\xef\xbb\xbf" + SMALL.replace("\n", "\r\n").encode())
    assert Study.from_toml(tmp_path / "windows.toml") == Study.from_text(SMALL)
    (tmp_path / "rigs.toml").write_text(SMALL.replace('name = "small"', ""))
    assert Study.from_toml(tmp_path / "rigs.toml").name == "rigs"  # without a title it is called as its file


@pytest.mark.parametrize("text, key, words", [
    (SMALL.replace("nb = 1", "nb = -1", 1), "formulation['arx']", "nb of input 'current' must be a positive integer"),
    (SMALL.replace("nb = 1", 'nb = 1\nconstraints = "saturation:-50,50"', 1),
     "formulation['arx + saturation:-50,50']", "does not fit the data: saturation levels"),
    (SMALL.replace("nb = 1", 'nb = 1\nconstraints = "saturation:5,1"', 1),
     "formulation[0].constraints[0]", "saturation needs low <= high; got 5.0, 1.0"),
    (SMALL.replace("[[data]]", "[data]"), "data", "written as [[data]], with two brackets"),
    (SMALL.replace("[[data]]", "[[datas]]"), "datas", "Did you mean 'data'"),
    (SMALL.replace('solvers = ["clarabel", "gauss_newton"]', 'solver = "clarabel"'), "solver", 'solvers = "auto"'),
    (SMALL.replace("[100, 200]", "1e3"), "data[0].samples[0]", "must be an integer; 1000.0 is not"),
])
def test_what_only_posing_the_problem_tells(text, key, words):
    found = problems(text)
    assert any(told.startswith(f"{key}: ") and words in told for told in found), found


OPTIONS = SMALL + """
[[solver]]
name = "tuned"
solver = "clarabel"
options = {{ max_iter = {}, {} }}
"""


@pytest.mark.sampled(2)
@pytest.mark.parametrize("written, key, words", [
    (("50", "max_itr = 3"), "max_itr", "max_itr makes clarabel fail where it succeeds without: TypeError"),
    (('"many"', "equilibrate_enable = true"), "max_iter",
     "max_iter makes clarabel fail where it succeeds without: TypeError"),
])
def test_options_that_a_solver_does_not_take_are_named(written, key, words):
    (told,) = problems(OPTIONS.format(*written))
    assert told.startswith(f"solver['tuned'].options.{key}: {words}")


def test_options_are_tried_only_where_that_says_something(monkeypatch):
    found = Study.from_text(OPTIONS.format("1", "equilibrate_enable = true"))  # it stops early: for the run to say
    assert dict(found.solvers[2].options) == {"max_iter": 1, "equilibrate_enable": True}
    wrong = {"solver": "clarabel", "options": {"max_itr": 3}}
    with pytest.raises(StudyError, match=r"solver\['clarabel'\].options.max_itr: max_itr makes clarabel fail"):
        replace(found, solvers=["scs", wrong]).check_data()
    replace(found, solvers=[wrong], formulations=found.formulations[1:]).check_data()  # not for clarabel at all
    replace(found, solvers=[{"solver": "mosek", "options": {"x": 1}}]).check_data()  # not installed
    monkeypatch.setattr(trial, "_solve", lambda *_: pytest.fail("no options, and yet a trial"))
    Study.from_text(SMALL)


def test_options_that_kill_a_solver_are_told(monkeypatch):
    from optid import backends

    clarabel = backends.back_ends()["clarabel"]
    monkeypatch.setitem(backends.back_ends(), "clarabel", replace(clarabel, run=killed_by_options))
    (told,) = problems(OPTIONS.format("50", "equilibrate_enable = true").replace("max_iter = 50, ", ""))
    assert "equilibrate_enable makes clarabel fail" in told and "SIGKILL" in told


@pytest.mark.slow
def test_a_formulation_that_fits_some_of_the_data_is_left_to_the_run():
    text = SMALL.replace("[[data]]", '[[data]]\nsystem = "two_modes"\n\n[[data]]', 1)
    one_output = text + '[[formulation]]\nformulation = "oe.exact"\nna = 2\nnb = 2\n'
    assert len(grid.cells(Study.from_text(one_output))) == 10 * 3 * 2  # records, formulations, solvers
    refused = problems(one_output + 'data = "two_modes"\n')
    assert len(refused) == 1 and "one output; there are 2" in refused[0]


def test_a_broken_formulation_of_a_third_party_is_told(monkeypatch):
    from importlib.metadata import EntryPoint

    from optid.registry import FORMULATIONS, find_entry_points

    known = {**find_entry_points(FORMULATIONS), "mine": EntryPoint("mine", "no_such_package:mine", FORMULATIONS)}
    monkeypatch.setattr("optid.studies.definition.find_entry_points",
                        lambda group: known if group == FORMULATIONS else {})
    found = problems(SMALL.replace('"arx"', '"mine"').replace('constraints = ["monotone:increasing"]', ""))
    assert found == ["formulation[0].formulation: formulation 'mine' cannot be loaded: ModuleNotFoundError: "
                     "No module named "
                     "'no_such_package'"]


# -- grids of arguments ------------------------------------------------------------------------------------------------


def names_of(text):
    return [entry.name for entry in Study.from_text(text).formulations]


def test_lists_of_arguments_form_the_grid():
    text = SMALL.replace("na = 2", "na = [1, 2, 3]", 1).replace("nb = 1", "nb = [1, 2]", 1)
    study = Study.from_text(text)
    assert [entry.name for entry in study.formulations[:3]] == ["arx, na = 1, nb = 1", "arx, na = 1, nb = 2",
                                                                "arx, na = 2, nb = 1"]
    assert [dict(entry.options) for entry in study.formulations[:2]] == [{"na": 1, "nb": 1}, {"na": 1, "nb": 2}]
    assert len(study.formulations) == 7 and len(grid.cells(study)) == 7 * 2 * 2 * 2 * 2
    assert Study.from_text(study.to_toml()) == study
    bases = SMALL.replace('basis = "triangular:6"', 'basis = ["triangular:6", "linear"]')
    assert names_of(bases)[1:] == ["monotone, basis = triangular:6", "monotone, basis = linear"]
    constraints = bases.replace('["monotone:increasing"]', '[[], ["stable"]]')
    assert [entry.constraints for entry in Study.from_text(constraints).formulations[1:]] == [
        (), (), ("stable",), ("stable",)]


def test_a_list_is_per_input_where_the_data_have_several():
    text = SMALL.replace('"thruster"', '"two_inputs"')
    assert [dict(entry.options)["nb"] for entry in Study.from_text(
        text.replace("nb = 1", "nb = [1, 2]", 1)).formulations] == [[1, 2], 1]
    assert names_of(text.replace("nb = 1", "nb = [[1, 2], [2, 1]]", 1))[:2] == ["arx, nb = 1+2", "arx, nb = 2+1"]


def test_what_is_wrong_in_a_grid_is_told_once():
    text = SMALL.replace("na = 2", "na = [1, 2, 0.5]", 1).replace("nb = 1", "nb = [1, 2]", 1)
    assert problems(text) == ["formulation[0].na: must be an integer; 0.5 is not"]
    (told,) = problems(SMALL.replace("na = 2", f"na = {list(range(20000))}", 1))
    assert "na form a grid of 20,000 formulations; the limit is 10,000" in told


def test_damaged_study_files_are_refused_by_name_or_read(tmp_path):
    rng, alphabet = np.random.default_rng(0), list("[]{}=\"'\\\n#.,-0123456789eaxnf\x00\u20ac")
    path = tmp_path / "damaged.toml"
    refused = 0
    for _ in range(200):
        text = list(SMALL)
        for at in rng.integers(0, len(text), rng.integers(1, 6)):
            text[at] = str(rng.choice(alphabet)) * int(rng.choice([0, 1, 3]))
        path.write_text("".join(text), encoding="utf-8")
        try:
            Study.from_toml(path)
        except StudyError as error:
            assert "damaged" in str(error)
            refused += 1
    assert refused > 100
    for nested in ("a = " + "[" * 100_000, "[" + "a." * 5_000 + "b]", "a = " + "{b=" * 20_000):
        with pytest.raises(StudyError):
            Study.from_text(nested)


# -- round trips and Python --------------------------------------------------------------------------------------------


_NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\r"), min_size=1, max_size=12).filter(str.strip)
_OPTIONS = _NAMES.filter(lambda name: name not in definition.SETTINGS)  # those are refused where options stand
_SHARES = st.floats(1e-12, 0.5)


def _lists(entries, **size):
    return st.lists(entries, unique=True, **size)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(name=_NAMES, labels=st.lists(_NAMES, min_size=2, max_size=2, unique=True), warm=st.booleans(),
       accuracy=_lists(_SHARES, min_size=1), noise=_lists(st.floats(0, 1e3)),
       seeds=_lists(st.integers(0, 2**40), min_size=1, max_size=5),
       options=st.dictionaries(_OPTIONS, st.integers() | st.floats(allow_nan=False) | _NAMES | st.booleans()
                               | st.datetimes() | st.dates() | st.times()))
def test_round_trip_of_any_study(name, labels, accuracy, seeds, noise, warm, options):
    study = Study(
        name, data=[{"system": "linear", "name": labels[0], "noise": noise}, {"system": "linear", "name": labels[1]}],
        formulations={"formulation": "arx", "na": 1, "nb": [1], "ridge": accuracy[0]}, accuracy=accuracy, seeds=seeds,
        solvers={"solver": "clarabel", "name": labels[0], "options": options}, warm=warm, holdout=accuracy[0])
    with pytest.MonkeyPatch.context() as patch:  # no solver takes options of any name, which would be told here
        patch.setattr(trial, "_wrong_options", lambda *_: [])
        assert Study.from_text(study.to_toml()) == study


def test_python_takes_what_is_simplest(rig):
    data = simulate("thruster", 50)[0]
    study = Study("t", data={"in memory": data, "simulated": "thruster", "on disk": {
        "file": "rig.csv", "inputs": "current", "outputs": "thrust"}}, formulations={"a": {
            "formulation": "arx", "na": 2, "nb": 1}}, solvers="clarabel", accuracy=1e-6, seeds=3, folder=rig)
    assert [entry.name for entry in study.data] == ["in memory", "simulated", "on disk"]
    assert study.data[0].record is data and study.data[2].files == ("rig.csv",)
    assert study.seeds == (0, 1, 2) and study.accuracy == (1e-6,) and study.formulations[0].name == "a"
    assert replace(study, seeds=range(2)).seeds == (0, 1)
    assert replace(study, seeds=200_000).seeds == tuple(range(200_000))  # in a moment, though no two may be equal
    with pytest.raises(StudyError, match="in memory"):
        study.to_toml()
    assert optid.Study is Study


def test_all_solvers_are_those_installed():
    from optid.backends import back_ends

    study = replace(Study.from_text(SMALL), solvers="all")
    assert study.solvers == replace(study, solvers=["all"]).solvers
    assert {entry.solver for entry in study.solvers} == {n for n, b in back_ends().items() if b.installed}


def test_python_hears_all_problems_with_their_places():
    with pytest.raises(StudyError) as caught:
        Study("t", data=["thruster", {"system": "linea"}], formulations=[{"formulation": "arx", "na": 2}, 3],
              solvers=["scs", {"solver": "clarabel", "acuracy": 1}], warm="yes", seeds=np.int64(0))
    lines = [line.strip().split(":")[0] for line in str(caught.value).splitlines()]
    assert set(lines[1:]) == {"warm", "seeds", "data[1].system", "formulation[0]", "formulation[1]",
                              "solver[1].acuracy"}


@pytest.mark.parametrize("change, words", [
    ({"data": {"rig": (np.zeros(9), np.zeros(9))}}, "data[0]: must be a record, optid.Data(u, y, dt)"),
    ({"formulations": [3]}, "formulation[0]: must be a table of keys with the name of a formulation; 3 is not"),
    ({"solvers": 3}, "solver[0]: must be the name of a solver, or a table of keys; 3 is not"),
    ({"solvers": "al"}, "no solver is called 'al'. Did you mean 'all'?"), ({"data": []}, "there is no [[data]]"),
    ({"solvers": []}, "there is no solver"),
])
def test_python_hears_what_an_axis_takes_and_nothing_besides(change, words):
    with pytest.raises(StudyError) as caught:
        Study("t", **{"data": "thruster", "formulations": {"formulation": "arx", "na": 2, "nb": 1}, "solvers": "auto",
                      **change})
    assert words in str(caught.value) and str(caught.value).count("\n") == 1


@pytest.mark.parametrize("value, words", [
    (object(), "<class 'object'>"), ([1, {2}], "<class 'set'>"), (None, "<class 'NoneType'>"),
    ({"a": 1j}, "<class 'complex'>"), ({1: 2}, "Keys must be strings"),
])
def test_options_are_what_a_study_file_can_hold(value, words):
    """Others have no text that tells two of them apart: cells would share a key, and one take over the other's rows."""
    data = {"system": "linear", "samples": 200}
    for place, of_formulation, of_solver in (("formulation[0].initial", {"initial": value}, {}),
                                             ("solver[0].options.initial", {}, {"initial": value})):
        with pytest.raises(StudyError) as caught:
            Study("t", data, {"formulation": "subspace.nuclear", "nx": 2, **of_formulation},
                  {"solver": "scs", "options": of_solver})
        assert f"{place}: a study file cannot hold it" in str(caught.value) and words in str(caught.value)


def test_files_are_looked_for_before_a_run(rig):
    study = Study("t", data=["rig.csv", "none.csv"], formulations={"formulation": "arx", "na": 2, "nb": 1},
                  solvers="auto", folder=rig)
    with pytest.raises(StudyError, match=r"(?s)data\[0\].inputs: .*no column 'u'.*data\[1\].file\[0\]: no file"):
        study.check_data()


# -- the grid ----------------------------------------------------------------------------------------------------------


def test_the_grid_has_every_combination_once():
    cells = grid.cells(replace(Study.from_text(SMALL), repetitions=2, accuracy=(1e-4, 1e-8)))
    assert len(cells) == 2 * 2 * 2 * 2 * 2 * 2 * 2
    assert len({(cell.key, cell.repetition) for cell in cells}) == len(cells)
    assert {(c.samples, c.noise, c.seed, c.formulation, c.solver, c.accuracy, c.repetition) for c in cells} == {
        (s, n, e, f, v, a, r) for s in (100, 200) for n in (0.0, 0.1) for e in (0, 1) for f in ("arx", "monotone")
        for v in ("clarabel", "gauss_newton") for a in (1e-4, 1e-8) for r in (0, 1)}
    assert pickle.loads(pickle.dumps(cells)) == cells


def test_cells_are_counted_without_being_made(rig):
    study = Study("t", data=["linear", {"system": "thruster", "samples": [50, 60], "noise": [0.1, 0.2]}, {
        "file": "rig.csv", "inputs": "current", "outputs": "thrust"}], folder=rig, repetitions=2, seeds=3,
        formulations=[{"formulation": "arx", "na": 1, "nb": 1}, {"name": "b", "formulation": "arx", "na": 2, "nb": 1,
                                                                 "data": ["linear", "rig"]}],
        solvers=["auto", {"solver": "scs", "accuracy": [1e-4, 1e-6]}])
    assert grid.number_of_cells(study) == len(grid.cells(study)) == (3 * 2 + 12 + 2) * 3 * 2
    with pytest.raises(StudyError, match="has 600,000,060 cells; at most 1,000,000 are allowed"):
        grid.cells(replace(study, repetitions=10_000_001))


def test_a_formulation_may_be_for_some_of_the_data():
    text = SMALL.replace("na = 2\nnb = 1\n\n", 'na = 2\nnb = 1\ndata = "linear"\n\n') + '[[data]]\nsystem = "linear"\n'
    pairs = {(cell.data, cell.formulation) for cell in grid.cells(Study.from_text(text))}
    assert pairs == {("thruster", "monotone"), ("linear", "arx"), ("linear", "monotone")}


@pytest.mark.parametrize("change", [
    {"accuracy": 1e-7}, {"warm": True}, {"time_limit": 30.0}, {"memory_limit": 500.0}, {"holdout": 0.0},
    {"data": {"system": "thruster", "samples": [100, 200], "noise": [0.0, 0.2]}},
    {"formulations": [{"formulation": "arx", "na": 3, "nb": 1}]}, {"solvers": ["scs"]}, {"seeds": [7]},
    {"solvers": {"solver": "clarabel", "options": {"max_iter": 9}}},
    {"formulations": [{"formulation": "arx", "na": 2, "nb": 1, "constraints": "stable"}]},
])
def test_whatever_determines_the_result_changes_the_key(change):
    study = replace(Study.from_text(SMALL), formulations=[{"formulation": "arx", "na": 2, "nb": 1}],
                    solvers="clarabel", seeds=1)
    before, after = ({cell.key for cell in grid.cells(s)} for s in (study, replace(study, **change)))
    assert len(before - after) == (2 if "data" in change else 4)


def test_labels_and_title_do_not_change_the_key():
    study = Study.from_text(SMALL)
    other = replace(study, name="other", data={**{"system": "thruster", "name": "x"}, "samples": [100, 200],
                                               "noise": [0.0, 0.1]})
    assert [cell.key for cell in grid.cells(study)] == [cell.key for cell in grid.cells(other)]


def test_versions_change_the_key(monkeypatch):

    study = Study.from_text(SMALL)
    before = {cell.key for cell in grid.cells(study)}
    grid.determining.cache_clear()
    monkeypatch.setattr(grid, "installed_version", lambda name: "99")
    assert not before & {cell.key for cell in grid.cells(study)}
    monkeypatch.undo()
    grid.determining.cache_clear()
    assert before == {cell.key for cell in grid.cells(study)}


def test_versions_do_not_depend_on_how_optid_was_installed(monkeypatch):
    """In place it is no distribution that holds the package; as a wheel it is."""

    found = []
    for holders in ((), ("optid",)):
        monkeypatch.setattr(grid, "packages_of", lambda package, holders=holders: holders)
        found.append([grid.determining.__wrapped__("arx", solver) for solver in ("gauss_newton", "scs", "auto")])
    assert found[0] == found[1]
    own, other, auto = found[0]
    assert "source of gauss_newton" in own and other["scs"] != "not installed"
    assert {"source of admm", "source of block_descent", "scs", "unopy"} <= set(auto)


def test_the_same_cell_twice_is_refused():
    study = replace(Study.from_text(SMALL), solvers={"one": "clarabel", "two": "clarabel"})
    with pytest.raises(StudyError, match="solver 'one' and 'two'"):
        grid.cells(study)


def test_a_solver_that_is_not_installed_is_refused_with_its_remedy():
    study = replace(Study.from_text(SMALL), solvers=["mosek", "auto"])
    refusals = {cell.solver: cell.refusal for cell in grid.cells(study)}
    assert refusals["auto"] == "" and "pip install Mosek" in refusals["mosek"]


def test_the_content_of_a_file_is_what_sha256sum_says(rig):
    import hashlib

    digest = hashlib.sha256((rig / "rig.csv").read_bytes())
    assert grid.content_hash(DataEntry("x", (str(rig / "rig.csv"),))) == digest.hexdigest()
    assert (grid.content_hash(DataEntry("x", (str(rig / "rig.csv"),) * 2))
            == hashlib.sha256(2 * digest.digest()).hexdigest())
    assert grid.content_hash(DataEntry("x", system="linear")) == ""
    data = [simulate("thruster", 60, seed=seed)[0] for seed in (0, 0, 1)]
    one, same, other = (grid.content_hash(DataEntry(record=record)) for record in data)
    assert one == same != other


def test_a_file_that_went_after_it_was_checked_is_told(rig):
    study = Study("t", data={"file": "rig.csv", "inputs": "current", "outputs": "thrust"}, solvers="auto",
                  formulations={"formulation": "arx", "na": 2, "nb": 1}, folder=rig)
    study.check_data()
    (rig / "rig.csv").unlink()
    with pytest.raises(StudyError, match="study 't': .*rig.csv cannot be read: No such file"):
        grid.cells(study)


# -- records -----------------------------------------------------------------------------------------------------------


def test_files_are_cut_and_simulated_records_keep_their_length(rig):
    study = Study("t", data=[{"file": "rig.csv", "inputs": "current", "outputs": "thrust"}, "thruster"],
                  solvers="auto", formulations={"formulation": "arx", "na": 2, "nb": 1}, folder=rig, holdout=0.25)
    cells = grid.cells(study)
    record = load(cells[0])
    assert (record.data.n_samples, record.holdout.n_samples, record.truth) == (30, 10, None)
    record = load(cells[1])
    assert (record.data.n_samples, record.holdout.n_samples) == (600, 200)
    assert not np.array_equal(record.data.y[:200], record.holdout.y)
    assert load(replace(cells[0], holdout=0.0)).holdout is None
    assert load(replace(cells[1], holdout=0.0)).data.n_samples == 600


def test_relative_file_names_start_at_the_study_file(rig, monkeypatch, tmp_path_factory):
    text = SMALL.replace('system = "thruster"\nsamples = [100, 200]\nnoise = [0.0, 0.1]',
                         'file = "rig.csv"\ninputs = "current"\noutputs = "thrust"')
    (rig / "study.toml").write_text(text)
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    cell = grid.cells(Study.from_toml(rig / "study.toml"))[0]
    assert Path(cell.data_source.files[0]) == (rig / "rig.csv").resolve()
    assert load(cell).data.inputs == ("current",)


# -- systems and truth -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_has_the_noise_asked_for(name):
    chosen, n = SYSTEMS[name], 3000
    clean, noisy = simulate(name, n, 0.0, seed=5)[0], simulate(name, n, 0.2, seed=5)[0]
    assert noisy.y.shape == (n, clean.l) and np.array_equal(clean.u, noisy.u) and chosen.samples > 0
    assert np.array_equal(noisy.y, simulate(name, n, 0.2, seed=5)[0].y)
    assert not np.array_equal(noisy.u, simulate(name, n, 0.2, seed=6)[0].u)
    size = np.sqrt(np.mean(np.var(noisy.y - clean.y, axis=0)) / np.mean(np.var(clean.y, axis=0)))
    if name in ("vanderpol", "pendulum", "example1"):  # the noise enters the state, or there is one output without any
        assert size > 0.05
    else:
        assert size == pytest.approx(0.2, rel=0.12)


@pytest.mark.parametrize("name", sorted(set(SYSTEMS) & set(EXAMPLES) - {"vanderpol", "pendulum"}))
def test_built_in_records_are_the_same_systems(name):
    np.testing.assert_allclose(simulate(name, seed=3)[0].y, EXAMPLES[name](seed=3).data.y, rtol=1e-12)


def test_simulations_that_cannot_be():
    with pytest.raises(LookupFailed, match="'thruster'"):
        simulate("truster")
    for samples, noise in ((0, 0.1), (10, -1.0), (10, float("nan"))):
        with pytest.raises(optid.errors.DataError, match="samples must be positive"):
            simulate("thruster", samples, noise)


IN_CLASS = [("dead_zone_in_span", "hammerstein_arx.exact"), ("ding_chen", "hammerstein_armax.exact"),
            ("linear", "oe.exact"), ("two_modes", "hammerstein_ss.sid"), ("step_test", "process.exact")]


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name, formulation", IN_CLASS)
def test_a_model_of_the_class_has_no_error_without_noise(name, formulation):
    from optid.cli.arguments import drop_foreign_options

    data, truth = simulate(name, 800, 0.0, seed=1)
    arguments = drop_foreign_options(SYSTEMS[name].suggestion, formulation)
    if name == "dead_zone_in_span":  # its basis, on the interval of its nodes
        arguments["basis"] = optid.Triangular(8, interval=(-1.0, 1.0))
    with np.errstate(all="ignore"):
        model = optid.fit(data, formulation, prove=False, **arguments).model
    assert truth.parameter_error(model) < 1e-8 and truth.nonlinearity_error(model) < 1e-8


def test_errors_do_not_depend_on_the_gauge_and_are_what_they_say():
    data, truth = simulate("dead_zone", 500, 0.1)
    fit = {gauge: optid.fit(data, na=2, nb=2, basis="triangular:6", gauge=gauge).model for gauge in ("norm", "b0")}
    errors = [(truth.parameter_error(model), truth.nonlinearity_error(model)) for model in fit.values()]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-9)
    model = fit["norm"]
    u = np.linspace(-1, 1, 401)
    line = np.polyfit(model.f(u), truth.f[0](u), 1)  # independent: scale and offset by polyfit
    left = np.polyval(line, model.f(u)) - truth.f[0](u)
    assert errors[0][1] == pytest.approx(np.sqrt(np.mean(left**2)) / np.std(truth.f[0](u)), rel=1e-9)
    found = model.impulse_response(200)[:, 0, 0] / line[0]
    true = truth.response[:, 0, 0]
    assert errors[0][0] == pytest.approx(np.linalg.norm(found - true) / np.linalg.norm(true), rel=1e-9)


def test_errors_that_cannot_be_told():
    data, _ = simulate("linear", 300, 0.1)
    model = optid.fit(data, "arx", na=2, nb=2).model
    other = Truth((np.sin, np.sin), ((-1, 1),) * 2, np.ones((200, 1, 2)))
    assert np.isnan(other.parameter_error(model)) and np.isnan(other.nonlinearity_error(model))
    fed_back = Truth((np.sin,), ((-1, 1),))
    assert np.isnan(fed_back.parameter_error(model)) and fed_back.nonlinearity_error(model) < 0.1


def test_data_that_changed_are_refused(rig):
    study = Study("t", data={"file": "rig.csv", "inputs": "current", "outputs": "thrust"}, solvers="auto",
                  formulations={"formulation": "arx", "na": 2, "nb": 1}, folder=rig)
    before = grid.cells(study)
    hashes = {("t", "rig"): {before[0].data_hash}}
    grid.check_unchanged(before, hashes)
    grid.check_unchanged(before, {("t", "another"): {"0"}, ("another", "rig"): {"0"}})
    with open(rig / "rig.csv", "a") as file:
        file.write("0.5,0.5\n")
    after = grid.cells(study)
    assert after[0].key != before[0].key
    with pytest.raises(StudyError, match=r"(?s)rig: .*rig.csv.*--accept-changed-data"):
        grid.check_unchanged(after, hashes)

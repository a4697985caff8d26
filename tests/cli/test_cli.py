import inspect
import json
import os
import subprocess
import sys
import warnings
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import typer
from commands import run
from hypothesis import given
from hypothesis import strategies as st

import optid
from optid.cli.terminal import spread
from optid.core.problem import Problem
from optid.core.statement import for_solvers, statement_of
from optid.descriptions import describe
from optid.examples import EXAMPLES, example
from optid.registry import CONSTRAINTS, FAULTS, FORMULATIONS, find_entry_points
from optid.solving.solve import solve


def table(path: Path, **columns: np.ndarray) -> Path:
    rows = zip(*columns.values())
    path.write_text(
        "\n".join([",".join(columns), *(",".join("" if v != v else repr(float(v)) for v in row) for row in rows)]))
    return path


@pytest.fixture(scope="module")
def csv(tmp_path_factory) -> Path:
    rng = np.random.default_rng(0)
    u1, u2, y = rng.uniform(-1, 1, 400), rng.uniform(-1, 1, 400), np.zeros(400)
    for k in range(1, 400):
        y[k] = 0.6 * y[k - 1] + u1[k] ** 3 + 0.5 * abs(u2[k - 1]) + 0.01 * rng.standard_normal()
    folder = tmp_path_factory.mktemp("records")
    table(folder / "second.csv", u1=u1[200:], u2=u2[200:], y1=y[200:])
    return table(folder / "record.csv", u1=u1, u2=u2, y1=y)


ORDERS = ["--na", 1, "--nb", 2, "--basis", "polynomial:3"]


@pytest.mark.parametrize("place", ["no_such_package:mine", "formulations.constraints.shape:no_such_function"])
def test_a_broken_plug_in_takes_nothing_away(monkeypatch, place):
    known = {**find_entry_points(CONSTRAINTS), "mine": EntryPoint("mine", place, CONSTRAINTS)}
    monkeypatch.setattr("optid.cli.listings.find_entry_points", lambda group: known)
    result = run("constraints")
    assert result.exit_code == 0 and "cannot be loaded" in result.output and "monotone" in result.output


# -- words -------------------------------------------------------------------------------------------------------------

values = st.text("abc13", min_size=1, max_size=3)


@given(
    st.lists(
        st.tuples(st.sampled_from(["--in", "--out", "--dt"]), st.lists(values, min_size=1, max_size=4)), max_size=5
    ),
    st.lists(values, max_size=2),
)
def test_spreading_repeats_the_option_before_each_value(options, before):
    words, expected = list(before), list(before)
    for option, given_values in options:
        listed = given_values[:1] if option == "--dt" else given_values
        words += [option, *listed]
        expected += [option, *listed] if option == "--dt" else [part for value in listed for part in (option, value)]
    assert spread(words, {"--in": False, "--out": False}) == expected


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--in a b data.csv", "--in a --in b data.csv"), ("--in a data.csv --in b", "--in a data.csv --in b"),
        ("--files a.csv b.csv", "--files a.csv --files b.csv"), ("--in=a b", "--in=a --in b"),
        ("--in a -- b", "--in a -- b"), ("--in -1.5 -2", "--in -1.5 --in -2"),
    ],
)
def test_spreading_stops_where_the_list_ends(words, expected):
    assert spread(words.split(), {"--in": False, "--out": False, "--files": True}) == expected.split()


@pytest.mark.parametrize("words", ["--in", "--in --out a", "--in --", "--in --dt 1"])
def test_an_option_without_a_value_is_refused(words):
    with pytest.raises(typer.BadParameter, match="--in needs a value"):
        spread(words.split(), {"--in": False, "--out": False})


@pytest.mark.slow
def test_several_values_by_spaces_commas_and_repetition_are_the_same(csv, tmp_path):
    models = []
    for k, names in enumerate((["--inputs", "u1", "u2"], ["--inputs", "u1,u2"], ["--inputs", "u1", "--inputs", "u2"])):
        path = tmp_path / f"{k}.json"
        result = run("fit", *names, "--outputs", "y1", csv, *ORDERS, "--nk", 0, 0, "--model", path)
        assert result.exit_code == 0, result.output
        models.append(path.read_text())
    assert models[0] == models[1] == models[2]
    assert optid.load(tmp_path / "0.json").inputs == ("u1", "u2")


# -- fit ---------------------------------------------------------------------------------------------------------------


def test_the_command_line_and_python_give_the_same_model(csv, tmp_path):
    result = run(
        "fit", csv, "--dt", 0.5, "--na", 1, "--nb", 1, 2, "--nk", 0, 1, "--basis", "polynomial:3", "polynomial:2",
        "--constraint", "monotone:increasing,channel=u1", "--gauge", "b0", "--ridge", 1e-3, "--model",
        tmp_path / "m.json")
    assert result.exit_code == 0, result.output
    from formulations.constraints import shape

    fit = optid.fit(
        optid.read(csv, dt=0.5), na=1, nb=[1, 2], nk=[0, 1], basis=["polynomial:3", "polynomial:2"],
        constraints=[shape.monotone("increasing", channel="u1")], gauge="b0", ridge=1e-3)
    loaded = optid.load(tmp_path / "m.json")
    assert np.array_equal(loaded.a, fit.model.a) and loaded.dt == 0.5
    assert all(np.array_equal(one, other) for one, other in zip(loaded.b, fit.model.b))
    assert fit.model.equation().split(" = ")[0] in result.output and "model written to" in result.output


@pytest.mark.slow
@pytest.mark.parametrize(("word", "count"), [("--split", 100), ("--test", 200)])
def test_held_out_samples_are_validated_on_and_the_report_has_it(csv, tmp_path, word, count):
    value = 0.75 if word == "--split" else csv.parent / "second.csv"
    result = run("fit", csv, *ORDERS, word, value, "--report", tmp_path / "r.html")
    assert result.exit_code == 0 and f"{count} samples held out of the fit" in result.output, result.output
    assert "Test record, not used by the fit" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_other_arguments_of_the_formulation_pass_through_set(csv):
    result = run(
        "fit", csv, "--inputs", "u1", "--formulation", "hammerstein_arx.nuclear", *ORDERS, "--set", "weight=0.25")
    assert result.exit_code == 0, result.output
    assert "nuclear dual" in result.output
    wrong = run("fit", csv, "--inputs", "u1", *ORDERS, "--set", "wait=3")
    assert wrong.exit_code == 2 and "takes no argument 'wait'" in wrong.output


def test_a_stream_gives_the_same_model(csv, tmp_path):
    for name, more in (("a.json", []), ("b.json", ["--stream"])):
        assert run("fit", csv, "--inputs", "u1", *ORDERS, *more, "--model", tmp_path / name).exit_code == 0
    assert np.allclose(optid.load(tmp_path / "a.json").a, optid.load(tmp_path / "b.json").a, rtol=1e-9)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_every_example_runs_as_suggested(name):
    result = run("fit", "--example", name, "--seed", 1)
    assert result.exit_code == 0, result.output
    proved = "formulation_name" not in example(name).suggestion  # the default one is proved
    assert ("optimal (proved)" if proved else "3 of 3 starts converge") in " ".join(result.output.split())
    assert np.array_equal(example(name, seed=1).data.y, example(name, seed=1).data.y)


@pytest.mark.slow
def test_a_suggestion_is_overruled_and_cut_to_what_the_formulation_takes():
    result = run("fit", "--example", "dead_zone", "--formulation", "arx", "--na", 1)
    assert result.exit_code == 0 and "Linear ARX model" in result.output and "a2" not in result.output
    other = run("fit", "--example=heater", "--formulation", "hammerstein_arx.exact")
    assert other.exit_code == 0 and "Hammerstein ARX model" in other.output
    free = run("fit", "--example", "dead_zone", "--constraint", "none")
    assert free.exit_code == 0 and "monotone" not in free.output


def test_a_solver_is_chosen_by_one_word():
    result = run(
        "fit", "--example", "dead_zone", "--formulation", "hammerstein_arx.overparametrised", "--solver", "scs")
    assert result.exit_code == 0 and "scs" in result.output


# -- options of the formulation ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_formulation_brings_its_options_along(csv, tmp_path):
    words = ["--inputs", "u1", "u2", "--outputs", "y1", "--formulation", "hammerstein_ss.sid", "--nx", "1",
             "--block-rows", "6", "--basis", "polynomial:3", "--feedthrough", "true", "true",
             "--no-offset"]  # fmt: skip
    result = run("fit", csv, *words, "--model", tmp_path / "m.json")
    assert result.exit_code == 0, result.output
    data = optid.read(csv, inputs=["u1", "u2"], outputs=["y1"])
    with warnings.catch_warnings(action="ignore", category=optid.errors.DataWarning):
        expected = optid.fit(data, "hammerstein_ss.sid", nx=1, block_rows=6, basis="polynomial:3",
                             feedthrough=[True, True], offset=False)  # fmt: skip
    assert optid.load(tmp_path / "m.json").to_dict() == expected.model.to_dict()
    assert "Block rows: 6" in result.output


@pytest.mark.parametrize(("words", "listed"), [
    (["-f", "hammerstein_ss.asivid"],
     ["--nx", "--block-rows", "--feedback-basis", "--no-offset", "Arguments of hammerstein_ss.asivid"]),
    ([], ["--nx", "--feedback-basis", "--criterion", "--nc", "--equations", "Arguments of other formulations"])])
def test_help_lists_the_options_of_the_formulation_named_or_of_all(words, listed):
    text = run("fit", *words, "--help").output
    assert all(option in text for option in listed) and text.count("--nx ") == 1
    assert "--nx" not in run("fit", "-f", "arx", "--help").output


def test_an_option_that_the_formulation_does_not_take_is_explained(csv):
    text = " ".join(run("fit", csv, "-f", "arx", "--nx", 3).output.replace("\u2502", " ").split())
    assert "formulation arx takes no --nx; its own options are --na --nb --nk" in text
    assert "Formulations that do:" in text and "hammerstein_ss.sid" in text
    assert "no formulation is called 'arrx'" in " ".join(run("fit", csv, "-f", "arrx", "--nx", 3).output.split())


# -- validate and listings ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_validate_takes_names_and_sampling_time_from_the_model(csv, tmp_path):
    assert run("fit", csv, "--dt", 0.5, *ORDERS, "--model", tmp_path / "m.json").exit_code == 0
    result = run("validate", tmp_path / "m.json", csv.parent / "second.csv")
    assert result.exit_code == 0, result.output
    model = optid.load(tmp_path / "m.json")
    with warnings.catch_warnings(action="ignore", category=optid.errors.DataWarning):  # of its length
        expected = optid.validate(model, optid.read(csv.parent / "second.csv", dt=0.5))
    assert f"{expected.one_step['y1'].fit:.2f}" in result.output
    assert model.equation() in result.output


def test_solvers_are_listed_from_the_registry():
    from optid.backends import back_ends

    result = run("solvers")
    assert result.exit_code == 0
    lines = {line.split()[0]: line for line in reversed(result.output.splitlines()) if line.strip()}
    for name, back_end in back_ends().items():
        assert name in lines
        assert all(kind in lines[name] for kind in back_end.classes)
        if not back_end.installed and back_end.pip:
            assert f"pip install {back_end.pip}" in " ".join(result.output.split())


@pytest.mark.parametrize(("command", "names"), [
    ("formulations", find_entry_points(FORMULATIONS)), ("formulations", find_entry_points(FAULTS)),
    ("constraints", find_entry_points(CONSTRAINTS)), ("examples", EXAMPLES)])
def test_registered_names_are_listed(command, names):
    result = run(command)
    assert result.exit_code == 0 and set(names) <= set(result.output.split())


def last_programme(procedure):
    program = next(procedure)
    try:
        while True:
            program = procedure.send(solve(program))
    except StopIteration:
        return program


@pytest.mark.sampled(8)
@pytest.mark.filterwarnings("ignore::optid.errors.DataWarning")
@pytest.mark.parametrize("name", sorted(find_entry_points(FORMULATIONS)))
def test_a_formulation_documents_the_variables_it_poses(name):
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 60)
    data = optid.Data(u, np.convolve(u + u**2, [1.0, 0.5])[:60] + 0.1 * rng.standard_normal(60))
    if name == "process.exact":  # which responds at a later time, at a constant rate
        level = np.repeat(rng.uniform(-1, 1, 6), 10)
        data = optid.Data(level, np.convolve(level, 0.3 * 0.7 ** np.arange(30))[:60] + 0.01 * rng.standard_normal(60))
    plant = optid.Equations(lambda v: {"x": v["a"] * v["x"] + v["b"] * v["u"], "y": v["x"]}, {"x": 0.1},
                            {"a": 0.5, "b": 1.0}, time="discrete")
    basis = "linear" if name == "process.exact" else "polynomial:2"
    offered = {"equations": plant, "na": 1, "nb": 2, "nk": 0, "nc": 1, "nd": 1, "nx": 1, "basis": basis}
    found = describe(find_entry_points(FORMULATIONS)[name])
    function = find_entry_points(FORMULATIONS)[name].load()
    parameters = inspect.signature(function).parameters
    assert list(found.signature.parameters) == list(parameters)
    problem = function(data, **{key: value for key, value in offered.items() if key in parameters})
    if not isinstance(problem, Problem):
        behind = "shooting" in name or "ss.exact" in name or "lfr" in name  # the steps that find the start
        problem = last_programme(problem) if behind else next(problem)
    view = statement_of(for_solvers(problem)).view
    courses = {"output y", "states of x", "x0"}  # with the names of a plant of equations
    own = {*plant.states, *plant.parameters, *courses} if name == "physical" else set()
    assert set(found.variables) == set(view) - own


def test_completion_in_a_shell():
    asked = {"complete_bash": ["--formulation"], "source_bash": "_optid_completion() {".split()}
    for instruction, words in asked.items():
        given = {"_OPTID_COMPLETE": instruction, "COMP_WORDS": "optid fit --formu", "COMP_CWORD": "2"}
        done = subprocess.run([sys.executable, "-m", "optid"], env={**os.environ, **given}, capture_output=True,
                              text=True)
        assert done.stdout.split()[: len(words)] == words


@pytest.mark.parametrize(("name", "group"), [("bj.exact", FORMULATIONS), ("fault.profile", FAULTS)])
def test_one_formulation_is_explained(name, group):
    found, shown = describe(find_entry_points(group)[name]), run("formulations", name)
    text = " ".join(shown.output.split())
    assert shown.exit_code == 0 and found.summary.split(".")[0][:40] in text
    assert all(f"--{key.replace('_', '-')} " in text for key in found.options if key != "constraints")
    assert all(word in text for word in found.variables)
    assert ("optid.fit(data, 'bj.exact', na=..., nb=..., nc=..., nd=...)" in text) == (name == "bj.exact")


def test_formulations_name_their_variables():
    text = " ".join(run("formulations").output.split())
    assert "variables: Theta a b mu offset" in text and "variables: Theta a offset" in text


# -- errors: one clean message and an exit code ------------------------------------------------------------------------

@pytest.fixture(scope="module")
def spoiled(tmp_path_factory) -> Path:
    """A folder of records and models of which most are wrong in some way."""
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("spoiled")
    u, y, time = rng.uniform(-1, 1, 100), rng.standard_normal(100), np.arange(100.0)
    for name, inputs in (("good", u), ("infinite", np.where(time == 7, np.inf, u)), ("constant", np.ones(100)),
                         ("binary", np.sign(u)), ("levels", np.round(u)), ("short", u[:6])):
        table(folder / f"{name}.csv", u=inputs, y=y)
    table(folder / "stamped.csv", time=time + 0.5 * (time >= 50), u=u, y=y)
    (folder / "empty.csv").write_text("")
    (folder / "model.json").write_text('{"format": "optid model", "vers')
    return folder


@pytest.mark.parametrize(("command", "code", "words"), [
    ("fit infinite.csv ORDERS", 2, ["infinite.csv", "'u'", "7"]),
    ("fit constant.csv ORDERS", 2, ["'u'", "constant", "excite"]),
    ("fit binary.csv ORDERS", 2, ["'u'", "binary", "arx"]), ("fit levels.csv ORDERS", 2, ["'u'", "levels", "basis"]),
    ("fit short.csv ORDERS", 2, ["rows"]), ("fit empty.csv ORDERS", 2, ["empty.csv"]),
    ("fit nothing.csv ORDERS", 2, ["nothing.csv"]), ("fit ORDERS", 2, ["--example"]),
    ("fit good.csv --inputs v ORDERS", 2, ["no column 'v'"]), ("fit stamped.csv ORDERS", 2, ["stamped.csv", "50"]),
    ("fit good.csv ORDERS --formulation hammerstein_arx.exakt", 2, [
        "'hammerstein_arx.exakt'", "Did you mean 'hammerstein_arx.exact'?"]),
    ("fit good.csv ORDERS --solver clarabell", 2, ["'clarabell'", "Did you mean 'clarabel'?"]),
    ("fit good.csv ORDERS --constraint monoton:increasing", 2, ["'monoton'", "Did you mean 'monotone'?"]),
    ("fit --example thrster", 2, ["'thrster'", "Did you mean 'thruster'?"]),
    ("fit good.csv --na 1 --nb 2 --basis triangle:5", 2, ["'triangle'", "Did you mean 'triangular'?"]),
    ("fit good.csv --na 1 --nb two --basis triangular:5", 2, ["--nb", "integer", "two"]),
    ("fit good.csv --na 1", 2, ["needs --nb, --basis"]),
    ("fit good.csv ORDERS --solver osqp", 2, ["osqp", "not convex", "gauss_newton"]),
    ("validate model.json good.csv", 2, ["model.json", "truncated"]),
    ("fit good.csv ORDERS --report nowhere/r.html", 2, ["nowhere"]),
    ("fit good.csv ORDERS --constraint coefficients:a,low=0.5 stable:0.3", 3, ["contradict"]),
    ("fit good.csv ORDERS --solver mosek", 4, ["pip install"]),
    ("fit good.csv ORDERS --set weight", 2, ["--set weight", "key=value"]),
    ("formulations bj.exct", 2, ["Did you mean 'bj.exact'?"])])
def test_bad_input_ends_with_one_message_and_its_code(command, code, words, spoiled, monkeypatch):
    monkeypatch.chdir(spoiled)
    result = run(*command.replace("ORDERS", " ".join(map(str, ORDERS))).split())
    assert result.exit_code == code, result.output
    message = next(line for line in result.output.splitlines() if line.startswith("error: "))
    assert all(word in message for word in words), message
    assert "Traceback" not in result.output


def test_an_unknown_option_is_refused_with_code_2(csv):
    result = run("fit", csv, "--bases", "triangular:4")
    assert result.exit_code == 2 and "--basis" in result.output


def test_a_weakness_of_the_record_is_a_note_and_not_an_error(tmp_path):
    rng = np.random.default_rng(0)
    u = rng.choice(np.linspace(-1, 1, 7), 300)
    result = run("fit", table(tmp_path / "few.csv", u=u, y=u**3 + 0.1 * rng.standard_normal(300)), *ORDERS)
    assert result.exit_code == 0 and "Note: too few levels" in result.output


def test_debug_shows_where_it_happened(tmp_path):
    result = run("fit", tmp_path / "nothing.csv", *ORDERS, "--debug")
    assert result.exit_code == 1 and isinstance(result.exception, optid.errors.DataError)


# -- as a program ------------------------------------------------------------------------------------------------------


def program(*words: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "optid", *map(str, words)], capture_output=True, text=True, timeout=600)


def test_the_module_runs_and_says_its_version():
    result = program("--version")
    assert (result.returncode, result.stdout.strip()) == (0, f"optid {optid.__version__}")


def printed(code: str) -> list[str]:
    """Words that a program of Python prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


@pytest.mark.parametrize(("words", "heavy"), [
    (["--help"], "numpy scipy cvxpy casadi numba matplotlib pandas"),
    pytest.param(["--na", "1", "--nb", "1", "--basis", "polynomial:3"], "matplotlib pandas", marks=pytest.mark.slow)])
def test_help_needs_nothing_heavy_and_a_fit_without_a_report_no_figures(csv, words, heavy):
    assert printed("import sys; from typer.testing import CliRunner; from optid.cli.app import app;"
                   f"assert CliRunner().invoke(app, {['fit', str(csv), *words]}).exit_code == 0;"
                   f"print(set({heavy.split()}) & sys.modules.keys())")[-1] == "set()"


def test_cvxpy_is_imported_without_the_packages_it_hardly_needs():
    assert printed("import sys, optid; optid.fit; print('cvxpy' in sys.modules, 'scipy.stats' in sys.modules);"
                   "from cvxpy.atoms.quantum_rel_entr import entropy; import scipy.stats;"
                   "print(entropy([0.5, 0.5]) == scipy.stats.entropy([0.5, 0.5]))") == ["True", "False", "True"]


def test_an_error_goes_to_the_error_stream(tmp_path):
    result = program("fit", tmp_path / "nothing.csv", *ORDERS)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1


def test_the_first_command_of_the_readme(tmp_path):
    result = program(
        "fit", "--example", "thruster", "--report", tmp_path / "thruster.html", "--model", tmp_path / "m.json")
    assert result.returncode == 0, result.stderr
    assert "optimal (proved)" in result.stdout and result.stderr == ""
    assert (tmp_path / "thruster.html").read_text(encoding="utf-8").endswith("</html>\n")
    assert json.loads((tmp_path / "m.json").read_text())["format"] == "optid model"


# -- identify ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def short_ladder(monkeypatch):
    from optid.identify.search.ladder import KINDS, LINEAR, RUNGS
    from optid.identify.search.trial import StructureCandidate

    for kind in KINDS:
        monkeypatch.setitem(RUNGS, kind, lambda ladder: iter(()))

    def lines(ladder):
        yield [StructureCandidate(LINEAR, "arx", {"na": na, "nb": 2}) for na in (1, 2)]

    monkeypatch.setitem(RUNGS, LINEAR, lines)


def test_identify_names_the_structure_and_writes_the_model(csv, tmp_path, short_ladder):
    result = run("identify", csv, "--inputs", "u1", "u2", "--outputs", "y1", "--workers", 1, "--split", 0.7,
                 "--model", tmp_path / "m.json", "--report", tmp_path / "r.html")
    assert result.exit_code == 0, result.output
    for words in ("Search over 2 structures", "Chosen: --formulation arx --na 1 --nb 2", "The model on this record",
                  "held out of the search", "model written to"):
        assert words in result.output
    assert optid.load(tmp_path / "m.json").na == 1 and "The model on this record" in (tmp_path / "r.html").read_text()


def test_fit_without_orders_searches_for_them(csv, short_ladder):
    result = run("fit", csv, "--inputs", "u1", "u2", "--outputs", "y1")
    assert result.exit_code == 0 and "Search over 2 structures" in result.output
    named = run("fit", csv, "--inputs", "u1", "u2", "--outputs", "y1", "--basis", "polynomial:3")
    assert named.exit_code == 2 and "needs --na, --nb" in named.output


@pytest.mark.parametrize("words, said", [
    (("--classes", "wiener"), "use one of linear"), (("--budget", -1), "budget must be"), (("--workers", 0), "workers"),
    (("--horizon", 0), "horizon"), (("--solver", "nosuch"), "no solver"), (("--constraint", "nosuch"), "no constraint"),
])
def test_identify_refuses_what_cannot_be(csv, words, said):
    result = run("identify", csv, "--inputs", "u1", "--outputs", "y1", *words)
    assert result.exit_code == 2 and said in result.output


def test_a_poor_model_is_told_with_what_would_help(tmp_path):
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, 500)
    y = np.concatenate([np.zeros(6), np.convolve(u, 0.7 ** np.arange(40))[:494]])
    path = table(tmp_path / "late.csv", u=u, y=y + 0.01 * rng.standard_normal(500))
    result = run("fit", path, "--formulation", "arx", "--na", 1, "--nb", 1)
    assert "The model on this record: useless" in result.output and "FAIL" in result.output
    assert "Advice: a delay of 6 samples raises the simulation fit" in result.output and "--nk 6" in result.output


@pytest.mark.parametrize(("words", "message"), [
    (["--formulation", "bj.exact", "--na", 1, "--nb", 1], "needs --nc, --nd"),
    (["--formulation", "oe.exact", "--na", 1, "--nb", 1, "--basis", "linear"], "takes no --basis; its own options"),
    (["--ridge", -1], "--ridge -1:"),
    (["--formulation", "hammerstein_ss.exact", "--nx", "many"], "--nx, unless 'auto'"),
])
def test_messages_speak_of_options(words, message):
    result = run("fit", "--example", "thruster", *words)
    assert result.exit_code == 2 and message in " ".join(result.output.split())

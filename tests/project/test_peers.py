"""The comparison with other packages, without them: records, judging, lines, the runner, and optid's own entry."""

import json
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

PEERS = Path(__file__).parents[2] / "benchmarks" / "peers"


def script(name):
    sys.path.insert(0, str(PEERS))
    try:
        return import_module(name)
    finally:
        sys.path.remove(str(PEERS))


records, judging, lines, table, harness, running, environments = map(
    script, ("records", "judging", "lines", "table", "harness", "running", "environments"))
OWN = PEERS / "entries" / "optid_.py"


def arx(a, b, f):
    """The neutral form of a Hammerstein-ARX model with nk = 1."""
    return {"a": a, "drive": lambda u: np.convolve(f(u[:, 0]), np.concatenate([[0.0], b]))[: len(u)]}


CUBIC = arx(records.CUBIC_A, records.CUBIC_B, records.cubic)
FREE = arx(records.FREE_A, records.FREE_B, records.saturation)


@pytest.mark.parametrize("row", [row for row in records.ROWS if not row.name.startswith("long")], ids=lambda r: r.name)
def test_records_repeat_and_hold_back_the_samples_to_score_on(row):
    one, two, other = row.simulate(3), row.simulate(3), row.simulate(4)
    assert one.keys() == two.keys()
    assert all(np.array_equal(one[name], two[name], equal_nan=True) for name in one)
    assert not np.array_equal(one["u"], other["u"])
    assert len(one["u"]) == len(one["y"]) and len(one["test_y"]) == records.TEST
    assert np.isfinite(one["test_y"]).all()


def test_a_tenth_of_the_outputs_is_missing_and_the_rest_is_that_of_the_first_row():
    lost, whole = records.hammerstein(1, lost=0.1), records.hammerstein(1)
    missing = np.isnan(lost["y"])
    assert 0.06 < missing.mean() < 0.14
    assert np.array_equal(lost["y"][~missing], whole["y"][~missing])


def test_the_true_model_predicts_up_to_the_noise():
    record = records.hammerstein(2)
    error = (record["test_y"] - judging.one_step(CUBIC, record["test_u"], record["test_y"]))[2:, 0]
    clean = judging.simulate(CUBIC, record["test_u"], record["test_y"])[:, 0]
    assert np.std(error) == pytest.approx(0.05 * np.std(clean), rel=0.1)
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.08


def test_the_true_state_space_model_leaves_its_innovations():
    record = records.state_space(0)
    truth = {"A": records.STATE_A, "B": records.STATE_B, "C": records.STATE_C, "D": np.zeros((2, 2)),
             "K": records.STATE_K}
    error = record["test_y"] - judging.one_step(truth, record["test_u"], record["test_y"])
    assert np.std(error[judging.RUN_IN :]) == pytest.approx(0.2, rel=0.05)
    free = judging.one_step({**truth, "K": None}, record["test_u"], record["test_y"])
    assert np.array_equal(free, judging.simulate(truth, record["test_u"], record["test_y"]))


def test_the_constrained_plant_keeps_its_constraints_and_others_are_told():
    assert judging.disobeyed(FREE, records.NODES) == ""
    curve = judging.static_curve(FREE, records.NODES)
    assert curve == pytest.approx(records.saturation(records.NODES), abs=1e-6)
    steep = arx(records.FREE_A, 2 * records.FREE_B, records.saturation)
    assert judging.disobeyed(steep, records.NODES) == "gain 2"
    bent = arx(records.FREE_A, records.FREE_B, lambda u: records.saturation(u) - 2 * np.maximum(u - 0.8, 0))
    assert judging.disobeyed(bent, records.NODES) == "not increasing"


def test_fit_of_a_prediction():
    rng = np.random.default_rng(0)
    y = rng.standard_normal((500, 2))
    assert judging.fit_percent(y, y) == 100
    assert judging.fit_percent(y, np.full_like(y, np.nan)) == 0
    assert judging.fit_percent(y, 1e300 * y) == 0
    assert judging.fit_percent(y, y[:-1]) == 0
    assert judging.fit_percent(y, 0.5 * y) == pytest.approx(50, abs=0.5)
    started_late = np.concatenate([np.full((judging.RUN_IN, 2), 9.0), y[judging.RUN_IN :]])
    assert judging.fit_percent(y, started_late) == 100


def test_both_forms_of_one_model_score_the_same():
    """optid's own prediction against the neutral form of the same parameters."""
    import optid

    record = records.hammerstein(0, 400)
    model = optid.fit(optid.Data(u=record["u"], y=record["y"]), "hammerstein_arx.exact", na=2, nb=2, nk=1,
                      basis=optid.Polynomial(3, interval=(-1, 1))).model
    neutral = arx(model.a, model.b[0].ravel(), lambda u: model.nonlinearities[0](u))
    neutral["drive"] = lambda u, inner=neutral["drive"]: inner(u) + np.ravel(model.offset)[0]
    own = {"one_step": lambda u, y: model.predict(optid.Data(u=u, y=y)), "simulate": lambda u, y: model.simulate(u)}
    for predict in (judging.one_step, judging.simulate):
        found = [predict(form, record["test_u"], record["test_y"])[judging.RUN_IN :] for form in (own, neutral)]
        assert found[0] == pytest.approx(found[1], abs=1e-9)


REDUCED = {"hammerstein": (lambda: records.hammerstein(0, 400), CUBIC),
           "missing": (lambda: records.hammerstein(0, 500, lost=0.1), CUBIC),
           "constrained": (lambda: records.constrained(0, 200), FREE)}


@pytest.mark.parametrize("kind", REDUCED)
def test_the_entry_of_optid_answers_like_the_true_plant(kind, tmp_path):
    simulate, truth = REDUCED[kind]
    record = simulate()
    np.savez(tmp_path / "r.npz", **record)
    found = harness.measured(getattr(harness.load(str(OWN)), kind), str(tmp_path / "r.npz"))
    assert "error" not in found, found
    assert not found.get("disobeyed")
    best = judging.fit_percent(record["test_y"], judging.one_step(truth, record["test_u"], record["test_y"]))
    assert best - 1.0 < found["one_step"] < best + 0.3
    assert found["seconds"] > 0


def test_the_entry_of_optid_answers_state_space(tmp_path):
    record = records.state_space(0, 800)
    np.savez(tmp_path / "r.npz", **record)
    for entry in (OWN, PEERS / "entries" / "optid_subspace.py"):
        found = harness.measured(harness.load(str(entry)).state_space, str(tmp_path / "r.npz"))
        assert found["one_step"] > 79 and found["simulation"] > 75, (entry, found)


def test_bad_records_get_an_answer_or_an_error_that_names_the_trouble(tmp_path):
    fitter = harness.load(str(OWN)).hammerstein
    words = {}
    for trouble, record in records.bad_records().items():
        np.savez(tmp_path / "bad.npz", **record)
        words[trouble] = table.verdict(trouble, harness.measured(fitter, str(tmp_path / "bad.npz")), 95.0)
    assert words["one NaN"] == "answers"
    assert words["constant input"].startswith("error that names it: DataError")
    assert words["unstable plant"].startswith("answers")
    assert words["y one shorter"].startswith("error that names it")


@pytest.mark.parametrize("result, word", [
    ({"one_step": 95.0, "said": ""}, "answers"), ({"one_step": 80.0, "said": ""}, "silent nonsense"),
    ({"one_step": 80.0, "said": "UserWarning: nan found"}, "warns"),
    ({"error": "ValueError", "message": "Input contains NaN"}, "error that names it"),
    ({"error": "LinAlgError", "message": "SVD did not converge"}, "error: "),
    ({"stopped": "the process ended: signal 11"}, "crash or endless")])
def test_what_a_peer_did_with_a_nan(result, word):
    assert table.verdict("one NaN", result, 95.2).startswith(word)


def test_lines_are_those_that_a_row_needs(tmp_path):
    entry = tmp_path / "entry.py"
    entry.write_text('"""Doc."""\n\nimport os\nimport json\n\nPACKAGES = ["x"]\nLIMIT = 3\n\n\ndef helper(x):\n'
                     '    """Doc\n    of two lines."""\n    # a comment\n\n    return json.dumps(x)\n\n\n'
                     'def one(r):\n    return helper(LIMIT)\n\n\ndef other(r):\n    return os.sep\n\n\nsame = one\n')
    assert lines.count(entry, "one") == 6  # import json, LIMIT, two of helper, two of one
    assert lines.count(entry, "other") == 3
    assert lines.count(entry, "same") == 7
    assert environments.named(entry, "PACKAGES", []) == ["x"]
    assert environments.named(entry, "CANNOT", {}) == {}


def test_an_entry_without_packages_runs_here(tmp_path):
    (tmp_path / "e.py").write_text("x = 1\n")
    assert environments.interpreter(tmp_path / "e.py", tmp_path) == (sys.executable, "")


TROUBLE = '''
import os, time
def answers(r):
    print("packages print")
    return {"a": [0.0, 0.0], "drive": lambda u: 0 * u[:, 0]}
def raises(r):
    raise KeyError("no")
def leaves(r):
    raise SystemExit("Error!")
def dies(r):
    os.abort()
def sleeps(r):
    time.sleep(60)
def turns(r):
    while True:
        pass
'''


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind, key, word", [
    ("answers", "one_step", None), ("raises", "error", "KeyError"), ("leaves", "error", "SystemExit"),
    ("dies", "stopped", "the process ended: signal 6"), ("sleeps", "stopped", "no answer in 2 s"),
    ("turns", "stopped", "no answer in 1 CPU seconds")])
def test_the_runner_survives_what_a_peer_does_and_does_not_repeat_it(kind, key, word, tmp_path, monkeypatch):
    entry, kept = tmp_path / "entry.py", tmp_path / "kept.json"
    entry.write_text(TROUBLE)
    paths = [records.write(tmp_path, records.ROWS[0], seed) for seed in range(4)]
    limit = {"sleeps": 2.0 / running.WALL, "turns": 1.0}.get(kind, 60.0)
    if kind == "turns":
        monkeypatch.setattr(running, "WALL", 300.0)  # on a busy machine a second of work takes a minute
    found = running.run(sys.executable, entry, kind, paths, kept, limit, 1e9)
    assert word is None or found[paths[0].stem][key] == word
    assert len(found) == {"stopped": 1, "error": 3}.get(key, 4)
    assert json.loads(kept.read_text()).keys() == found.keys()
    again = running.run("no such interpreter", entry, kind, paths, kept, limit, 1e9)
    assert again == found


def test_a_peer_is_compared_on_the_seeds_that_both_have():
    ours = table.line("optid_", 5, {i: {"seconds": 1.0, "one_step": 90.0 + i, "simulation": 80.0} for i in range(4)})
    peer = table.line("sippy", 9, {i: {"seconds": 2.0, "one_step": 91.0, "simulation": 70.0} for i in (0, 1)})
    assert table.difference(ours, peer, "one_step") == pytest.approx(-0.5)
    rows = (records.ROWS[2],)
    bad = {"optid_": {"one NaN": "answers", "constant input": "error that names it: 'u' is constant"},
           "sippy": {"one NaN": "error: SVD", "constant input": "silent nonsense (one-step fit 3.0 %)"}}
    text = "\n".join(table.goals({"long": [ours, peer]}, rows, bad))
    assert "trouble named: **optid** 2, SIPPY 0 of 2." in text
    assert "no, " in text and "one-step: SIPPY by 0.500" in text and "SIPPY 2" in text


def test_a_peer_that_breaks_a_constraint_does_not_answer_the_row():
    one = {"seconds": 1.0, "one_step": 99.0, "simulation": 99.0, "disobeyed": "gain 2"}
    ours = table.line("optid_", 5, {0: one | {"disobeyed": "", "one_step": 90.0, "simulation": 90.0}})
    text = "\n".join(table.goals({"constrained": [ours, table.line("casadi_", 5, {0: one})]}, (records.ROWS[4],)))
    assert "**optid** 1, hand-written CasADi 0 of 1" in text

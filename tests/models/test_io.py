"""Model files: exact round trip, and refusals that say what is wrong with the file."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refuses
from state_systems import linear, with_feedback
from systems import BASES, inputs, mimo, siso

import optid
from optid.bases import UserFunctions
from optid.errors import ModelFileError, StructureError
from optid.models import Nonlinearity
from optid.models.files import from_content, load

NOISY = [siso(c=[-0.6, 0.25], d=d) for d in (None, [], [-0.5, 0.1, 0.3])] + [siso(d=[]), siso(d=[-0.5])]
STATES = [linear(), with_feedback(), with_feedback(gauge="norm").regauge("norm")]


@pytest.mark.parametrize("model", [*(siso(basis, nk=1) for basis in BASES), mimo(), siso(a=[]), *NOISY, *STATES])
def test_round_trip_is_exact(model, tmp_path):
    path = model.save(tmp_path / "model.json")
    again = load(path)
    assert again.to_dict() == model.to_dict() and (again.structure, again.title) == (model.structure, model.title)
    u = inputs(model)
    assert np.array_equal(again.simulate(u), model.simulate(u))
    assert [p.name for p in tmp_path.iterdir()] == ["model.json"]
    assert optid.load is load


@given(numbers=st.lists(st.floats(-1e150, 1e150), min_size=9, max_size=9))
def test_every_float_survives(numbers):
    model = siso(a=numbers[:2], b=(numbers[2:4],), offset=numbers[4])
    again = from_content(json.loads(json.dumps(model.to_dict())))
    assert again.to_dict() == model.to_dict()


def test_no_outputs_of_a_model_without_past_outputs(tmp_path):
    model = mimo()
    static = type(model)(np.zeros((0, 2, 2)), model.b, model.nonlinearities, model.nk, model.offset)
    assert load(static.save(tmp_path / "m.json")).a.shape == (0, 2, 2)


def test_user_functions_are_asked_for(tmp_path):
    basis = UserFunctions((np.tanh,), ("tanh",)).with_interval(-1, 1)
    model = siso(nonlinearities=(Nonlinearity(basis, [2.0]),))
    path = model.save(tmp_path / "m.json")
    refuses(StructureError, "'tanh'.*functions=", load, path)
    assert load(path, functions={"tanh": np.tanh}).f(0.3) == model.f(0.3)


def damage(tmp_path, change):
    path = siso().save(tmp_path / "m.json")
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


def test_every_truncation_is_named(tmp_path):
    path = siso().save(tmp_path / "m.json")
    text = path.read_text()
    for cut in range(0, len(text) - 1, 37):
        path.write_text(text[:cut])
        refuses(ModelFileError, "truncated|empty|not a model", load, path)


@pytest.mark.parametrize(("change", "words"),
                         [(lambda c: c.update(version=99), "version 99.*reads version 1"),
                          (lambda c: c.update(version=None), "version None"),
                          (lambda c: c.update(format="something else"), "not a model"),
                          (lambda c: c.pop("nk"), "lacks 'nk'"),
                          (lambda c: c.update(kind="Wiener"), "unknown kind"),
                          (lambda c: c.update(a="many"), "damaged"),
                          (lambda c: c.update(b=[[1.0], [2.0]]), "damaged"),
                          (lambda c: c["nonlinearities"][0].update(mu=[1.0]), "damaged.*mu"),
                          (lambda c: c["nonlinearities"][0]["basis"].update(type="wavelet"), "damaged.*wavelet"),
                          (lambda c: c["nonlinearities"][0]["basis"].update(p=-3), "damaged"),
                          (lambda c: c["nonlinearities"][0].update(basis=None), "damaged"),
                          (lambda c: c.update(inputs=["a\n"]), r"damaged.*name of an input is 'a\\n'.*U\+000A"),
                          (lambda c: c.update(outputs=["a\ud800"]), r"damaged.*name of an output is 'a\\ud800'"),
                          (lambda c: c.update(output_units=["\u202ea"]), r"damaged.*unit of an output is '\\u202ea'"),
                          (lambda c: c.update(nonlinearities=7), "damaged")])
def test_damaged_files(tmp_path, change, words):
    refuses(ModelFileError, words, load, damage(tmp_path, change))


@pytest.mark.parametrize("text", [b"u,y\n1,2\n", b"[1, 2]", b"\xff\xfe\x00pickle", b'"word"', b"{}", b"[" * 100_000])
def test_other_files_are_not_models(tmp_path, text):
    path = tmp_path / "other"
    path.write_bytes(text)
    refuses(ModelFileError, "not a model", load, path)
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nothing.json")

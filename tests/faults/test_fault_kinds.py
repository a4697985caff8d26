"""A kind of fault is one record: that of a third party passes everything, and what ships is complete."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from fault_plants import levels
from test_fault_injection import small

from optid import registry
from optid.data.record import Data
from optid.errors import LookupFailed, StructureError
from optid.faults import (
    Fault,
    Monitor,
    diagnose,
    dictionary,
    inject,
    isolability,
    load_diagnosis,
    reformulate,
    whiten,
)
from optid.faults.kinds import KINDS, all_kinds, kind_of

THEIRS = Path(__file__).parents[1] / "third_party"


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """The distribution of a third party on the path, with the entry points of its pyproject.toml."""
    groups = tomllib.loads((THEIRS / "pyproject.toml").read_text())["project"]["entry-points"]
    info = tmp_path / "optid_third_party-1.0.dist-info"
    info.mkdir()
    info.joinpath("METADATA").write_text("Metadata-Version: 2.1\nName: optid-third-party\nVersion: 1.0\n")
    info.joinpath("entry_points.txt").write_text("\n".join(
        f"[{group}]\n" + "\n".join(f"{name} = {value}" for name, value in points.items())
        for group, points in groups.items()))
    for folder in (THEIRS, tmp_path):
        monkeypatch.syspath_prepend(str(folder))
    for cached in (registry.find_entry_points, all_kinds):
        cached.cache_clear()
    yield
    for cached in (registry.find_entry_points, all_kinds):
        cached.cache_clear()


def test_a_ninth_kind_passes_everything_without_a_change_of_optid(installed, tmp_path):
    model, u = small(), levels(300, 3)
    kinds = [name for name, kind in all_kinds().items() if kind.places and name != "loss"]
    faults = dictionary(model, kinds=kinds)
    label = "actuator:u1 surge"
    assert {"surge", *KINDS} == set(all_kinds()) and label in faults.labels
    fault = Fault("actuator:u1", "surge", 150, size=0.6)
    assert str(fault) == "actuator:u1: surge 0.6 from sample 150"
    broken, healthy = (inject(model, u, one, seed=2, noise="none") for one in (fault, ()))
    # the signature is what the fault adds to the innovations, by simulation of the plant and of the predictor
    silent = [whiten(model, Data(u, y), x0="zero").r for y in (broken, healthy)]
    np.testing.assert_allclose(silent[0] - silent[1], 0.6 * faults.signature(label, 300, 150, u)[..., 0], atol=1e-9)
    y = inject(model, u, fault, seed=2)
    found = diagnose(model, (u, y), faults)
    assert found.verdict == "faulty" and label in [one.label for one in found.candidates]
    estimate = next(one for one in found.candidates if one.label == label).faults[0]
    low, high = estimate.size_interval[0]
    assert low < 0.6 < high and abs(estimate.onset - 150) <= 10 and "share gained" in str(found)
    assert str(load_diagnosis(found.save(tmp_path / "d.json"))) == str(found)
    alone = diagnose(model, (u, y), dictionary(model, kinds="surge", state_jump=False, unknown=False))
    assert alone.best.label == label
    repaired = reformulate(model, alone, (u, y))
    assert repaired.members[0].damage.columns == (0,)
    assert repaired.members[0].damage.gains[0] == pytest.approx(1 + alone.best.faults[0].size[0])
    monitor = Monitor(model, dictionary(model, kinds=["bias", "surge"]), arl0=1000, window=60, samples=60_000)
    assert label in monitor.labels
    stream = levels(700, 8)
    events = monitor.run(stream, inject(model, stream, Fault("actuator:u1", "surge", 450, size=0.6), seed=9))
    named = next(e for e in events if e.kind == "isolated" and e.sample > 450)
    assert named.candidates[0][0] == label
    assert abs(named.onset - 450) <= 10 and named.size[0] == pytest.approx(0.6, abs=0.2)
    restored = Monitor.load(monitor.save(tmp_path / "monitor.npz"))
    assert restored.labels == monitor.labels
    study = isolability(dictionary(model, kinds=["bias", "surge"]), 60, u=u[:60], draws=100, calibration=5000)
    assert np.isfinite(study.detectable[study.labels.index(label)])


def test_a_kind_that_is_not_installed_is_refused_by_its_name():
    with pytest.raises(LookupFailed, match="no fault of kind 'surge'"):
        dictionary(small(), kinds="surge")
    with pytest.raises(StructureError, match="no fault of kind 'surge'"):
        Fault("actuator:u1", "surge", 10, size=1.0)
    with pytest.raises(LookupFailed, match="no fault of kind 'saturated'"):  # told of a reading, no candidate
        dictionary(small(), kinds="saturated")


@pytest.mark.parametrize("name", KINDS)
def test_courses_for_a_range_of_onsets_span_those_of_every_onset(name):
    kind = kind_of(name)
    for first, last in ((3, 3), (3, 9), (0, 19)):
        basis = np.array(kind.courses(first, last, 20), dtype=float).T
        for onset in range(first, last + 1):
            course = kind.progress(np.arange(20) - onset)
            left = course - basis @ np.linalg.lstsq(basis, course, rcond=None)[0]
            assert np.abs(left).max() < 1e-9

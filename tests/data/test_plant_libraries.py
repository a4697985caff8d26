"""Excel, TDMS and MDF files, read by the libraries of the extra `plant`; without them a refusal has the pip line."""

import gc
import sys
import warnings
from datetime import datetime, timedelta

import numpy as np
import pandas as pd
import pytest
from plant_exports import N, U, Y
from refusals import refuses

import optid
from optid.data.reading.plant_files import LIBRARIES
from optid.errors import DataError

TIME = 0.1 * np.arange(N)


@pytest.fixture(autouse=True)
def quiet():
    with warnings.catch_warnings(action="ignore"):  # the libraries warn about one another's versions as they write
        yield


def same(data, dt=0.1):
    np.testing.assert_allclose(data.u[:, 0], U)
    np.testing.assert_allclose(data.y[:, 0], Y)
    assert data.dt == pytest.approx(dt) and data.time_unit == "s"


@pytest.mark.parametrize("kind", LIBRARIES)
def test_without_its_library_a_file_is_refused_with_the_pip_line(tmp_path, monkeypatch, kind):
    (tmp_path / f"r{kind}").write_bytes(b"something")
    for module in ("fastexcel", "nptdms", "asammdf"):
        monkeypatch.setitem(sys.modules, module, None)
    refuses(DataError, rf'r{kind}: files of kind {kind} are read by .*: pip install "optid\[plant\]"', optid.read,
            tmp_path / f"r{kind}")


def test_excel(tmp_path):
    pytest.importorskip("fastexcel")
    pytest.importorskip("openpyxl")
    path = tmp_path / "r.xlsx"
    pd.DataFrame({"t": TIME, "u": U, "y": Y}).to_excel(path, index=False)
    same(optid.read(path))
    stamps = [datetime(2024, 5, 1, 6) + timedelta(seconds=5 * k) for k in range(N)]
    frame = pd.DataFrame({"Timestamp": stamps, "OP": U, "PV": Y.astype(object)})
    frame.to_excel(path, index=False)
    same(optid.read(path, "OP", "PV"), 5.0)
    frame.loc[7, "PV"] = "BAD"
    frame.to_excel(path, index=False)
    refuses(DataError, "column 'PV', row 8 holds 'BAD'.*missing='BAD'", optid.read, path, "OP", "PV")
    assert np.flatnonzero(np.isnan(optid.read(path, "OP", "PV", missing="BAD").y)).tolist() == [7]
    path.write_bytes(path.read_bytes()[:900])
    refuses(DataError, "r.xlsx is damaged", optid.read, path)


def test_tdms(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    path = tmp_path / "r.tdms"

    def write(*groups, **properties):
        with nptdms.TdmsWriter(str(path)) as writer:
            writer.write_segment([nptdms.ChannelObject(group, name, values, {"wf_increment": 0.1, **properties})
                                  for group in groups for name, values in (("u", U), ("y", Y))])

    write("log", unit_string="V")
    same(optid.read(path))
    assert optid.read(path).input_units == ("V",)
    write("log", wf_start_time=np.datetime64("2024-05-01T06:00:00"))
    same(optid.read(path))
    assert optid.read(path).start == np.datetime64("2024-05-01T06:00")
    write("run 1", "run 2")
    assert optid.read(path).n_experiments == 2
    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment([nptdms.ChannelObject("log", "u", U, {"wf_increment": 0.1})])
    path.write_bytes(path.read_bytes()[:-80])
    found = optid.read(path, {"u": "u"}, {"y": "u"})
    assert found.n_samples == N - 10 and "the file ends within a segment" in found.findings[0]
    path.write_bytes(b"nonsense" * 9)
    refuses(DataError, "r.tdms is damaged", optid.read, path)


def test_mdf(tmp_path, monkeypatch):
    mdf = pytest.importorskip("asammdf")
    path = tmp_path / "r.mf4"
    file = mdf.MDF(version="4.10")
    file.append([mdf.Signal(U, TIME, name="u", unit="V"), mdf.Signal(Y, TIME, name="y")])
    file.append([mdf.Signal(np.zeros(9), np.arange(9.0), name="slow")])
    file.save(path, overwrite=True)
    same(optid.read(path))
    assert optid.read(path).input_units == ("V",)
    refuses(DataError, "has no column 'slow'", optid.read, path, inputs="slow")
    path.write_bytes(path.read_bytes()[:-99])
    raised = []
    monkeypatch.setattr(sys, "unraisablehook", raised.append)
    refuses(DataError, "r.mf4 is damaged", optid.read, path)
    gc.collect()
    assert raised == []  # no finaliser of what was left half built prints a traceback
    path.write_bytes(b"nonsense" * 99)
    refuses(DataError, "r.mf4 is damaged", optid.read, path)

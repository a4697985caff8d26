"""What a MAT file holds is read the same in versions 5 and 7.3, or refused by name."""

import sys
import warnings

import numpy as np
import pytest
from damage import bytes_of
from mat_files import VERSIONS, Cell, Object, write_mat
from refusals import refuses
from scipy import sparse
from scipy.io import savemat

from optid.data.readers import read
from optid.data.reading import mat_tree
from optid.data.reading.mat_contents import file_contents
from optid.data.reading.matlab import mat_contents
from optid.errors import DataError, DataWarning

N = 40
U = np.random.default_rng(1).normal(size=N)
Y = np.convolve(U, 0.9 ** np.arange(9.0))[:N]
T = 0.1 * np.arange(N)
UU = np.stack([U, U[::-1]], 1)
EMPTY = np.zeros((0, 0))


@pytest.fixture(params=VERSIONS)
def save(request, tmp_path):
    def write(**variables):
        return write_mat(tmp_path / "r.mat", variables, request.param)

    return write


def column(x):
    return np.asarray(x)[:, None]


def same(data, dt=0.1, u=U, y=Y, channels=("u",)):
    np.testing.assert_array_equal(data.u, np.asarray(u).reshape(len(u), -1))
    np.testing.assert_array_equal(data.y[:, 0], y)
    assert data.n_experiments == 1 and data.dt == dt and data.inputs == channels


# -- where the signals are


def test_a_vector_is_a_signal_in_either_orientation(save):
    same(read(save(u=U[None], y=column(Y), t=T[None])))
    same(read(save(u=U.reshape(1, 1, N), y=Y[None], t=column(T))))
    same(read(save(u=UU, y=Y[None], t=T[None])), u=UU, channels=("u1", "u2"))


def test_structures_to_any_depth(save):
    same(read(save(a={"b": {"c": {"d": {"u": column(U), "y": Y, "t": T, "note": "rig 3"}}}})))
    same(read(save(a={"b": {"u": U, "y": Y}, "t": T}, title="x")))
    same(read(save(data={"u": U, "y": Y, "dt": 0.1}, operating_point={"u0": 1.0, "y0": 2.0}, K=np.eye(2))))
    path = save(exp={"run1": {"u": U, "y": Y, "t": T}, "run2": {"u": Y, "y": U, "t": 2 * T}})
    refuses(DataError, r"no column 'u'.*exp.run1.u, exp.run1.y, .*exp.run2.u", read, path)
    same(read(path, "exp.run1.u", "exp.run1.y"), channels=("exp.run1.u",))
    same(read(path, {"u": "exp.run2.u"}, {"y": "exp.run2.y"}), 0.2, Y, U)


def test_the_top_level_comes_before_structures(save):
    path = save(u=U, y=Y, Ts=0.1, log={"u": Y, "y": U, "w": U[:5], "t": 5 * T})
    same(read(path))
    same(read(path, {"u": "log.u"}, {"y": "log.y"}), 0.5, Y, U)
    refuses(DataError, "no column 'w'", read, path, inputs="w")
    refuses(DataError, "no column 'u'", read, save(y=Y, data={"u": U, "y": Y}))


def test_array_of_structures_is_one_experiment_per_element(save):
    path = save(run=[{"u": U[:15], "y": Y[:15]}, {"u": U[15:], "y": Y[15:]}], Ts=0.1)
    data = read(path)
    assert data.n_experiments == 2 and data.dt == 0.1
    np.testing.assert_array_equal(data.u[1][:, 0], U[15:])
    np.testing.assert_array_equal(read(path, "run.u", "run.y").y[0][:, 0], Y[:15])
    same(read(path, {"u": "run(2).u"}, "run(2).y"), u=U[15:], y=Y[15:])
    data = read(save(run=[{"u": U[:9], "y": Y[:9], "t": T[:9]}, {"u": U[9:], "y": Y[9:], "t": T[9:] + 5}]))
    assert [e.start for e in data.experiments] == [0.0, pytest.approx(5.9)] and data.dt == 0.1
    batch = [{"run": [{"u": U, "y": Y}, {"u": Y, "y": U}], "Ts": 0.1}, {"run": [{"u": U, "y": U}, {"u": Y, "y": Y}],
                                                                        "Ts": 0.1}]
    data = read(save(batch=batch))
    assert data.n_experiments == 4 and data.dt == 0.1
    np.testing.assert_array_equal(data.u[2][:, 0], U)
    np.testing.assert_array_equal(data.y[3][:, 0], Y)
    data = read(save(exp={"dt": 0.1, "runs": [{"u": U, "y": Y}, {"u": Y, "y": U}]}))
    assert data.n_experiments == 2 and data.dt == 0.1


def test_cells_of_experiments(save):
    path = save(u=Cell([U[:15], U[15:]]), y=Cell([column(Y[:15]), Y[15:]]), dt=0.1)
    assert [e.n_samples for e in read(path).experiments] == [15, N - 15] and read(path).dt == 0.1
    same(read(path, {"u": "u{2}"}, "y{2}"), u=U[15:], y=Y[15:])
    data = read(save(c=Cell([{"u": U, "y": Y, "t": T}, {"u": Y, "y": U, "t": T}])))
    assert data.n_experiments == 2 and data.dt == 0.1
    data = read(save(u=U, y=Cell([Y, U]), dt=0.1))  # the same input twice
    assert data.n_experiments == 2
    np.testing.assert_array_equal(data.u[0], data.u[1])


def test_experiments_that_do_not_fit_are_refused(save):
    refuses(DataError, r"r.mat: experiment 2 has no 'y'", read, save(u=Cell([U, U]), y=Cell([Y])))
    refuses(DataError, r"r.mat, experiment 1: u has 9 samples and y has 31", read,
            save(u=Cell([U[:9], U[9:]]), y=Cell([Y[9:], Y[:9]])))
    refuses(DataError, r"experiment 2 has channels .*'u2'", read, save(u=Cell([U, UU]), y=Cell([Y, Y])))
    refuses(DataError, r"'run.Ts' differs between the experiments \(0.1 to 0.2\)", read,
            save(run=[{"u": U, "y": Y, "Ts": 0.1}, {"u": U, "y": Y, "Ts": 0.2}]))
    refuses(DataError, "'y' is empty", read, save(run=[{"u": U, "y": Y}, {"u": U, "y": EMPTY}]))
    refuses(DataError, "outputs have 1 experiments, with .*k.* there are 2", read,
            save(u=U, y=Y, k=Cell([U, U])), experiment="k")


def test_samples_spread_over_elements_are_no_experiments(save):
    rows = [{"t": t, "u": u, "y": y} for t, u, y in zip(T, U, Y)]
    refuses(DataError, r"'u' is spread over 40 structures, one number in each. In MATLAB: u = \[rows.u\]'", read,
            save(rows=rows, x=U))
    refuses(DataError, r"'u' is a cell array of 40 scalars. In MATLAB: u = cell2mat\(u\)", read,
            save(u=Cell(list(U)), y=Y))


def test_experiment_column_of_a_mat_file(save):
    data = read(save(u=U, y=Y, Ts=0.1, run=np.repeat([1.0, 2.0], N // 2)), experiment="run")
    assert data.n_experiments == 2 and data.dt == 0.1


# -- clocks


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name, value", [("Ts", 0.1), ("dt", 0.1), ("fs", 10.0), ("Fs", 10.0), ("SampleTime", 0.1),
                                         ("SampleRate", 10.0), ("Ts", np.float32(0.1)), ("fs", np.int32(10))])
def test_scalar_clocks(save, name, value):
    same(read(save(u=U, y=Y, **{name: value})), pytest.approx(0.1, rel=1e-7))
    same(read(save(data={"u": U, "y": Y}, **{name: value})), pytest.approx(0.1, rel=1e-7))
    path = save(data={"u": U, "y": Y, name: value}, dt=3.0)
    same(read(path), pytest.approx(0.1, rel=1e-7))
    assert read(path, time=False).dt == 1.0 and read(path, time=False, dt=0.3).dt == 0.3
    refuses(DataError, "dt = 0.3, but the time stamps step by 0.1", read, path, dt=0.3)


def test_time_vectors(save):
    for name in ("t", "time", "Time", "tout"):
        same(read(save(u=U, y=Y, **{name: T})))
    same(read(save(u=U, y=Y, t=T, Ts=0.1)))
    same(read(save(u=U, y=T, t=2 * T), time="y", outputs={"y": "y"}), y=T)
    refuses(DataError, "the time stamps step by 0.2 s, and the sampling time beside them is 0.1 s. Pass", read,
            save(u=U, y=Y, t=2 * T, Ts=0.1))
    assert read(save(u=U, y=Y, t=2 * T, Ts=0.1), dt=0.2).dt == read(save(u=U, y=Y, t=2 * T, dt=0.1), time="t").dt == 0.2
    same(read(save(u=U, y=Y, t=2 * T, Ts=0.1), time="Ts"))
    same(read(save(u=U, y=Y, Ts=0.1), time=True))
    same(read(save(u=U, y=Y, t=739000 + 10 * T / 86400, Ts=1.0)), pytest.approx(1.0, rel=1e-4))  # as of datenum
    same(read(save(u=U, y=Y, t=2 * T, Ts=0.1), time=False, dt=0.1))
    refuses(DataError, "'Ts' has the step 0.1, but fs says 0.01 s. Pass dt", read, save(u=U, y=Y, Ts=0.1, fs=100.0))
    same(read(save(u=U, y=Y, Ts=0.1, fs=10.0)))
    refuses(DataError, "'t' has 30 stamps for 40 samples", read, save(u=U, y=Y, t=T[:30]))
    refuses(DataError, "time stamps are not uniform", read, save(u=U, y=Y, t=T**2))
    refuses(DataError, "no time vector t or time, and no scalar Ts", read, save(u=U, y=Y), time=True)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_impossible_sampling_times(save, bad):
    words = "'Ts' is .*, which is no sampling time or rate. Pass dt .time=False ignores it"
    refuses(DataError, words, read, save(u=U, y=Y, Ts=bad))


def test_clocks_that_cannot_be_read_are_no_missing_clocks(save):
    refuses(DataError, r"'t' is a MATLAB object of class datetime. In MATLAB: t = seconds\(t - t\(1\)\)", read,
            save(u=U, y=Y, t=Object("datetime")))
    refuses(DataError, r"'Ts' is a MATLAB object of class duration", read, save(u=U, y=Y, Ts=Object("duration")))
    same(read(save(u=U, y=Y, time=Object("datetime"), Ts=0.1)))
    refuses(DataError, "'t' is text", read, save(u=U, y=Y, t=Cell(["12:00", "12:01"])))
    same(read(save(u=U, y=Y, time="12:00 on Monday")), 1.0)
    refuses(DataError, "'t' is complex", read, save(u=U, y=Y, t=T * 1j))
    same(read(save(u=U, y=Y, t=EMPTY)), 1.0)


# -- Simulink and the System Identification Toolbox


def test_to_file(save):
    path = save(ans=np.vstack([T, U, Y]))
    same(read(path, 1, 2))
    refuses(DataError, "no column 'u'.*Columns: 0, 1, 2, ans", read, path)
    same(read(save(log={"data": np.vstack([T, UU.T, Y])}), [1, 2], 3), u=UU, channels=("u1", "u2"))
    same(read(save(data=np.column_stack([T, U, Y])), 1, 2))
    same(read(save(data=np.column_stack([U, Y]), Ts=0.1), 0, 1))
    refuses(DataError, "more channels|only 2 sample", read, save(data=np.vstack([U, Y])), "data", "data")


def test_structure_with_time(save):
    def logged(values, label=""):
        return {"values": column(values), "dimensions": 1.0, "label": label, "blockName": "rig/Scope"}

    same(read(save(u={"time": T, "signals": logged(U)}, y={"time": T, "signals": logged(Y)})))
    path = save(scope={"time": column(T), "signals": [logged(U, "u"), logged(Y, "y"), logged(Y)], "blockName": "rig"})
    same(read(path))
    assert "scope.signals3" in mat_contents(path).experiments[0]
    scope = {"time": T, "signals": [logged(U, "u"), logged(Y, "y")]}
    assert read(save(run=[{"s": scope}, {"s": scope}])).n_experiments == 2
    same(read(save(time=T, signals=[logged(U, "u"), logged(Y, "y")])))
    path = save(s={"time": T, "signals": [logged(U, "a"), logged(Y, "a")]}, x=U)
    same(read(path, {"u": "s.signals1"}, "s.signals2"))
    refuses(DataError, "the clocks of its signals differ .u.time, y.time.", read,
            save(u={"time": T, "signals": logged(U)}, y={"time": 2 * T, "signals": logged(Y)}))
    cube = {"values": np.ones((2, 3, N)), "dimensions": np.array([2.0, 3.0]), "label": "m"}
    refuses(DataError, "'x' has 3 dimensions .2 x 3 x 40.", read,
            save(x={"time": T, "signals": cube}, y={"time": T, "signals": logged(Y)}), inputs="x")


def iddata(u=U, y=Y, **changes):
    return {"Domain": "Time", "OutputData": y, "InputData": u, "Ts": 0.1, "OutputName": Cell(["Speed"]),
            "InputName": Cell(["Voltage"]), "OutputUnit": Cell(["rpm"]), "InputUnit": Cell(["V"]),
            "TimeUnit": "seconds", "Tstart": 0.1, "SamplingInstants": EMPTY, **changes}


def test_fields_of_iddata(save):
    path = save(z=iddata(column(U), column(Y)))
    data = read(path)
    same(data, channels=("Voltage",))
    assert data.outputs == ("Speed",) and data.input_units == ("V",) and data.output_units == ("rpm",)
    same(read(path, "Voltage", "Speed"), channels=("Voltage",))
    same(read(path, "u", "y"))
    same(read(save(z={"OutputData": Y, "InputData": U, "Ts": 0.1})))
    path = save(**iddata(UU, InputName=Cell(["a", "b"]), InputUnit=Cell(["V", "A"])))
    same(read(path), u=UU, channels=("a", "b"))
    assert read(path).input_units == ("V", "A")
    same(read(path, "b"), u=UU[:, 1], channels=("b",))
    path = save(**iddata(UU, InputName=Cell(["u", "v"])))
    same(read(path), u=UU, channels=("u", "v"))
    same(read(path, "u"), u=UU, channels=("u1", "u2"))
    same(read(save(z=iddata(UU, InputName=Cell(["Ts", "b"])))), u=UU, channels=("Ts", "b"))
    voltage = {"channels": ("Voltage",)}
    same(read(save(z=iddata(Ts=EMPTY, SamplingInstants=T))), **voltage)
    same(read(save(z=iddata(TimeUnit="minutes"))), 6.0, **voltage)
    refuses(DataError, "'z.Ts' is in 'fortnights'; known TimeUnit: nanoseconds", read,
            save(z=iddata(TimeUnit="fortnights")))
    refuses(DataError, "'u' is in the frequency domain", read, save(z=iddata(U * 1j, Domain="Frequency"), x=U))
    refuses(DataError, "'u' is empty", read, save(z=iddata(np.zeros((N, 0)))))


def test_iddata_of_several_experiments(save):
    several = iddata(Cell([UU[:15], UU[15:]]), Cell([Y[:15], Y[15:]]), Ts=Cell([0.1, 0.1]), Tstart=Cell([0.1, 0.1]),
                     InputName=Cell(["a", "b"]), InputUnit=Cell(["V", "A"]), SamplingInstants=Cell([EMPTY, EMPTY]))
    path = save(z=several)
    data = read(path)
    assert data.n_experiments == 2 and data.dt == 0.1 and data.inputs == ("a", "b")
    np.testing.assert_array_equal(data.u[1], UU[15:])
    np.testing.assert_array_equal(read(path, "b", "Speed").u[0][:, 0], UU[:15, 1])
    refuses(DataError, "'z.Ts' differs between the experiments", read, save(z={**several, "Ts": Cell([0.1, 0.2])}))


# -- what is not a real number


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind, line", [
    ("timetable", r"r = x.Properties.RowTimes; s = table2struct\(timetable2table\(x"),
    ("table", r"s = table2struct\(x, 'To"), ("iddata", r"s = get\(x\)"), ("timeseries", r"struct\('t', x.Time"),
    ("Simulink.SimulationOutput", r"x.logsout.get\('u'\)"), ("Simulink.SimulationData.Dataset", r"x.get\('u'\)"),
    ("dictionary", "save the numbers that it holds as plain arrays")])
def test_objects_are_refused_with_the_line_to_type(save, kind, line):
    words = rf"is a MATLAB object of class {kind}. In MATLAB: .*{line}"
    refuses(DataError, f"r.mat holds no arrays of numbers. 'x' {words}", read, save(x=Object(kind)))
    refuses(DataError, f"r.mat: 'x' {words}", read, save(x=Object(kind), y=Y, other=Object("table")), "x", "y")
    path = save(data={"u": Object(kind), "y": Y})
    refuses(DataError, f"r.mat: 'u' is a MATLAB object of class {kind}. In MATLAB: ", read, path)


def test_text_is_ignored(save):
    path = save(u=U, y=Y, title="run 1", names=Cell(["a", "b"]), s=Object("string"), Ts=0.1)
    same(read(path))
    assert set(mat_contents(path).experiments[0]) == {"u", "y", "Ts"}
    refuses(DataError, "no column 'title'", read, path, inputs="title")


@pytest.mark.sampled(6)
@pytest.mark.parametrize("value, words", [
    (U * 1j, r"is complex. In MATLAB: u = \[real\(u\)"), (sparse.csc_matrix(column(U)), r"is sparse.*u = full\(u\)"),
    (np.zeros((0, 3)), "is empty"), (np.ones((3, 4, 5)), "has 3 dimensions .3 x 4 x 5."),
    (U.astype(np.complex64), "is complex"), (Cell([]), "is empty"), (Cell([U, 1j * U]), "is complex")])
def test_values_that_are_no_signal_are_refused_by_name(save, value, words):
    refuses(DataError, f"r.mat: 'u' {words}", read, save(u=value, y=Y))
    refuses(DataError, f"r.mat: 'u' {words.replace('u = ', 'a.u = ').replace('(u', '(a.u')}", read,
            save(a={"u": value, "y": Y}))


def test_types_of_numbers(save):
    for kind in (np.int16, np.float32, np.uint8, np.int64):
        same(read(save(u=np.arange(N).astype(kind), y=Y, Ts=0.1)), u=np.arange(N))
    same(read(save(u=U > 0, y=Y, Ts=0.1)), u=U > 0)
    with pytest.warns(DataWarning, match="'u': 10 sample"):
        read(save(u=np.repeat(np.array([255, 3, 9, 7], np.uint8), 10), y=Y))


def test_matlab_bytes_are_doubles_again(tmp_path):
    # MATLAB stores small whole doubles as bytes: 255 is then a value like any other, not a saturated one.
    savemat(tmp_path / "r.mat", {"u": np.array([[255.0], [3.0]]), "y": np.ones((2, 1))})
    assert read(tmp_path / "r.mat").u[0, 0] == 255.0


def test_version_4(tmp_path):
    savemat(tmp_path / "r.mat", {"u": U, "y": column(Y), "Ts": 0.1, "note": "x"}, format="4")
    same(read(tmp_path / "r.mat"))
    savemat(tmp_path / "r.mat", {"u": U * 1j, "y": column(Y)}, format="4")
    refuses(DataError, "'u' is complex", read, tmp_path / "r.mat")


@pytest.mark.parametrize("version", VERSIONS)
def test_compressed_files(tmp_path, version):
    same(read(write_mat(tmp_path / "r.mat", {"a": {"u": U, "y": Y}, "Ts": 0.1}, version, do_compression=True)))


# -- other HDF5, and hostile files


@pytest.fixture
def h5(tmp_path):
    h5py = pytest.importorskip("h5py")
    return lambda: h5py.File(tmp_path / "r.mat", "w")


def test_hdf5_that_matlab_did_not_write_has_samples_as_rows(h5, tmp_path):
    with h5() as file:
        file["u"], file["log/y"], file["y"], file["Ts"], file["note"] = UU, Y, column(Y), 0.1, "x"
    same(read(tmp_path / "r.mat"), u=UU, channels=("u1", "u2"))


def test_groups_that_hold_themselves_are_refused(h5, tmp_path):
    with h5() as file:
        file["a/u"] = U
        file["a/b"] = file["a"]
    refuses(DataError, "r.mat is damaged, or not a MAT file: 'a.b' holds itself", read, tmp_path / "r.mat")


def test_references_without_end_are_refused_early(h5, tmp_path):
    import h5py

    with h5() as file:
        cell = file.create_dataset("c", (2, 1), h5py.ref_dtype)
        cell[:] = [[cell.ref], [cell.ref]]
    refuses(DataError, "'c' holds itself", read, tmp_path / "r.mat")
    with h5() as file:
        file["g/" * 40 + "u"] = U
    refuses(DataError, "more than 32 deep", read, tmp_path / "r.mat")


def test_a_tree_that_grows_without_end_is_refused_early(h5, tmp_path, monkeypatch):
    import h5py

    with h5() as file:  # a million ways to the same number
        file["x0"] = 1.0
        for k in range(20):
            file.create_dataset(f"x{k + 1}", (2, 1), h5py.ref_dtype)[:] = [[file[f"x{k}"].ref]] * 2
    monkeypatch.setattr(mat_tree, "MOST_NODES", 300)
    with pytest.raises(ValueError, match="more than 300 variables"), mat_tree.open_tree(tmp_path / "r.mat"):
        pass


def test_deep_structures_of_version_5_are_refused(tmp_path):
    value = {"u": U}
    for _ in range(40):
        value = {"s": value}
    savemat(tmp_path / "r.mat", {"a": value})
    refuses(DataError, "more than 32 deep", read, tmp_path / "r.mat")


def test_nested_cells_take_no_time(tmp_path):
    value = np.ones((1, 1))
    for _ in range(30):
        cell = np.empty((1, 1), object)
        cell[0, 0] = value
        value = cell
    savemat(tmp_path / "r.mat", {"c": value, "u": U, "y": Y})
    same(read(tmp_path / "r.mat"), 1.0)


def test_links_to_other_files_are_refused(h5, tmp_path):
    import h5py

    with h5() as file:
        file["u"] = h5py.ExternalLink("other.h5", "u")
    refuses(DataError, "'u' is a link to another file", read, tmp_path / "r.mat")
    with h5() as file:
        file.create_dataset("u", (3,), "f8", external=[("other.bin", 0, 24)])
    refuses(DataError, "'u' are stored in another file", read, tmp_path / "r.mat")


def test_h5py_is_named_where_it_is_missing(tmp_path, monkeypatch):
    write_mat(tmp_path / "r.mat", {"u": U, "y": Y}, "7.3")
    monkeypatch.setitem(sys.modules, "h5py", None)
    refuses(DataError, r'7.3, which needs h5py: pip install "optid\[mat\]"', file_contents, tmp_path / "r.mat", None)


KINDS = {
    "plain": {"u": U, "y": Y, "t": T, "title": "run 1"}, "nested": {"a": {"b": {"u": U, "y": Y}, "Ts": 0.1}},
    "structures": {"run": [{"u": U, "y": Y}, {"u": Y, "y": U}]},
    "cells": {"u": Cell([U, Y]), "y": Cell([Y, U]), "fs": 10.0},
    "simulink": {"s": {"time": T, "signals": [{"values": x, "label": k} for k, x in (("u", U), ("y", Y))]}},
    "iddata": {"z": iddata(UU, InputName=Cell(["a", "b"]))}, "to file": {"ans": np.vstack([T, U, Y])},
    "others": {"u": U, "y": Y * 1j, "s": sparse.csc_matrix(UU), "o": Object("table"), "e": EMPTY, "b": U > 0}}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_damaged_files_are_read_or_refused_by_name(save, kind, count):
    path, found = save(**KINDS[kind]), []
    for bad in bytes_of(path.read_bytes(), count, seed=4):
        path.write_bytes(bad)
        try:
            with warnings.catch_warnings(action="ignore", category=DataWarning):
                read(path, *([1, 2] if kind == "to file" else []))
        except DataError as error:
            assert "r.mat" in str(error) or "channel" in str(error), error
            assert len(str(error)) < 3000
            found.append(str(error))
    assert found

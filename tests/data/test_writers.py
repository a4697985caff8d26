"""A record that is written as a text table is read back as it was."""

from typing import Any

import numpy as np
import pytest
from refusals import refuses
from typer.testing import CliRunner

import optid
from optid.cli.app import app
from optid.errors import DataError
from optid.examples import EXAMPLES, example


def equal(read: optid.Data, written: optid.Data) -> bool:
    """Whether two records are the same; the sampling time to the nanoseconds of dates."""
    fields = ("inputs", "outputs", "input_units", "output_units", "time_unit", "dated", "n_experiments")
    assert [getattr(read, name) for name in fields] == [getattr(written, name) for name in fields]
    assert read.dt == pytest.approx(written.dt, rel=1e-9)
    for one, other in zip(read.experiments, written.experiments, strict=True):
        np.testing.assert_array_equal(one.u, other.u)
        np.testing.assert_array_equal(one.y, other.y)
        assert one.start == pytest.approx(other.start, rel=1e-14)
    return True


def again(data: optid.Data, path, **words) -> optid.Data:
    return optid.read(data.to_csv(path), inputs=data.inputs, outputs=data.outputs, **words)


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_is_read_back_with_its_units_and_times(name, tmp_path):
    data = example(name, n=200).data
    assert equal(again(data, tmp_path / "record.csv"), data)


@pytest.mark.parametrize(("dt", "start"), [
    (0.25, "2024-03-01T08:00:00.5"), (1 / 3, "2024-03-01"), (1e-4, "1969-12-31T23:59:59"), (0.1, 12.7), (None, 0.0)])
def test_dates_fractions_gaps_and_experiments_are_kept(dt, start, tmp_path):
    rng = np.random.default_rng(0)
    u = [rng.standard_normal((n, 2)) * 10.0 ** rng.integers(-9, 9) for n in (30, 20)]
    y = [rng.standard_normal((n, 1)) for n in (30, 20)]
    u[0][:2], y[0][:2], u[1][-1], y[1][-1] = np.nan, np.nan, np.nan, np.nan
    names: dict[str, Any] = {"inputs": ["valve, main", "Größe"], "outputs": ['a "b"'], "input_units": ["%", ""],
                             "output_units": ["°C"]}
    single = optid.Data(u[0], y[0], dt, start=start, **names)
    assert equal(again(single, tmp_path / "one.csv"), single)
    both = optid.Data(u, y, dt, start=start, **names)
    assert equal(again(both, tmp_path / "two.csv", experiment="experiment"), both)


def test_a_record_without_units_has_no_row_of_them(tmp_path):
    data = optid.Data([1, 2.5, np.nan], [0.1, 1e22, -3], 0.5)
    assert data.to_csv(tmp_path / "r.csv").read_text() == "time,u,y\n0,1,0.1\n0.5,2.5,1e+22\n1,NaN,-3\n"


@pytest.mark.parametrize(("names", "units", "message"), [
    (["time", "y"], ["", ""], "named 'time'"), (["0.5", "y"], ["", ""], "'0.5'"), (["u", "y"], ["1", ""], "units"),
    ([" u", "y"], ["", ""], "read as")])
def test_what_would_be_read_as_something_else_is_refused_and_no_file_is_touched(names, units, message, tmp_path):
    path = tmp_path / "r.csv"
    path.write_text("kept")
    data = optid.Data(np.arange(9.0), np.arange(9.0) ** 2, 0.5, inputs=names[:1], outputs=names[1:],
                      input_units=units[:1], output_units=units[1:])
    refuses(DataError, message, data.to_csv, path)
    assert path.read_text() == "kept"


def test_the_command_writes_what_it_shows(tmp_path):
    path = tmp_path / "heater.csv"
    done = CliRunner().invoke(app, ["look", "--example", "heater", "--csv", str(path)])
    assert done.exit_code == 0 and "record written to" in done.stdout
    assert equal(optid.read(path, inputs="heater", outputs="temperature"), example("heater").data)

"""The database of a study: what goes in comes out, and what cannot be used is refused."""

import sqlite3
from contextlib import closing

import numpy as np
import pytest
import study_rows
from study_rows import append, finished_rows, rows

from optid.errors import DatabaseError, DataError, OptidError
from optid.studies.storage.export import export
from optid.studies.storage.rows import COLUMNS, NAMES
from optid.studies.storage.store import Store, read_rows, rows_of_one


@pytest.fixture
def path(tmp_path):
    return tmp_path / "study.sqlite"


def test_rows_come_back_as_they_went_in(path):
    made = rows(400, seed=2)
    append(path, made[:150])
    append(path, made[150:])
    found = read_rows(path)
    assert tuple(found) == NAMES
    assert finished_rows(path) == {(row["key"], row["repetition"]) for row in made}
    for column in COLUMNS:
        want = [row[column.name] for row in made]
        got = found[column.name]
        if column.kind in ("text", "json"):
            assert list(got) == [value or "" for value in want]
        elif column.kind == "time":
            assert [np.datetime64(value[:-6], "us") for value in want] == list(got)
        else:
            empty = 0.0 if column.kind == "flag" else np.nan
            np.testing.assert_array_equal(got.astype(float), [empty if value is None else value for value in want])
    assert found["repetition"].dtype == np.int64 and found["proved"].dtype == bool


def test_the_largest_whole_numbers_come_back(path):
    (row,) = rows(1)
    row |= {"iterations": 2**63 - 1, "seed": -(2**63)}
    append(path, [row])
    with Store(path) as store:
        (back,) = store.rows_of(None, [(row["key"], row["repetition"])])
    assert (back["iterations"], back["seed"]) == (2**63 - 1, -(2**63))


def test_hashes_of_data_files_by_study_and_label(path):
    made = rows(200)
    append(path, made)
    expected = {("synthetic", row["data"]): {row["data_hash"]} for row in made if row["data_hash"]}
    with Store(path) as store:
        assert expected and store.data_hashes() == expected


def test_a_row_for_the_same_cell_replaces_the_former_one(path):
    made = rows(10)
    append(path, made)
    append(path, [{**made[3], "solver": "renamed"}])
    found = read_rows(path)
    assert len(found["key"]) == 10 and "renamed" in found["solver"]


def test_a_batch_with_a_row_that_is_none_changes_nothing(path):
    made = rows(10)
    append(path, made[:5])
    with pytest.raises(ValueError, match="no column is called"):
        append(path, [*made[5:], {**made[0], "strange": 1}])
    assert len(finished_rows(path)) == 5


def test_only_the_cells_of_the_grid_as_it_is_now_keep_their_rows_and_former_ones_come_back(path):
    made = rows(10)
    identities = [(row["key"], row["repetition"]) for row in made]
    append(path, made)
    append(path, [{**made[0], "study": "another"}])
    with Store(path, write=True) as store:

        def aside(study=None):
            return sum(store.count_superseded(study).values())

        store.keep("synthetic", identities[:6])
        assert finished_rows(path, "synthetic") == set(identities[:6]) and len(finished_rows(path, "another")) == 1
        assert aside() == aside("synthetic") == 4 and aside("another") == 0
        late = {**made[8], "objective": 5.0, "started": "2027-01-01T00:00:00+00:00"}
        store.append([late])
        store.keep("synthetic", identities[:6])
        store.keep("synthetic", identities)  # made[8] is there twice: the newest comes back
        found = [(row["key"], row["objective"]) for row in store.rows_of("synthetic", identities[6:])]
        assert found == [(row["key"], row["objective"]) for row in (*made[6:8], late, made[9])]
        assert aside() == 1
        store.keep("synthetic", [])
        assert store.finished_rows("synthetic") == set() and aside() == 11


def test_studies_in_one_database_do_not_touch_each_other(path):
    made = rows(10)
    append(path, made)
    append(path, [{**row, "study": "another"} for row in made[:4]])
    assert [rows_of_one(path, name)["key"].size for name in ("synthetic", "another")] == [10, 4]
    assert len(finished_rows(path, "another")) == 4 and read_rows(path)["key"].size == 14


def test_of_rows_of_several_studies_one_that_is_done_comes_first_then_the_newest(path):
    (one,) = rows(1)
    for study, outcome, year, first in (("a", "crashed", 2031, "a"), ("b", "done", 2028, "b"),
                                        ("c", "done", 2030, "c"), ("d", "error", 2029, "c")):
        append(path, [{**one, "study": study, "outcome": outcome, "started": f"{year}-01-01T00:00:00+00:00"}])
        with Store(path) as store:
            found = store.rows_of(None, [(one["key"], one["repetition"])])
        assert [row["study"] for row in found] == [first]


@pytest.mark.parametrize("ending", ["parquet", "csv"])
def test_export_has_every_row_and_column(path, tmp_path, ending):
    import pandas as pd

    made = rows(200)
    append(path, made)
    target = tmp_path / f"it's here.{ending}"
    assert export(path, target) == 200
    frame = (pd.read_parquet if ending == "parquet" else pd.read_csv)(target)
    assert tuple(frame.columns) == NAMES and len(frame) == 200
    assert frame["objective"].isna().sum() == sum(row["objective"] is None for row in made)


def test_no_rows_are_not_exported(path, tmp_path):
    append(path, rows(1))
    with pytest.raises(DatabaseError, match="has no rows of a study 'another' to export"):
        export(path, tmp_path / "rows.csv", "another")
    with Store(path, write=True) as store:
        store.keep("synthetic", [])
    with pytest.raises(DatabaseError, match="has no rows to export: `optid study run`"):
        export(path, tmp_path / "rows.csv")
    assert not (tmp_path / "rows.csv").exists()


def test_no_rows_yet(path):
    assert finished_rows(path) == set()
    append(path, [])
    assert read_rows(path)["objective"].shape == (0,)


def made_by(statement):
    """An SQLite file of another kind or version."""

    def make(path):
        if statement.startswith("UPDATE"):
            append(path, rows(3))
        with closing(sqlite3.connect(path)) as connection, connection:
            connection.execute(statement)

    return make


@pytest.mark.parametrize("name, make, words", [
    ("study.sqlite", made_by("UPDATE meta SET value = '99' WHERE name = 'schema version'"),
     "schema version 99.*made by optid"),
    ("mine.sqlite", made_by("CREATE TABLE mine (x INTEGER)"), "not a database of studies"),
    ("valve.csv", b"time,u,y\n1,2,3\n" * 1000, "valve.csv is a file of another kind, .*give the one that `optid study"),
    ("study.toml", b'name = "small"\n' * 30, "study.toml is a file of another kind"),
    ("short.sqlite", b"\n", "not a database of studies .it has no tables"),
])
def test_files_of_another_kind_or_version_are_told_with_what_to_do(tmp_path, name, make, words):
    path = tmp_path / name
    make(path) if callable(make) else path.write_bytes(make)
    content = path.read_bytes()
    for attempt in (lambda: read_rows(path), lambda: append(path, rows(1)), lambda: finished_rows(path)):
        with pytest.raises(DatabaseError, match=words):
            attempt()
    assert path.read_bytes() == content


@pytest.mark.parametrize("seed", range(4))
def test_damaged_databases_are_named_and_end_in_time(path, seed):
    """Cut short, bytes changed, pages exchanged: an error that names the file, or rows that are still whole."""
    append(path, rows(60))
    content = path.read_bytes()
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(60):
        damaged = bytearray(content)
        way = rng.integers(3)
        if way == 0:
            damaged = damaged[: rng.integers(16, len(content))]
        elif way == 1:
            for at in rng.integers(16, len(content), rng.integers(1, 400)):
                damaged[at] = rng.integers(256)
        else:
            a, b = 4096 * rng.integers(0, len(content) // 4096, 2)
            damaged[a : a + 4096], damaged[b : b + 4096] = damaged[b : b + 4096], damaged[a : a + 4096]
        path.write_bytes(damaged)
        for attempt in (read_rows, finished_rows, lambda there: append(there, rows(1))):
            try:
                attempt(path)
            except DatabaseError as error:
                assert "study.sqlite" in str(error)
                refused += 1
        for beside in path.parent.glob("study.sqlite-*"):
            beside.unlink(missing_ok=True)  # SQLite removes them when the last statement of a failed read is collected
    assert refused > 60


def test_tables_and_values_of_another_shape_are_refused(path, tmp_path):
    append(path, rows(3))
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE rows SET started = 'yesterday'")
    with pytest.raises(DatabaseError, match="study.sqlite holds invalid values"):
        read_rows(path)
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("ALTER TABLE rows DROP COLUMN objective")
    with pytest.raises(DatabaseError, match="table rows does not have the columns of a study"):
        read_rows(path)


def test_a_run_under_way_can_be_read_and_leaves_one_file(path):
    made = rows(20)
    with Store(path, write=True) as store:
        for k, row in enumerate(made):
            store.append([row])
            assert len(finished_rows(path)) == k + 1
    read_rows(path)
    assert [file.name for file in path.parent.iterdir()] == ["study.sqlite"]


def test_a_second_connection_of_the_writer_gives_up_none_of_its_locks(path):
    """Else a reader in another process takes the pending writes for its own, and what is written later is lost."""
    import subprocess
    import sys

    reader = f"from optid.studies.storage.store import read_rows; print(read_rows({str(path)!r})['key'].size)"
    made = rows(6)
    with Store(path, write=True) as store:
        for k, row in enumerate(made):
            store.append([row])
            finished_rows(path)  # here
            there = subprocess.run([sys.executable, "-c", reader], capture_output=True, text=True, check=True)
            assert int(there.stdout) == k + 1


def test_two_processes_write_into_one_database(path):
    import subprocess
    import sys
    from pathlib import Path

    program = ("import sys; sys.path.insert(0, sys.argv[1]); from study_rows import append, rows; "
               "[append(sys.argv[2], [{**row, 'study': sys.argv[3]}]) for row in rows(60)]")
    started = [subprocess.Popen([sys.executable, "-c", program, str(Path(study_rows.__file__).parent), str(path),
                                name])
               for name in ("one", "two")]
    assert [process.wait() for process in started] == [0, 0]
    assert [len(finished_rows(path, name)) for name in ("one", "two")] == [60, 60]


def test_texts_in_csv_are_no_formulas_and_parquet_has_them_as_they_are(path, tmp_path):
    import polars

    hostile = ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(1)", "\t=1", "plain", "a=b"]
    append(path, [{**row, "reason": text} for row, text in zip(rows(7), hostile)])
    assert export(path, tmp_path / "rows.csv") == export(path, tmp_path / "rows.parquet") == 7
    assert sorted(polars.read_parquet(tmp_path / "rows.parquet")["reason"]) == sorted(hostile)
    written = polars.read_csv(tmp_path / "rows.csv", infer_schema=False)["reason"].to_list()
    assert sorted(written) == sorted([*("'" + text for text in hostile[:5]), *hostile[5:]])


def test_an_export_reads_like_its_database(path, tmp_path):
    from optid.studies.verdicts.verdict import conclude

    append(path, rows(300))
    export(path, tmp_path / "rows.parquet")
    assert str(conclude(tmp_path / "rows.parquet")) == str(conclude(path))
    good = (tmp_path / "rows.parquet").read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(100):
        damaged = bytearray(good)
        for at in rng.integers(0, len(good), 40):
            damaged[at] = rng.integers(256)
        (tmp_path / "bad.parquet").write_bytes(damaged)
        try:
            conclude(tmp_path / "bad.parquet")
        except OptidError as error:
            assert "bad.parquet" in str(error) or isinstance(error, DataError)
    (tmp_path / "bad.parquet").write_bytes(b"PAR1" + b"no table" * 9)
    with pytest.raises(DatabaseError, match="bad.parquet cannot be read"):
        rows_of_one(tmp_path / "bad.parquet")


def test_nothing_and_a_folder_are_no_database(tmp_path, path):
    with pytest.raises(DatabaseError, match="no such database"):
        read_rows(path)
    for attempt in (lambda: read_rows(tmp_path), lambda: append(tmp_path, rows(1))):
        with pytest.raises(DatabaseError, match="no such database|Is a directory"):
            attempt()


def test_export_to_another_ending_or_nowhere(path, tmp_path):
    append(path, rows(1))
    with pytest.raises(DatabaseError, match="ends in .parquet or .csv"):
        export(path, tmp_path / "rows.xlsx")
    with pytest.raises(DatabaseError, match="cannot be written"):
        export(path, tmp_path / "no folder" / "rows.csv")

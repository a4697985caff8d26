"""The database of a study: what goes in comes out, and what cannot be used is refused."""

import numpy as np
import pytest
from study_rows import rows

from optid.errors import DatabaseError
from optid.studies.storage import database, opening
from optid.studies.storage.database import append, data_hashes, export, finished, read_rows
from optid.studies.storage.journal import Journal
from optid.studies.storage.opening import opened
from optid.studies.storage.rows import COLUMNS, NAMES

duckdb = pytest.importorskip("duckdb")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "study.duckdb"


def test_rows_come_back_as_they_went_in(path):
    made = rows(400, seed=2)
    append(path, made[:150])
    append(path, made[150:])
    found = read_rows(path)
    assert tuple(found) == NAMES
    assert finished(path) == {(row["key"], row["repetition"]) for row in made}
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
    (back,) = database.rows_of(path, None, [(row["key"], row["repetition"])])
    assert (back["iterations"], back["seed"]) == (2**63 - 1, -(2**63))


def test_hashes_of_data_files_by_study_and_label(path):
    made = rows(200)
    append(path, made)
    expected = {("synthetic", row["data"]): {row["data_hash"]} for row in made if row["data_hash"]}
    assert expected and data_hashes(path) == expected


@pytest.mark.slow
def test_ten_thousand_rows_are_written_and_read(path):
    append(path, rows(10_000))
    assert read_rows(path)["key"].size == 10_000


def test_a_row_twice_is_refused_and_leaves_the_rest(path):
    made = rows(20)
    append(path, made[:10])
    with pytest.raises(DatabaseError, match="cannot be written"):
        append(path, made[9:])
    assert len(finished(path)) == 10


def test_a_newer_row_of_the_same_place_moves_the_older_aside(path):
    made = rows(10)
    append(path, made)
    append(path, [{**made[3], "key": "f" * 64, "objective": 5.0}])
    assert len(finished(path)) == 10 and ("f" * 64, made[3]["repetition"]) in finished(path)
    with opened(path) as connection:
        assert connection.execute("SELECT key FROM superseded").fetchall() == [(made[3]["key"],)]


def test_a_cell_under_another_label_moves_the_former_row_aside(path):
    made = rows(10)
    append(path, made)
    append(path, [{**made[3], "solver": "renamed", "place": "p" * 32}])
    found = read_rows(path)
    assert len(found["key"]) == 10 and "renamed" in found["solver"]
    with opened(path) as connection:
        assert connection.execute("SELECT solver FROM superseded").fetchall() == [(made[3]["solver"],)]


def test_only_the_cells_of_the_grid_as_it_is_now_keep_their_rows_and_former_ones_come_back(path):
    made = rows(10)
    identities = [(row["key"], row["repetition"]) for row in made]
    append(path, made)
    append(path, [{**made[0], "study": "another"}])
    database.keep(path, "synthetic", identities[:6])
    assert finished(path, "synthetic") == set(identities[:6]) and len(finished(path, "another")) == 1
    assert database.former(path) == database.former(path, "synthetic") == 4 and database.former(path, "another") == 0
    late = {**made[8], "objective": 5.0, "started": "2027-01-01T00:00:00+00:00"}
    append(path, [late])
    database.keep(path, "synthetic", identities[:6])
    database.keep(path, "synthetic", identities)  # made[8] is there twice: the newest comes back
    found = [(row["key"], row["objective"]) for row in database.rows_of(path, "synthetic", identities[6:])]
    assert found == [(row["key"], row["objective"]) for row in (*made[6:8], late, made[9])]
    assert database.former(path) == 1
    database.keep(path, "synthetic", [])
    assert finished(path, "synthetic") == set() and database.former(path) == 11


def test_studies_in_one_database_do_not_touch_each_other(path):
    made = rows(10)
    append(path, made)
    append(path, [{**row, "study": "another", "place": row["place"][::-1]} for row in made[:4]])
    assert [read_rows(path, name)["key"].size for name in ("synthetic", "another")] == [10, 4]
    assert len(finished(path, "another")) == 4 and read_rows(path)["key"].size == 14


def test_of_rows_of_several_studies_one_that_is_done_comes_first_then_the_newest(path):
    (one,) = rows(1)
    for study, outcome, year, first in (("a", "crashed", 2031, "a"), ("b", "done", 2028, "b"),
                                        ("c", "done", 2030, "c"), ("d", "error", 2029, "c")):
        append(path, [{**one, "study": study, "outcome": outcome, "started": f"{year}-01-01T00:00:00+00:00"}])
        found = database.rows_of(path, None, [(one["key"], one["repetition"])])
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


def test_rows_that_are_only_in_the_journal_are_read_and_exported_and_nothing_is_written(path, tmp_path):
    """One of them is in the database too, one takes the place of a row there, one is half written."""
    import pandas as pd

    made = rows(10)
    append(path, made[:7])
    journal = Journal(path)
    newer = {**made[3], "key": "f" * 64, "objective": 5.0}
    for row in (made[6], *made[7:], newer):
        journal.add(row)
    with open(journal.path, "a") as file:
        file.write('{"key": "half a ro')
    link = tmp_path / "link.duckdb"
    link.symlink_to(path)
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    want = {row["key"]: row["objective"] for row in (*made[:3], newer, *made[4:])}
    for name in (path, link):
        found = read_rows(name)
        assert found["key"].size == 10 == read_rows(name, "synthetic")["key"].size
        assert tuple(found) == NAMES and list(found["started"]) == sorted(found["started"])
        assert set(found["key"]) == set(want)
    np.testing.assert_array_equal(found["objective"], [np.nan if want[k] is None else want[k] for k in found["key"]])
    assert read_rows(path, "another")["key"].size == 0
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before
    assert export(path, tmp_path / "rows.csv") == 10 == export(path, tmp_path / "rows.csv", "synthetic")
    assert set(pd.read_csv(tmp_path / "rows.csv")["key"]) == set(want)


def test_a_journal_of_another_version_is_told_to_readers_too(path, tmp_path):
    append(path, rows(1))
    path.with_name("study.duckdb.journal").write_text('{"sover": 1}\n')
    for attempt in (lambda: read_rows(path), lambda: export(path, tmp_path / "rows.csv")):
        with pytest.raises(DatabaseError, match="journal holds what is no row of this version.*Remove it"):
            attempt()


def test_no_rows_are_not_exported(path, tmp_path):
    append(path, rows(1))
    with pytest.raises(DatabaseError, match="has no rows of a study 'another' to export"):
        export(path, tmp_path / "rows.csv", "another")
    database.keep(path, "synthetic", [])
    with pytest.raises(DatabaseError, match="has no rows to export: `optid study run`"):
        export(path, tmp_path / "rows.csv")
    assert not (tmp_path / "rows.csv").exists()


def test_no_rows_yet(path):
    assert finished(path) == set()
    append(path, [])
    assert read_rows(path)["objective"].shape == (0,)


def test_missing_database(path):
    with pytest.raises(DatabaseError, match="no such database"):
        read_rows(path)


def test_another_version_is_refused_for_reading_and_writing(path):
    append(path, rows(3))
    with duckdb.connect(str(path)) as connection:
        connection.execute("UPDATE meta SET value = '99' WHERE name = 'schema version'")
    for attempt in (lambda: read_rows(path), lambda: append(path, rows(1)), lambda: finished(path)):
        with pytest.raises(DatabaseError, match="schema version 99.*made by optid"):
            attempt()


def test_other_files_are_refused(path):
    with duckdb.connect(str(path)) as connection:
        connection.execute("CREATE TABLE mine (x INTEGER)")
    for attempt in (lambda: read_rows(path), lambda: append(path, rows(1))):
        with pytest.raises(DatabaseError, match="not a database of studies"):
            attempt()


@pytest.mark.parametrize("name, content, words", [
    ("valve.csv", b"time,u,y\n1,2,3\n" * 1000, "valve.csv is a file of another kind, .*give the one that `optid study"),
    ("study.toml", b'name = "small"\n' * 30, "study.toml is a file of another kind"),
    ("short.duckdb", b"\n", "is a file of another kind"),
    ("empty.duckdb", b"", "is empty, and no database: remove it"),
])
def test_files_of_another_kind_are_told_with_what_to_do(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    for attempt in (lambda: read_rows(path), lambda: append(path, rows(1)), lambda: finished(path)):
        with pytest.raises(DatabaseError, match=words):
            attempt()
    assert path.read_bytes() == content


@pytest.mark.sampled(2)
@pytest.mark.parametrize("share", [0.001, 0.01, 0.1, 0.3])
def test_a_database_that_was_cut_short_is_told_with_what_to_do(path, share):
    append(path, rows(2000))
    content = path.read_bytes()
    path.write_bytes(content[:max(int(share * len(content)), 20)])
    with pytest.raises(DatabaseError, match="cannot be (opened|read): .*cut short, take another copy, or remove it"):
        read_rows(path)


def test_a_folder_is_no_database(tmp_path):
    for attempt in (lambda: read_rows(tmp_path), lambda: append(tmp_path, rows(1))):
        with pytest.raises(DatabaseError, match="no such database|Is a directory"):
            attempt()


def test_export_to_another_ending_or_nowhere(path, tmp_path):
    append(path, rows(1))
    with pytest.raises(DatabaseError, match="ends in .parquet or .csv"):
        export(path, tmp_path / "rows.xlsx")
    with pytest.raises(DatabaseError, match="cannot be written"):
        export(path, tmp_path / "no folder" / "rows.csv")


def test_a_database_in_use_is_waited_for_then_refused(path, monkeypatch):
    import subprocess
    import sys

    append(path, rows(1))
    monkeypatch.setattr(opening, "PATIENCE", 0.1)
    hold = f"import duckdb, sys; c = duckdb.connect({str(path)!r}); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None and other.stdout.readline() == b"open\n"
        with pytest.raises(DatabaseError, match="in use by another process"):
            read_rows(path)
        other.communicate()
    assert len(finished(path)) == 1

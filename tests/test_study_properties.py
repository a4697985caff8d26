"""Properties of rows, journal and database, on rows that hypothesis makes up."""

import json
import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from study_rows import rows as synthetic

from optid.studies.storage import database
from optid.studies.storage.journal import Journal, kept
from optid.studies.storage.rows import COLUMNS, NAMES, OUTCOMES, STATUSES, as_json, complete, place

pytest.importorskip("duckdb")

TEXT = st.text(st.characters(exclude_categories=()), max_size=40)
NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
JSON = st.recursive(NUMBERS | TEXT | st.booleans() | st.none() | st.integers(),
                    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3), max_leaves=8)
KINDS = {"text": TEXT, "number": NUMBERS, "integer": st.integers(-(2**53), 2**53), "flag": st.booleans(),
         "json": JSON.map(as_json)}
ALWAYS = {"outcome": st.sampled_from(sorted(OUTCOMES)), "status_verified": st.sampled_from([None, *STATUSES]),
          "started": st.datetimes().map(lambda when: when.isoformat() + "+00:00")}


def _values(column):
    if column.name in ALWAYS:
        return ALWAYS[column.name]
    values = KINDS[column.kind]
    if column.always and column.kind == "number":
        return st.floats(allow_nan=False, allow_infinity=False)
    return values if column.always else st.none() | values


ROWS = st.fixed_dictionaries({column.name: _values(column) for column in COLUMNS}).map(complete)
BATCHES = st.lists(ROWS, min_size=1, max_size=4, unique_by=(lambda r: (r["study"], r["key"], r["repetition"]),
                                                            lambda r: (r["study"], r["place"])))
FEW = settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))


@FEW
@given(ROWS)
def test_complete_is_idempotent_and_finite(row):
    assert tuple(row) == NAMES and complete(row) == row
    assert all(math.isfinite(value) for value in row.values() if isinstance(value, float))


@pytest.mark.slow
@FEW
@given(BATCHES)
def test_rows_survive_the_database(batch):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.duckdb"
        database.append(path, batch)
        identities = [(row["key"], row["repetition"]) for row in batch]
        for study in {row["study"] for row in batch}:
            mine = [row for row in batch if row["study"] == study]
            back = database.rows_of(path, study, [(row["key"], row["repetition"]) for row in mine])
            for row, found in zip(mine, back, strict=True):
                row, found = dict(row), dict(found)
                assert np.datetime64(row.pop("started")[:-6]) == np.datetime64(found.pop("started")[:-6])
                assert found == row
        assert database.finished(path) == set(identities)
        assert database.read_rows(path)["key"].size == len(batch)


@FEW
@given(BATCHES, st.data())
def test_a_journal_cut_anywhere_holds_the_rows_before(batch, data):
    with tempfile.TemporaryDirectory() as folder:
        journal = Journal(Path(folder) / "x.duckdb")
        for row in batch:
            journal.add(row)
        content = journal.path.read_bytes()
        cut = data.draw(st.integers(0, len(content)))
        journal.path.write_bytes(content[:cut])
        assert kept(Path(folder) / "x.duckdb") == batch[: content[:cut].count(b"\n")]
        journal.close()


@FEW
@given(JSON)
def test_json_is_finite_and_parses(value):
    def refuse(word):
        raise AssertionError(word)

    json.loads(as_json(value), parse_constant=refuse)


@FEW
@given(st.lists(st.tuples(TEXT, st.none() | st.floats(allow_nan=False), st.integers()), unique=True, max_size=6))
def test_places_differ_where_labels_do(labels):
    assert len({place(*label) for label in labels}) == len({json.dumps(label) for label in labels})


@pytest.mark.slow
@FEW
@given(st.permutations(range(8)), st.sets(st.integers(0, 7)))
def test_the_order_of_batches_does_not_matter(order, renewed):
    """Whatever is renewed replaces what stood at its place, whenever it comes after it."""
    made = synthetic(8)
    newer = {k: {**made[k], "key": f"{k:x}" * 64, "objective": float(k)} for k in renewed}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.duckdb"
        for k in order:
            database.append(path, [made[k]])
        for k in order:
            if k in renewed:
                database.append(path, [newer[k]])
        expected = {(newer.get(k, made[k])["key"], made[k]["repetition"]) for k in range(8)}
        assert database.finished(path) == expected
        with database.opened(path) as connection:
            assert connection.execute("SELECT count(*) FROM superseded").fetchall() == [(len(renewed),)]

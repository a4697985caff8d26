"""Properties of rows and database, on rows that hypothesis makes up."""

import json
import math
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from study_rows import append, finished_rows

from optid.studies.storage.rows import COLUMNS, NAMES, OUTCOMES, STATUSES, as_json, complete
from optid.studies.storage.store import Store, read_rows

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
BATCHES = st.lists(ROWS, min_size=1, max_size=4, unique_by=lambda r: (r["study"], r["key"], r["repetition"]))
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
        path = Path(folder) / "x.sqlite"
        append(path, batch)
        identities = [(row["key"], row["repetition"]) for row in batch]
        for study in {row["study"] for row in batch}:
            mine = [row for row in batch if row["study"] == study]
            with Store(path) as store:
                back = store.rows_of(study, [(row["key"], row["repetition"]) for row in mine])
            for row, found in zip(mine, back, strict=True):
                assert found == row
        assert finished_rows(path) == set(identities)
        assert read_rows(path)["key"].size == len(batch)


@FEW
@given(JSON)
def test_json_is_finite_and_parses(value):
    def refuse(word):
        raise AssertionError(word)

    json.loads(as_json(value), parse_constant=refuse)

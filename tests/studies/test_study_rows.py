"""The row schema and the synthetic rows."""

import math
from pathlib import Path

import numpy as np
import pytest
from study_rows import rows

from optid.studies.storage.rows import BY_NAME, COLUMNS, NAMES, OUTCOMES, as_json, complete, markdown


def test_columns_have_distinct_names_and_a_meaning():
    assert len(set(NAMES)) == len(COLUMNS)
    assert all(column.meaning for column in COLUMNS)


def test_synthetic_rows_hold_every_outcome_but_error_and_false_claims():
    made = rows(3000, seed=1)
    assert {row["outcome"] for row in made} == set(OUTCOMES) - {"error", "killed"}
    assert any(row["false_claim"] for row in made)
    assert len({(row["key"], row["repetition"]) for row in made}) == 3000
    assert made == rows(3000, seed=1)


def test_non_finite_numbers_become_empty_and_numpy_scalars_plain_numbers():
    row = rows(1)[0] | {"objective": math.nan, "gap": math.inf, "bound": np.float64(-math.inf), "scale": 10**400,
                        "iterations": np.int32(7), "proved": np.bool_(True), "violation": np.float32(0.5)}
    done = complete(row)
    assert done["objective"] is done["gap"] is done["bound"] is done["scale"] is None
    assert [type(done[name]) for name in ("iterations", "proved", "violation")] == [int, bool, float]
    assert as_json([1.0, math.nan, np.array([math.inf, 2.0])]) == "[1.0, null, [null, 2.0]]"


@pytest.mark.parametrize("change, words", [
    ({"sover": "x"}, "no column is called sover"),
    ({"outcome": "fine"}, "outcome 'fine'"),
    ({"status_verified": "ok"}, "status_verified 'ok'"),
    ({"key": None}, "'key' must have a value"),
    ({"accuracy": math.nan}, "'accuracy' must have a value"),
    ({"iterations": 2**63}, "'iterations' holds integers of 64 bits; this one is larger"),
    ({"seed": -(2**63) - 1}, "'seed' holds integers of 64 bits"),
    ({"unknowns": 1e300}, "'unknowns' holds integers of 64 bits"),
    ({"iterations": 1.5}, "'iterations' holds a integer"),
    ({"proved": 1}, "'proved' holds a flag"),
    ({"objective": "1.0"}, "'objective' holds a number"),
])
def test_rows_that_break_the_schema_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        complete({**rows(1)[0], **change})


def test_documentation_names_every_column_and_outcome():
    text = (Path(__file__).parents[2] / "examples/studies/schema.md").read_text()
    assert text == markdown(), "write it anew: optid study schema > examples/studies/schema.md"
    assert all(f"| `{name}` |" in text for name in BY_NAME)
    assert all(f"| {word} |" in text for word in OUTCOMES)

"""Means over the seeds of a study, formulations side by side: python figures.py STUDY.toml STUDY.sqlite COLUMN ...

What has no row in the database yet is run first. Columns are those of the rows (optid.studies.storage.rows); "excess"
is the objective over that of the first formulation, minus one, in the same record.
"""

import sys
from pathlib import Path
from typing import Any

import pandas as pd

import optid

RECORD = ["data", "samples", "noise"]


def table(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return the mean of a column: one line per kind of record, one column per formulation."""
    first = list(dict.fromkeys(rows["formulation"]))
    if column == "excess":
        base = rows[rows["formulation"] == first[0]].set_index([*RECORD, "seed"])["objective"]
        rows = rows.join(base.rename("least"), on=[*RECORD, "seed"])
        rows = rows.assign(excess=rows["objective"] / rows["least"] - 1)
    return rows.pivot_table(column, RECORD, "formulation", aggfunc="mean", dropna=False)[first].dropna(how="all")


def main(study: Any, db: Any, columns: list[str], workers: int | None = None) -> dict[str, pd.DataFrame]:
    """Run what is left of a study, and return and print the tables."""
    study = study if isinstance(study, optid.Study) else optid.Study.from_toml(study)
    rows = study.run(db, workers=workers)
    found = {column: table(rows, column) for column in columns}
    for column, means in found.items():
        print(f"\n{study.name}: mean {column}\n{means.to_string(float_format='{:.3g}'.format)}")
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:] or ["parameter_error", "nonlinearity_error"])

"""Rows that a study had and no longer has: kept in the table ``superseded``, in no report."""

from pathlib import Path

from optid.studies.definition.description import Study
from optid.studies.storage.database import opened


def told_former(path: str | Path, study: Study) -> str:
    """Return in words which rows of a study are set aside, and why; empty where none is.

    Args:
        path: the database.
        study: as it is now.

    Raises:
        DatabaseError: as in `opened`.
    """
    with opened(path) as connection:
        found = connection.execute("SELECT data, formulation, solver, count(*) FROM superseded WHERE study = ? "
                                   "GROUP BY ALL", [study.name]).fetchall()
    axes = {"data": study.data, "formulation": study.formulations, "solver": study.solvers}
    known = [{entry.name for entry in entries} for entries in axes.values()]
    counts: dict[str, int] = {}
    for *labels, count in found:
        gone = next((f"{axis} {label} is" for axis, label, names in zip(axes, labels, known) if label not in names), "")
        counts[gone] = counts.get(gone, 0) + int(count)
    reasons = [f"{gone} no longer in the study ({count:,})" for gone, count in sorted(counts.items()) if gone]
    if "" in counts:
        reasons.append(f"former data, settings or versions, or run again ({counts['']:,})")
    total = sum(counts.values())
    rows = "row is" if total == 1 else "rows are"
    return f"{total:,} {rows} set aside: {'; '.join(reasons)}" if total else ""

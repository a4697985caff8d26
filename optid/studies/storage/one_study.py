"""The rows of one study of a database, which may hold several: they are never taken for one."""

from pathlib import Path

import numpy as np

from optid.errors import LookupFailed, StudyError, nearest
from optid.studies.storage.database import read_rows


def rows_of_one(path: str | Path, study: str | None = None) -> dict[str, np.ndarray]:
    """Return the rows of a study as one array per column, as `read_rows` does.

    Args:
        path: the database.
        study: title of the study; it need not be given where the database holds only one.

    Raises:
        StudyError: the database holds several studies, and none is given.
        LookupFailed: it holds none of this title.
        DatabaseError: the database cannot be read.
    """
    rows = read_rows(path)
    titles = list(dict.fromkeys(rows["study"].tolist()))
    if study is None:
        if len(titles) > 1:
            listed = ", ".join(f"{title!r} ({int(np.sum(rows['study'] == title)):,} rows)" for title in titles)
            raise StudyError(f"{path} holds {len(titles)} studies: {listed}. Name one: --study TITLE (study=TITLE)")
        return rows
    if study not in titles:
        raise LookupFailed(f"no study in {path} is called {study!r}. {nearest(study, titles)}")
    return {name: values[rows["study"] == study] for name, values in rows.items()}

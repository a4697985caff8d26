"""Study files: TOML, with the key of everything that is wrong; what is no TOML is told in the words of its parser."""

import tomllib
from pathlib import Path

from optid.errors import StudyError
from optid.studies.definition.description import Study
from optid.studies.definition.entries import read
from optid.studies.definition.problems import Problems
from optid.studies.definition.trial import note_all

HINT = "a text stands in quotation marks, a path in single ones, several values in [ ]; a line holds one key = value"


def read_study(path: Path) -> Study:
    """Read a study file; see `Study.from_toml`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise StudyError(f"study file {path} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise StudyError(f"{path} has a problem:\n  not UTF-8, in which a study file is written: {error}") from None
    return parse_study(text.removeprefix("\ufeff"), path.parent, str(path), title=path.stem)


def parse_study(text: str, folder: Path, label: str, title: str = "study") -> Study:
    """Read the text of a study file; see `Study.from_text`. The title is that of a study that has none."""
    text = text.replace("\r\n", "\n")
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise StudyError(f"{label} has a problem:\n  lists or tables are nested too deeply to be a study") from None
    except ValueError as error:  # what is not TOML, and a whole number of so many digits that Python does not read it
        raise StudyError(f"{label} has a problem:\n  {error}; {HINT}") from None
    problems = Problems()
    found = {"name": title, **read(raw, problems)}
    note_all(folder, found["data"], found["formulations"], found["solvers"], problems)
    problems.told(label)
    study = Study(**found, folder=folder)
    object.__setattr__(study, "data_checked", True)
    return study

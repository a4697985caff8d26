"""Study files: TOML, with the line and column of everything that is wrong."""

import re
import tomllib
from pathlib import Path

from optid.errors import StudyError
from optid.studies.definition.description import Study
from optid.studies.definition.entries import read
from optid.studies.definition.positions import locate
from optid.studies.definition.problems import Problems
from optid.studies.definition.trial import Records, note_impossible, note_unreadable

_PLACE = re.compile(r"(.*) \(at line (\d+), column (\d+)\)")
_END = " (at end of document)"


def read_study(path: Path) -> Study:
    """Read a study file; see `Study.from_toml`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise StudyError(f"study file {path} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        before = path.read_bytes()[: error.start]
        line, column = before.count(b"\n") + 1, error.start - before.rfind(b"\n")
        raise StudyError(f"{path} has a problem:\n  line {line}, column {column}: this is not UTF-8, in which a study "
                         "file is written") from None
    return parse_study(text.removeprefix("\ufeff"), path.parent, str(path), title=path.stem)


def parse_study(text: str, folder: Path, label: str, title: str = "study") -> Study:
    """Read the text of a study file; see `Study.from_text`.

    Args:
        text: TOML.
        folder: where relative data files are looked for.
        label: what the text is called in messages.
        title: title of a study that has none.
    """
    text = text.replace("\r\n", "\n")
    try:
        raw = tomllib.loads(text)
    except ValueError as error:  # what is not TOML, and a whole number of so many digits that Python does not read it
        raise StudyError(f"{label} has a problem:\n  {_syntax(str(error), text)}") from None
    positions, problems = locate(text), Problems()
    found = {"name": title, **read(raw, problems)}
    records = Records(folder)
    if "data" in raw:
        note_unreadable(found["data"], records, problems, wrong={problem.path[:2] for problem in problems})
    if not problems:
        note_impossible(found["data"], found["formulations"], records, problems)
    problems.told(label, positions)
    study = Study(**found, folder=folder)
    object.__setattr__(study, "data_checked", True)
    return study


def _syntax(message: str, text: str) -> str:
    """Put the place in front of a message of the parser."""
    found = _PLACE.fullmatch(message)
    if found:
        return f"line {found[2]}, column {found[3]}: {found[1][:1].lower()}{found[1][1:]}"
    if not message.endswith(_END):
        return message
    last = text.rstrip("\n")
    line = last.count("\n") + 1
    column = len(last) - last.rfind("\n")
    return f"line {line}, column {column}: {message.removesuffix(_END)}, at the end of the file"

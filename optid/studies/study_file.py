"""Study files: TOML, with the line and column of everything that is wrong."""

import re
import tomllib
import warnings
from pathlib import Path

from optid.errors import DataError, DataWarning, StudyError
from optid.studies.description import DataEntry, Study
from optid.studies.entries import read
from optid.studies.positions import locate
from optid.studies.problems import Problems

_PLACE = re.compile(r"(.*) \(at line (\d+), column (\d+)\)")


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
    except tomllib.TOMLDecodeError as error:
        raise StudyError(f"{label} has a problem:\n  {_syntax(str(error), text)}") from None
    positions, problems = locate(text), Problems()
    found = {"name": title, **read(raw, problems)}
    unreadable = Problems()
    if "data" in raw:
        _note_unreadable(found["data"], folder, unreadable, at={problem.path[:2] for problem in problems})
    problems.extend(unreadable)
    problems.told(label, positions)
    return Study(**found, folder=folder)


def note_unreadable(study: Study, problems: Problems) -> None:
    """Note the data entries of a study whose files cannot be read."""
    _note_unreadable(study.data, study.folder, problems, at=set())


def _note_unreadable(entries: tuple[DataEntry, ...], folder: Path, problems: Problems, at: set) -> None:
    for i, entry in enumerate(entries):
        if ("data", i) in at:  # its keys are wrong already
            continue
        for number, name in enumerate(entry.files):
            key, text = _trouble(folder / name, entry)
            if text:
                problems.add(("data", i, key, number) if key == "file" else ("data", i, key), text)
                break


def _trouble(path: Path, entry: DataEntry) -> tuple[str, str]:
    """The key that is to blame, and why a file cannot be read; two empty texts where it can."""
    from optid.readers import read as read_record
    from optid.reading.columns import choose
    from optid.reading.tables import open_table

    options = dict(entry.options)
    key = "file"
    try:
        table = open_table(path, options.get("columns"), options.get("delimiter", ","), options.get("decimal", "."))
        for key, letter in (("inputs", "u"), ("outputs", "y")):
            choose(table.names, options.get(key), letter, table.label)
        key = "file"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DataWarning)  # they are told when the record is used
            read_record(path, **options)
    except DataError as error:
        return key, str(error)
    return "", ""


def _syntax(message: str, text: str) -> str:
    """Put the place in front of a message of the parser."""
    found = _PLACE.fullmatch(message)
    if found:
        return f"line {found[2]}, column {found[3]}: {found[1][:1].lower()}{found[1][1:]}"
    last = text.rstrip("\n")
    line = last.count("\n") + 1
    column = len(last) - last.rfind("\n")
    return f"line {line}, column {column}: {message.removesuffix(' (at end of document)')}, at the end of the file"

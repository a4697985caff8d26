"""Study files: TOML, with the key of everything that is wrong."""

import re
import tomllib
from pathlib import Path

from optid.errors import StudyError
from optid.studies.definition.description import Study
from optid.studies.definition.entries import read
from optid.studies.definition.problems import Problems
from optid.studies.definition.trial import note_all

_PLACE = re.compile(r"(.*) \(at line (\d+), column (\d+)\)")
_END = " (at end of document)"
_WORD = re.compile(r"[^\s,\]}#]+")
_MEANT = {
    r"Illegal character '\n'": "the quotation mark that ends this text is missing",
    "Invalid value": "{there} is no value: a text stands in quotation marks; others are numbers, true, false, lists in "
                     "[ ]",
    "Expected newline or end of document": "{there} is too much: a line holds one key = value; several values stand in "
                                           "[ ]",
    "Unclosed array": "the list does not end: a comma or ] is missing before this place",
    "Unterminated string": "the quotation marks that end a text are missing",
    "Cannot overwrite a value": "this key has a value already",
    "Invalid hex value": "a backslash is written twice, or the text stands in single quotation marks: '...'",
    r"Unescaped '\' in a string": "a backslash is written twice, or the text stands in single quotation marks: '...'",
}
"""Beginnings of messages of the parser, and what they mean for somebody who does not know its words."""


def read_study(path: Path) -> Study:
    """Read a study file; see `Study.from_toml`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise StudyError(f"study file {path} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        raise StudyError(f"{path} has a problem:\n  line {line}: this is not UTF-8, in which a study file is written"
                         ) from None
    return parse_study(text.removeprefix("\ufeff"), path.parent, str(path), title=path.stem)


def parse_study(text: str, folder: Path, label: str, title: str = "study") -> Study:
    """Read the text of a study file; see `Study.from_text`. The title is that of a study that has none."""
    text = text.replace("\r\n", "\n")
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise StudyError(f"{label} has a problem:\n  lists or tables are nested too deeply to be a study") from None
    except ValueError as error:  # what is not TOML, and a whole number of so many digits that Python does not read it
        raise StudyError(f"{label} has a problem:\n  {_syntax(str(error), text)}") from None
    problems = Problems()
    found = {"name": title, **read(raw, problems)}
    note_all(folder, found["data"], found["formulations"], found["solvers"], problems)
    problems.told(label)
    study = Study(**found, folder=folder)
    object.__setattr__(study, "data_checked", True)
    return study


def _syntax(message: str, text: str) -> str:
    """Put the place in front of a message of the parser, and say what is meant where its words do not."""
    found = _PLACE.fullmatch(message)
    if found:
        words, line, column = found[1], int(found[2]), int(found[3])
    elif message.endswith(_END):
        last = text.rstrip("\n")
        words, line, column = message.removesuffix(_END), last.count("\n") + 1, len(last) - last.rfind("\n")
    else:
        return message
    rest = text.split("\n")[line - 1][column - 1 :]
    there = repr(match[0]) if (match := _WORD.match(rest)) else "what stands here"
    told = next((meant for begin, meant in _MEANT.items() if words.startswith(begin)), words[:1].lower() + words[1:])
    if words == "Invalid value" and (not rest.strip() or rest.lstrip().startswith("#")):
        told = "the value is missing"
    told = told.format(there=there) if told in _MEANT.values() else told
    return f"line {line}, column {column}: {told}" + ("" if found else ", at the end of the file")

"""What is wrong in a study, each problem with its key as a study file writes it."""

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from optid.errors import StudyError, nearest

Problem = tuple[tuple[str | int, ...], str]
"""Keys that lead to a value, and what is wrong with it."""

WORDS = {"Value error, ": "", "Input should ": "must ",
         "a valid number": "a number", "a valid integer": "an integer", "a valid boolean": "true or false",
         "a valid dictionary": "a table", "a valid string": "a text",
         "a dictionary or an instance of DataEntry": "a record, optid.Data(u, y, dt), the name of a file or of a "
         "simulated system, or a table of keys",
         "a dictionary or an instance of FormulationEntry": "a table of keys with the name of a formulation",
         "a dictionary or an instance of SolverEntry": "the name of a solver, or a table of keys"}
"""Words of pydantic, and ours."""

EMPTY = {"data": "there is no [[data]]: a study needs at least one",
         "formulations": "there is no [[formulation]]: a study needs at least one",
         "solvers": "there is no solver: add solvers = \"all\", solvers = [\"clarabel\", ...] or [[solver]]"}
"""Axes without an entry."""


def refuse(problems: Sequence[Problem]) -> Any:
    """Raise a `pydantic.ValidationError` with these problems, which gains the keys of what is being validated."""
    if problems:
        raise ValidationError.from_exception_data("study", [InitErrorDetails(
            type=PydanticCustomError("study", "{text}", {"text": text}), loc=keys, input=None)
            for keys, text in problems])


def unknown_keys(raw: Mapping[str, Any], known: Sequence[str], more: str = "") -> list[Problem]:
    """Return the keys of a table that are not known."""
    return [((str(key),), f"unknown key {key!r}. {nearest(str(key), known)}{more}") for key in raw if key not in known]


def problems_of(error: ValidationError) -> list[Problem]:
    """Return the problems of a validation, each with its keys."""
    found: list[Problem] = []
    for line in error.errors(include_url=False):
        keys, text = line["loc"], line["msg"]
        if line["type"] == "too_short" and line["input"]:  # pydantic counts the valid ones: each has its own problem
            continue
        for pydantic, word in WORDS.items():
            text = text.replace(pydantic, word)
        if line["type"] == "string_pattern_mismatch":
            text = "must be a text that is not blank"
        elif line["type"] == "too_short":
            text = EMPTY.get(str(keys[-1]), "is empty; give at least one number")
        elif line["msg"].startswith("Input should "):
            text = f"{text}; {format_value(line['input'])} is not"
        found.append((tuple("file" if key == "files" else key for key in keys), text))
    return found


def refuse_study(label: str, problems: Sequence[tuple[str, str]]) -> None:
    """Raise a `StudyError` with one line per problem, if there are any; repeated problems count as one.

    Args:
        label: name of the study or its file.
        problems: keys that lead to a value, written as in a study file, and what is wrong with it.
    """
    places: dict[str, list[str]] = {}
    for where, text in problems:
        places.setdefault(text, []).append(where)
    lines = [f"{where}: {text}" if where else text for text, (first, *others) in places.items()
             for where in [first + (f" and {len(others)} more" if others else "")]]
    if lines:
        count = f"{len(lines)} problems" if len(lines) > 1 else "a problem"
        raise StudyError(f"{label} has {count}:" + "".join(f"\n  {line}" for line in lines))


def format_keys(keys: Sequence[str | int], words: int) -> str:
    """Write keys as in a study file: data[0].noise. The first so many solvers are words at its top."""
    first, *rest = keys or ("",)
    if first == "solvers" and rest and isinstance(rest[0], int):
        first, rest = ("solvers", rest[:1]) if rest[0] < words else ("solver", [rest[0] - words, *rest[1:]])
    text = str({"formulations": "formulation"}.get(str(first), first))
    for part in rest:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return text


def format_value(value: Any) -> str:
    """Write a value for messages."""
    if isinstance(value, str):
        return f"the text {value!r}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "a table"
    if isinstance(value, int) and value.bit_length() > 200:  # Python does not even write one of 5000 digits
        return "a number of more than 60 digits"
    text = " ".join(repr(list(value) if isinstance(value, tuple) else value).split())
    return text if len(text) <= 60 else text[:57] + "..."

"""Options of the commands: types and defaults from the signature, words and help from the docstring.

A docstring describes the parameters in sections, one for every panel of the help text ("Files" are arguments, "Options"
have no panel), each as ``name (words METAVAR): help [dim]default[/]``. Words are given where the option differs from
the name of its parameter or has a short form. Options of several commands are described once, in `SHARED`.
"""

import ast
import functools
import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, get_origin

import typer

from optid.descriptions import Description, describe
from optid.registry import FORMULATIONS, find_entry_points

Words = list[str] | None
Paths = list[Path] | None
File = Path | None

SHARED = """
Files:
    data (DATA...): CSV, Parquet, MAT, NPZ or NPY files, one experiment each.
    model (MODEL): Model file (.json) of a state-space model.
    db (DATABASE): Database written by optid study run.
The record:
    example (NAME): Use a built-in record instead of files; optid examples lists them.
    inputs (-u NAME...): Columns of the inputs. [dim]u, u1, u2, ...[/]
    outputs (-y NAME...): Columns of the outputs. [dim]y, y1, y2, ...[/]
    dt: Sampling time. [dim]from the time stamps[/]
    time (NAME): Column of time stamps; 'none' ignores them. [dim]a column named like a clock, or with dates[/]
    experiment (NAME): Column that names the experiment of each row.
    columns (NAME...): Names of the columns of a file without a header.
    input_units (UNIT...): One unit per input.
    output_units (UNIT...): One unit per output.
    test (FILE...): Validate on these files.
    seed: Seed of the noise of the example.
How the files are written:
    delimiter: Character between the cells of a text file. [dim]found[/]
    decimal: Decimal mark.
    thousands: Mark between groups of three digits.
    encoding (NAME): Encoding of a text file. [dim]UTF-8, or by its byte order mark[/]
    comment (TEXT): Skip lines that begin with this text.
    skip_rows (N): Lines to skip before the header.
    units_row (N): Row after the header that holds the units, 0 for none. [dim]found[/]
    missing (WORD...): Words and numbers that mark missing samples, such as BAD,-9999.
    date_format (FORMAT): Format of the time stamps, such as '%d.%m.%Y %H:%M:%S'. [dim]ISO 8601[/]
    time_zone (ZONE): Zone of local time stamps, such as Europe/Berlin.
    time_tolerance (SHARE): Largest deviation of a time step, relative to the median step.
    gaps (WORD): Lost rows become 'missing' samples, 'experiments' begin after them, or rows keep their 'stamps',
        however irregular (processes in continuous time). [dim]refused; process.exact: stamps[/]
    resample (DURATION): Bring the record onto this sampling time, such as 1s or 5min.
    quality (COLUMN:VALUE...): Columns of quality and their value for a good sample, such as PV.Q:192.
    from_ (--from TIME): Leave out the samples before this date or second.
    to (TIME): Leave out the samples after this date or second.
The model:
    formulation (-f NAME): Formulation of the model; optid formulations lists them.
    feedback_basis (NAME:SIZE...): Basis of the nonlinear output feedback, one for all outputs or one per output.
    load (--load --process NAME=E1,E2,...): Direction of a process fault: one number per state, or its effect on the
        outputs, such as leak=y1:-1.
    disturbance (NAME): Unknown disturbance that is not a fault: an input, an output or a --process direction.
    state_jump (--state-jump/--no-state-jump): Include a jump of the state as a fault.
The solver:
    solver (-s NAME): Solver, or STEP=NAME,... for steps of the formulation; optid solvers lists them.
The result:
    report (-o FILE): Write a self-contained HTML report.
    saved (--model -m FILE): Write the model: JSON, or an FMU, structured text or C by the ending .fmu, .st or .c.
    picture (-p FILE): Write a figure (PNG, PDF).
Options:
    title (--study TITLE): Study to use, if the database holds several.
    accept_changed_data: Rerun the cells whose data file has changed since the last run.
"""

READING: dict[str, tuple[Any, Any]] = {
    "inputs": (Words, None),
    "outputs": (Words, None),
    "dt": (float | None, None),
    "time": (str | None, None),
    "experiment": (str | None, None),
    "columns": (Words, None),
    "input_units": (Words, None),
    "output_units": (Words, None),
    "delimiter": (str | None, None),
    "decimal": (str, "."),
    "thousands": (str | None, None),
    "encoding": (str | None, None),
    "comment": (str | None, None),
    "skip_rows": (int, 0),
    "units_row": (int | None, None),
    "missing": (Words, None),
    "date_format": (str | None, None),
    "time_zone": (str | None, None),
    "time_tolerance": (float, 0.01),
    "gaps": (str | None, None),
    "resample": (str | None, None),
    "quality": (Words, None),
    "from_": (str | None, None),
    "to": (str | None, None),
}
"""How the files of a record are read: the type of each option and its default, in place of a parameter ``how``."""

_ENTRY = re.compile(r"(\w+)(?: \((.*?)\))?: (.*)")


def register(app: typer.Typer, function: Callable[..., None], kind: Any) -> None:
    """Make a function a command of a class; what its docstring says before the sections is the help text."""
    text = inspect.getdoc(function)
    if text is None:  # python -OO
        source: Any = ast.parse(inspect.getsource(function)).body[0]
        text = ast.get_docstring(source) or ""
    about, own = parse_docstring(text)
    entries = parse_docstring(SHARED)[1] | own
    parameters = []
    for parameter in inspect.signature(function).parameters.values():
        if parameter.name == "how":
            parameters += [inspect.Parameter(key, parameter.kind, default=default, annotation=type_)
                           for key, (type_, default) in READING.items()]
        else:
            parameters.append(parameter)
    reads = "how" in inspect.signature(function).parameters
    parameters = [p if get_origin(p.annotation) is Annotated else
                  p.replace(annotation=Annotated[p.annotation, _option(p, *entries[p.name])]) for p in parameters]

    @functools.wraps(function)
    def run(**given: Any) -> None:
        how = {"how": {key: given.pop(key) for key in READING}} if reads else {}
        function(**how, **given)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    app.command(cls=kind, help=about)(run)


def parse_docstring(text: str) -> tuple[str, dict[str, tuple[str, str, str]]]:
    """Return what a docstring says before the sections, and {parameter: (panel, words, help)}."""
    about, *sections = re.split(r"(?:\n|^)(?=[A-Z][\w ]*:\n    )", text)
    found = {}
    for section in sections:
        panel, _, body = section.partition(":\n")
        for entry in re.split(r"\n(?=    \S)", body):
            match = _ENTRY.fullmatch(" ".join(entry.split()))
            if match is None:
                raise ValueError(f"no option: {entry}")
            found[match[1]] = panel, match[2] or "", match[3]
    return about.strip(), found


def option_of(argument: str) -> str:
    """Return the option word of an argument."""
    return "--" + argument.strip("_").replace("_", "-")


def descriptions() -> Iterator[tuple[str, Description]]:
    """Yield the name and the description of every formulation that can be loaded."""
    for name, point in sorted(find_entry_points(FORMULATIONS).items()):
        with suppress(ImportError):  # a broken plug-in takes nothing away
            yield name, describe(point)


def in_options(text: str, reading: bool = False) -> str:
    """Write a message about arguments of Python, or only those of `optid.read`, with the options of the command."""
    known = {*READING} if reading else {"solver", "accuracy", "time_limit", *READING}.union(
        *(found.options for _, found in descriptions()))
    word = "|".join(sorted(known, key=len, reverse=True))

    def several(match: re.Match[str]) -> str:
        return match[1] + ", ".join(option_of(one) for one in match[2].split(", ") if one != "constraints")

    text = re.sub(rf"(takes no )argument '({word})'(?=\.)", lambda m: m[1] + option_of(m[2]), text)
    text = re.sub(rf"( needs |Known: )((?:{word})(?:, (?:{word}))*)(?=$|\.)", several, text)
    text = text.replace("missing='-", "--missing='-")  # else an option would seem to follow
    text = text.replace("pass time=False and dt=", "pass --time none and --dt").replace("time=False", "--time none")
    text = re.sub(rf"(?<=['\w\]]), (?=(?:{word})=)", " ", text)
    text = re.sub(rf"(?<![\w.-])({word})=(?=['\"\w\[(.-])", lambda m: option_of(m[1]) + " ", text)
    text = re.sub(rf"(?<![\w.-])({word})=(?=[ .,:])", lambda m: option_of(m[1]), text)
    return re.sub(rf"^({word})(?=,| must| is | has | of input| \()", lambda m: option_of(m[1]), text)


def _option(parameter: inspect.Parameter, panel: str, words: str, text: str) -> Any:
    flags = [word for word in words.split() if word.startswith("-")]
    metavar = " ".join(word for word in words.split() if not word.startswith("-")) or None
    if panel == "Files":
        return typer.Argument(metavar=metavar, help=text, show_default=False)
    text = text.replace("[dim]", r"[dim]\[default: ").replace("[/]", "][/]")
    if not any(flag.startswith("--") for flag in flags):
        flags.insert(0, option_of(parameter.name))
    return typer.Option(*flags, metavar=metavar, help=text, rich_help_panel=None if panel == "Options" else panel,
                        min=0 if parameter.name == "seed" else None)

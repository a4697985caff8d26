"""Tables of what there is to choose from, generated from the registries and from nothing else."""

from collections.abc import Sequence
from importlib.metadata import EntryPoint
from typing import Any

from rich.text import Text

from optid.cli.terminal import new_table
from optid.descriptions import Description, describe, describe_function
from optid.registry import CONSTRAINTS, FAULTS, FORMULATIONS, registered

CLASSES = ("LP", "QP", "SOCP", "SDP", "conic", "NLP", "rank-one")


def solvers() -> list[Any]:
    """Return the table of back ends: those that are installed, then those that are a pip line away."""
    from optid.backends.choice import back_ends

    rows = []
    for back_end in sorted(back_ends().values(), key=lambda b: (not b.installed, b.name)):
        classes = sorted(back_end.accepted, key=lambda word: (*CLASSES, word).index(word))
        missing = f"pip install {back_end.pip}" if back_end.pip else "from its vendor"
        rows.append((Text(back_end.name, "bold" if back_end.installed else "dim"), " ".join(classes),
                     *(Text("yes", "green") if yes else Text("no", "dim")
                       for yes in (back_end.duals, back_end.warm, back_end.installed)),
                     back_end.about if back_end.installed else Text(missing, "dim")))
    return _table("Back ends", ("solver", "takes", "prices", "warm", "here", "about"), rows,
                  "Use one with --solver NAME. prices: returns multipliers, so that constraints have prices. "
                  "warm: can start from a given point. here: installed.", firm=2)


def formulations() -> list[Any]:
    """Return the tables of formulations, with summary, arguments and named variables, and of those about faults."""
    return _table(
        "Formulations", ("formulation", "what it poses"), _entries(FORMULATIONS),
        "Constraints speak about the variables; with several inputs they carry the input, as in mu[valve]. "
        "Arguments in brackets may be left out.") + _table(
        "Programmes about faults", ("programme", "what it poses"), _entries(FAULTS),
        "Posed and solved by optid diagnose, optid reformulate and the functions of optid.faults.")


def constraints() -> list[Any]:
    """Return the table of named constraints with their arguments and summaries."""
    rows = []
    for name, point in sorted(registered(CONSTRAINTS).items()):
        found = _described(point)
        if isinstance(found, Text):
            rows.append((Text(name, "dim"), "", found))
        else:
            rows.append((Text(name, "bold"), _arguments(found), found.summary))
    return _table("Constraints", ("constraint", "arguments", "what it demands"), rows,
                  "Use one with --constraint NAME:VALUE or NAME:VALUE,KEY=VALUE. Arguments in brackets may be left "
                  "out.")


def examples() -> list[Any]:
    """Return the table of built-in records."""
    from optid.examples import EXAMPLES

    rows = [(Text(name, "bold"), describe_function(function).summary) for name, function in sorted(EXAMPLES.items())]
    return _table("Built-in records", ("example", "what it is"), rows, "Use one with optid fit --example NAME.")


def systems() -> list[Any]:
    """Return the table of simulated systems for studies."""
    from optid.studies.sources.systems import SYSTEMS

    rows = [(Text(name, "bold"), str(system.samples), f"{system.noise:.3g}",
             *(str(system.suggestion.get(key, default)) for key, default in (("na", "-"), ("nb", "-"), ("nk", 0))),
             system.about) for name, system in SYSTEMS.items()]
    return _table("Simulated systems", ("system", "samples", "noise", "na", "nb", "nk", "what it is"), rows,
                  "samples and noise are those used where a study names none; noise is relative to the "
                  "noise-free output. na, nb and nk suit the system; with other ones a model may be "
                  "far from the truth.", right=range(1, 6))


def _entries(group: str) -> list[tuple[Text, Text]]:
    """Names of a group with summary, arguments and named variables."""
    rows = []
    for name, point in sorted(registered(group).items()):
        found = _described(point)
        if isinstance(found, Text):
            rows.append((Text(name, "dim"), found))
            continue
        about = Text.assemble(found.summary, ("\narguments: ", "dim"), _arguments(found))
        if found.variables:
            about.append("\nvariables: ", "dim").append(" ".join(found.variables))
        rows.append((Text(name, "bold"), about.append("\n")))
    return rows


def _described(point: EntryPoint) -> Description | Text:
    try:
        return describe(point)
    except ImportError as error:  # a broken plug-in takes nothing away
        return Text(f"cannot be loaded: {error}", "dim")


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], footer: str, firm: int = 1,
           right: Sequence[int] = ()) -> list[Any]:
    """Return a table and what is said below; the first `firm` columns are never broken."""
    table = new_table(title)
    for c, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=c < firm, justify="right" if c in right else "left")
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    return [table, Text(footer, "dim")]


def _arguments(found: Description) -> Text:
    """Arguments after the record; those with a default in brackets."""
    words = [Text(p.name) if p.default is p.empty else Text(f"[{p.name}]", "dim")
             for p in found.signature.parameters.values()
             if p.name != "data" and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    return Text(" ").join(words)

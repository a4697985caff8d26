"""Tables of what there is to choose from, generated from the registries and from nothing else."""

from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint
from typing import Any

from rich.text import Text

from optid.cli.terminal import new_table, output
from optid.descriptions import Description, describe, describe_function
from optid.registry import CONSTRAINTS, FAULTS, FORMULATIONS, registered

Show = Callable[[], None]


def solvers() -> Show:
    """Return what prints every back end: those that are installed, then those that are a pip line away."""
    from optid.backends.choice import back_ends

    order = ("LP", "QP", "SOCP", "SDP", "conic", "NLP", "rank-one")
    rows = []
    for back_end in sorted(back_ends().values(), key=lambda b: (not b.installed, b.name)):
        classes = sorted(back_end.accepted, key=lambda word: order.index(word) if word in order else len(order))
        missing = f"pip install {back_end.pip}" if back_end.pip else "from its vendor"
        rows.append(
            (
                Text(back_end.name, "bold" if back_end.installed else "dim"),
                Text(" ".join(classes)),
                _mark(back_end.duals),
                _mark(back_end.warm),
                _mark(back_end.installed),
                back_end.about if back_end.installed else Text(missing, "dim"),
            )
        )
    return _table(
        "Back ends",
        ("solver", "takes", "prices", "warm", "here", "about"),
        rows,
        "Use one with --solver NAME. prices: returns multipliers, so that constraints have prices. "
        "warm: can start from a given point. here: installed.",
        firm=2,
    )


def formulations() -> Show:
    """Return what prints every formulation with its summary, arguments and named variables, then those about faults."""
    models = _table(
        "Formulations", ("formulation", "what it poses"), _entries(FORMULATIONS),
        "Constraints speak about the variables; with several inputs they carry the input, as in mu[valve]. "
        "Arguments in brackets may be left out.")
    faults = _table(
        "Programmes about faults", ("programme", "what it poses"), _entries(FAULTS),
        "Posed and solved by optid diagnose, optid reformulate and the functions of optid.faults.")

    def show() -> None:
        models()
        faults()

    return show


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


def constraints() -> Show:
    """Return what prints every named constraint with its arguments and summary."""
    rows = []
    for name, point in sorted(registered(CONSTRAINTS).items()):
        found = _described(point)
        if isinstance(found, Text):
            rows.append((Text(name, "dim"), Text(""), found))
        else:
            rows.append((Text(name, "bold"), _arguments(found), found.summary))
    return _table(
        "Constraints",
        ("constraint", "arguments", "what it demands"),
        rows,
        "Use one with --constraint NAME:VALUE or NAME:VALUE,KEY=VALUE. Arguments in brackets may be left out.",
    )


def examples() -> Show:
    """Return what prints the built-in records."""
    from optid.examples import EXAMPLES

    rows = [(Text(name, "bold"), describe_function(function).summary) for name, function in sorted(EXAMPLES.items())]
    return _table("Built-in records", ("example", "what it is"), rows, "Use one with optid fit --example NAME.")


def _mark(yes: bool) -> Text:
    return Text("yes", "green") if yes else Text("no", "dim")


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], footer: str, firm: int = 1) -> Show:
    """Return what prints a table; the first `firm` columns are never broken."""

    def show() -> None:
        table = new_table(title)
        for c, column in enumerate(columns):
            table.add_column(column, overflow="fold", no_wrap=c < firm)
        for row in rows:
            table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
        output().print(table)
        output().print(Text(footer, "dim"))

    return show


def _arguments(found: Description) -> Text:
    """Arguments after the record; those with a default in brackets."""
    words = [Text(p.name) if p.default is p.empty else Text(f"[{p.name}]", "dim")
             for p in found.signature.parameters.values()
             if p.name != "data" and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    return Text(" ").join(words)

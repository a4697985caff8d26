"""Tables of what there is to choose from, generated from the registries and from nothing else."""

import inspect
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from optid.cli.terminal import output

Show = Callable[[], None]


def solvers() -> Show:
    """Return what prints every back end: those that are installed, then those that are a pip line away."""
    from optid.backends import back_ends

    order = ("LP", "QP", "SOCP", "SDP", "conic", "NLP", "rank-one")
    rows = []
    for back_end in sorted(back_ends().values(), key=lambda b: (not b.installed, b.name)):
        classes = [name for name in order if name in back_end.classes] + sorted(back_end.classes - set(order))
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
    from optid.registry import FORMULATIONS, registered

    rows = []
    for name, point in sorted(registered(FORMULATIONS).items()):
        try:
            function = point.load()
        except ImportError as error:  # a broken plug-in takes nothing away
            rows.append((Text(name, "dim"), Text(f"cannot be loaded: {error}", "dim")))
            continue
        about = Text.assemble(
            _summary(function),
            ("\narguments: ", "dim"),
            _arguments(function),
            *((("\nvariables: ", "dim"), " ".join(variables)) if (variables := _variables(function)) else ()),
            "\n",
        )
        rows.append((Text(name, "bold"), about))
    models = _table(
        "Formulations",
        ("formulation", "what it poses"),
        rows,
        "Constraints speak about the variables; with several inputs they carry the input, as in mu[valve]. "
        "Arguments in brackets may be left out.",
    )
    faults = _fault_programmes()

    def show() -> None:
        models()
        faults()

    return show


def _fault_programmes() -> Show:
    from optid.registry import FAULTS, registered

    rows = []
    for name, point in sorted(registered(FAULTS).items()):
        try:
            function = point.load()
        except ImportError as error:
            rows.append((Text(name, "dim"), Text(f"cannot be loaded: {error}", "dim")))
            continue
        about = Text.assemble(_summary(function), ("\narguments: ", "dim"), _arguments(function), "\n")
        rows.append((Text(name, "bold"), about))
    return _table(
        "Programmes about faults",
        ("programme", "what it poses"),
        rows,
        "Posed and solved by optid diagnose, optid reformulate and the functions of optid.faults.",
    )


def constraints() -> Show:
    """Return what prints every named constraint with its arguments and summary."""
    from optid.registry import CONSTRAINTS, registered

    rows = []
    for name, point in sorted(registered(CONSTRAINTS).items()):
        try:
            function = point.load()
        except ImportError as error:
            rows.append((Text(name, "dim"), Text(""), Text(f"cannot be loaded: {error}", "dim")))
            continue
        rows.append((Text(name, "bold"), _arguments(function), _summary(function)))
    return _table(
        "Constraints",
        ("constraint", "arguments", "what it demands"),
        rows,
        "Use one with --constraint NAME:VALUE or NAME:VALUE,KEY=VALUE. Arguments in brackets may be left out.",
    )


def examples() -> Show:
    """Return what prints the built-in records."""
    from optid.examples import EXAMPLES

    rows = [(Text(name, "bold"), _summary(function)) for name, function in sorted(EXAMPLES.items())]
    return _table("Built-in records", ("example", "what it is"), rows, "Use one with optid fit --example NAME.")


def _mark(yes: bool) -> Text:
    return Text("yes", "green") if yes else Text("no", "dim")


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]], footer: str, firm: int = 1) -> Show:
    """Return what prints a table; the first `firm` columns are never broken."""

    def show() -> None:
        table = Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold", pad_edge=False)
        for c, column in enumerate(columns):
            table.add_column(column, overflow="fold", no_wrap=c < firm)
        for row in rows:
            table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
        output().print(table)
        output().print(Text(footer, "dim"))

    return show


def _summary(function: Any) -> str:
    """First sentence of a docstring, without its markup."""
    text = (inspect.getdoc(function) or "").split("\n\n")[0].replace("\n", " ")
    text = re.sub(r"`+", "", text)
    return text[7].upper() + text[8:] if text.startswith("Return ") else text


def _arguments(function: Any) -> Text:
    """Arguments after the record; those with a default in brackets."""
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except ValueError:
        return Text("")
    words = []
    for p in parameters:
        if p.name == "data" or p.kind in (p.VAR_KEYWORD, p.VAR_POSITIONAL):
            continue
        words.append(Text(p.name) if p.default is p.empty else Text(f"[{p.name}]", "dim"))
    return Text(" ").join(words)


def _variables(function: Any) -> list[str]:
    """Names that constraints may use, from the programme posed on a small simulated record."""
    from optid.data import Data

    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, 60)
    data = Data(u, np.convolve(u + u**2, [1.0, 0.5])[:60] + 0.1 * rng.standard_normal(60))
    offered = {"na": 1, "nb": 2, "nk": 0, "nc": 1, "nd": 1, "nx": 1, "basis": "polynomial:2"}
    takes = inspect.signature(function).parameters
    try:
        problem = function(data, **{key: value for key, value in offered.items() if key in takes})
        return sorted(problem.view if hasattr(problem, "view") else next(problem).view)
    except Exception:  # a formulation that needs other arguments documents its variables itself
        return []

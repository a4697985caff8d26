"""The commands that list solvers, formulations, constraints, examples and simulated systems."""

import re
import textwrap
from importlib.metadata import EntryPoint

from rich.text import Text

from optid.cli.options import option_of
from optid.cli.terminal import Spinner, print_table, print_text
from optid.descriptions import Description, describe, describe_function
from optid.registry import CONSTRAINTS, FAULTS, FORMULATIONS, entry_point, find_entry_points

_SECTION = re.compile(r"(Args|Raises|Returns|Warns|Attributes|Named variables):")
"""Paragraphs of a docstring that are no text."""

CLASSES = ("LP", "QP", "SOCP", "SDP", "conic", "NLP", "rank-one")


def solvers() -> None:
    """List the solvers: the problem classes that each accepts, and whether it is installed."""
    rows = []
    with Spinner() as waiting:
        waiting.step("asking the back ends")
        from optid.backends.choice import back_ends

        for back_end in sorted(back_ends().values(), key=lambda b: (not b.installed, b.name)):
            classes = sorted(back_end.accepted, key=lambda word: (*CLASSES, word).index(word))
            missing = f"pip install {back_end.pip}" if back_end.pip else "from its vendor"
            rows.append((Text(back_end.name, "bold" if back_end.installed else "dim"), " ".join(classes),
                         *(Text("yes", "green") if yes else Text("no", "dim")
                           for yes in (back_end.duals, back_end.warm, back_end.installed)),
                         back_end.about if back_end.installed else Text(missing, "dim")))
    print_table("Back ends", ("solver", "takes", "prices", "warm", "here", "about"), rows,
                "Use one with --solver NAME. prices: returns multipliers, from which the prices of constraints are "
                "computed. warm: accepts a starting point. here: installed.", firm=(0, 1))


def formulations(name: str | None = None) -> None:
    """List the formulations, or explain one: its arguments and the variables for constraints.

    Example: optid formulations bj.exact

    Files:
        name (NAME): Formulation to explain.
    """
    if name is not None:
        _explain(name)
        return
    with Spinner() as waiting:
        waiting.step("loading the formulations")
        fits, faults = _entries(FORMULATIONS), _entries(FAULTS)
    print_table("Formulations", ("formulation", "problem"), fits,
                "Constraints refer to the variables by name; with several inputs the name has the input, as mu[valve]. "
                "Arguments in brackets are optional.")
    print_table("Fault programmes", ("programme", "problem"), faults,
                "Solved by optid diagnose, optid reformulate and the functions of optid.faults.")


def constraints() -> None:
    """List the constraints and their arguments."""
    rows = []
    for name, point in sorted(find_entry_points(CONSTRAINTS).items()):
        found = _described(point)
        if isinstance(found, Text):
            rows.append((Text(name, "dim"), "", found))
        else:
            rows.append((Text(name, "bold"), _arguments(found), found.summary))
    print_table("Constraints", ("constraint", "arguments", "meaning"), rows,
                "Use one with --constraint NAME:VALUE or NAME:VALUE,KEY=VALUE. Arguments in brackets are optional. "
                "A constraint on an interval holds everywhere on it; for sines, cosines and user functions, at 201 "
                "points of it. Bounds hold to 1e-6, relative, the accuracy of the programmes of a fit.")


def examples() -> None:
    """List the built-in records."""
    from optid.examples import EXAMPLES

    rows = [(Text(name, "bold"), describe_function(function).summary) for name, function in sorted(EXAMPLES.items())]
    print_table("Built-in records", ("example", "description"), rows, "Use one with optid fit --example NAME.")


def systems() -> None:
    """List the simulated systems for study files."""
    from optid.studies.sources.systems import SYSTEMS

    rows = [(Text(name, "bold"), str(system.samples), f"{system.noise:.3g}",
             *(str(system.suggestion.get(key, default)) for key, default in (("na", "-"), ("nb", "-"), ("nk", 0))),
             system.about) for name, system in SYSTEMS.items()]
    print_table("Simulated systems", ("system", "samples", "noise", "na", "nb", "nk", "description"), rows,
                "samples and noise are the defaults of a study; noise is relative to the noise-free output. na, nb and "
                "nk are those of the system.",
                right=range(1, 6))


def _explain(name: str) -> None:
    """Print the docstring of a formulation or of a fault programme, its arguments and its variables."""
    known = find_entry_points(FAULTS)
    found = describe(known[name] if name in known else entry_point(FORMULATIONS, name))
    head, _, rest = found.text.partition("\n\n")
    more = [part for part in re.split(r"\n\n", rest) if not _SECTION.match(part)] if rest else []
    for part in (head, *more):
        print_text(textwrap.fill(" ".join(part.replace("`", "").split()), 80) + "\n")
    about = found.arguments()
    rows = [(Text(option_of(key), "bold"), "required" if one.default is one.empty else f"{one.default}",
             about.get(key, "")) for key, one in found.options.items() if key != "constraints"]
    print_table(name, ("option", "default", "meaning"), rows,
                f"In Python: optid.fit(data, {name!r}, {', '.join(_required(found)) or '...'})." * (name not in known))
    if found.variables:
        print_text(textwrap.fill("Constraints may name: " + ", ".join(found.variables) + ". With several inputs the "
                                 "name has the input, as mu[valve].", 80))


def _required(found: Description) -> list[str]:
    return [f"{key}=..." for key, one in found.options.items() if one.default is one.empty]


def _entries(group: str) -> list[tuple[Text, Text]]:
    rows = []
    for name, point in sorted(find_entry_points(group).items()):
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


def _arguments(found: Description) -> Text:
    """Arguments after the record; those with a default in brackets."""
    words = [Text(p.name) if p.default is p.empty else Text(f"[{p.name}]", "dim")
             for p in found.signature.parameters.values()
             if p.name != "data" and p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
    return Text(" ").join(words)

"""The command line: all commands, and the lists of what there is to choose from."""

from typing import Annotated, Any

import typer

from optid.cli.bench import workbench
from optid.cli.comparing import compare
from optid.cli.derived import ComparingCommand, FittingCommand
from optid.cli.designing import design, order
from optid.cli.faults import diagnose, isolability, reformulate
from optid.cli.fitting import fit, identify, validate
from optid.cli.monitoring import monitor
from optid.cli.options import register
from optid.cli.studies import study
from optid.cli.terminal import Command, Group, Waiting, output, say

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="rich",
)


def _version(wanted: bool) -> None:
    if wanted:
        from optid import __version__

        say(f"optid {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Identify Hammerstein systems by optimisation with constraints, with a proof of global optimality."""


def solvers() -> None:
    """List every back end: what it accepts and whether it is installed."""
    from optid.cli import listings

    with Waiting() as waiting:
        waiting.step("asking the back ends")
        found = listings.solvers()
    _show(found)


def formulations() -> None:
    """List the formulations, their arguments and the variables that constraints may use."""
    from optid.cli import listings

    with Waiting() as waiting:
        waiting.step("loading the formulations")
        found = listings.formulations()
    _show(found)


def constraints() -> None:
    """List the constraints by the words the command line takes."""
    from optid.cli import listings

    _show(listings.constraints())


def examples() -> None:
    """List the built-in records."""
    from optid.cli import listings

    _show(listings.examples())


def _show(tables: list[Any]) -> None:
    for part in tables:
        output().print(part)


register(app, fit, FittingCommand)
for function in (validate, solvers, formulations, constraints, examples, identify):
    register(app, function, Command)
register(app, compare, ComparingCommand)
for function in (design, diagnose, isolability, monitor, reformulate, order, workbench):
    register(app, function, Command)
app.add_typer(study, name="study")

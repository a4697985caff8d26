"""The command line: all commands."""

from typing import Annotated

import typer

from optid.cli.bench import workbench
from optid.cli.comparing import compare
from optid.cli.derived import FittingCommand
from optid.cli.designing import design, order
from optid.cli.faults import diagnose, isolability, reformulate
from optid.cli.fitting import fit, identify, validate
from optid.cli.listings import constraints, examples, formulations, solvers
from optid.cli.look import look
from optid.cli.monitoring import monitor
from optid.cli.options import register
from optid.cli.studies import study
from optid.cli.terminal import Command, CommandGroup, print_text

app = typer.Typer(
    cls=CommandGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode="rich",
)


def _version(wanted: bool) -> None:
    if wanted:
        from optid import __version__

        print_text(f"optid {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Identify Hammerstein systems by constrained optimisation with proofs of global optimality, and detect faults."""


for function in (look, fit, validate, solvers, formulations, constraints, examples, identify, compare, design, diagnose,
                 isolability, monitor, reformulate, order, workbench):
    register(app, function, FittingCommand if function in (fit, compare) else Command)
app.add_typer(study, name="study")

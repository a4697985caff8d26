"""The command line: fit, validate, and what there is to choose from."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.comparing import ComparingCommand, compare
from optid.cli.derived import DEFAULT, FittingCommand
from optid.cli.designing import design
from optid.cli.diagnosing import diagnose
from optid.cli.identifying import identify, search
from optid.cli.isolability import isolability
from optid.cli.monitoring import monitor
from optid.cli.options import MODEL, RECORD, RESULT, SOLVER, Example, Files, Report, Seed, reads_a_record
from optid.cli.ordering import order
from optid.cli.reformulating import reformulate
from optid.cli.results import command_line, conclude
from optid.cli.startup import check_names
from optid.cli.studies import study
from optid.cli.terminal import FILES, Command, Group, Waiting, hearing, say
from optid.lazy import import_cvxpy

app = typer.Typer(
    cls=Group,
    no_args_is_help=True,
    add_completion=False,
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


@app.command(cls=FittingCommand)
@reads_a_record
def fit(
    data: Files = None,
    example: Example = None,
    *,
    how: dict[str, Any],
    stream: Annotated[
        bool,
        typer.Option("--stream", rich_help_panel=RECORD, help="Read chunk by chunk: for a file larger than memory."),
    ] = False,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            rich_help_panel=RECORD,
            help="Let a Dask cluster (tcp://host:8786) read the row groups of Parquet files or folders.",
        ),
    ] = None,
    split: Annotated[
        float | None,
        typer.Option(
            "--split",
            metavar="SHARE",
            rich_help_panel=RECORD,
            help="Fit on this share, validate on the rest, e.g. 0.7.",
        ),
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option("--test", metavar=FILES, rich_help_panel=RECORD, help="Validate on these files.")
    ] = None,
    formulation: Annotated[
        str, typer.Option("--formulation", "-f", metavar="NAME", rich_help_panel=MODEL, help="See optid formulations.")
    ] = DEFAULT,
    na: Annotated[int | None, typer.Option("--na", rich_help_panel=MODEL, help="Number of past outputs in A.")] = None,
    nb: Annotated[
        list[str] | None,
        typer.Option(
            "--nb", metavar="N...", rich_help_panel=MODEL, help="Coefficients of B, one number or one per input."
        ),
    ] = None,
    nk: Annotated[
        list[str] | None,
        typer.Option(
            "--nk", metavar="N...", rich_help_panel=MODEL, help="Delay in samples, one number or one per input."
        ),
    ] = None,
    basis: Annotated[
        list[str] | None,
        typer.Option(
            "--basis",
            metavar="NAME:SIZE...",
            rich_help_panel=MODEL,
            help="Basis of the nonlinearity, one or one per input, "
            "e.g. triangular:10, polynomial:4, trigonometric:5, bspline:8.",
        ),
    ] = None,
    constraint: Annotated[
        list[str] | None,
        typer.Option(
            "--constraint",
            "-c",
            metavar="NAME:VALUE...",
            rich_help_panel=MODEL,
            help="e.g. monotone:increasing; see optid constraints. 'none' drops those an example suggests.",
        ),
    ] = None,
    loss: Annotated[
        str | None, typer.Option("--loss", rich_help_panel=MODEL, help="squares, huber, huber:1.5 or l1.")
    ] = None,
    ridge: Annotated[
        float | None, typer.Option("--ridge", rich_help_panel=MODEL, help="Weight of the size of Theta.")
    ] = None,
    curvature: Annotated[
        float | None, typer.Option("--curvature", rich_help_panel=MODEL, help="Weight of the curvature of f.")
    ] = None,
    holdout: Annotated[
        str | None,
        typer.Option(
            "--holdout",
            metavar="PENALTY",
            rich_help_panel=MODEL,
            help="Choose the weight of ridge, curvature or weight (nuclear norm) by hold-out.",
        ),
    ] = None,
    gauge: Annotated[
        str | None, typer.Option("--gauge", rich_help_panel=MODEL, help="Scale between f and B: norm, gain or b0.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE...", rich_help_panel=MODEL, help="Any other argument of the formulation."
        ),
    ] = None,
    solver: Annotated[
        str, typer.Option("--solver", "-s", metavar="NAME", rich_help_panel=SOLVER, help="See optid solvers.")
    ] = "auto",
    accuracy: Annotated[
        float, typer.Option("--accuracy", rich_help_panel=SOLVER, help="Relative, for any solver.")
    ] = 1e-8,
    time_limit: Annotated[
        float | None,
        typer.Option(
            "--time-limit", metavar="SECONDS", rich_help_panel=SOLVER, help="Stop the solver after this time."
        ),
    ] = None,
    prove: Annotated[
        bool, typer.Option("--prove/--no-prove", rich_help_panel=SOLVER, help="Ask for a proof of global optimality.")
    ] = True,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="KEY=VALUE...", rich_help_panel=SOLVER, help="Native options of the solver."),
    ] = None,
    seed: Seed = 0,
    report: Report = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", "-m", metavar="FILE", rich_help_panel=RESULT, help="Write the model (JSON)."),
    ] = None,
) -> None:
    """Fit a model to a record, prove it optimal, and report it; without orders, search for them as optid identify does.

    Example: optid fit data.csv --inputs u --outputs y --dt 0.1 --na 2 --nb 2 --basis triangular:10
    --constraint monotone:increasing --report report.html
    """
    check_names(formulation, constraint, solver)
    asked = (na, nb, nk, basis, loss, ridge, curvature, holdout, gauge, settings, option, time_limit, scheduler)
    if data and formulation == DEFAULT and not stream and all(word is None for word in asked):
        search(data, example, how, seed, split, test, constraint, solver, model, report, accuracy=accuracy)
        return
    from optid.cli import arguments as words

    words.check_folders(model, report)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        record: Any
        record, suggestion = words.record(data, how, example, seed, stream=stream, scheduler=scheduler)
        import_cvxpy()
        from optid.identify.fitting import fit as fit_model
        from optid.identify.selection import fit_by_holdout
        from optid.identify.validation import validate as check
        from optid.show.printing import describe

        arguments = words.suited(suggestion, formulation) if suggestion else {}
        given = {
            "na": na,
            "nb": words.whole_numbers(nb, "--nb"),
            "nk": words.whole_numbers(nk, "--nk"),
            "basis": words.one_or_all(words.listed(basis)),
            "constraints": constraint,
            "loss": loss,
            "ridge": ridge,
            "curvature": curvature,
            "gauge": gauge,
        }
        arguments |= {key: value for key, value in given.items() if value is not None} | words.pairs(settings, "--set")
        if arguments.get("constraints") == ["none"]:
            del arguments["constraints"]
        held_out: Any = words.read_record(test, how) if test else None
        if split is not None and held_out is None:
            record, held_out = words.split_record(record, split)
        waiting.step(f"fitting {formulation}")
        found = (fit_model if holdout is None else partial(fit_by_holdout, penalty=holdout))(
            record,
            formulation,
            solver=solver,
            accuracy=accuracy,
            time_limit=time_limit,
            prove=prove,
            solver_options=words.pairs(option, "--option"),
            **arguments,
        )
        waiting.step("standard errors")
        text = describe(found)
        if found.verdict is not None and found.verdict.word in ("poor", "useless"):
            waiting.step("looking for what would help")
            text += "".join(f"\nAdvice: {advice}" for advice in found.advice)
        if held_out is not None:
            waiting.step("validating")
            text += f"\n\n{held_out.n_samples} samples held out of the fit\n{check(found.model, held_out)}"
        if model is not None:
            found.model.save(model)
        if report is not None:
            from optid.show.report import write

            waiting.step("writing the report")
            write(found, report, held_out, command=command_line())
    conclude(text, heard, model=model, report=report)


@app.command(cls=Command)
@reads_a_record
def validate(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="MODEL... DATA...", help="Model files (.json) written by fit --model, then files of the record."
        ),
    ],
    *,
    how: dict[str, Any],
    horizon: Annotated[
        int, typer.Option("--horizon", metavar="N", rich_help_panel=RESULT, help="Predict so many samples ahead, too.")
    ] = 1,
    report: Report = None,
) -> None:
    """Validate saved models on another record: fits, residual tests; several models side by side.

    Inputs, outputs and sampling time are those of the first model where they are not given.
    """
    from optid.cli import arguments as words
    from optid.identify.validation import compare_models
    from optid.identify.validation import validate as check
    from optid.models.files import load

    words.check_folders(report)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        paths, data = words.models_and_data(files)
        models = dict(zip(words.distinct_names(paths), map(load, paths)))
        first = next(iter(models.values()))
        record: Any = words.read_record(data, words.as_modelled(how, first))
        waiting.step("validating")
        compared = len(models) > 1 or report is not None
        found: Any = compare_models(models, record, horizon) if compared else None
        if len(models) > 1:
            text = str(found)
        else:
            text = f"{first}\n\n{found.validations[0] if compared else check(first, record, horizon=horizon)}"
        if report is not None:
            from optid.show.report import write_comparison

            waiting.step("writing the report")
            write_comparison(found, report, command=command_line())
    conclude(text, heard, report=report)


@app.command(cls=Command)
def solvers() -> None:
    """List every back end: what it accepts and whether it is installed."""
    from optid.cli.listings import solvers as table

    with Waiting() as waiting:
        waiting.step("asking the back ends")
        listing = table()
    listing()


@app.command(cls=Command)
def formulations() -> None:
    """List the formulations, their arguments and the variables that constraints may use."""
    from optid.cli.listings import formulations as table

    with Waiting() as waiting:
        waiting.step("loading the formulations")
        listing = table()
    listing()


@app.command(cls=Command)
def constraints() -> None:
    """List the constraints by the words the command line takes."""
    from optid.cli.listings import constraints as table

    table()()


@app.command(cls=Command)
def examples() -> None:
    """List the built-in records."""
    from optid.cli.listings import examples as table

    table()()


app.command(cls=Command)(identify)
app.command(cls=ComparingCommand)(compare)
app.command(cls=Command)(design)
app.command(cls=Command)(diagnose)
app.command(cls=Command)(isolability)
app.command(cls=Command)(monitor)
app.command(cls=Command)(reformulate)
app.command(cls=Command)(order)
app.add_typer(study, name="study")

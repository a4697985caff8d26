"""The command `optid diagnose`: what does a record say about the health of a plant?"""

from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.options import (
    MODEL,
    RECORD,
    RESULT,
    SOLVER,
    Disturbance,
    Example,
    Load,
    Picture,
    Report,
    StateJump,
    reads_a_record,
)
from optid.cli.results import command_line, conclude, save_picture
from optid.cli.terminal import FILES, Waiting, hearing


@reads_a_record
def diagnose(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file (.json) of a state-space model.")],
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="DATA", help="The record: a CSV, Parquet, MAT, NPZ or npy file.", show_default=False
        ),
    ] = None,
    *,
    example: Example = None,
    how: dict[str, Any],
    healthy: Annotated[
        list[Path] | None,
        typer.Option(
            "--healthy", metavar=FILES, rich_help_panel=RECORD,
            help="A healthy record: its innovations must be white and of the size that the model says.",
        ),
    ] = None,
    identified: Annotated[
        list[Path] | None,
        typer.Option(
            "--identified", metavar=FILES, rich_help_panel=RECORD,
            help="The record that the model was identified from, or the name of a built-in one: the uncertainty of "
            "the model counts as noise. [dim]the model is exact[/]",
        ),
    ] = None,
    rescale: Annotated[
        bool, typer.Option("--rescale", rich_help_panel=RECORD, help="Take the scale of the noise from --healthy.")
    ] = False,
    kinds: Annotated[
        list[str] | None,
        typer.Option(
            "--kinds", "-k", metavar="NAME...", rich_help_panel=MODEL,
            help="bias, loss, stuck, drift, frozen, noise, spike. [dim]bias, loss, spike[/]",
        ),
    ] = None,
    load: Load = None,
    disturbance: Disturbance = None,
    zero: Annotated[
        list[str] | None,
        typer.Option(
            "--zero", metavar="INPUT=VALUE...", rich_help_panel=MODEL,
            help="Where an actuator does nothing, for shares lost. [dim]not known[/]",
        ),
    ] = None,
    state_jump: StateJump = True,
    max_faults: Annotated[
        int, typer.Option("--max-faults", rich_help_panel=MODEL, help="Faults that may be in the record.")
    ] = 1,
    false_alarm: Annotated[
        float,
        typer.Option("--false-alarm", rich_help_panel=MODEL, help="Probability that a healthy record raises an alarm."),
    ] = 0.01,
    coverage: Annotated[
        float, typer.Option("--coverage", rich_help_panel=MODEL, help="Of the set of answers and of the intervals.")
    ] = 0.95,
    robust: Annotated[
        bool, typer.Option("--robust", rich_help_panel=MODEL, help="Bound the influence of outliers.")
    ] = False,
    method: Annotated[
        str, typer.Option("--method", rich_help_panel=SOLVER, help="exact, sparse, sparse+polish or set.")
    ] = "exact",
    solver: Annotated[
        str, typer.Option("--solver", "-s", metavar="NAME", rich_help_panel=SOLVER, help="See optid solvers.")
    ] = "auto",
    seed: Annotated[
        int, typer.Option("--seed", rich_help_panel=SOLVER, help="Seed of simulated thresholds, and of an example.")
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", rich_help_panel=RESULT, help="Write the diagnosis (.json)."),
    ] = None,
    report: Report = None,
    picture: Picture = None,
) -> None:
    """Find out whether a record is healthy, and if not, what broke, when, and how much of it.

    Example: optid diagnose model.json faulty.csv --max-faults 2 --out d.json --report d.html
    """
    from optid.cli import arguments as words
    from optid.errors import DataError
    from optid.faults import diagnose as judge
    from optid.faults import dictionary, model_uncertainty
    from optid.faults.diagnosis.diagnosing import KINDS

    words.check_folders(out, report, picture)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        plant = words.state_space_model(model)
        how = words.as_modelled(how, plant)
        record: Any = words.record(data, how, example, seed)[0]
        if record.n_experiments > 1:
            raise DataError(
                f"{record.n_experiments} experiments: diagnose one record at a time (give one file, and cut it to the "
                "experiment)."
            )
        sound: Any = words.read_record(healthy, how) if healthy else None
        origin = _origin(identified, how)
        waiting.step("signatures")
        found = dictionary(
            plant, kinds=words.listed(kinds) or list(KINDS), process=words.directions(load, "--process", plant),
            state_jump=state_jump, disturbances=words.listed(disturbance) or (),
            zeros=_zeros(zero),
        )
        waiting.step("searching")
        uncertainty: Any = "ignore"
        if origin is not None:
            silent = bool(found.predictor.silent)
            uncertainty = model_uncertainty(found.model, origin, decoupled=found.predictor if silent else None)
        answer = judge(
            plant, record, found, false_alarm=false_alarm, max_faults=max_faults, method=method, coverage=coverage,
            model_uncertainty=uncertainty, robust=robust,
            healthy=sound, rescale=rescale, seed=seed, solver=solver,
        )
        if out is not None:
            answer.save(out)
        if report is not None:
            from optid.faults.diagnosis.page import write

            waiting.step("report")
            write(answer, report, record=record.name, command=command_line())
        if picture is not None:
            waiting.step("drawing")
            save_picture(answer.plot(), picture)
    if origin is None and answer.detected:
        heard.append(
            "The model counts as exact, so that its errors may look like a fault: --identified FILE (the record that "
            "it was identified from) takes its uncertainty into account."
        )
    conclude(str(answer), heard, diagnosis=out, report=report, picture=picture)


def _zeros(given: list[str] | None) -> dict[str, float]:
    from optid.cli import arguments as words
    from optid.errors import StructureError

    found = {}
    for word in words.listed(given) or []:
        name, equals, value = word.partition("=")
        try:
            found[name] = float(value)
        except ValueError:
            equals = ""
        if not (name and equals):
            raise StructureError(f"--zero {word}: write INPUT=VALUE, the input at which the actuator does nothing")
    return found


def _origin(identified: list[Path] | None, how: dict[str, Any]) -> Any:
    """Return the record that a model was identified from; a built-in one where no file has its name."""
    from optid.cli import arguments as words

    if not identified:
        return None
    name = str(identified[0])
    if len(identified) == 1 and not identified[0].exists() and not identified[0].suffix:
        from optid.examples import EXAMPLES

        if name in EXAMPLES:
            return EXAMPLES[name]().data
    return words.read_record(identified, how)

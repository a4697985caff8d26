"""The command `optid isolability`: what could break, and would it be noticed and named?"""

from pathlib import Path
from typing import Annotated

import typer

from optid.cli.options import MODEL, RESULT
from optid.cli.terminal import Waiting, coloured, hearing, note, say


def isolability(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file (.json) of a state-space model.")],
    window: Annotated[
        int, typer.Option("--window", "-w", metavar="N", rich_help_panel=MODEL, help="Samples of a window.")
    ] = 100,
    onset: Annotated[
        str, typer.Option("--onset", metavar="K", rich_help_panel=MODEL, help="Sample of the onset, or unknown.")
    ] = "unknown",
    prob: Annotated[
        float, typer.Option("--prob", rich_help_panel=MODEL, help="Probability to be noticed, and to be named.")
    ] = 0.95,
    false_alarm: Annotated[
        float,
        typer.Option("--false-alarm", rich_help_panel=MODEL, help="Probability that a healthy window raises an alarm."),
    ] = 0.01,
    kinds: Annotated[
        list[str] | None,
        typer.Option("--kinds", "-k", metavar="NAME...", rich_help_panel=MODEL, help="bias, drift. [dim]bias[/]"),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            "--load", metavar="NAME=E1,E2,...", rich_help_panel=MODEL,
            help="Direction of a disturbance in the state equation, one number per state.",
        ),
    ] = None,
    state_jump: Annotated[
        bool, typer.Option("--state-jump/--no-state-jump", rich_help_panel=MODEL, help="May the state jump?")
    ] = True,
    draws: Annotated[
        int, typer.Option("--draws", rich_help_panel=MODEL, help="Simulated windows per fault.")
    ] = 1000,
    seed: Annotated[int, typer.Option("--seed", rich_help_panel=MODEL, help="Seed of the simulation.")] = 0,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", "-p", metavar="FILE", rich_help_panel=RESULT, help="Write the picture (PNG, PDF)."),
    ] = None,
) -> None:
    """Find how large every fault must be to be noticed, and to be told from the others; no data are needed.

    Example: optid isolability model.json --window 100 --load pump=0.5,-0.3,0.4,0.2 --picture isolability.png
    """
    from optid.cli import arguments as words
    from optid.errors import DataError, StructureError
    from optid.faults import dictionary
    from optid.io import load as load_model

    words.check_folders(picture)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        plant = load_model(model)
        if plant.kind != "HammersteinSS":
            raise StructureError(
                f"{model} is a {plant.kind}: faults are judged with a state-space model that has noise covariances "
                "(optid fit ... --formulation hammerstein_ss.asivid)."
            )
        waiting.step("signatures")
        found = dictionary(
            plant, kinds=words.listed(kinds) or ["bias"], process=_directions(load), state_jump=state_jump
        )
        waiting.step("simulating faults")
        if onset != "unknown" and not onset.isdigit():
            raise StructureError(f"--onset {onset}: the number of a sample, or unknown, is needed")
        study = found.isolability(
            window, onset=onset if onset == "unknown" else int(onset), prob=prob, false_alarm=false_alarm, draws=draws,
            seed=seed,
        )
        if picture is not None:
            waiting.step("drawing")
            try:
                study.plot().savefig(picture, dpi=150)
            except ValueError as error:  # an ending that matplotlib does not know
                raise DataError(f"{picture}: {error}") from None
    say(coloured(str(study)))
    for sentence in heard:
        note(sentence)
    if picture is not None:
        say(f"picture written to {picture}")


def _directions(load: list[str] | None) -> dict[str, list[float]]:
    from optid.errors import StructureError

    found = {}
    for text in load or []:
        name, equals, numbers = text.partition("=")
        try:
            found[name] = [float(number) for number in numbers.split(",")]
        except ValueError:
            equals = ""
        if not (name and equals):
            raise StructureError(f"--load {text}: write NAME=E1,E2,..., one number per state")
    return found

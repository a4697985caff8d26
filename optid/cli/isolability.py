"""The command `optid isolability`: what could break, and would it be noticed and named?"""

from pathlib import Path
from typing import Annotated

import typer

from optid.cli.options import MODEL, Disturbance, Load, Picture, StateJump
from optid.cli.results import conclude, save_picture
from optid.cli.terminal import Waiting, hearing


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
    load: Load = None,
    disturbance: Disturbance = None,
    state_jump: StateJump = True,
    draws: Annotated[
        int, typer.Option("--draws", rich_help_panel=MODEL, help="Simulated windows per fault.")
    ] = 1000,
    seed: Annotated[int, typer.Option("--seed", rich_help_panel=MODEL, help="Seed of the simulation.")] = 0,
    picture: Picture = None,
) -> None:
    """Find how large every fault must be to be noticed, and to be told from the others; no data are needed.

    Example: optid isolability model.json --window 100 --load pump=0.5,-0.3,0.4,0.2 --picture isolability.png
    """
    from optid.cli import arguments as words
    from optid.errors import StructureError
    from optid.faults import dictionary

    if onset != "unknown" and not onset.isdecimal():
        raise StructureError(f"--onset {onset}: the number of a sample, or unknown, is needed")
    words.check_folders(picture)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        plant = words.state_space_model(model)
        waiting.step("signatures")
        found = dictionary(
            plant,
            kinds=words.listed(kinds) or ["bias"],
            process=words.directions(load, "--process", plant),
            state_jump=state_jump, disturbances=words.listed(disturbance) or (),
        )
        waiting.step("simulating faults")
        study = found.isolability(
            window, onset=onset if onset == "unknown" else int(onset), prob=prob, false_alarm=false_alarm, draws=draws,
            seed=seed,
        )
        if picture is not None:
            waiting.step("drawing")
            save_picture(study.plot(), picture)
    conclude(str(study), heard, picture=picture)

"""The command `optid reformulate`: the damaged system from a model, a diagnosis and the record."""

from pathlib import Path
from typing import Annotated, Any

import typer

from optid.cli.options import MODEL, RESULT, SOLVER, Example, Picture, Report, reads_a_record
from optid.cli.results import command_line, conclude, save_picture
from optid.cli.terminal import Waiting, hearing


@reads_a_record
def reformulate(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Model file (.json) of the healthy plant.")],
    diagnosis: Annotated[Path, typer.Argument(metavar="DIAGNOSIS", help="Written by optid diagnose --out.")],
    data: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="DATA", help="The record of the diagnosis: CSV, Parquet, MAT, NPZ or npy.", show_default=False
        ),
    ] = None,
    *,
    example: Example = None,
    how: dict[str, Any],
    constraint: Annotated[
        list[str] | None,
        typer.Option(
            "--constraint", "-c", metavar="NAME:VALUE...", rich_help_panel=MODEL,
            help="Of a damaged nonlinearity; by default monotone and nowhere steeper than before; 'none' for none.",
        ),
    ] = None,
    stage: Annotated[
        str,
        typer.Option("--stage", rich_help_panel=MODEL, help="'affected only', 'all with prior' or auto (by hold-out)."),
    ] = "auto",
    nodes: Annotated[
        int, typer.Option("--nodes", rich_help_panel=MODEL, help="Values of a damaged nonlinearity.")
    ] = 7,
    low: Annotated[
        list[str] | None, typer.Option("--low", metavar="U...", rich_help_panel=MODEL, help="Least inputs.")
    ] = None,
    high: Annotated[
        list[str] | None, typer.Option("--high", metavar="U...", rich_help_panel=MODEL, help="Largest inputs.")
    ] = None,
    target: Annotated[
        list[str] | None,
        typer.Option(
            "--target", metavar="Y...", rich_help_panel=RESULT, help="Can these outputs be held? One number each."
        ),
    ] = None,
    if_ambiguous: Annotated[
        str, typer.Option("--if-ambiguous", rich_help_panel=MODEL, help="wait, probe, robust or auto.")
    ] = "auto",
    solver: Annotated[
        str, typer.Option("--solver", "-s", metavar="NAME", rich_help_panel=SOLVER, help="See optid solvers.")
    ] = "auto",
    seed: Annotated[
        int, typer.Option("--seed", rich_help_panel=SOLVER, help="Seed of draws and probes, and of an example.")
    ] = 0,
    out: Annotated[
        Path | None,
        typer.Option("--model", "-m", metavar="FILE", rich_help_panel=RESULT, help="Write the damaged model (JSON)."),
    ] = None,
    report: Report = None,
    picture: Picture = None,
) -> None:
    """Turn a healthy model and a diagnosis into the damaged system: its model, what observes it, what it can still do.

    Example: optid reformulate model.json d.json faulty.csv --model damaged.json --report r.html
    """
    from optid.cli import arguments as words
    from optid.faults import load_diagnosis
    from optid.faults import reformulate as rebuild

    words.check_folders(out, report, picture)
    with hearing() as heard, Waiting() as waiting:
        waiting.step("reading")
        plant = words.state_space_model(model)
        found = load_diagnosis(diagnosis)
        record: Any = words.record(data, words.as_modelled(how, plant), example, seed)[0]
        given = words.listed(constraint)
        waiting.step("refitting")
        built = rebuild(
            plant, found, record, constraints="default" if given is None else [] if given == ["none"] else given,
            stage=stage, nodes=nodes, low=_numbers(low, "--low"), high=_numbers(high, "--high"),
            if_ambiguous=if_ambiguous, solver=solver, seed=seed,
        )
        text = str(built)
        if target is not None:
            text += f"\ntarget {built.attainable(_numbers(target, '--target') or [])}"
        if out is not None:
            built.model.save(out)
        if report is not None:
            from optid.faults.repair.page import write

            waiting.step("report")
            write(built, report, record=record.name or (data[0].name if data else ""), command=command_line())
        if picture is not None:
            waiting.step("drawing")
            save_picture(built.plot(), picture)
    conclude(text, heard, model=out, report=report, picture=picture)


def _numbers(given: list[str] | None, option: str) -> list[float] | None:
    from optid.cli import arguments as words
    from optid.errors import StructureError

    listed = words.listed(given)
    if listed is None:
        return None
    try:
        return [float(part) for text in listed for part in text.replace(",", " ").split()]
    except ValueError:
        raise StructureError(f"{option} {' '.join(listed)}: numbers are needed, one per channel") from None

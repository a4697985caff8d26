"""The command `optid compare`: a study with one record and one formulation."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import typer
from rich.text import Text

from optid.cli.derived import DEFAULT
from optid.cli.options import File, Paths, Words
from optid.cli.results import check_folders, check_names, command_line
from optid.cli.studies import NOTHING_SOLVED, follow_progress
from optid.cli.terminal import note, print_table, print_text
from optid.descriptions import describe
from optid.lazy import import_cvxpy
from optid.registry import FORMULATIONS, entry_point

ASSUMED = {"na": 2, "nb": 2, "nc": 1, "nd": 1, "nx": 2, "basis": "triangular:8"}
"""Values of required arguments that are not given: the command compares solvers, not orders."""


def compare(data: Paths = None, example: str | None = None, *, how: dict[str, Any], formulation: str = DEFAULT,
            constraint: Words = None, settings: Words = None, solvers: Words = None, accuracy: float = 1e-8,
            time_limit: float = 60.0, memory_limit: float = 2000.0, repetitions: int = 3, holdout: float = 0.3,
            seed: int = 0, db: File = None, workers: int = 1, accept_changed_data: bool = False, report: File = None
            ) -> None:
    """Compare solvers on one record at equal verified accuracy and recommend one.

    Example: optid compare data.csv --inputs u --outputs y --formulation hammerstein_arx.exact --na 2 --nb 2
    --basis triangular:8 --solvers all

    The record:
        holdout (SHARE): Share of the record held out.
    The model:
        constraint (-c NAME:VALUE...): Constraint; optid constraints lists them.
        settings (--set KEY=VALUE...): Any argument of the formulation.
    The solver:
        solvers (--solvers --solver -s NAME...): Solvers; optid solvers lists them. [dim]all[/]
        accuracy: Requested relative accuracy, verified for every solver.
        time_limit (SECONDS): Time limit of a run.
        memory_limit (MB): Memory limit of a run.
    The study:
        repetitions: Runs of each solver; the median time is reported.
        workers (--workers -w N): Number of worker processes; times are most exact with one.
        db (FILE): Keep the results in this database, and resume from it.
    """
    check_names(constraint, formulation=formulation)
    from optid.cli import arguments as words

    import_cvxpy()
    from optid.errors import StudyError
    from optid.studies.execution import running
    from optid.studies.study import Study
    from optid.studies.verdicts.comparison import compare as side_by_side
    from optid.studies.verdicts.comparison import verdict_on_one_record

    check_folders(report, db)
    entry, suggestion = _entry(data, how, example, seed)
    arguments = words.drop_foreign_options(suggestion, formulation) if suggestion else {}
    arguments |= words.pairs(settings, "--set")
    needed = describe(entry_point(FORMULATIONS, formulation)).options
    assumed = {key: ASSUMED[key] for key, parameter in needed.items()
               if parameter.default is parameter.empty and key in ASSUMED and key not in arguments}
    arguments |= assumed
    constraints = constraint if constraint is not None else arguments.pop("constraints", [])
    arguments["constraints"] = [] if constraints == ["none"] else constraints
    chosen = words.split_names(solvers) or ["all"]
    try:
        study = Study(f"compare {entry['name']}", data=entry, formulations={"formulation": formulation, **arguments},
                      solvers="all" if chosen == ["all"] else chosen, accuracy=accuracy, time_limit=time_limit,
                      memory_limit=memory_limit, repetitions=repetitions, warm=True, holdout=holdout)
        study.check_data()
    except StudyError as error:
        raise StudyError(_as_options(str(error))) from None
    with TemporaryDirectory() as folder, follow_progress(db) as follow:
        rows = running.run(study, db or Path(folder) / "compare.sqlite", workers=workers, progress=follow,
                           accept_changed_data=accept_changed_data)
    found = side_by_side(rows)
    if (reason := found.common_error) is not None:
        raise StudyError(f"no solver was run: {reason}")
    _show(found, study.formulations[0].name, entry["name"])
    if assumed:
        note(f"{', '.join(f'{key} = {value}' for key, value in assumed.items())} assumed; optid order selects orders")
    if report is not None:
        verdict_on_one_record(rows).report(report, command=command_line())
        print_text(f"report written to {report}")
    if not found.lines:
        raise typer.Exit(NOTHING_SOLVED)


def _entry(files: list[Path] | None, how: dict[str, Any], example: str | None, seed: int
           ) -> tuple[dict[str, Any], dict[str, Any]]:
    """The data entry of the study, and the arguments that a built-in record suggests."""
    from optid.cli import arguments as words

    if example is not None or not files:
        record, suggestion = words.record(files, how, example, seed)
        return {"name": example, "record": record}, suggestion
    reading = words.reading(how)
    entry = {"name": files[0].stem, "file": [str(path) for path in files]}
    return entry | {key: value for key, value in reading.items() if value is not None}, {}


def _as_options(text: str) -> str:
    """Write the keys of a study in a message as options of the command line."""
    import re

    text = "\n".join(line.strip() for line in text.splitlines()[1:]) or text
    text = re.sub(r"(?m)^(?:\w+\[[^]\n]*\]\.)?(\w+)(?:\[\d+\])?: must",
                  lambda m: f"--{m[1].replace('_', '-')} must", text)
    return re.sub(r"(?m)^(?:data|formulation|solvers?)\[[^]\n]*\](?:\.\w+)*(?:\[\d+\])?: ", "", text)


def _show(found: Any, formulation: str, record: str) -> None:
    from optid.backends.choice import back_ends
    from optid.phrases import seconds
    from optid.program.solution import GRADIENT
    from optid.show.wording import number
    from optid.studies.verdicts.choice import join_names
    from optid.studies.verdicts.outcomes import SOLVED

    absent = {name for name, back_end in back_ends().items() if not back_end.installed}

    def small(value: float) -> str:
        return "-" if value != value else f"{value:.0e}"

    table = []
    for line in found.lines:
        good = line.state == SOLVED
        word = "local" if line.status == "locally optimal" else line.status
        table.append((
            Text(line.solver, "bold" if good else "dim"),
            Text(word if good else line.state, "green" if line.proved else "yellow"),
            "0" if abs(line.above) < 1e-12 else small(line.above), small(line.residual), seconds(line.cold),
            seconds(line.warm), number(line.one_step, 4), number(line.simulation, 4)))
    print_table(f"{formulation} on {record}, accuracy {found.accuracy:.0e}",
                ("solver", "verified", "excess", "residual", "cold", "warm", "1-step", "simul."), table,
                firm=(0, *range(2, 8)), right=range(2, 8), padding=(0, 0, 0, 1))
    for reason, solvers in found.reasons.items():
        print_text(Text(f"{join_names(solvers, most=20)}: {reason}", "dim"))
    unfit = []
    for solver, reason in found.refused.items():
        if solver in absent or not found.lines:  # with what to install, or which solvers take it
            print_text(Text(f"{solver}: {reason}", "dim"))
        else:
            unfit.append(solver)
    if unfit:
        print_text(Text(f"not applicable to {formulation}: {', '.join(unfit)}", "dim"))
    print_text(Text("optimal: proved globally optimal. excess: relative distance of the objective from the best. "
                    "residual: largest residual of the optimality conditions, verified by optid (constraints, "
                    f"complementarity, and gradient / {GRADIENT:g}). 1-step, simul.: fit in % on held-out samples.",
                    "dim"))
    print_text(Text(found.recommendation, "bold"))

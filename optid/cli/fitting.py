"""The commands `optid fit`, `optid identify` and `optid validate`."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import typer

from optid.cli.derived import DEFAULT
from optid.cli.options import File, Paths, Words
from optid.cli.results import Work, check_names, reading_for, save_model, solver_choice, working
from optid.cli.terminal import STOPPED
from optid.errors import DataError
from optid.lazy import import_cvxpy


class _Given(NamedTuple):
    """Options about the record of a search."""

    data: Paths
    example: str | None
    how: dict[str, Any]
    seed: int
    split: float | None
    test: Words


def fit(data: Paths = None, example: str | None = None, *, how: dict[str, Any], stream: bool = False,
        scheduler: str | None = None, split: float | None = None, test: Words = None, formulation: str = DEFAULT,
        constraint: Words = None, holdout: str | None = None, settings: Words = None, solver: str = "auto",
        accuracy: float = 1e-8, time_limit: float | None = None, prove: bool = True, option: Words = None,
        seed: int = 0, report: File = None, saved: File = None) -> None:
    """Fit a model to a record, prove global optimality and report; without orders, search for them like optid identify.

    Example: optid fit data.csv --inputs u --outputs y --dt 0.1 --na 2 --nb 2 --basis triangular:10
    --constraint monotone:increasing --report report.html

    The record:
        stream: Read in chunks, for files larger than memory.
        scheduler (ADDRESS): Read Parquet files or folders on a Dask cluster (tcp://host:8786).
        split (SHARE): Fit on this share of the record and validate on the rest, such as 0.7.
    The model:
        constraint (-c NAME:VALUE...): Constraint, such as monotone:increasing; optid constraints lists them. 'none'
            removes those of the example.
        holdout (PENALTY): Choose this weight by hold-out: ridge, curvature or weight (of the nuclear norm).
        settings (--set KEY=VALUE...): Any argument of the formulation.
    The solver:
        accuracy: Requested relative accuracy of the solver.
        time_limit (SECONDS): Time limit of the solver.
        prove (--prove/--no-prove): Try to prove global optimality.
        option (KEY=VALUE...): Native options of the solver.
    """
    check_names(constraint, solver, formulation)
    asked = (holdout, settings, option, time_limit, scheduler)
    if data and formulation == DEFAULT and not stream and all(word is None for word in asked):
        _search(_Given(data, example, how, seed, split, test), constraint, solver, saved, report, accuracy=accuracy)
        return
    with working(saved, report) as work:
        from optid.cli import arguments as words

        if data:  # examples have no stamps: a wrong name is refused before anything large is imported
            how = words.at_stamps(how, formulation)
        record, suggestion = words.record(data, how, example, seed, stream=stream, scheduler=scheduler)
        import_cvxpy()
        from optid.identify.fitting import fit as fit_model
        from optid.identify.selection import fit_by_holdout
        from optid.show.printing import describe, describe_advice

        arguments = words.drop_foreign_options(suggestion, formulation) if suggestion else {}
        arguments |= words.pairs(settings, "--set") | ({"constraints": constraint} if constraint else {})
        if arguments.get("constraints") == ["none"]:
            del arguments["constraints"]
        record, held_out = words.held_out(record, split, test, how)
        work.step(f"fitting {formulation}")
        found = (fit_model if holdout is None else partial(fit_by_holdout, penalty=holdout))(
            record, formulation, solver=solver_choice(solver), accuracy=accuracy, time_limit=time_limit, prove=prove,
            solver_options=words.pairs(option, "--option"), **arguments)
        _save(work, found, held_out, saved, None if stream or scheduler else data, how)
        work.step("standard errors")
        work.text = describe(found)
        work.step("searching for advice")
        work.text += describe_advice(found)
        _check(work, found, record, held_out, "fit")
        work.page(found, report, held_out)


def identify(data: Paths = None, example: str | None = None, *, how: dict[str, Any], effort: str = "normal",
             budget: float | None = None, horizon: int | None = None, classes: Words = None, constraint: Words = None,
             solver: str = "auto", workers: int | None = None, trials: File = None, split: float | None = None,
             test: Words = None, seed: int = 0, report: File = None, saved: File = None) -> None:
    """Select formulation, delay, orders and bases by cross-validation, and fit the model.

    Example: optid identify data.csv --inputs u --outputs y --dt 0.1 --report report.html

    The model:
        effort (WORD): small, normal, large, or a number of units of about one CPU second. Every machine runs the same
            trials.
        budget (SECONDS): Stop the search after this CPU time. [dim]none[/]
        horizon (N): Compare N-step-ahead predictions. [dim]simulation[/]
        classes (NAME...): Model classes: linear, 'input functions', feedback, 'latent signals'. [dim]all[/]
        constraint (-c NAME:VALUE...): Constraint on every model; optid constraints lists them.
    The solver:
        workers (N): Number of processes. [dim]one per core[/]
        trials (FILE): Keep finished trials in this file; a stopped search resumes from it.
    The record:
        split (SHARE): Search on this share of the record and validate on the rest.
    """
    _search(_Given(data, example, how, seed, split, test), constraint, solver, saved, report, effort=effort,
            budget=budget, horizon=horizon, workers=workers, trials=trials, **({"classes": classes} if classes else {}))


def _search(given: _Given, constraint: Words, solver: str, saved: File, report: File, **settings: Any) -> None:
    check_names(constraint, solver)
    with working(saved, report) as work:
        from optid.cli import arguments as words

        data, how = given.data, given.how
        if data:
            how = words.at_stamps(how)
        record: Any = words.record(data, how, given.example, given.seed)[0]
        import_cvxpy()
        from optid.identify.search.search import INTERRUPT
        from optid.identify.search.search import identify as find

        record, held_out = words.held_out(record, given.split, given.test, how)
        found = find(record, constraints=constraint or (), solver=solver, progress=work.step, **settings)
        _save(work, found, held_out, saved, data, how)
        work.text = str(found)
        _check(work, found, record, held_out, "search")
        work.page(found, report, held_out)
    if found.stopped == INTERRUPT:
        raise typer.Exit(STOPPED)


def _save(work: Work, found: Any, held_out: Any, saved: Path | None, data: Paths, how: dict[str, Any]) -> None:
    """Save the model; a record that was used whole is named in its file."""
    from optid.cli import arguments as words

    record = None
    if data and held_out is None:
        named = {key: words.split_names(value) if isinstance(value, list) else value for key, value in how.items()}
        record = {**named, "files": [str(Path(name).resolve()) for name in data]}
    work.write("model", saved, lambda path: save_model(found.model, path, record))


def _check(work: Work, found: Any, record: Any, held_out: Any, what: str) -> None:
    """Validate on the held-out record, if there is one; findings that were printed before are not repeated."""
    if held_out is not None:
        from optid.identify.validation.checks import validate as check
        from optid.show.printing import describe_interval

        work.step("validating")
        checked = check(found.model, held_out)
        if checked.findings == record.findings:
            checked = replace(checked, findings=())
        work.text += f"\n\n{held_out.n_samples} samples held out of the {what}\n{checked}"
        if interval := describe_interval(getattr(found, "fit", found), held_out):
            work.text += f"\n\n{interval}"


def validate(files: list[Path], *, how: dict[str, Any], horizon: int = 1, report: File = None) -> None:
    """Validate one or several saved models on another record: fits and residual tests.

    Inputs, outputs and sampling time are by default those of the first model.

    Files:
        files (MODEL... DATA...): Model files (.json) written by fit --model, then files of the record.
    The result:
        horizon (N): Also compute N-step-ahead predictions.
    """
    with working(report) as work:
        from optid.cli import arguments as words
        from optid.identify.validation import compare_models
        from optid.identify.validation import validate as check
        from optid.models.files import load
        from optid.show.terminal import findings_lines

        paths = [path for i, path in enumerate(files) if i == 0 or path.suffix.lower() == ".json"]
        data = [path for path in files if path not in paths]
        if not data:
            raise DataError(f"give a data file after the model{'s' if len(paths) > 1 else ''}")
        distinct = len({path.stem for path in paths}) == len(paths)
        models = {path.stem if distinct else str(path): load(path) for path in paths}
        first = next(iter(models.values()))
        record: Any = words.read_record(data, reading_for(first, how))
        work.step("validating")
        compared = len(models) > 1 or report is not None
        found: Any = compare_models(models, record, horizon) if compared else None
        if len(models) > 1:
            work.text = str(found)
        else:
            checked = found.validations[0] if compared else check(first, record, horizon=horizon)
            said = "\n".join([*findings_lines(checked.findings), ""]) if checked.findings else ""
            work.text = f"{said}{first}\n\n{replace(checked, findings=())}"
        work.page(found, report)

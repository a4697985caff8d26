"""The commands about faults: isolability before there are any, diagnose, and reformulate after one."""

from pathlib import Path
from typing import Any

from optid.cli.options import File, Paths, Words
from optid.cli.results import reading_for, save_model, working


def isolability(model: Path, window: int = 100, onset: str = "unknown", prob: float = 0.95, false_alarm: float = 0.01,
                kinds: Words = None, load: Words = None, disturbance: Words = None, state_jump: bool = True,
                draws: int = 1000, seed: int = 0, report: File = None, picture: File = None) -> None:
    """Compute the smallest size at which each fault is detectable and isolable; needs no data.

    Example: optid isolability model.json --window 100 --load pump=0.5,-0.3,0.4,0.2 --picture isolability.png

    The model:
        window (-w N): Length of the window in samples.
        onset (K): Sample of the onset, or unknown.
        prob: Required probability of detection and of isolation.
        false_alarm: Probability of a false alarm in a window.
        kinds (-k NAME...): Kinds of faults: bias, drift. [dim]bias[/]
        draws: Simulated windows per fault.
        seed: Seed of the simulation.
    """
    from optid.cli import arguments as words
    from optid.errors import StructureError

    if onset != "unknown" and not onset.isdecimal():
        raise StructureError(f"--onset {onset}: must be the number of a sample, or unknown")
    with working(report, picture) as work:
        from optid.faults import isolability as simulate

        plant = words.state_space_model(model)
        work.step("signatures")
        found = words.candidates(plant, ["bias"], kinds, load, disturbance, state_jump)
        work.step("simulating faults")
        study = simulate(found, window, onset=onset if onset == "unknown" else int(onset), prob=prob,
                         false_alarm=false_alarm, draws=draws, seed=seed)
        work.text = str(study)
        work.page(study, report)
        work.draw(study.plot, picture)


def diagnose(model: Path, data: Paths = None, *, example: str | None = None, how: dict[str, Any], healthy: Paths = None,
             identified: Paths = None, rescale: bool = False, kinds: Words = None, load: Words = None,
             disturbance: Words = None, zero: Words = None, state_jump: bool = True, max_faults: int = 1,
             false_alarm: float = 0.01, coverage: float = 0.95, robust: bool = False, method: str = "exact",
             solver: str = "auto", seed: int = 0, out: File = None, report: File = None, picture: File = None) -> None:
    """Diagnose a record: healthy or faulty, which fault, its onset and size.

    Example: optid diagnose model.json faulty.csv --max-faults 2 --out d.json --report d.html

    Files:
        data (DATA): The record: a CSV, Parquet, MAT, NPZ or NPY file.
    The record:
        healthy (FILE...): A healthy record, on which the innovations are tested for whiteness and variance.
        identified (FILE...): The record from which the model was identified, or the name of an example; the
            uncertainty of the model is added to the noise. [dim]exact model[/]
        rescale: Scale the noise covariance to that of --healthy.
    The model:
        kinds (-k NAME...): Kinds of faults: bias, loss, stuck, drift, frozen, noise, spike. [dim]bias, loss, spike[/]
        zero (INPUT=VALUE...): Input at which an actuator has no effect; a loss is a share of the distance from it.
            [dim]unknown[/]
        max_faults: Largest number of simultaneous faults.
        false_alarm: Probability of a false alarm on a healthy record.
        coverage: Coverage of the set of candidates and of the confidence intervals.
        robust: Limit the influence of outliers.
    The solver:
        method: Search method: exact, sparse, sparse+polish or set.
        seed: Seed of the simulated thresholds and of the example.
    The result:
        out (FILE): Write the diagnosis (.json).
    """
    with working(out, report, picture) as work:
        from optid.cli import arguments as words
        from optid.errors import DataError
        from optid.faults import diagnose as judge
        from optid.faults import model_uncertainty
        from optid.faults.diagnosis.diagnosing import KINDS

        plant = words.state_space_model(model)
        how = reading_for(plant, how)
        record: Any = words.record(data, how, example, seed)[0]
        if record.n_experiments > 1:
            raise DataError(f"the record has {record.n_experiments} experiments: give one file with one experiment.")
        sound: Any = words.read_record(healthy, how) if healthy else None
        origin = _origin(identified, how)
        work.step("signatures")
        found = words.candidates(plant, KINDS, kinds, load, disturbance, state_jump, zero)
        work.step("searching")
        uncertainty: Any = "ignore"
        if origin is not None:
            silent = bool(found.predictor.silent)
            uncertainty = model_uncertainty(found.model, origin, decoupled=found.predictor if silent else None)
        answer = judge(
            plant, record, found, false_alarm=false_alarm, max_faults=max_faults, method=method, coverage=coverage,
            model_uncertainty=uncertainty, robust=robust, healthy=sound, rescale=rescale, seed=seed, solver=solver)
        work.write("diagnosis", out, answer.save)
        work.text = str(answer)
        if origin is None and answer.detected:
            work.heard.append(
                "The model is assumed exact: a model error may appear as a fault. --identified FILE (the record "
                "from which the model was identified) accounts for its uncertainty.")
        work.page(answer, report, record=record.name)
        work.draw(answer.plot, picture)


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


def reformulate(model: Path, diagnosis: Path, data: Paths = None, *, example: str | None = None, how: dict[str, Any],
                constraint: Words = None, stage: str = "auto", nodes: int = 7, low: Words = None, high: Words = None,
                target: Words = None, if_ambiguous: str = "auto", solver: str = "auto", seed: int = 0,
                saved: File = None, report: File = None, picture: File = None) -> None:
    """Build the model of the damaged system from a healthy model and a diagnosis.

    Example: optid reformulate model.json d.json faulty.csv --model damaged.json --report r.html

    Files:
        model (MODEL): Model file (.json) of the healthy plant.
        diagnosis (DIAGNOSIS): Diagnosis (.json) written by optid diagnose --out.
        data (DATA): The diagnosed record: a CSV, Parquet, MAT, NPZ or NPY file.
    The model:
        constraint (-c NAME:VALUE...): Constraints on a damaged nonlinearity; 'none' removes them.
            [dim]monotone, no steeper than before[/]
        stage: Parameters to refit: 'affected only', 'all with prior' or auto (chosen by hold-out).
        nodes: Number of nodes of a damaged nonlinearity.
        low (U...): Lower limits of the inputs, one per input.
        high (U...): Upper limits of the inputs, one per input.
        if_ambiguous: Action when several faults explain the record: wait, probe, robust or auto.
    The solver:
        seed: Seed of the draws, the probes and the example.
    The result:
        target (Y...): Check whether these constant outputs are attainable; one number per output.
        saved (--model -m FILE): Write the model of the damaged system; formats as of optid fit.
    """
    with working(saved, report, picture) as work:
        from optid.cli import arguments as words
        from optid.faults import load_diagnosis
        from optid.faults import reformulate as rebuild

        plant = words.state_space_model(model)
        found = load_diagnosis(diagnosis)
        record: Any = words.record(data, reading_for(plant, how), example, seed)[0]
        given = words.split_names(constraint)
        work.step("refitting")
        built = rebuild(
            plant, found, record, constraints="default" if given is None else [] if given == ["none"] else given,
            stage=stage, nodes=nodes, low=words.numbers(low, "--low"), high=words.numbers(high, "--high"),
            if_ambiguous=if_ambiguous, solver=solver, seed=seed)
        work.write("model", saved, lambda path: save_model(built.model, path))
        work.text = str(built)
        if target is not None:
            work.text += f"\ntarget {built.attainable(words.numbers(target, '--target') or [])}"
        work.page(built, report, record=record.name or (data[0].name if data else ""))
        work.draw(built.plot, picture)

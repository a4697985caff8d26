"""Records and arguments from the words of the command line."""

import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from optid.data.record import Data
from optid.data.streams import Stream
from optid.errors import DataError, StructureError


def read_record(files: Sequence[Path | str], how: Mapping[str, Any], *, stream: bool = False,
                scheduler: str | None = None) -> Data | Stream:
    """Read the files of a record, one experiment each, with the options of `optid.cli.options.READING`.

    A stream, or a Dask scheduler whose workers read it, takes folders of Parquet files as well. `DataError` as of
    `optid.read`.
    """
    from optid.data.readers import open_stream, read

    options = reading(how)
    if not stream and scheduler is None:
        return _in_options(read([Path(name) for name in files], **options))
    if options.pop("experiment") is not None:
        raise DataError("--stream and --scheduler read a file or folder as one experiment; leave --experiment out")
    paths = [Path(name) for name in files]
    return _in_options(open_stream(paths if len(paths) > 1 else paths[0], scheduler=scheduler, **options))


def _in_options(record: Any) -> Any:
    """Return a record whose findings name the options of the command."""
    from optid.cli.options import in_options

    return record.with_findings(in_options(finding, reading=True) for finding in record.findings)


def reading(how: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a record as arguments of `optid.read`."""
    return {
        **how,
        **{key: split_names(how[key]) for key in ("inputs", "outputs", "columns", "input_units", "output_units",
                                                  "quality")},
        "missing": tuple(split_names(how["missing"]) or ()),
        "time": False if how["time"] == "none" else how["time"]}


def record(files: Sequence[Path | str] | None, how: Mapping[str, Any], example: str | None, seed: int, *,
           asked: str = "a data file", **reading: Any) -> tuple[Any, dict[str, Any]]:
    """Return the record of files, or a built-in one with the arguments of a fit that it suggests.

    `files`, `how` and `reading` are those of `read_record`, `asked` is how messages call the files.

    Raises:
        DataError: neither files nor an example, or both; what `optid.read` refuses.
        LookupFailed: no such example.
    """
    if example is None:
        if not files:
            raise DataError(f"give {asked}, or --example NAME (optid examples lists them)")
        return read_record(files, how, **reading), {}
    if files:
        raise DataError(f"give {asked} or --example, not both")
    from optid.examples import example as built_in

    chosen = built_in(example, seed=seed)
    return chosen.data, dict(chosen.suggestion)


def drop_foreign_options(suggestion: Mapping[str, Any], formulation: str) -> dict[str, Any]:
    """Return the suggested arguments that the formulation takes (`LookupFailed` for an unknown one)."""
    from optid.registry import formulation as look_up

    takes = inspect.signature(look_up(formulation)[1]).parameters
    arguments = {key: value for key, value in suggestion.items() if key in takes}
    if "basis" not in takes:  # the suggested constraints are about the nonlinearity
        arguments.pop("constraints", None)
    return arguments


def at_stamps(how: dict[str, Any], formulation: str | None = None) -> dict[str, Any]:
    """Return the reading options with the stamps kept where the formulation takes any times and no repair is asked for.

    Without a formulation there is a search, which tries processes on such a record. `LookupFailed` for an unknown one.
    """
    if formulation is not None:
        from optid.lazy import import_cvxpy
        from optid.registry import formulation as look_up

        import_cvxpy()
        if not getattr(look_up(formulation)[1], "takes_any_times", False):
            return how
    return {**how, "gaps": "stamps"} if how["gaps"] is None and how["resample"] is None else how


def options_of_model(how: Mapping[str, Any], model: Any) -> dict[str, Any]:
    """Return the reading options with channels and sampling time of a model where none are given."""
    return {
        **how,
        "inputs": how["inputs"] or list(model.inputs),
        "outputs": how["outputs"] or list(model.outputs),
        "dt": model.dt if how["dt"] is None else how["dt"]}


def state_space_model(path: Path) -> Any:
    """Read a state-space model for fault diagnosis; `StructureError` for another kind."""
    from optid.models.files import load

    model = load(path)
    if model.kind != "HammersteinSS":
        raise StructureError(f"{path} is a {model.kind}; fault diagnosis needs a state-space model with noise "
                             "covariances (optid fit ... --formulation hammerstein_ss.asivid).")
    return model


def held_out(record: Any, share: float | None, files: Sequence[str] | None, how: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the records to fit and to validate on: other files, the rest after a share, or None.

    `DataError` for an impossible share, or a share of a stream.
    """
    if files:
        return record, read_record(files, how)
    if share is None:
        return record, None
    if isinstance(record, Stream):
        raise DataError("--split needs the record in memory; leave --stream and --scheduler out, or give --test "
                        "another file")
    return record.split(share)


def split_names(words: Sequence[str] | None) -> list[str] | None:
    """Split words at commas into names; None stays None."""
    return None if words is None else [part.strip() for word in words for part in word.split(",") if part.strip()]


def one_or_all(values: list[Any] | None) -> Any:
    """Return the single value of a list, else the list itself."""
    return values[0] if values is not None and len(values) == 1 else values


def numbers(words: Sequence[str] | None, option: str) -> list[float] | None:
    """Read numbers, one per channel; None stays None; a `StructureError` names the option and the words."""
    found = split_names(words)
    try:
        return None if found is None else [float(part) for text in found for part in text.split()]
    except ValueError:
        raise StructureError(f"{option} {' '.join(found or [])}: must be numbers, one per channel") from None


def value(word: str) -> Any:
    """Return the value of a word that is JSON (number, list, true), else the word."""
    try:
        return json.loads(word)
    except json.JSONDecodeError:
        return word


def pairs(words: Sequence[str] | None, option: str, form: str = "key=value", read: Callable[[str], Any] = value
          ) -> dict[str, Any]:
    """Read key=value words, the values by `read`; a `StructureError` names option, word and expected form."""
    found = {}
    for word in words or []:
        key, equals, text = word.partition("=")
        try:
            found[key] = read(text)
        except ValueError:
            equals = ""
        if not (key and equals):
            raise StructureError(f"{option} {word}: write {form}")
    return found


def directions(words: Sequence[str] | None, option: str, model: Any = None) -> dict[str, Any]:
    """Read NAME=E1,E2,... (directions in the state equation) or NAME=y1:-1,y2:0.5 (effects on outputs of a model).

    `LookupFailed` for an unknown output, `StructureError` for another word or a direction of the wrong size.
    """
    def read(text: str) -> Any:
        parts = [part.rpartition(":") for part in text.split(",")]
        values = [float(number) for _, _, number in parts]
        outputs = [output for output, _, _ in parts if output]
        if outputs and (len(outputs) < len(parts) or model is None):
            raise ValueError
        return dict(zip(outputs, values)) if outputs else values

    form = "NAME=E1,E2,..., one number per state, or NAME=OUTPUT:CHANGE,..."
    found = pairs(words, option, form, read)
    if model is None:
        return found
    for name, change in found.items():
        if isinstance(change, dict):
            from optid.faults.directions import direction_of

            found[name] = direction_of(model, change)
        elif len(change) != model.nx:
            word = next(word for word in words or () if word.partition("=")[0] == name)
            raise StructureError(f"{option} {word}: {len(change)} numbers for {model.nx} states. Give one per state, "
                                 f"or its effect on the outputs: {name}={model.outputs[0]}:-1")
    return found


def candidates(model: Any, kinds: Sequence[str], given: Sequence[str] | None, load: Sequence[str] | None,
               disturbance: Sequence[str] | None, state_jump: bool, zero: Sequence[str] | None = None) -> Any:
    """Return the dictionary of possible faults, of the kinds given or else of `kinds`; errors as of `dictionary`."""
    from optid.faults import dictionary

    return dictionary(
        model, kinds=split_names(given) or list(kinds), process=directions(load, "--process", model),
        state_jump=state_jump, disturbances=split_names(disturbance) or (),
        zeros=pairs(split_names(zero), "--zero", "INPUT=VALUE, the input at which the actuator has no effect", float))

"""From words of the command line to records and arguments."""

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
    """Read the files of a record, one experiment each.

    Args:
        files: paths; for a stream also of folders of Parquet files.
        how: the options of `optid.cli.options.READING`.
        stream: read chunk by chunk.
        scheduler: address of a Dask scheduler whose workers read them, chunk by chunk.

    Raises:
        DataError: what `optid.read` refuses.
    """
    from optid.data.readers import open_stream, read

    options = reading(how)
    if not stream and scheduler is None:
        return read([Path(name) for name in files], **options)
    if options.pop("experiment") is not None:
        raise DataError("--stream and --scheduler read a file or folder as one experiment; leave --experiment out")
    paths = [Path(name) for name in files]
    return open_stream(paths if len(paths) > 1 else paths[0], scheduler=scheduler, **options)


def reading(how: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a record as arguments of `optid.read`."""
    return {
        **how,
        **{key: listed(how[key]) for key in ("inputs", "outputs", "columns")},
        "time": False if how["time"] == "none" else how["time"],
        "delimiter": how["delimiter"].replace("\\t", "\t"),
    }


def record(files: Sequence[Path | str] | None, how: Mapping[str, Any], example: str | None, seed: int, *,
           asked: str = "a data file", **reading: Any) -> tuple[Any, dict[str, Any]]:
    """Return the record of files, or a built-in one with the arguments of a fit that it suggests.

    Args:
        files: as in `read_record`.
        how: as in `read_record`.
        example: name of a built-in record in their place.
        seed: of the noise of the example.
        asked: what the command takes in the way of files, for the messages.
        reading: other arguments of `read_record`.

    Raises:
        DataError: neither is given, or both are, or what `optid.read` refuses.
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


def suited(suggestion: Mapping[str, Any], formulation: str) -> dict[str, Any]:
    """Return those of the suggested arguments that the formulation takes.

    Raises:
        LookupFailed: no such formulation.
    """
    from optid.registry import formulation as look_up

    takes = inspect.signature(look_up(formulation)[1]).parameters
    arguments = {key: value for key, value in suggestion.items() if key in takes}
    if "basis" not in takes:  # the suggested constraints are about the nonlinearity
        arguments.pop("constraints", None)
    return arguments


def as_modelled(how: Mapping[str, Any], model: Any) -> dict[str, Any]:
    """Return how to read a record for a model: its channels and sampling time where none are given."""
    return {
        **how,
        "inputs": how["inputs"] or list(model.inputs),
        "outputs": how["outputs"] or list(model.outputs),
        "dt": model.dt if how["dt"] is None else how["dt"],
    }


def state_space_model(path: Path) -> Any:
    """Read the model that questions about faults are asked of.

    Raises:
        StructureError: a model of another kind.
    """
    from optid.models.files import load

    model = load(path)
    if model.kind != "HammersteinSS":
        raise StructureError(f"{path} is a {model.kind}: faults are judged with a state-space model that has noise "
                             "covariances (optid fit ... --formulation hammerstein_ss.asivid).")
    return model


def models_and_data(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Tell model files from data files: the first is a model, and so are all others that end in .json.

    Raises:
        DataError: no data file.
    """
    models = [path for i, path in enumerate(files) if i == 0 or path.suffix.lower() == ".json"]
    data = [path for path in files if path not in models]
    if not data:
        raise DataError(f"give a data file after the model{'s' if len(models) > 1 else ''}")
    return models, data


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of files without folder and ending where these differ, the whole paths where they do not."""
    names = [path.stem for path in paths]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


def held_out(record: Any, share: float | None, files: Sequence[str] | None, how: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the record to fit and the one to validate on: files, or the rest of the record after a share, or None.

    Raises:
        DataError: an impossible share, or a stream.
    """
    if files:
        return record, read_record(files, how)
    if share is None:
        return record, None
    if isinstance(record, Stream):
        raise DataError("--split needs the record in memory; leave --stream and --scheduler out, or give --test "
                        "another file")
    return record.split(share)


def listed(words: Sequence[str] | None) -> list[str] | None:
    """Return the names in words that may be joined by commas; None stays None."""
    return None if words is None else [part.strip() for word in words for part in word.split(",") if part.strip()]


def one_or_all(values: list[Any] | None) -> Any:
    """Return the single value of a list, the list itself when it has several, None for None."""
    return values[0] if values is not None and len(values) == 1 else values


def numbers(words: Sequence[str] | None, option: str) -> list[float] | None:
    """Read numbers, one per channel; None stays None; a `StructureError` names the option and the words."""
    found = listed(words)
    try:
        return None if found is None else [float(part) for text in found for part in text.split()]
    except ValueError:
        raise StructureError(f"{option} {' '.join(found or [])}: numbers are needed, one per channel") from None


def value(word: str) -> Any:
    """Return what a word that is JSON says (number, list, true); any other is text."""
    try:
        return json.loads(word)
    except json.JSONDecodeError:
        return word


def pairs(words: Sequence[str] | None, option: str, form: str = "key=value", read: Callable[[str], Any] = value
          ) -> dict[str, Any]:
    """Read key=value words, the values by `read`; for any other the `StructureError` names option, word and form."""
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
    """Read NAME=E1,E2,... words: directions in the state equation by name, or NAME=y1:-1,y2:0.5 by outputs.

    Args:
        words: as given.
        option: that they were given to.
        model: whose outputs are named.

    Raises:
        LookupFailed: no such output.
        StructureError: a word that is something else, a direction of the wrong size.
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
                                 f"or say what it does to the outputs: {name}={model.outputs[0]}:-1")
    return found

"""MAT files of version 5 and 7.3, read in a child process: a damaged file may crash the library or exhaust memory."""

import os
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optid.errors import DataError
from optid.processes import run_forked

MAT = 'pip install "optid[mat]"'
TEXT = (b"char", b"cell", b"function_handle")
MEMORY, EXPANSION = 4 << 30, 32  # memory limit in bytes, or `EXPANSION` times the size of the file if that is more
SECONDS, PACE = 60.0, 1 << 30  # time limit, and again for each `PACE` bytes


def mat_variables(path: Path, names: Sequence[str] | None = None) -> dict[str, Any]:
    """Return numeric variables by name, fields of structures as "structure.field"; without names {name: None} of all.

    `DataError`: a damaged file, a link to another file, too much time or memory for its size, or h5py is missing.
    """
    if not hasattr(os, "fork"):
        return _variables(path, names)
    size, damaged = path.stat().st_size, f"{path.name} is damaged, or not a MAT file"
    try:
        return run_forked(_variables, path, names, quiet=True, seconds=SECONDS * (1 + size / PACE),
                          memory=max(MEMORY, EXPANSION * size))
    except TimeoutError:
        raise DataError(f"{damaged}: reading it took more than {SECONDS:g} s.") from None
    except ChildProcessError as death:
        raise DataError(f"{damaged}: the process that read it crashed ({death}).") from None


def _variables(path: Path, names: Sequence[str] | None) -> dict[str, Any]:
    """Return {name: array} of these numeric variables; {name: None} of all where no names are given."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = _of_version_5(path, names)
            except NotImplementedError:
                found = _of_version_7(path, names)
    except Exception as error:  # whatever a library raises on a damaged file
        if isinstance(error, ImportError) and "h5py" in str(error):
            raise DataError(f"{path.name} is a MAT file of version 7.3, which needs h5py: {MAT}") from None
        text = str(error) or type(error).__name__
        raise DataError(f"{path.name} is damaged, or not a MAT file: {text}") from None
    return dict.fromkeys(found) if names is None else found


def _of_version_5(path: Path, names: Sequence[str] | None) -> dict[str, Any]:
    """Return the numeric variables, and the fields of structures as "structure.field"."""
    from scipy.io import loadmat

    wanted = None if names is None else sorted({name.split(".")[0] for name in names} | set(names))
    # With mat_dtype a double that MATLAB packed into bytes comes back as a double.
    content = loadmat(path, mat_dtype=True, variable_names=wanted)
    found = {}
    for name, value in content.items():
        if not isinstance(value, np.ndarray) or name.startswith("__"):
            continue
        if value.dtype.names and value.size == 1:
            found |= {f"{name}.{part}": value.flat[0][part] for part in value.dtype.names}
        else:
            found[name] = value
    return {name: value for name, value in found.items() if getattr(value, "dtype", np.dtype(object)).kind in "biufc"}


def _of_version_7(path: Path, names: Collection[str] | None) -> dict[str, Any]:
    """Return the numeric data sets of an HDF5 file; a ValueError where one is in another file."""
    import h5py

    found: dict[str, Any] = {}

    def visit(group: Any, prefix: str, above: list[Any]) -> None:
        for key in group:
            link = group.get(key, getlink=True)
            if isinstance(link, h5py.ExternalLink):
                raise ValueError(f"{prefix + key!r} is a link to another file, {link.filename!r}: optid follows none")
            if isinstance(link, h5py.SoftLink) or key.startswith("#"):
                continue
            item, name = group[key], prefix + key
            if isinstance(item, h5py.Group):
                if item.id not in above:  # groups can hold each other
                    visit(item, name + ".", [*above, item.id])
            elif isinstance(item, h5py.Dataset) and item.dtype.kind in "iuf" and \
                    item.attrs.get("MATLAB_class", b"") not in TEXT:
                if item.external or item.is_virtual:
                    raise ValueError(f"the samples of {name!r} are stored in another file: optid opens none")
                if names is None:
                    found[name] = None
                elif name in names:
                    found[name] = item[()].T  # HDF5 stores MATLAB's columns as rows

    with h5py.File(path, "r") as file:
        visit(file, "", [file.id])
    return found

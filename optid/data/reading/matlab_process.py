"""Reads one MAT file in a process of its own: a damaged file can crash the library that reads it, or ask for terabytes.

Run as a script with [path, folder, names or null, bytes of memory] in JSON as its argument; it needs nothing of optid.
Without names it prints the names of the numeric variables; with names it saves these variables into the folder.
"""

import json
import sys

TEXT = (b"char", b"cell", b"function_handle")


def version_5(path, names):
    """Return {name: array} of the numeric variables, and of the fields of structures as "structure.field"."""
    import numpy as np
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


def version_7(path, names):
    """Return {name: array} of the numeric data sets of an HDF5 file; only shapes where no names are given.

    Raises:
        ValueError: a link to another file, or samples that are stored in another file.
    """
    import h5py

    found = {}

    def visit(group, prefix, above):
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


def main():
    """Answer in JSON on the standard output: {"names": [...]} or {"error": kind, "text": message}."""
    path, folder, names, memory = json.loads(sys.argv[1])
    try:
        import numpy as np

        try:
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        except (ImportError, ValueError, OSError):
            pass
        try:
            found = version_5(path, names)
        except NotImplementedError:
            found = version_7(path, names)
        if names is not None:
            for number, name in enumerate(names):
                np.save(f"{folder}/{number}.npy", found[name], allow_pickle=False)
        answer = {"names": list(found)}
    except Exception as error:  # whatever a library raises on a damaged file
        answer = {"error": type(error).__name__, "text": str(error)}
    print("\n" + json.dumps(answer))


if __name__ == "__main__":
    main()

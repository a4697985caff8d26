"""MAT files of versions 4 to 7.3 as trees of structures, lists, numbers and text, the same for every version."""

import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

DEEPEST, MOST_NODES, LONGEST_CELL, LONGEST_TEXT, LONGEST_NAME = 32, 30_000, 1000, 10_000, 200
NUMERIC = {"double", "single", "logical", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
DATASET = ("u = {0}.get('u').Values; y = {0}.get('y').Values; s = struct('t', y.Time, 'u', u.Data, 'y', y.Data); "
           "save('data.mat', '-struct', 's')")
LINES = {  # what to type in MATLAB to save the numbers of an object of a class
    "timetable": "r = {0}.Properties.RowTimes; s = table2struct(timetable2table({0}, 'ConvertRowTimes', false), "
                 "'ToScalar', true); s.t = seconds(r - r(1)); save('data.mat', '-struct', 's')",
    "table": "s = table2struct({0}, 'ToScalar', true); save('data.mat', '-struct', 's')",
    "iddata": "s = get({0}); save('data.mat', 's')",
    "timeseries": "s = struct('t', {0}.Time, 'y', squeeze({0}.Data)); save('data.mat', '-struct', 's')",
    "Simulink.SimulationOutput": DATASET.replace("{0}", "{0}.logsout"),
    "Simulink.SimulationData.Dataset": DATASET,
    "datetime": "{0} = seconds({0} - {0}(1)), then save again",
    "duration": "{0} = seconds({0}), then save again",
}
HDF5 = b"\x89HDF\r\n\x1a\n"  # first bytes of an HDF5 file
EMPTY = "is empty"
OTHER_OBJECT = "save the numbers that it holds as plain arrays"


class Numbers(NamedTuple):
    """Real numbers: one or more channels, vectors of any orientation as (N,)."""

    shape: tuple[int, ...]  # (N,) or (rows, columns)
    load: Callable[[], np.ndarray]  # returns an array of this shape; logical values as 0.0 and 1.0


class Elements(NamedTuple):
    """Elements of a cell array, or of an array of structures, in the order of MATLAB's linear index."""

    brackets: str  # "{}" for a cell array, "()" for structures
    items: "list[Node]"


class Refused(NamedTuple):
    """Something that holds no real numbers that could be read."""

    reason: str  # what it is
    line: str = ""  # what to type in MATLAB, with {0} for the name of the variable

    @property
    def is_empty(self) -> bool:
        """Whether it holds nothing."""
        return self.reason.startswith(EMPTY)


Node = Numbers | Elements | Refused | str | dict[str, "Node"]


@contextmanager
def open_tree(path: Path) -> Iterator[dict[str, Node]]:
    """Open a MAT file as a structure of its variables, whose numbers can be loaded while it is open.

    Whatever the libraries raise on damaged files, a ValueError where the file is nested without end or refers to
    another file, and an ImportError if h5py is missing.
    """
    from scipy.io.matlab import matfile_version

    with open(path, "rb") as file:
        by_matlab = file.read(len(HDF5)) != HDF5  # which puts its own header first
    if by_matlab and matfile_version(path)[0] < 2:
        yield _tree_of_scipy(path)
        return
    import h5py

    with h5py.File(path, "r") as file:
        yield _Hdf5(file, by_matlab).tree()


class _Limit:
    """Counts the nodes and the depth of a tree, so that a hostile file is refused early."""

    def __init__(self) -> None:
        self.nodes = count(1)

    def check(self, depth: int) -> None:
        if depth > DEEPEST:
            raise ValueError(f"its structures and cells are nested more than {DEEPEST} deep, or hold themselves")
        if next(self.nodes) > MOST_NODES:
            raise ValueError(f"it holds more than {MOST_NODES} variables, fields and cells")


def _numbers(shape: tuple[int, ...], load: Callable[[], np.ndarray]) -> Node:
    """Return numbers of a shape as in MATLAB, vectors without their axes of length one."""
    if 0 in shape:
        return Refused(f"{EMPTY} ({_times(shape)})")
    long = [n for n in shape if n > 1]
    if len(long) > 1 and len(shape) > 2:
        return Refused(f"has {len(shape)} dimensions ({_times(shape)}); it must be samples by channels")
    flat = shape if len(long) > 1 else (max(shape, default=1),)

    def load_array() -> np.ndarray:
        array = load().reshape(flat)
        return array.astype(np.float64) if array.dtype.kind == "b" else array

    return Numbers(flat, load_array)


def _elements(brackets: str, size: int, items: Iterator[Node]) -> Node:
    """Return an array of cells or structures, whose items are taken one by one if there are not too many."""
    if not size:
        return Refused(EMPTY)
    if size <= LONGEST_CELL:
        return Elements(brackets, list(items))
    if isinstance(first := next(items), str):
        return f"{first}\n"  # the others are not needed
    kind = "cells" if brackets == "{}" else "structures"
    return Refused(f"is an array of {size} {kind}; save each signal as a vector")


def _object(kind: str) -> Node:
    """Return an object of a class as refused; a string object as text."""
    kind = kind if re.fullmatch(r"[A-Za-z][\w.]{0,60}", kind) else "unknown"
    if kind == "string":
        return ""
    if kind == "function_handle":
        return Refused("is a function handle")
    return Refused(f"is a MATLAB object of class {kind}", LINES.get(kind, OTHER_OBJECT))


COMPLEX = Refused("is complex", "{0} = [real({0}) imag({0})], then save again")
SPARSE = Refused("is sparse", "{0} = full({0}), then save again")


def _times(shape: Iterable[int]) -> str:
    return " x ".join(map(str, shape))


# -- versions 4 to 7


def _tree_of_scipy(path: Path) -> dict[str, Node]:
    from scipy.io import loadmat, matlab

    with warnings.catch_warnings(record=True, action="always") as caught:
        # With mat_dtype a double that MATLAB packed into bytes comes back as a double, but without its imaginary part.
        content = loadmat(path, mat_dtype=True)
    lossy = any(issubclass(warning.category, np.exceptions.ComplexWarning) for warning in caught)
    with warnings.catch_warnings(action="ignore"):
        stored = loadmat(path) if lossy else content
        limit = _Limit()
        tree = {name: _node_of_scipy(value, stored[name], 1, limit) for name, value in content.items()
                if not name.startswith("__") and not isinstance(value, matlab.MatlabOpaque)}
        if any(isinstance(value, matlab.MatlabOpaque) for value in content.values()):
            with open(path, "rb") as file:  # scipy calls all of them 'None': read each from its own file
                for name, part in matlab.varmats_from_mat(file):
                    if name == "None":
                        value = loadmat(part)[name]
                        tree[_ascii(value["s0"][0])] = _node_of_scipy(value, value, 1, limit)
    return tree


def _node_of_scipy(value: Any, stored: Any, depth: int, limit: _Limit) -> Node:
    """Return the node of a value that was loaded with the types of MATLAB, and as it is stored."""
    from scipy import sparse
    from scipy.io import matlab

    limit.check(depth)
    if sparse.issparse(value):
        return SPARSE
    if isinstance(value, matlab.MatlabFunction):
        return _object("function_handle")
    if isinstance(value, matlab.MatlabOpaque):
        return _object(_ascii(value["s2"][0]))
    if isinstance(value, matlab.MatlabObject):
        return _object(str(value.classname))
    if value is None:
        return {}
    if not isinstance(value, np.ndarray):
        return Refused(f"cannot be read ({str(value)[:200]})")
    if value.dtype.names:
        fields = value.dtype.names
        items = ({name: _node_of_scipy(one[name], other[name], depth + 1, limit) for name in fields}
                 for one, other in zip(value.ravel("F"), stored.ravel("F")))
        return next(items) if value.size == 1 else _elements("()", value.size, items)
    if value.dtype.kind == "O":
        return _elements("{}", value.size, (_node_of_scipy(one, other, depth + 1, limit)
                                            for one, other in zip(value.ravel("F"), stored.ravel("F"))))
    if stored.dtype.kind == "c":
        return COMPLEX
    if value.dtype.kind in "biuf":
        return _numbers(value.shape, lambda: value)
    return "\n".join(map(str, value.ravel()[:LONGEST_TEXT]))[:LONGEST_TEXT]


def _ascii(text: Any) -> str:
    return text.decode("latin1") if isinstance(text, bytes) else str(text)


# -- version 7.3, and other HDF5


class _Hdf5:
    """Reads nodes of an HDF5 file; MATLAB stores its columns as rows there."""

    def __init__(self, file: Any, by_matlab: bool) -> None:
        import h5py

        self.h5py, self.file, self.by_matlab, self.limit = h5py, file, by_matlab, _Limit()

    def tree(self) -> dict[str, Node]:
        return self._fields(self.file, "", [self.file.id])

    def _fields(self, group: Any, prefix: str, above: list[Any]) -> dict[str, Node]:
        found = {}
        for key in group:
            if len(key) > LONGEST_NAME:
                raise ValueError(f"it holds a name of {len(key)} characters")
            link = group.get(key, getlink=True)
            if isinstance(link, self.h5py.ExternalLink):
                raise ValueError(f"{prefix + key!r} is a link to another file, {link.filename!r}: optid follows none")
            if not isinstance(link, self.h5py.SoftLink) and not key.startswith("#"):
                found[key] = self._node(group[key], prefix + key, above)
        return found

    def _node(self, item: Any, name: str, above: list[Any]) -> Node:
        self.limit.check(len(above))
        if item.id in above:
            raise ValueError(f"{name[:80]!r} holds itself")
        above = [*above, item.id]
        kind = _ascii(item.attrs.get("MATLAB_class", ""))
        if isinstance(item, self.h5py.Group):
            return self._group(item, name, kind, above)
        if not isinstance(item, self.h5py.Dataset):
            return Refused("is neither data nor a group of data")
        if item.external or item.is_virtual:
            raise ValueError(f"the samples of {name!r} are stored in another file: optid opens none")
        is_reference = self.h5py.check_ref_dtype(item.dtype) is self.h5py.Reference
        if item.attrs.get("MATLAB_empty", 0) or item.shape is None:
            return "" if kind == "char" else Refused(EMPTY)
        if kind == "char":
            rows = np.atleast_2d(item[()].T) if item.size <= LONGEST_TEXT else []
            return "\n".join("".join(map(chr, row)) for row in rows)
        if kind == "cell" or not kind and is_reference:
            return _elements("{}", item.size, (self._referred(one, name, above) for one in np.ravel(item[()])))
        if kind and kind not in NUMERIC or item.attrs.get("MATLAB_object_decode", 0):
            return _object(kind)
        if item.dtype.kind == "c" or item.dtype.names == ("real", "imag"):
            return COMPLEX
        if item.dtype.kind not in "biuf":
            return ""
        logical = kind == "logical"
        shape = item.shape[::-1] if self.by_matlab else item.shape

        def load() -> np.ndarray:
            array = item[()]
            array = array.T if self.by_matlab else array
            return array.astype(bool) if logical else array

        return _numbers(shape, load)

    def _group(self, group: Any, name: str, kind: str, above: list[Any]) -> Node:
        if "MATLAB_sparse" in group.attrs:
            return SPARSE
        if kind not in ("", "struct") or group.attrs.get("MATLAB_object_decode", 0):
            return _object(kind)
        columns = self._columns_of_structures(group)
        if not columns:
            return self._fields(group, name + ".", above)
        rows = zip(*(np.ravel(item[()]) for item in columns.values()))
        return _elements("()", next(iter(columns.values())).size, (
            {key: self._referred(one, f"{name}.{key}", above) for key, one in zip(columns, row)} for row in rows))

    def _columns_of_structures(self, group: Any) -> dict[str, Any]:
        """Return the references of each field if a group is an array of structures, else nothing."""
        members = {key: group[key] for key in group
                   if group.get(key, getclass=True, getlink=True) is self.h5py.HardLink}
        shapes = {getattr(item, "shape", None) for item in members.values()}
        if len(members) < len(group) or len(shapes) != 1 or not all(
                isinstance(item, self.h5py.Dataset) and "MATLAB_class" not in item.attrs
                and self.h5py.check_ref_dtype(item.dtype) is self.h5py.Reference for item in members.values()):
            return {}
        return members

    def _referred(self, reference: Any, name: str, above: list[Any]) -> Node:
        if not reference:
            return Refused(EMPTY)
        return self._node(self.file[reference], name, above)

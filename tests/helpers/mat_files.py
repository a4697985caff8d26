"""Write the same variables as MAT files of version 5 and of version 7.3, as MATLAB does."""

import string
import struct
from itertools import count, product

import numpy as np
import pytest
from scipy import sparse
from scipy.io import savemat
from scipy.io.matlab import MatlabObject

VERSIONS = ("5", "7.3")


class Cell(list):
    """A cell array: a row, or rows of the same length."""


class Object:
    """An object of a MATLAB class, whose contents are not written."""

    def __init__(self, kind):
        self.kind = kind


def write_mat(path, variables, version, **options):
    """Write {name: array, text, dict (structure), list of dicts (array of structures), Cell or Object}."""
    (_write_5 if version == "5" else _write_73)(path, variables, **options)
    return path


def _as_2d(value):
    array = np.asarray(value)
    return array.reshape(1, -1) if array.ndim < 2 else array


# -- version 5


def _write_5(path, variables, **options):
    plain = {name: _value_5(value) for name, value in variables.items() if not isinstance(value, Object)}
    savemat(path, plain, **options)
    with open(path, "ab") as file:
        for name, value in variables.items():
            if isinstance(value, Object):
                file.write(_opaque(name, value.kind))


def _value_5(value):
    if isinstance(value, dict):
        return {key: _value_5(item) for key, item in value.items()}
    if isinstance(value, Cell):
        cells = np.empty(len(value), object)
        for k, item in enumerate(value):
            cells[k] = _value_5(item)
        return cells[None]
    if isinstance(value, list):
        array = np.empty(len(value), [(key, object) for key in value[0]])
        for k, item in enumerate(value):
            array[k] = tuple(_value_5(item[key]) for key in value[0])
        return array[None]
    if isinstance(value, Object):  # within a structure scipy writes objects of the old kind only
        return MatlabObject(np.array([[(1.0,)]], [("p", object)]), value.kind)
    return value if isinstance(value, str) or sparse.issparse(value) else _as_2d(value)


def _opaque(name, kind):
    """Return the bytes of an object of a class defined by classdef."""

    def element(code, data):
        return struct.pack("<II", code, len(data)) + data.ljust(-(-len(data) // 8) * 8, b"\0")

    handle = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    handle = element(14, handle + element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1)))
    parts = [element(1, text.encode()) for text in (name, "MCOS", kind)]
    return element(14, element(6, struct.pack("<II", 17, 0)) + b"".join(parts) + handle)


# -- version 7.3


def _write_73(path, variables, matlab=True, **options):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        names = ("".join(letters) for size in count(1) for letters in product(string.ascii_letters, repeat=size))
        writer = _Writer(h5py, file, names, options)
        for name, value in variables.items():
            writer.write(file, name, value)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(124) + b"\x00\x02IM")


class _Writer:
    def __init__(self, h5py, file, names, options):
        self.h5py, self.file, self.names, self.options = h5py, file, names, options

    def write(self, group, name, value):
        if isinstance(value, dict):
            item = group.create_group(name)
            for key, part in value.items():
                self.write(item, key, part)
            return self.of_class(item, "struct")
        if isinstance(value, Cell):
            item = self.references(group, name, value) if value else self.numbers(group, name, np.zeros((0, 0)))
            return self.of_class(item, "cell")
        if isinstance(value, list):
            item = group.create_group(name)
            for key in value[0]:
                self.references(item, key, [one[key] for one in value])
            return self.of_class(item, "struct")
        if isinstance(value, Object):
            item = group.create_dataset(name, data=np.array([[0xDD000000, 2, 1, 1, 1, 1]], np.uint32))
            item.attrs["MATLAB_object_decode"] = np.int32(3)
            return self.of_class(item, value.kind)
        if isinstance(value, str):
            item = group.create_dataset(name, data=np.array([[ord(c)] for c in value], np.uint16))
            return self.of_class(item, "char")
        if sparse.issparse(value):
            item, columns = group.create_group(name), sparse.csc_matrix(value)
            item["data"], item["ir"], item["jc"] = columns.data, columns.indices, columns.indptr
            item.attrs["MATLAB_sparse"] = np.uint64(value.shape[0])
            return self.of_class(item, "double")
        return self.numbers(group, name, _as_2d(value))

    def numbers(self, group, name, array):
        kinds = {"float64": "double", "complex128": "double", "float32": "single", "complex64": "single",
                 "bool": "logical"}
        kind = kinds.get(array.dtype.name, array.dtype.name)
        if array.size == 0:
            item = group.create_dataset(name, data=np.array(array.shape, np.uint64))
            item.attrs["MATLAB_empty"] = np.int32(1)
        elif array.dtype.kind == "c":
            pairs = np.empty(array.shape, [("real", "f8"), ("imag", "f8")])
            pairs["real"], pairs["imag"] = array.real, array.imag
            item = group.create_dataset(name, data=pairs.T)
        else:
            stored = array.astype(np.uint8) if kind == "logical" else array
            packed = {"compression": "gzip", "chunks": True} if self.options.get("do_compression") else {}
            item = group.create_dataset(name, data=stored.T, **packed)
        if kind == "logical":
            item.attrs["MATLAB_int_decode"] = np.int32(1)
        return self.of_class(item, kind)

    def references(self, group, name, values):
        there = self.file.require_group("#refs#")
        refs = np.empty((len(values), 1), self.h5py.ref_dtype)
        for k, value in enumerate(values):
            refs[k, 0] = self.write(there, next(self.names), value).ref
        return group.create_dataset(name, data=refs, dtype=self.h5py.ref_dtype)

    def of_class(self, item, kind):
        item.attrs["MATLAB_class"] = np.bytes_(kind)
        return item

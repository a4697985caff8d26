"""Damaged files end in an error of optid that names the file, in bounded time; some are still good, and are read."""

import time
import warnings

import numpy as np
import polars as pl
import pytest
from damage import bytes_of
from refusals import refuses
from scipy.io import savemat

import optid
from optid.data.reading import csvfile
from optid.errors import DataError, OptidError

U, Y = np.arange(60.0)[:, None], np.sin(np.arange(60.0))[:, None]


def good_file(kind, folder):
    """Write a good file of a kind and return its path."""
    path = folder / f"r.{kind.split('-')[0]}"
    if kind == "csv":
        rows = [f"{0.1 * k:.1f},{u:.3f},{y:.6f}" for k, (u, y) in enumerate(zip(U[:, 0], Y[:, 0]))]
        path.write_text("t,u,y\n" + "\n".join(rows))
    elif kind == "parquet":
        pl.DataFrame({"u": U[:, 0], "y": Y[:, 0], "run": ["a"] * 60}).write_parquet(path)
    elif kind == "npz":
        np.savez(path, u=U, y=Y, fs=3.0)
    elif kind == "npz-packed":
        np.savez_compressed(path, u=U, y=Y)
    elif kind == "npy":
        np.save(path, np.hstack([U, Y]))
    elif kind == "mat":
        savemat(path, {"u": U, "y": Y, "log": {"u": U, "note": "x"}})
    elif kind == "mat-packed":
        savemat(path, {"u": U, "y": Y}, do_compression=True)
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["u"], file["y"], file["log/u"] = U.T, Y.T, U.T
        with open(path, "r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    return path


def outcome(path, read):
    """Return "read" or "refused"; anything but an error of optid that names the file is a failure."""
    started = time.monotonic()
    try:
        with warnings.catch_warnings(action="ignore", category=optid.errors.DataWarning):
            read()
    except OptidError as error:
        assert path.name in str(error) or "channel" in str(error), error
        assert len(str(error)) < 3000
        return "refused"
    finally:
        assert time.monotonic() - started < 30
    return "read"


def read_record(path, read=optid.read):
    found = read(path, **({"inputs": 0, "outputs": 1} if path.suffix == ".npy" else {}))
    assert isinstance(found, optid.Data) or list(found)  # a pass over a stream


@pytest.mark.sampled(4)
@pytest.mark.parametrize(("kind", "read"), [
    *((kind, optid.read) for kind in ("csv", "parquet", "npz", "npz-packed", "npy")),
    *((kind, optid.open_stream) for kind in ("csv", "parquet", "npy"))])
def test_damaged_records_and_streams(tmp_path, monkeypatch, kind, read):
    monkeypatch.setattr(csvfile, "SMALL", -1)
    path = good_file(kind, tmp_path)
    assert outcome(path, lambda: read_record(path, read)) == "read"
    found = []
    for bad in bytes_of(path.read_bytes(), 200, seed=1 if read is optid.read else 2):
        path.write_bytes(bad)
        found.append(outcome(path, lambda: read_record(path, read)))
    assert found.count("refused") > 20


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["mat", "mat-packed", "mat-7.3"])
@pytest.mark.parametrize("count", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_damaged_mat_files(tmp_path, kind, count):
    path = good_file(kind, tmp_path)
    assert outcome(path, lambda: read_record(path)) == "read"
    found = []
    for bad in bytes_of(path.read_bytes(), count, seed=3):
        path.write_bytes(bad)
        found.append(outcome(path, lambda: read_record(path)))
    assert "refused" in found


def test_a_changed_page_of_a_parquet_file_with_checksums_is_never_read(tmp_path):
    """Of random single bits in the pages every one is noticed; without a check most would change a sample."""
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    r = np.random.default_rng(4)
    path = tmp_path / "r.parquet"
    table = pa.table({"u": r.normal(size=400), "y": r.normal(size=400)})
    pq.write_table(table, path, compression="none", use_dictionary=False, write_page_checksum=True)
    whole = path.read_bytes()
    for at in r.integers(80, 6000, 60):
        changed = bytearray(whole)
        changed[at] ^= 1 << int(r.integers(0, 8))
        path.write_bytes(changed)
        for read in (optid.read, lambda path: list(optid.open_stream(path))):
            refuses(DataError, "r.parquet is not a Parquet file, or it is damaged", read, path)

"""Damaged tables and impossible words: read, or refused by a named error, never a crash or a bare one."""

import warnings
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from plant_exports import EXPORTS

import optid
from optid.errors import OptidError

PIECES = [b",", b";", b"\t", b'"', b"'", b"\n", b"\r", b"\r\n", b"\0", b" ", b"-", b".", b"e", b"1e999", b"nan", b"#",
          b"\xff", b"\xef\xbb\xbf", b"\xfe\xff", b"2024-05-01", b"24:00:00", b"99/99/9999", b"9999-12-31T23:59:59.999Z",
          b"0000-00-00", b"1" * 400, "\u0663".encode(), b"NaT", b"time", b"t,t", b"sep=", b"***End_of_Header***\n"]

VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 3, 1e9, 10**30, 0.5, -0.5, float("nan"), float("inf"), "", " ", "x", ",", ";", ".",
    "\t", "\\t", "missing", "experiments", "1s", "-1s", "5 min", "1e400", "Europe/Berlin", "%Y", "%",
    "%d.%m.%Y %H:%M:%S", "%f", "utf-8", "utf-16", "latin-1", "rot13", "idna", "u", "y", "time", ["u"],
    ["u", "y"], ["u", "y", "time"], {"u": 1}, {"u": None}, {"y": "x"}, [None], [[1]], object(), b"x", np.arange(3),
    "2024-05-01", "9999-99-99", np.datetime64("2024-05-01"), np.datetime64("NaT"), "u:192", "-9999", "BAD,NO DATA",
    ("a", 1)]


def damaged(text: bytes, r: np.random.Generator) -> bytes:
    """Return a file with a few random changes."""
    changed = bytearray(text)
    for _ in range(r.integers(1, 5)):
        at = int(r.integers(0, max(len(changed), 1)))
        kind = r.integers(0, 6)
        if kind == 0:
            changed = changed[:at]
        elif kind == 1 and changed:
            changed[at] ^= 1 << int(r.integers(0, 8))
        elif kind == 2:
            changed[at:at] = PIECES[r.integers(0, len(PIECES))]
        elif kind == 3:
            lines = changed.split(b"\n")
            a, b = r.integers(0, len(lines), 2)
            lines[a], lines[b] = lines[b], lines[a]
            changed = bytearray(b"\n".join(lines))
        elif kind == 4:
            changed[at : at + int(r.integers(1, 40))] = b""
        else:
            stop = at + int(r.integers(1, 400))
            changed[stop:stop] = changed[at:stop]
    return bytes(changed)


def arguments(r: np.random.Generator) -> dict[str, Any]:
    """Return some random words with random values."""
    known = [*(field.name for field in fields(optid.Format)), "dt", "time", "experiment", "inputs", "outputs", "name"]
    chosen = r.choice(known, r.integers(0, 4), replace=False)
    return {str(word): VALUES[r.integers(0, len(VALUES))] for word in chosen}


def attempt(path, seed: int) -> str:
    """Read a damaged file with random words, whole or as a stream; return what came of it."""
    r = np.random.default_rng(seed)
    export = EXPORTS[r.integers(0, len(EXPORTS))]
    path = path / f"{seed % 7}{['.csv', '.txt', '.dat', '.tsv'][r.integers(0, 4)]}"
    path.write_bytes(damaged(export.write(), r) if r.random() < 0.8 else export.write())
    words = {"inputs": export.channels[0], "outputs": export.channels[1]} | (
        dict(export.words) if r.random() < 0.7 else {}) | (arguments(r) if r.random() < 0.4 else {})
    try:
        with warnings.catch_warnings(action="error"):
            if r.random() < 0.8:
                data = optid.read(path, **words)
                assert str(data) and data.n_samples and np.isfinite(data.dt) and len(data.to_pandas()) == len(data)
            else:
                stream = optid.open_stream(path, **words)
                assert sum(len(u) for u, _ in stream) > 0
        return "read"
    except OptidError as error:
        assert str(error)
        return "refused"


@pytest.mark.parametrize("small", [1 << 18, -1])
@pytest.mark.parametrize("part", range(2))
def test_no_table_and_no_word_ends_in_a_bare_error(tmp_path, monkeypatch, small, part):
    monkeypatch.setattr("optid.data.reading.csvfile.SMALL", small)
    came = [attempt(tmp_path, seed) for seed in range(1000 * part, 1000 * part + 60)]
    assert came.count("read") > 3 and came.count("refused") > 15


@pytest.mark.slow
@pytest.mark.parametrize("small", [1 << 18, -1])
@pytest.mark.parametrize("part", range(5))
def test_no_table_and_no_word_of_many_ends_in_a_bare_error(tmp_path, monkeypatch, small, part):
    monkeypatch.setattr("optid.data.reading.csvfile.SMALL", small)
    for seed in range(10_000 + 1000 * part, 10_000 + 1000 * part + 260):
        attempt(tmp_path, seed)

"""What loggers, historians and spreadsheets export is read right, or refused with what to type."""

import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest
from plant_exports import EXPORTS, GAIN, POLE, Export
from typer.testing import CliRunner

import optid
from optid.cli.app import app
from optid.cli.options import in_options, option_of
from optid.errors import DataError

FORMATS = Path(__file__).parents[2] / "docs" / "formats.md"
BY_NAME = {one.name: one for one in EXPORTS}


def plant(data: optid.Data, scale: float) -> tuple[float, float]:
    """Return gain and pole of a first order model by least squares over the samples that are there."""
    u, y, after = (np.concatenate(parts) for parts in zip(*(
        (e.u[:-1, 0] / scale, e.y[:-1, 0], e.y[1:, 0]) for e in data.experiments)))
    here = np.isfinite(u + y + after)
    (pole, gain), *_ = np.linalg.lstsq(np.column_stack([y, u])[here], after[here], rcond=None)
    return gain / (1 - pole), pole


def is_read_right(export: Export, data: optid.Data) -> bool:
    gain, pole = plant(data, export.scale)
    near = 0.05 if "resample" in export.words else 0.02
    return abs(gain / GAIN - 1) < near and abs(pole - POLE) < near and data.dt == pytest.approx(export.dt, rel=1e-9)


@pytest.mark.parametrize("export", [one for one in EXPORTS if not one.refusal and not one.words], ids=lambda e: e.name)
def test_files_without_traps_are_read_as_they_are(export, tmp_path):
    data = optid.read(export.file(tmp_path), *export.channels)
    assert is_read_right(export, data) and data.n_samples == 240 and not any(data.missing.values())
    assert any(export.finding in one for one in data.findings) if export.finding else not data.findings


@pytest.mark.parametrize("export", [one for one in EXPORTS if one.refusal], ids=lambda e: e.name)
def test_what_is_refused_says_what_to_type(export, tmp_path):
    with pytest.raises(DataError) as error:
        optid.read(export.file(tmp_path), *export.channels)
    assert export.refusal in str(error.value)
    for word, value in export.words.items():
        assert f"{word}=" in str(error.value)
        if word not in ("time_tolerance", "missing", "resample"):  # one of several that serve
            assert f"{word}={value!r}" in str(error.value)


@pytest.mark.parametrize("export", [one for one in EXPORTS if one.words], ids=lambda e: e.name)
@pytest.mark.parametrize("small", [1 << 20, -1])
def test_with_its_words_a_file_is_read_right(export, tmp_path, monkeypatch, small):
    monkeypatch.setattr("optid.data.reading.csvfile.SMALL", small)
    data = optid.read(export.file(tmp_path), *export.channels, **export.words)
    assert is_read_right(export, data)
    assert round(data.missing[data.outputs[0]] * data.n_samples) == export.missing
    assert not export.finding or any(export.finding in one for one in data.findings) or not export.refusal


def test_a_mark_of_missing_samples_is_told(tmp_path):
    export = BY_NAME["markers.csv"]
    assert any(export.finding in one for one in optid.read(export.file(tmp_path)).findings)
    assert not optid.read(tmp_path / export.name, **export.words).findings


@pytest.mark.sampled(3)
@pytest.mark.parametrize("export", [one for one in EXPORTS if one.words or not one.refusal], ids=lambda e: e.name)
def test_the_command_reads_the_same(export, tmp_path):
    words = ["look", export.file(tmp_path), "--inputs", export.channels[0], "--outputs", export.channels[1]]
    for word, value in export.words.items():
        words += [option_of(word), value]
    result = CliRunner().invoke(app, list(map(str, words)))
    assert result.exit_code == 0, result.output
    read = optid.read(tmp_path / export.name, *export.channels, **export.words)
    assert result.output.startswith(str(read.with_findings(in_options(one, True) for one in read.findings)).strip())


@pytest.mark.parametrize("export", [one for one in EXPORTS if one.refusal and one.words], ids=lambda e: e.name)
def test_the_refusal_of_the_command_can_be_typed(export, tmp_path):
    """The options that a refusal names, typed as they stand there, read the file right."""
    words = ["look", str(export.file(tmp_path)), "--inputs", export.channels[0], "--outputs", export.channels[1]]
    for _ in range(3):
        result = CliRunner().invoke(app, words)
        if result.exit_code == 0:
            break
        text = result.output.partition(" (or ")[0].partition("If the stamps are wrong")[0]
        found = [shlex.split(one) for one in re.findall(r"--[a-z-]+ (?:'[^']*'|[\w.-]*\w)", text)]
        assert found, result.output
        given = {option for option, _ in found}
        words = [word for word in words if word not in given] + [
            word for option, value in found if not (option == "--resample" and "--gaps" in given)
            for word in (option, value)]
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize("export", [one for one in EXPORTS if one.name.endswith(".csv")
                                    and "encoding" not in one.words], ids=lambda e: e.name)
def test_through_frames_nothing_is_silently_wrong(export, tmp_path):
    """A frame that pandas or polars made of the file: read right, or refused by name."""
    path = export.file(tmp_path)
    makers = [lambda: pd.read_csv(path), lambda: pd.read_csv(path, sep=None, engine="python"),
              lambda: pl.read_csv(path, truncate_ragged_lines=True, ignore_errors=True)]
    words = {word: value for word, value in export.words.items() if word not in ("delimiter", "skip_rows", "comment")}
    outcomes = []
    for make in makers:
        try:
            frame = make()
        except Exception:  # not a table for the library
            continue
        for more in ({}, words):
            try:
                data = optid.read(frame, *export.channels, **more)
            except DataError:
                outcomes.append("refused")
                continue
            told = any("quality" in one or "far from all others" in one for one in data.findings)
            outcomes.append("read" if told or is_read_right(export, data) else "wrong")
    assert "wrong" not in outcomes, outcomes


def outcome(export: Export, folder: Path) -> str:
    """Return the row of a file in the table of the documentation."""
    try:
        data = optid.read(export.file(folder), *export.channels)
        finding = data.findings[0].partition(". Pass")[0].partition("; pass")[0] if data.findings else ""
        default = f"read; {finding}" if finding else "read"
    except DataError as error:
        assert export.refusal in str(error)
        default = f"refused: {export.refusal}"
    words = " ".join(f"`{option_of(word)} {shlex.quote(str(value))}`" for word, value in export.words.items())
    return f"| {export.about} | {default} | {words or '–'} |"


def test_the_documentation_lists_what_is_read(tmp_path):
    rows = [outcome(one, tmp_path) for one in EXPORTS]
    print("\n".join(rows))
    text = FORMATS.read_text(encoding="utf-8")
    assert "\n".join(rows) in text, "\n".join(["the table of docs/formats.md is not that of this test:", *rows])

"""Commands in encodings that lack some of what they print."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import optid
from optid.cli.app import app
from optid.cli.encoding import substitute

ENCODINGS = ["ascii", "cp1252", "latin-1"]
ODD = {"inputs": "σ₁ ≤ 温", "outputs": "‖ÿ‖² → Ω"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A record with names that none of these encodings has."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("odd")
    u, y = rng.uniform(-1, 1, 200), np.zeros(200)
    for k in range(1, 200):
        y[k] = 0.6 * y[k - 1] + u[k - 1] ** 3 + 0.02 * rng.normal()
    rows = "\n".join(f"{a},{b}" for a, b in zip(u, y))
    (path / "r.csv").write_text(f"{ODD['inputs']},{ODD['outputs']}\n{rows}\n", encoding="utf-8")
    return path


def run(encoding, *words):
    found = CliRunner(charset=encoding).invoke(app, list(map(str, words)))
    assert not isinstance(found.exception, UnicodeError), found.exception
    text = found.stdout_bytes.decode(encoding)
    assert "codec can't encode" not in text + found.stderr_bytes.decode(encoding)
    return found.exit_code, text


@pytest.mark.sampled(1)
@pytest.mark.parametrize("encoding", ENCODINGS[:2])
def test_a_record_with_any_names_is_fitted_validated_and_searched(folder, encoding):
    words = [folder / "r.csv", "--inputs", ODD["inputs"], "--outputs", ODD["outputs"], "--dt", "1"]
    code, text = run(encoding, "fit", *words, "--formulation", "hammerstein_arx.exact", "--na", 1, "--nb", 1, "--basis",
                     "triangular:4", "-m", folder / "m.json", "-o", folder / "r.html")
    assert code == 0 and "sigma1 <= ?" in text
    assert ("|ÿ|² -> Omega" if encoding != "ascii" else "|y|^2 -> Omega") in text
    assert run(encoding, "validate", folder / "m.json", folder / "r.csv")[0] == 0
    assert optid.load(folder / "m.json").inputs == (ODD["inputs"],)  # files have every character
    code, _ = run(encoding, "identify", *words, "--effort", "0.5")
    assert code == 0
    assert run(encoding, "fit", folder / "r.csv", "--inputs", "温")[0] == 2


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("words", [["--help"], ["formulations"], ["constraints"], ["examples"], ["solvers"],
                                   ["study", "systems"], ["study", "schema"], ["nöpe≤"]])
def test_lists_and_refusals_print(encoding, words):
    code, _ = run(encoding, *words)
    assert code == (2 if words == ["nöpe≤"] else 0)


@pytest.mark.parametrize("command", [one.name or one.callback.__name__ for one in app.registered_commands])
def test_every_help_prints_in_ascii(command):
    assert run("ascii", command, "--help")[0] == 0


def test_what_optid_prints_has_readable_substitutes():
    home = Path(optid.__file__).parent
    read_only = home / "data" / "reading" / "clock.py"  # words of many languages for a clock, which are never printed
    written = {c for path in [*home.rglob("*.py"), *(home.parent / "formulations").rglob("*.py")]
               if path != read_only for c in path.read_text(encoding="utf-8") if not c.isascii()}
    without = {c for c in written | set("σμθλφΩ₁₂⁻−≤≥→≈½éšŁ") if "?" in substitute(c)}
    assert not without


def test_every_character_has_a_substitute_in_ascii():
    assert all(substitute(chr(code)).isascii() for code in range(128, 0x11000))


def test_the_streams_are_as_before():
    import sys

    before = sys.stdout.errors, sys.stderr.errors
    with pytest.raises(SystemExit):
        app(["--version"])
    assert (sys.stdout.errors, sys.stderr.errors) == before
